"""Recordings: round trip, laziness, and a clear answer to every kind of bad input."""

import dataclasses
import shutil

import numpy as np
import pytest
import synthetic_clips as synthetic
import zarr

from tagjax.data.clips import clip_dataset, load_clip
from tagjax.data.flow_cache import pair_flow
from tagjax.data.store import open_recording, save_recording, write_recording
from tagjax.recording import ClockAudit, Recording, RecordingError, RecordingWarning, TagReads


def _with_reads(recording: Recording, **columns) -> Recording:
    return recording.with_reads(dataclasses.replace(recording.reads, **columns))


@pytest.fixture
def recording() -> Recording:
    return synthetic.recording(12)


def test_round_trip(recording, tmp_path):
    audit = ClockAudit(1.5, 20.0, 0.3, 400, "unix")
    save_recording(dataclasses.replace(recording, clock=audit), tmp_path / "a.zarr")
    again = open_recording(tmp_path / "a.zarr")
    for t in (0, 11):
        np.testing.assert_array_equal(again.colour[t], recording.colour[t])
        np.testing.assert_array_equal(again.depth[t], recording.depth[t])
        np.testing.assert_array_equal(again.truth.labels[t], recording.truth.labels[t])
    for field in dataclasses.fields(TagReads):
        np.testing.assert_array_equal(getattr(again.reads, field.name), getattr(recording.reads, field.name))
    assert again.intrinsics == recording.intrinsics
    assert again.clock == audit
    assert again.truth.tag_to_label == dict(recording.truth.tag_to_label)
    np.testing.assert_array_equal(again.truth.tag_range_m["tag-a"], recording.truth.tag_range_m["tag-a"])
    assert isinstance(again.colour, zarr.Array)
    assert again.colour.chunks[0] == 1


def test_remote_store(recording):
    fsspec = pytest.importorskip("fsspec")
    address = "memory://somewhere/a.zarr"
    write_recording(recording, zarr.open_group(address, mode="w", zarr_format=3))
    again = open_recording(address)
    assert again.store is None
    np.testing.assert_array_equal(again.depth[3], recording.depth[3])
    fsspec.filesystem("memory").rm("/somewhere", recursive=True)


def test_existing_folder_is_not_overwritten_and_a_failed_write_leaves_nothing(recording, tmp_path):
    save_recording(recording, tmp_path / "a.zarr")
    with pytest.raises(RecordingError, match="exists"):
        save_recording(recording, tmp_path / "a.zarr")

    class Failing:
        shape, dtype = recording.depth.shape, recording.depth.dtype

        def __getitem__(self, index):
            raise OSError("no more")

    with pytest.raises(OSError, match="no more"):
        save_recording(dataclasses.replace(recording, depth=Failing()), tmp_path / "b.zarr")
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]


def test_truncated_and_foreign_stores_are_refused(recording, tmp_path):
    path = tmp_path / "a.zarr"
    save_recording(recording, path)
    whole = tmp_path / "whole.zarr"
    shutil.copytree(path, whole)
    next((path / "depth" / "c").iterdir()).rename(tmp_path / "lost")
    with pytest.raises(RecordingError, match="11 of 12 chunks"):
        open_recording(path)
    shutil.rmtree(path / "depth")
    with pytest.raises(RecordingError, match="'depth' is missing"):
        open_recording(path)
    zarr.open_group(str(whole), mode="r+").attrs["version"] = 99
    with pytest.raises(RecordingError, match="version 99"):
        open_recording(whole)
    zarr.open_group(str(tmp_path / "other.zarr"), mode="w", zarr_format=3)
    with pytest.raises(RecordingError, match="no recording"):
        open_recording(tmp_path / "other.zarr")
    (tmp_path / "empty.zarr").mkdir()
    with pytest.raises(RecordingError, match="no readable Zarr"):
        open_recording(tmp_path / "empty.zarr")
    with pytest.raises(RecordingError, match="no such folder"):
        open_recording(tmp_path / "nowhere.zarr")


def test_missing_depth_is_an_error_and_a_frame_without_is_carried(recording):
    with pytest.raises(RecordingError, match="no depth at all"):
        dataclasses.replace(recording, depth=np.zeros_like(recording.depth)).check()
    hole = recording.depth.copy()
    hole[0] = 0
    with pytest.warns(RecordingWarning, match="frame 0 has no depth"):
        dataclasses.replace(recording, depth=hole).check()


def test_nan_depth_counts_as_missing(recording):
    depth = recording.depth.copy()
    depth[:, :4] = np.nan
    holed = dataclasses.replace(recording, depth=depth)
    holed.check()
    assert np.all(holed.depth_metres(3)[:4] == 0)
    clip = load_clip(holed, 0, 6, stride=2)
    assert np.isfinite(np.asarray(clip.frames.depth_m)).all()


def test_nan_phase_is_an_error(recording):
    phase = recording.reads.phase_rad.copy()
    phase[5] = np.nan
    with pytest.raises(RecordingError, match=r"1 of \d+ values of phase_rad are not finite"):
        _with_reads(recording, phase_rad=phase).check()


def test_zero_reads_are_carried_with_a_warning_until_tracing(recording):
    silent = recording.with_reads(TagReads.empty())
    with pytest.warns(RecordingWarning, match="no tag read"):
        silent.check()
    with pytest.raises(RecordingError, match="nothing to trace"):
        load_clip(silent, 0, 6, stride=2)


def test_one_read_is_carried_and_the_radio_says_that_it_knows_nothing(recording):
    one = recording.with_reads(recording.reads[30:31])
    one.check()
    clip = load_clip(one, 0, 10, stride=2)
    assert np.isinf(np.asarray(clip.frames.radio.std_m)).all()


def test_unknown_epc_names_the_known_ones(recording):
    with pytest.raises(RecordingError, match="tag-a, tag-b"):
        load_clip(recording, 0, 6, stride=2, epcs=["tag-x"])


@pytest.mark.parametrize("shift", [0, -5_000_000])
def test_duplicate_and_decreasing_frame_times_are_errors(recording, shift):
    times = recording.time_ns.copy()
    times[4] = times[3] + shift
    with pytest.raises(RecordingError, match="frame 4"):
        dataclasses.replace(recording, time_ns=times).check()


def test_decreasing_read_times_are_an_error(recording):
    times = recording.reads.time_ns.copy()
    times[[7, 9]] = times[[9, 7]]
    with pytest.raises(RecordingError, match="time goes back at read 8"):
        _with_reads(recording, time_ns=times).check()


def test_frames_without_reads_are_carried(recording):
    inside = recording.reads.time_ns < int(0.4e9)
    quiet = recording.with_reads(recording.reads[inside])
    quiet.check()
    clip = load_clip(quiet, 0, 12, stride=2)
    assert np.isinf(np.asarray(clip.frames.radio.std_m)[-1]).all()
    assert np.isfinite(np.asarray(clip.frames.radio.relative_m)).all()


def test_reads_of_another_clock_are_an_error(recording):
    with pytest.raises(RecordingError, match="clocks differ"):
        _with_reads(recording, time_ns=recording.reads.time_ns + int(1e18)).check()


def test_mixed_frequencies(recording):
    carrier = recording.reads.carrier_hz.copy()
    carrier[::2] = 866e6
    carrier[1::2] = 2.4e9
    with pytest.raises(RecordingError, match="mixed"):
        _with_reads(recording, carrier_hz=carrier).check()


@pytest.mark.parametrize(
    ("column", "factor", "message"),
    [("phase_rad", 57.3, "Degrees"), ("carrier_hz", 1e-6, "MHz"), ("rssi_dbm", 100, "Centi-dBm")],
)
def test_wrong_units_are_errors(recording, column, factor, message):
    values = getattr(recording.reads, column)
    with pytest.raises(RecordingError, match=message):
        _with_reads(recording, **{column: (values * factor).astype(values.dtype)}).check()


def test_depth_in_the_wrong_unit_is_an_error(recording):
    with pytest.raises(RecordingError, match="Wrong unit"):
        dataclasses.replace(recording, depth=(recording.depth * 5000).astype(np.float32)).check()


def test_unknown_carriers_are_said_and_left_out(recording):
    unknown = _with_reads(recording, carrier_hz=np.full(recording.reads.num_reads, np.nan))
    with pytest.warns(RecordingWarning, match="hop table"):
        unknown.check()
    clip = load_clip(unknown, 0, 8, stride=2)
    assert np.isinf(np.asarray(clip.frames.radio.std_m)).all()


def test_clips_hold_what_the_recording_holds(recording):
    clip = load_clip(recording, 3, 9, stride=2, window=4, max_reads=32)
    assert clip.frames.depth_m.shape == (6, 12, 16)
    np.testing.assert_allclose(clip.frames.depth_m[2], recording.depth[5, ::2, ::2])
    np.testing.assert_allclose(clip.frames.time_s, recording.frame_time_s()[3:9], rtol=1e-6)
    truth = recording.truth.tag_range_m["tag-b"]
    relative = np.asarray(clip.frames.radio.relative_m)[-1, 1]
    np.testing.assert_allclose(relative, truth[5:9] - truth[5], atol=5e-3)
    # Past of a clip in the middle: the same radio as in the whole recording.
    whole = load_clip(recording, 0, 12, stride=2, window=4, max_reads=32)
    np.testing.assert_allclose(clip.frames.radio.relative_m, whole.frames.radio.relative_m[3:9], atol=1e-6)


def test_missing_depth_takes_the_nearest_of_its_cell(recording):
    depth = recording.depth.copy()
    depth[:, 0, 0] = 0
    depth[:, 0, 1] = 1.25
    clip = load_clip(dataclasses.replace(recording, depth=depth), 0, 2, stride=2)
    assert float(clip.frames.depth_m[0, 0, 0]) == 1.25


def test_range_is_turned_into_depth(recording):
    near = dataclasses.replace(recording.intrinsics, fx_px=20.0, fy_px=20.0)
    clip = load_clip(dataclasses.replace(recording, depth_kind="range", intrinsics=near), 0, 2, stride=1)
    x, y = (0 - near.cx_px) / 20.0, (0 - near.cy_px) / 20.0
    np.testing.assert_allclose(
        clip.frames.depth_m[0, 0, 0], recording.depth[0, 0, 0] / np.sqrt(x * x + y * y + 1), rtol=1e-5
    )


def test_flow_is_kept_with_the_recording(recording, tmp_path):
    save_recording(recording, tmp_path / "a.zarr")
    stored = open_recording(tmp_path / "a.zarr")
    first = pair_flow(stored, 0, 5, "dis_fast")
    assert "cache/flow/dis_fast/backward" in stored.store
    again = pair_flow(open_recording(tmp_path / "a.zarr"), 0, 5, "dis_fast")
    np.testing.assert_array_equal(first[0], again[0])
    assert not first[0][0].any()
    with pytest.raises(ValueError, match="Unknown optical flow"):
        pair_flow(recording, 0, 2, "magic")


def test_the_clip_stream_is_shuffled_by_seed_and_resumes_exactly(recording):
    def stream(seed):
        return iter(clip_dataset([recording], clip_length=4, stride=4, step=1, seed=seed))

    one, same, other = stream(0), stream(0), stream(1)
    starts = [next(one).start for _ in range(9)]
    assert starts == [next(same).start for _ in range(9)]
    assert sorted(starts) == list(range(9))
    assert starts != [next(other).start for _ in range(9)]
    state = one.get_state()
    later = [next(one).start for _ in range(3)]
    fresh = stream(0)
    fresh.set_state(state)
    assert [next(fresh).start for _ in range(3)] == later
    with pytest.raises(RecordingError, match="the longest has 12"):
        clip_dataset([recording], clip_length=40, stride=4, seed=0)
