"""Clips: settings that no clip can have, and recordings with the reads of several antennas."""

from __future__ import annotations

import dataclasses
import itertools
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
import synthetic_clips as synthetic

from tagjax.core.camera import working_stride
from tagjax.core.numerics import SPEED_OF_LIGHT_M_S
from tagjax.core.settings import ConfigError
from tagjax.recording import Recording, RecordingError, RecordingWarning, TagReads
from tagjax.recording.loading import VirtualTagSettings
from tagjax.recording.reads import join_reads
from tagjax.tracing.clips import ClipSettings, choose_antennas, clip_loader, load_clip, subsampled_depth
from tagjax.training.clip_dataset import clip_dataset, measured_motion
from tagjax.training.sources import DataSettings, training_recordings

ANTENNAS_M = np.array([[0.0, 0.0, 0.0], [0.5, -0.3, 4.0], [9.0, 9.0, 9.0]])
SMALL = {"stride": 2, "flow": "dis_ultrafast"}


@pytest.fixture(scope="module")
def recording() -> Recording:
    return synthetic.enlarged(synthetic.recording(20), 4)


@pytest.mark.parametrize(
    ("width", "stride"), [(1, 1), (256, 1), (320, 1), (512, 2), (640, 2), (960, 4), (1280, 5), (1920, 8)]
)
def test_the_working_resolution_follows_from_the_camera(width: int, stride: int) -> None:
    assert working_stride(width) == stride
    assert working_stride(width, 3) == 3


def test_a_clip_has_about_256_columns_unless_a_stride_is_given(recording: Recording) -> None:
    wide = synthetic.enlarged(recording, 4)  # 512 columns
    given = load_clip(wide, 0, 6, flow="zero", stride=2)
    for automatic in (load_clip(wide, 0, 6, flow="zero"), clip_loader(ClipSettings(flow="zero"))(wide, 0, 6)):
        assert automatic.frames.depth_m.shape == (6, 192, 256)
        np.testing.assert_array_equal(automatic.camera.rays, given.camera.rays)
        np.testing.assert_array_equal(automatic.frames.depth_m, given.frames.depth_m)


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_missing_depth_comes_from_the_nearest_pixel_of_the_cell(stride: int) -> None:
    rng = np.random.default_rng(stride)
    depth_m = rng.uniform(0.5, 4.0, (2, 13, 17)).astype(np.float32)
    for missing in (0.0, np.nan, np.inf, -np.inf):
        depth_m[rng.uniform(size=depth_m.shape) < 0.2] = missing
    expected = np.zeros((2, -(-13 // stride), -(-17 // stride)), np.float32)
    for t, row, column in np.ndindex(expected.shape):
        cell = depth_m[t, row * stride : (row + 1) * stride, column * stride : (column + 1) * stride]
        places = [place for place in np.ndindex(cell.shape) if np.isfinite(cell[place]) and cell[place] > 0]
        if places:
            expected[t, row, column] = cell[min(places, key=lambda place: (place[0] ** 2 + place[1] ** 2, place))]
    np.testing.assert_array_equal(subsampled_depth(depth_m, stride), expected)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"stride": 0}, "stride is 0; expected at least 1"),
        ({"stride": -3}, "stride is -3; expected at least 1"),
        ({"window": 1}, "window is 1; expected at least 2"),
        ({"max_reads": 0}, "max_reads is 0; expected at least 1"),
    ],
)
def test_settings_that_no_clip_can_have_are_refused(recording: Recording, settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_clip(recording, 0, 6, **{**SMALL, **settings})
    with pytest.raises(ValueError, match=message):
        clip_dataset([recording], clip_length=6, seed=0, **{**SMALL, **settings})


@pytest.mark.parametrize(("name", "found"), [("clip_length", 0), ("step", 0), ("step", -1)])
def test_datasets_of_no_length_are_refused(recording: Recording, name: str, found: int) -> None:
    with pytest.raises(ValueError, match=f"{name} is {found}; expected at least 1 frame"):
        clip_dataset([recording], seed=0, **{**SMALL, "clip_length": 6, name: found})


def _two_antennas(recording: Recording, share: float, epcs: tuple[str, ...] = ("tag-a", "tag-b")) -> Recording:
    """With a `share` as many reads again by antenna 2, before the object: the distance to it shrinks as the other's grows.

    The first read is antenna 2's.
    """
    own = recording.reads
    rng = np.random.default_rng(0)
    chosen = np.isin(own.epc, epcs) & (rng.random(own.num_reads) < share)
    chosen[0] = True
    other = own[chosen]
    time_s = other.time_ns * 1e-9
    offset = np.where(other.epc == "tag-a", synthetic.offset_m(1, time_s), synthetic.offset_m(2, time_s))
    phase = np.mod(4 * np.pi * other.carrier_hz / SPEED_OF_LIGHT_M_S * (2.0 - offset) + 1.0, 2 * np.pi)
    other = dataclasses.replace(
        other, antenna=np.full(other.num_reads, 2, np.int16), phase_rad=phase, time_ns=other.time_ns - 1_000_000
    )
    return dataclasses.replace(recording, reads=join_reads([own, other]), antennas_m=ANTENNAS_M)


def _same_radio(one, other) -> None:
    for name in ("relative_m", "std_m"):
        np.testing.assert_array_equal(getattr(one.frames.radio, name), getattr(other.frames.radio, name))
    np.testing.assert_array_equal(one.frames.reads.valid, other.frames.reads.valid)
    np.testing.assert_array_equal(one.frames.reads.phase_rad, other.frames.reads.phase_rad)


def test_the_busiest_antenna_is_the_one_with_the_most_reads(recording: Recording) -> None:
    both = _two_antennas(recording, 0.6)
    assert both.reads.antenna[0] == 2
    surplus = both.reads.num_reads - recording.reads.num_reads
    with pytest.warns(
        RecordingWarning, match=rf"{surplus} of {both.reads.num_reads} reads are unused .* to antenna 1\."
    ):
        clip = load_clip(both, 4, 20, antennas="busiest", **SMALL)
    np.testing.assert_array_equal(clip.camera.antennas_m, ANTENNAS_M[:1])
    _same_radio(clip, load_clip(recording, 4, 20, **SMALL))
    truth = np.diff(np.stack([recording.truth.tag_range_m[epc] for epc in clip.epcs], axis=1), axis=0)[3:]
    steps = np.asarray(clip.frames.radio.relative_m)
    np.testing.assert_allclose((steps[:, :, 0, -1] - steps[:, :, 0, -2])[4:], truth[4:], atol=5e-3)


def test_each_antenna_s_distances_are_those_that_it_alone_would_give(recording: Recording) -> None:
    both = _two_antennas(recording, 0.9)
    clip = load_clip(both, 4, 20, **SMALL)  # all antennas
    np.testing.assert_allclose(clip.camera.antennas_m, ANTENNAS_M[:2], atol=1e-6)
    for place in range(2):
        with pytest.warns(RecordingWarning, match=rf"to antenna {place + 1}\. `antennas=all` uses every antenna"):
            alone = load_clip(both, 4, 20, antennas=(place + 1,), **SMALL)
        _same_radio(_of_antenna(clip, place), alone)


def _of_antenna(clip, place: int):
    """The clip with one antenna's radio and reads alone."""
    of = lambda part: jax.tree.map(lambda leaf: leaf[:, :, place : place + 1], part)  # noqa: E731
    frames = clip.frames
    return eqx.tree_at(
        lambda c: (c.frames.radio, c.frames.reads, c.camera.antennas_m),
        clip,
        (of(frames.radio), of(frames.reads), clip.camera.antennas_m[place : place + 1]),
    )


def test_a_given_antenna_is_used(recording: Recording) -> None:
    both = _two_antennas(recording, 0.9)
    with pytest.warns(RecordingWarning, match=rf"{recording.reads.num_reads} of .* to antenna 2\."):
        clip = load_clip(both, 4, 20, antennas=(2,), **SMALL)
    np.testing.assert_allclose(clip.camera.antennas_m, ANTENNAS_M[1:2], atol=1e-6)
    truth = -np.diff(np.stack([recording.truth.tag_range_m[epc] for epc in clip.epcs], axis=1), axis=0)[3:]
    steps = np.asarray(clip.frames.radio.relative_m)
    np.testing.assert_allclose((steps[:, :, 0, -1] - steps[:, :, 0, -2])[4:], truth[4:], atol=5e-3)
    with pytest.warns(RecordingWarning, match=r"to antenna 2\."):
        first = next(iter(clip_dataset([both], clip_length=6, seed=0, antennas=(2,), **SMALL)))
    np.testing.assert_allclose(first.camera.antennas_m, ANTENNAS_M[1:2], atol=1e-6)


@pytest.mark.parametrize("antenna", [0, 3, 4])
def test_an_antenna_without_place_or_reads_is_refused(recording: Recording, antenna: int) -> None:
    both = _two_antennas(recording, 0.5)
    with pytest.raises(RecordingError, match=rf"found antennas=\[1, {antenna}\]; .*antennas 1 to 3.*of antenna 2"):
        load_clip(both, 0, 6, antennas=(1, antenna), **SMALL)


@pytest.mark.parametrize(("antennas", "result"), [((), ""), ((1, 1), "1, 1")])
def test_no_antenna_and_one_twice_are_refused(recording: Recording, antennas: tuple[int, ...], result: str) -> None:
    with pytest.raises(RecordingError, match=rf"found antennas=\[{result}\]; .*each once"):
        load_clip(_two_antennas(recording, 0.5), 0, 6, antennas=antennas, **SMALL)


def test_antennas_without_place_are_passed_over(recording: Recording) -> None:
    moved = recording.with_reads(dataclasses.replace(recording.reads, antenna=np.full_like(recording.reads.antenna, 2)))
    with pytest.raises(RecordingError, match="of antenna 2; antennas_m holds positions of antennas 1 to 1"):
        load_clip(moved, 0, 6, **SMALL)
    both = _two_antennas(recording, 0.4)
    swapped = dataclasses.replace(both.reads, antenna=(3 - both.reads.antenna).astype(np.int16))  # most are now 2's
    placed = dataclasses.replace(both, reads=swapped, antennas_m=ANTENNAS_M[:1])
    for antennas, advice in (("all", "add those of the others"), ("busiest", "`antennas=all` uses every antenna")):
        with pytest.warns(RecordingWarning, match=rf"to antenna 1\. .*{advice}"):
            assert choose_antennas(placed, ["tag-a"], antennas) == (1,)


def test_one_antenna_serves_all_tags_and_unread_tags_are_reported(recording: Recording) -> None:
    both = _two_antennas(recording, 1.0)
    apart = (both.reads.epc == "tag-b") == (both.reads.antenna == 2)  # tag-a by antenna 1 only, tag-b by antenna 2
    split = both.with_reads(both.reads[apart][:-20])  # as many reads of both: the first antenna
    with pytest.warns(RecordingWarning, match=r"to antenna 1\. .* No read is left of: tag-b"):
        clip = load_clip(split, 0, 12, antennas="busiest", **SMALL)
    at = clip.epcs.index("tag-b")
    np.testing.assert_array_equal(clip.camera.antennas_m, ANTENNAS_M[:1])
    assert np.isinf(np.asarray(clip.frames.radio.std_m)[:, at]).all()
    assert not np.asarray(clip.frames.reads.valid)[:, at].any()
    assert np.isfinite(np.asarray(clip.frames.radio.std_m)[-1, 1 - at]).all()


def test_reads_of_unknown_carrier_do_not_choose_the_antenna(recording: Recording) -> None:
    both = _two_antennas(recording, 0.5)
    carrier = np.where(both.reads.antenna == 1, np.nan, both.reads.carrier_hz)
    unknown = both.with_reads(dataclasses.replace(both.reads, carrier_hz=carrier))
    with pytest.warns(RecordingWarning, match=r"to antenna 2\."):
        assert choose_antennas(unknown, unknown.reads.epcs, "busiest") == (2,)


def test_the_true_distances_may_stand_in_for_the_radio(recording: Recording) -> None:
    clip = load_clip(recording, 3, 12, **SMALL, window=4, estimator="truth")
    time_s = recording.frame_time_s()
    for tag, epc in enumerate(clip.epcs):
        range_m = synthetic.offset_m(synthetic.EPCS[epc], time_s)
        for index in range(9):
            past = np.maximum(np.arange(index, index + 4), 0)
            np.testing.assert_allclose(
                clip.frames.radio.relative_m[index, tag, 0], range_m[past] - range_m[past[0]], atol=1e-5
            )
    assert np.isfinite(np.asarray(clip.frames.radio.std_m)).all()
    assert recording.truth is not None
    partly = dataclasses.replace(recording.truth, tag_range_m={"tag-a": recording.truth.tag_range_m["tag-a"]})
    with pytest.raises(RecordingError, match="true range of tag-b; found ranges of: tag-a"):
        load_clip(dataclasses.replace(recording, truth=partly), 3, 12, **SMALL, estimator="truth")
    turned = dataclasses.replace(recording.reads, antenna=np.full(recording.reads.num_reads, 2, np.int16))
    elsewhere = dataclasses.replace(recording, reads=turned, antennas_m=np.zeros((2, 3)))
    with pytest.raises(RecordingError, match="true ranges are known to antenna 1 only; found antenna 2"):
        load_clip(elsewhere, 3, 12, **SMALL, estimator="truth")


@pytest.mark.ci
def test_clips_that_threads_load_at_once_are_those_of_one_after_the_other():
    recording = synthetic.recording(12)
    load = lambda start: load_clip(recording, start, start + 6, stride=2)  # noqa: E731
    starts = [0, 2, 4, 6] * 2
    with ThreadPoolExecutor(4) as threads:
        at_once = list(threads.map(load, starts))
    for start, found in zip(starts, at_once, strict=True):
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(load(start)), strict=True):
            np.testing.assert_array_equal(one, other)


def test_recordings_of_which_no_clip_can_be_loaded_are_refused_at_once(recording: Recording) -> None:
    make = lambda *recordings, **more: clip_dataset(recordings, clip_length=6, seed=0, **SMALL, **more)  # noqa: E731
    unread = dataclasses.replace(recording, name="unread", reads=TagReads.empty())
    with pytest.raises(RecordingError, match="unread holds no tag read"):
        make(recording, unread)
    with pytest.raises(RecordingError, match=r"synthetic: EPC 'tag-z' was never read.*tag-a, tag-b"):
        make(recording, epcs=["tag-a", "tag-z"])
    with pytest.raises(RecordingError, match=r"found antennas=\[4\]"):
        make(recording, antennas=(4,))
    with pytest.raises(RecordingError, match="needs the true range of tag-a"):
        make(recording, dataclasses.replace(recording, truth=None), estimator="truth")


def _moving_from(num_frames: int, begin: int) -> Recording:
    """The synthetic scene with both tags at rest before frame `begin`, half of their reads flipped."""
    moving = synthetic.recording(num_frames)
    reads, begin_ns = moving.reads, int(moving.time_ns[begin])
    rests = reads.time_ns < begin_ns
    flips = np.random.default_rng(0).integers(0, 2, reads.num_reads) * np.pi
    phase = np.mod(np.where(rests, 1.0, reads.phase_rad) + flips, 2 * np.pi)
    return dataclasses.replace(moving, reads=dataclasses.replace(reads, phase_rad=phase))


def test_clips_without_measured_motion_are_left_out() -> None:
    late = _moving_from(50, 25)
    starts = range(0, 41, 10)
    motion = measured_motion(late, starts, 10, ["tag-a", "tag-b"], [1])
    assert motion.shape == (5, 2)
    assert (motion[:1] < 1e-9).all()  # one that ends where they begin shares its last piece with what comes
    assert (motion[3:] > 0.2).all()
    np.testing.assert_array_equal(measured_motion(late, starts, 10, ["tag-b"], [1]), motion[:, 1:])
    assert not measured_motion(late, starts, 10, ["tag-a"], [2]).any()  # never read there
    drawn = iter(clip_dataset([late], clip_length=10, step=10, seed=0, min_motion=0.1, stride=2))
    assert {next(drawn).start for _ in range(5)} <= set(starts[1:])
    everything = iter(clip_dataset([late], clip_length=10, step=10, seed=0, stride=2))
    assert {next(everything).start for _ in range(5)} == set(starts)
    still = _moving_from(40, 39)
    with pytest.raises(
        RecordingError, match=r"No clip of 10 frames has a tag whose reads show motion of 0\.1 or more \(the maximum"
    ):
        clip_dataset([still], clip_length=10, seed=0, min_motion=0.1, stride=2)


@pytest.mark.ci
def test_of_many_tags_the_one_that_moves_most_is_kept_and_others_by_chance() -> None:
    recording = synthetic.recording(40)
    reads = recording.reads
    first = reads.select("tag-a")
    still = [
        dataclasses.replace(first, epc=np.full(first.num_reads, f"tag-{number}"), phase_rad=np.ones(first.num_reads))
        for number in range(6)
    ]
    both = dataclasses.replace(recording, reads=join_reads([reads, *still]))
    settings = {"clip_length": 10, "step": 10, "seed": 0, "stride": 2}
    kept = [one.epcs for _, one in zip(range(4), clip_dataset([both], max_tags=3, **settings), strict=False)]
    assert {len(epcs) for epcs in kept} == {3}
    assert all({"tag-a", "tag-b"} & set(epcs) for epcs in kept)
    assert len(set(itertools.chain(*kept))) > 4
    again = [one.epcs for _, one in zip(range(2), clip_dataset([both], max_tags=3, **settings), strict=False)]
    assert again == kept[:2]
    assert len(next(iter(clip_dataset([both], **settings))).epcs) == 8
    # Antenna 2 is the busiest of all tags, antenna 1 that of the ones that move: whoever is drawn, it is the former.
    elsewhere = [dataclasses.replace(one, antenna=np.full(one.num_reads, 2, np.int16)) for one in still]
    apart = dataclasses.replace(recording, reads=join_reads([reads, *elsewhere]), antennas_m=ANTENNAS_M)
    with pytest.warns(RecordingWarning, match=r"to antenna 2\."):
        drawn = next(iter(clip_dataset([apart], max_tags=1, min_motion=0.0, antennas="busiest", **settings)))
    assert len(drawn.epcs) == 1
    np.testing.assert_allclose(drawn.camera.antennas_m, ANTENNAS_M[1:2], atol=1e-6)
    assert len(next(iter(clip_dataset([both], max_tags=20, **settings))).epcs) == 8
    with pytest.raises(ValueError, match="max_tags is 0; expected at least 1 tag"):
        clip_dataset([both], max_tags=0, **settings)
    with pytest.raises(ConfigError, match="max_tags is 0; expected at least 1 tag"):
        ClipSettings(max_tags=0)


def test_recordings_shorter_than_a_clip_are_named(recording: Recording) -> None:
    short = dataclasses.replace(synthetic.recording(4), name="short")
    with pytest.warns(RecordingWarning, match="short has 4 frames, fewer than a clip's 6: it gives no clip"):
        clip_dataset([recording, short], clip_length=6, seed=0, **SMALL)


@pytest.mark.parametrize("share", [-0.1, 1.0])
def test_no_motion_loses_all_coherence_and_none_less_than_nothing(share: float) -> None:
    with pytest.raises(ConfigError, match=rf"min_motion is {share}; expected a loss of coherence"):
        ClipSettings(min_motion=share)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"validation": ("held_out.zarr",)}, r"data\.validation is held_out\.zarr, but data\.recordings is empty"),
        (
            {"virtual_tag": VirtualTagSettings(tracks="tracks.csv")},
            r"data\.virtual_tag is given, but data\.recordings is",
        ),
    ],
)
def test_settings_that_mean_nothing_without_recordings_are_refused(given: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        training_recordings(DataSettings(**given))


def test_a_recording_is_not_held_out_from_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link.zarr").symlink_to(tmp_path / "a.zarr")
    for other in ("a.zarr/", "./b/../a.zarr", str(tmp_path / "a.zarr"), "link.zarr"):
        with pytest.raises(RecordingError, match=r"a\.zarr: found in both data\.recordings and data\.validation"):
            training_recordings(DataSettings(recordings=("a.zarr",), validation=(other,)))
    with pytest.raises(RecordingError, match="no such folder"):
        training_recordings(DataSettings(recordings=("a.zarr",), validation=("b.zarr",)))
