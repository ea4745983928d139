"""Error budgets: each swap puts the truth where it says, and nothing else changes."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import synthetic_clips as synthetic
import yaml
from composed import composed

from experiments.suites import suites_named
from tagjax.core.numerics import SPEED_OF_LIGHT_M_S
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation.error_budget import BudgetConfig, run_budget
from tagjax.evaluation.error_budget.cut import Uncut, best_mask, with_best_cuts
from tagjax.evaluation.error_budget.objects import numbered, with_objects
from tagjax.evaluation.error_budget.reads import RSSI_DBM, TrueReads, with_true_reads
from tagjax.evaluation.error_budget.swaps import make_swaps, swapped_traces
from tagjax.evaluation.error_budget.table import MEASURES, BudgetRow, markdown
from tagjax.metrics.interval import Estimate
from tagjax.metrics.recordings import ScoreSettings
from tagjax.recording import Recording, RecordingError
from tagjax.report.intervals import interval_bars
from tagjax.sim.suites import Item, Suite
from tagjax.tagattention.published import TagAttentionPublished
from tagjax.tagattention.tracer_settings import make_tracer
from tagjax.tracing.clips import load_clip
from tagjax.tracing.recordings import trace_recording

ROOT = Path(__file__).parents[1]
QUIET = ScoreSettings(min_pixels=2, num_pictures=0)


def _walkers_item() -> Item:
    """The item of the recording `small_walkers`."""
    settings = yaml.safe_load((ROOT / "conf" / "suite" / "walkers.yaml").read_text())
    (item,) = from_mapping(Suite, settings, where="suite").smoke().items()
    return item


def _without_flow(recording: Recording) -> Recording:
    return dataclasses.replace(
        recording, truth=dataclasses.replace(recording.truth, flow_px=None, backward_flow_px=None)
    )


def test_exact_flow_is_the_simulators(small_walkers: Recording) -> None:
    from tagjax.sim.flow_truth import with_exact_flow

    item = _walkers_item()
    found = with_exact_flow(item, _without_flow(small_walkers)).truth
    for name in ("flow_px", "backward_flow_px"):
        np.testing.assert_allclose(getattr(found, name), getattr(small_walkers.truth, name), atol=1e-3)
    assert np.abs(np.nan_to_num(np.asarray(found.flow_px))).max() > 1
    assert with_exact_flow(item, small_walkers) is small_walkers
    another = dataclasses.replace(item, seed=item.seed + 1)
    with pytest.raises(RecordingError, match="found another world"):
        with_exact_flow(another, _without_flow(small_walkers))


@pytest.mark.parametrize("dwell_s", [None, 0.2])
def test_true_reads_have_the_phase_of_the_distance_and_no_gap(dwell_s: float | None) -> None:
    recording = synthetic.recording(40)
    swapped = with_true_reads(recording, TrueReads(reads_per_s=50.0, dwell_s=dwell_s))
    frame_s = recording.frame_time_s()
    assert swapped.truth is recording.truth
    assert swapped.reads.epcs == recording.reads.epcs
    for epc, label in synthetic.EPCS.items():
        reads = swapped.reads.select(epc)
        time_s = (reads.time_ns - recording.time_ns[0]) * 1e-9
        np.testing.assert_allclose(np.diff(time_s), 0.02, atol=1e-6)
        assert time_s[-1] > frame_s[-1] - 0.03
        distance_m = 2.0 + synthetic.offset_m(label, time_s)
        error = np.angle(
            np.exp(1j * (reads.phase_rad - 4 * np.pi * reads.carrier_hz * distance_m / SPEED_OF_LIGHT_M_S))
        )
        assert np.abs(error).max() < 0.03  # a tenth of a millimetre a degree: the spline between frames of 10 Hz
        assert len(np.unique(reads.carrier_hz)) == (1 if dwell_s is None else 2)
    unknown = dataclasses.replace(recording, truth=dataclasses.replace(recording.truth, tag_range_m={}))
    with pytest.raises(RecordingError, match="found no true distance"):
        with_true_reads(unknown, TrueReads())
    with pytest.raises(ValueError, match="reads_per_s is 0"):
        TrueReads(reads_per_s=0.0)


def test_true_reads_come_when_and_on_the_channel_that_the_recording_has() -> None:
    recording = synthetic.recording(40)
    rng, clean = np.random.default_rng(0), recording.reads
    few = np.sort(rng.choice(clean.num_reads, 150, replace=False))
    hops = 915e6 + 5e5 * rng.integers(0, 20, len(few))
    noise_rad = rng.uniform(0, 2 * np.pi, len(few))
    weak = np.full(len(few), -75, np.float32)
    disturbed = dataclasses.replace(
        clean[few], phase_rad=noise_rad, carrier_hz=hops, rssi_dbm=weak, phase_sign=-1, pi_flips=True
    )
    swapped = with_true_reads(recording.with_reads(disturbed), TrueReads())
    within = disturbed.time_ns <= recording.time_ns[-1]
    np.testing.assert_array_equal(swapped.reads.time_ns, disturbed.time_ns[within])
    np.testing.assert_array_equal(swapped.reads.epc, disturbed.epc[within])
    clip = load_clip(swapped, 0, 40, stride=1, flow="zero", epcs=list(synthetic.EPCS), estimator="truth")
    assert clip.frames.arrivals is not None
    arrivals = {name: np.asarray(values) for name, values in vars(clip.frames.arrivals).items()}
    valid, total = arrivals["valid"], 0
    assert valid.sum() >= within.sum() - 1  # a read at the time of the first frame is none of its own
    for tag, label in enumerate(synthetic.EPCS.values()):
        own = valid & (arrivals["tag"] == tag)
        time_s, carrier_hz = arrivals["time_s"][own], arrivals["carrier_hz"][own]
        expected = 4 * np.pi * carrier_hz * (2.0 + synthetic.offset_m(label, time_s)) / SPEED_OF_LIGHT_M_S
        error = np.angle(np.exp(1j * (arrivals["phase_rad"][own] - expected)))
        assert np.abs(error).max() < 0.03  # of the spline, and of single precision
        total += len(time_s)
    assert total == valid.sum()
    assert set(arrivals["channel"][valid].tolist()) == set(np.rint(1e-3 * hops[within]).astype(int).tolist())  # kHz
    assert arrivals["rssi_dbm"][valid].min() == RSSI_DBM


def test_objects_are_the_labels_at_the_working_resolution(small_walkers: Recording) -> None:
    clip = load_clip(small_walkers, 2, 6, stride=2, flow="truth", estimator="truth")
    given = with_objects(clip, small_walkers, 2)
    labels = np.asarray(small_walkers.truth.labels[2:6])[:, ::2, ::2]
    np.testing.assert_array_equal(given.frames.objects, np.where(labels == 255, 0, labels))
    assert given.frames.objects.shape == clip.frames.depth_m.shape
    assert given.frames.objects.max() > 0
    assert clip.frames.objects is None
    with pytest.raises(RecordingError, match=r"found the label 200; expected labels up to 32"):
        numbered(np.full((1, 2, 2), 200, np.uint8), "x")
    with pytest.raises(RecordingError, match="found no labels"):
        with_objects(clip, dataclasses.replace(small_walkers, truth=None), 2)


@pytest.mark.parametrize("seed", range(5))
def test_the_best_mask_is_that_of_a_search_over_all_thresholds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    likelihood = np.round(rng.uniform(0, 1, (9, 11)), 1)  # with ties
    true = rng.uniform(size=likelihood.shape) < 0.3
    likelihood = np.where(true, np.minimum(likelihood + 0.2, 1.0), likelihood)
    counted = rng.uniform(size=likelihood.shape) < 0.9

    def iou(mask: np.ndarray) -> float:
        return (mask & true & counted).sum() / ((mask | true) & counted).sum()

    every = [iou(likelihood >= threshold) for threshold in np.unique(likelihood) if threshold > 0]
    best = best_mask(likelihood, true, counted)
    assert iou(best) == pytest.approx(max(every))
    assert not best_mask(np.zeros((9, 11)), true, counted).any()
    assert not best_mask(likelihood, np.zeros((9, 11), bool), counted).any()


def _masks(traces, truth_labels: np.ndarray, labels: dict[str, int], epcs: list[str]) -> dict[tuple[int, str], float]:
    """Mask IoU at the working resolution by frame and tag."""
    found = {}
    for number, trace in traces:
        for tag, epc in enumerate(epcs):
            true = truth_labels[number] == labels[epc]
            mask = (np.asarray(trace.mask[tag]) >= 0.5) & (truth_labels[number] != 255)
            if true.any():
                found[number, epc] = (mask & true).sum() / (mask | true).sum()
    return found


@pytest.mark.parametrize(
    "name",
    [pytest.param("tagattention", marks=pytest.mark.ci), "tagattention_published"],
)
def test_every_swap_applies_and_the_best_cut_is_better(small_walkers: Recording, name: str) -> None:
    settings = {**composed("error_budget", f"tracer@tracers.learnable={name}")["tracers"]["learnable"]}
    settings["clips"] = {**settings.get("clips", {}), "stride": 4, "flow": "truth"}
    recording, item = small_walkers, _walkers_item()
    labels = np.asarray(recording.truth.labels)[:, ::4, ::4]
    scores, swaps = {}, make_swaps(TrueReads())
    for row in ((), ("radio",), ("segments",), ("cut",), tuple(swaps)):
        traces, epcs, stride = swapped_traces(settings, item, recording, [swaps[one] for one in row], QUIET)
        assert stride == 4
        scores[row] = _masks(traces, labels, recording.truth.tag_to_label, epcs)
    # The published tracer's own mask is refined by clusters, and no level set of its likelihood.
    if name != "tagattention_published":
        assert all(scores[("cut",)][key] >= value - 1e-6 for key, value in scores[()].items())
    assert sum(scores[("cut",)].values()) > sum(scores[()].values())
    assert scores[("radio",)] != scores[()]
    assert scores[("segments",)] != scores[()]
    together = np.mean([*scores[tuple(swaps)].values()])
    assert together > np.mean([*scores[()].values()])


def test_the_uncut_likelihood_of_the_published_tracer_orders_its_own_mask(small_walkers: Recording) -> None:
    tracer = TagAttentionPublished()

    def load(recording: Recording, start: int, stop: int, **given):
        return load_clip(recording, start, stop, stride=4, flow="truth", estimator="published", **given)

    epcs = small_walkers.reads.epcs
    plain = dict(trace_recording(tracer, small_walkers, load, epcs=epcs))
    uncut = dict(trace_recording(Uncut(tracer), small_walkers, load, epcs=epcs))
    shown = 0
    for number, trace in plain.items():
        np.testing.assert_array_equal(trace.box_px, uncut[number].box_px)
        for tag in range(len(epcs)):
            inside = trace.mask[tag] > 0.5
            if inside.any():
                shown += 1
                # A cluster that is taken whole reaches the cut in the fraction `whole`, and is raised to its mean.
                assert uncut[number].mask[tag][inside].min() >= tracer.cut * tracer.whole
    assert shown > 5
    labels = np.asarray(small_walkers.truth.labels)[:, ::4, ::4]
    for number, trace in with_best_cuts(iter(uncut.items()), small_walkers, epcs, 4):
        np.testing.assert_array_equal(trace.detected, plain[number].detected)
        for tag, epc in enumerate(epcs):
            mask = np.asarray(trace.mask[tag]) > 0.5
            if mask.any():
                assert (labels[number] == small_walkers.truth.tag_to_label[epc]).any()
                rows, columns = np.nonzero(mask)
                assert trace.box_px[tag].tolist() == [columns.min(), rows.min(), columns.max(), rows.max()]


def test_the_published_tracer_takes_a_given_object_whole_or_not_at_all(small_walkers: Recording) -> None:
    settings = composed("error_budget")["tracers"]["published"]
    settings["clips"] = {**settings["clips"], "stride": 4, "flow": "truth"}
    swap = make_swaps(TrueReads())["segments"]
    traces, epcs, _ = swapped_traces(settings, _walkers_item(), small_walkers, [swap], QUIET)
    objects = numbered(np.asarray(small_walkers.truth.labels)[:, ::4, ::4], "x")
    clip = load_clip(small_walkers, 0, small_walkers.num_frames, stride=4, flow="truth", estimator="truth")
    depth = np.asarray(clip.frames.depth_m) > 0
    whole = 0
    for number, trace in traces:
        for tag in range(len(epcs)):
            for one in np.unique(objects[number])[1:]:
                inside = (objects[number] == one) & depth[number]
                covered = np.asarray(trace.mask[tag])[inside].mean() if inside.any() else 0.0
                assert covered == pytest.approx(1.0) or covered < 0.3  # `whole`
                whole += covered == 1.0
    assert whole > 5


def _config(**changes) -> BudgetConfig:
    values = composed("error_budget", "suites=[walkers]")
    values.pop("progress")
    return from_mapping(BudgetConfig, {**values, "suites": suites_named(["walkers"]), **changes})


def test_rows_are_none_each_swap_and_all() -> None:
    assert list(_config().combinations()) == ["none", "flow", "radio", "segments", "cut", "all"]
    assert _config(swaps=("cut",)).combinations() == {"none": (), "cut": ("cut",)}
    with pytest.raises(ConfigError, match="swaps: found magic; expected some of flow, radio, segments, cut"):
        _config(swaps=("magic",))
    with pytest.raises(ConfigError, match="online tracing"):
        dataclasses.replace(_config(), scores=ScoreSettings(smooth=True))
    with pytest.raises(ConfigError, match="found none"):
        _config(tracers={"learnable": None})


def test_the_table_and_the_figure_have_a_place_for_every_result(tmp_path: Path) -> None:
    one = Estimate(0.5, 0.4, 0.6, 5.0, 10, 2)
    rows = [
        BudgetRow(suite, tracer, truth, dict.fromkeys(MEASURES, one))
        for suite in ("a", "b")
        for tracer in ("x", "y")
        for truth in ("none", "flow")
    ]
    lines = markdown(rows[:-1]).splitlines()
    assert lines[0].startswith("| tracer | truth in place of | `a`: box IoU | `a`: mask J")
    assert lines[2] == "| x | none |" + " 0.50 [0.40, 0.60] |" * 6
    assert lines[5] == "| y | flow |" + " 0.50 [0.40, 0.60] |" * 3 + " - |" * 3
    panels = {title: {"a": {"none": one, "flow": one}, "b": {"none": one}} for title in "uvw"}
    interval_bars(tmp_path / "bars.png", panels, columns=3)
    assert (tmp_path / "bars.png").stat().st_size > 5000


@pytest.mark.ci
def test_a_suite_in_small(tmp_path: Path) -> None:
    config = dataclasses.replace(
        _config(recordings_dir=str(tmp_path / "made"), smoke=True, swaps=("flow", "cut")), scores=QUIET
    )
    rows = run_budget(config, tmp_path / "out")
    assert [(row.tracer, row.truth) for row in rows] == [
        (tracer, truth) for tracer in ("learnable", "published") for truth in ("none", "flow", "cut", "all")
    ]
    assert all(row.estimates["iou"].num_recordings == 1 for row in rows)
    written = json.loads((tmp_path / "out" / "result.json").read_text())
    assert len(written) == len(rows)
    assert "| published | all |" in (tmp_path / "out" / "table.md").read_text()
    assert (tmp_path / "out" / "error_budget.png").is_file()


def test_swaps_leave_alone_what_they_do_not_change(small_walkers: Recording) -> None:
    swaps, item = make_swaps(TrueReads()), _walkers_item()
    tracer = make_tracer({"_target_": "tagjax.tagattention.published.TagAttentionPublished"})
    assert {name for name, swap in swaps.items() if swap.tracer(tracer) is not tracer} == {"cut"}
    reads = swaps["radio"].recording(item, small_walkers)
    assert reads.colour is small_walkers.colour
    assert swaps["radio"].recording(item, small_walkers) is not reads
    stripped = _without_flow(small_walkers)
    found = swaps["flow"].recording(item, stripped)
    assert found.reads is stripped.reads
    assert swaps["flow"].recording(item, stripped) is found  # computed once for one recording
    clip = jnp.zeros(())
    assert all(swaps[name].clip(clip, small_walkers, 1) is clip for name in ("flow", "radio", "cut"))  # type: ignore[arg-type]
