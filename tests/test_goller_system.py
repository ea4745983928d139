"""Goller et al.: the whole system, offline and as a tracer."""

from __future__ import annotations

import dataclasses

import goller_scenes as scenes
import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.baselines import host_trace
from tagjax.baselines.goller import GollerSettings, GollerTracer
from tagjax.baselines.goller.detection import BlobSettings
from tagjax.baselines.goller.experiment.rates import Example, outcomes, rates
from tagjax.baselines.goller.matching import associate
from tagjax.baselines.goller.offline import estimate, observe
from tagjax.baselines.goller.room import find_room_frame
from tagjax.baselines.goller.truth import true_states, true_tags
from tagjax.recording import TagReads
from tagjax.recording.reads import concatenate_reads


@pytest.fixture(scope="module")
def shop():
    return scenes.shop()


@pytest.fixture(scope="module")
def calibration():
    return scenes.calibration()


def test_the_leaver_is_alarmed_and_still_tags_are_not(shop, calibration):
    observed = observe(shop, scenes.LOOKING_DOWN)
    estimates = estimate(calibration, observed, scenes.LOOKING_DOWN)
    score = dict(zip(observed.epcs, np.max(np.asarray(estimates.exit_score), axis=1), strict=True))
    assert score["leaver"] > 0.9
    assert score["shelf"] < 0.1
    assert score["near"] < 0.2
    states = true_states(observed, true_tags(shop))
    leaver = observed.epcs.index("leaver")
    best = np.argmax(np.asarray(estimates.probability[leaver]), axis=1)
    # Location by proximity stays at an antenna until the next one is stronger: there a walker's tag counts as background
    # (Eq. 4). In the exit region, where alarms are due, the location has just moved on.
    beyond = scenes.frames_beyond_exit(scenes.straight((4.6, 0.3), (-1.6, 0.3)))
    assert np.all(states[leaver][beyond] > 0)
    np.testing.assert_array_equal(best[beyond], states[leaver][beyond])
    speed = np.linalg.norm(np.asarray(estimates.location.velocity_m_s[leaver]), axis=1)
    stationary = (states[leaver] > 0) & (speed < 0.3)
    assert stationary.sum() > 5
    assert not best[stationary].any()
    found = outcomes(calibration, [Example("sp_st_still", observed, true_tags(shop))], scenes.LOOKING_DOWN)
    counted = rates(found, "fused", 0.5)
    assert (counted.num_runs, counted.num_leaves, counted.num_still, counted.num_stays) == (1, 1, 2, 0)
    assert (counted.detected_run, counted.detected, counted.false_alarm) == (1.0, 1.0, 0.0)
    assert np.isnan(counted.false_alarm_stays)


def test_with_true_places_a_tag_is_its_carriers_all_the_way(shop, calibration):
    """Only location by proximity misses the middle of a walk: with true positions the association loses no frame."""
    observed, truth = observe(shop, scenes.LOOKING_DOWN), true_tags(shop)
    states = true_states(observed, truth)
    for epc in observed.epcs:
        row, tag = observed.epcs.index(epc), truth.epcs.index(epc)
        path = truth.position_m[tag].astype(np.float32)
        velocity = np.gradient(path, observed.time_s, axis=0).astype(np.float32)
        held = associate(
            calibration.association,
            jnp.asarray(observed.time_s),
            jnp.asarray(path),
            jnp.asarray(velocity),
            jnp.asarray(observed.rssi.received[:, row].any(axis=1)),
            jnp.asarray(observed.blobs.position_m),
            jnp.asarray(observed.blobs.identity),
        )
        known = states[row] >= 0
        best = np.argmax(np.asarray(held.probability), axis=1)
        # A new blob takes the tag over from the background within half a second.
        begun = np.cumsum(known & (states[row] > 0)) > 5
        counts = known & (begun | (states[row] == 0))
        assert counts.sum() > 40
        np.testing.assert_array_equal(best[counts], states[row][counts])


def test_more_tags_than_blobs_share_one_and_blobs_without_tags_are_nobodys(calibration):
    walk = scenes.straight((4.6, 0.4), (-1.6, 0.4))
    other = scenes.straight((0.4, -0.6), (4.4, -0.6))
    recording = scenes.drawn_shop({"a": walk}, {}, strangers=(other,))
    twins = recording.reads[recording.reads.epc == "a"]
    twins = dataclasses.replace(twins, epc=np.full(twins.num_reads, "b", "<U24"), time_ns=twins.time_ns + 1)
    both = concatenate_reads([recording.reads, twins])
    both = both[np.argsort(both.time_ns, kind="stable")]
    observed = observe(recording.with_reads(both), scenes.LOOKING_DOWN)
    estimates = estimate(calibration, observed, scenes.LOOKING_DOWN)
    best = np.argmax(np.asarray(estimates.probability), axis=2)
    assert observed.epcs == ("a", "b")
    assert np.mean(best[0] == best[1]) > 0.95
    beyond = scenes.frames_beyond_exit(walk)
    carrier = np.argmin(np.linalg.norm(observed.blobs.position_m[50] - walk[50], axis=1))
    np.testing.assert_array_equal(best[:, beyond], 1 + carrier)


def test_no_tags_and_no_blobs_are_defined(shop, calibration):
    silent = shop.with_reads(TagReads.empty())
    observed = observe(silent, scenes.LOOKING_DOWN)
    assert observed.epcs == ()
    assert observed.blobs.identity.any()
    found = outcomes(calibration, [Example("x", observed, true_tags(shop))], scenes.LOOKING_DOWN)
    assert [one.fused for one in found] == [0.0] * 3
    assert not any(one.read or np.isfinite(one.rfid) for one in found)
    still = dataclasses.replace(shop, colour=np.repeat(np.asarray(shop.colour)[:1], shop.num_frames, axis=0))
    estimates = estimate(calibration, observe(still, scenes.LOOKING_DOWN), scenes.LOOKING_DOWN)
    np.testing.assert_allclose(estimates.probability[..., 0], 1.0, rtol=1e-6)
    np.testing.assert_array_equal(estimates.exit_score, 0.0)


def test_one_sample_is_defined(shop, calibration):
    first = dataclasses.replace(
        shop, colour=shop.colour[:1], depth=shop.depth[:1], time_ns=shop.time_ns[:1], reads=shop.reads[:1]
    )
    observed = observe(first, scenes.LOOKING_DOWN)
    estimates = estimate(calibration, observed, scenes.LOOKING_DOWN)
    assert estimates.probability.shape == (1, 1, 7)
    assert np.isfinite(np.asarray(estimates.probability)).all()


def test_another_number_of_antennas_is_refused(shop, calibration):
    fewer = dataclasses.replace(shop, antennas_m=scenes.ANTENNAS_M[:2], reads=shop.reads[shop.reads.antenna < 3])
    with pytest.raises(ValueError, match="2 antennas, calibrated are 3"):
        estimate(calibration, observe(fewer, scenes.LOOKING_DOWN), scenes.LOOKING_DOWN)
    assert "calibrated are 3" in (GollerTracer(calibration, scenes.LOOKING_DOWN).inapplicable(fewer) or "")


@pytest.mark.ci
def test_the_tracer_agrees_with_the_whole_recording(shop, calibration):
    tracer = GollerTracer(calibration, scenes.LOOKING_DOWN).install(shop)
    traces = list(host_trace(tracer, shop))
    observed = observe(shop, scenes.LOOKING_DOWN)
    probability = np.asarray(estimate(calibration, observed, scenes.LOOKING_DOWN).probability)
    leaver = observed.epcs.index("leaver")
    overlap = []
    is_carried = np.argmax(probability[leaver], axis=1) > 0
    # In the exit region, where alarms are due, it is detected in every frame.
    assert is_carried[scenes.frames_beyond_exit(scenes.straight((4.6, 0.3), (-1.6, 0.3)))].all()
    for frame, trace in traces:
        best = int(np.argmax(probability[leaver, frame]))
        assert bool(trace.detected[leaver]) == (best > 0)
        if best:
            np.testing.assert_allclose(trace.confidence[leaver], probability[leaver, frame, best], atol=1e-4)
            truth = np.asarray(shop.truth.labels[frame]) == 1
            mask = trace.mask[leaver] > 0.5
            overlap.append((mask & truth).sum() / (mask | truth).sum())
            place = find_room_frame(shop).to_room(trace.centre_m[leaver][None].astype(float))[0]
            assert place[2] == pytest.approx(0.85, abs=0.01)
    assert len(overlap) == is_carried.sum()
    assert np.mean(overlap[3:-10]) > 0.7
    assert not any(trace.detected[observed.epcs.index("shelf")] for _, trace in traces[10:])


def test_a_tracer_without_commissioning_learns_the_background_itself(calibration):
    # The first frame is the background; a person who enters later is a blob.
    walk = scenes.straight((7.5, 0.3), (0.3, 0.3), wait=0)
    recording = scenes.drawn_shop({"a": walk}, {})
    settings = dataclasses.replace(
        scenes.LOOKING_DOWN, blobs=dataclasses.replace(scenes.LOOKING_DOWN.blobs, warm_up="online")
    )
    tracer = GollerTracer(calibration, settings, room=find_room_frame(recording))
    assert sum(bool(trace.detected[0]) for _, trace in host_trace(tracer, recording)) > 15


def test_a_state_is_stepped_once_and_depth_is_refused(shop, calibration):
    from tagjax.baselines import HostCamera, host_frames

    tracer = GollerTracer(calibration, scenes.LOOKING_DOWN).install(shop)
    camera = HostCamera(scenes.LENS, scenes.ANTENNAS_M, ("leaver",))
    state, frame = tracer.init(camera), next(host_frames(shop, ["leaver"]))
    after, _ = tracer.step(camera, state, frame)
    assert tracer.finish(after) is not None
    with pytest.raises(ValueError, match="stepped already"):
        tracer.step(camera, state, frame)
    with pytest.raises(ValueError, match="does not see"):
        GollerTracer(calibration, GollerSettings(blobs=BlobSettings(position="depth")))


def test_recordings_that_it_cannot_do_are_named(shop, calibration):
    tracer = GollerTracer(calibration)
    one = dataclasses.replace(shop, antennas_m=scenes.ANTENNAS_M[:1], reads=shop.reads[shop.reads.antenna == 1])
    assert "there is 1" in (tracer.inapplicable(one) or "")
    mute = dataclasses.replace(shop.reads, rssi_dbm=np.full(shop.reads.num_reads, np.nan, np.float32))
    assert "no RSSI" in (tracer.inapplicable(shop.with_reads(mute)) or "")
    blind = dataclasses.replace(shop, depth=np.zeros_like(shop.depth))
    assert tracer.inapplicable(blind) is None  # it uses no depth
    assert next(host_trace(tracer, blind))[0] == 0
    in_rows = dataclasses.replace(shop, antennas_m=np.array([[x, 0.0, 0.0] for x in (0.0, 2.1, 4.2)]))
    assert "picture's rows" in (tracer.inapplicable(in_rows) or "")
    assert tracer.install(shop).inapplicable(shop) is None
