"""Recordings: round trip, laziness, and a clear answer to every kind of bad input."""

import copy
import dataclasses
import functools
import http.server
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import fsspec
import numpy as np
import pytest
import synthetic_clips as synthetic
import zarr

from tagjax.flow import cache as flow_cache
from tagjax.flow.cache import pair_flow
from tagjax.flow.registry import make_flow
from tagjax.recording import ClockAudit, ClockPiece, Recording, RecordingError, RecordingWarning, TagReads, Truth, store
from tagjax.recording.store import open_recording, save_recording, write_recording
from tagjax.recording.stored_frames import StoredFrames
from tagjax.recording.time_reversal import time_reversed
from tagjax.tracing.clips import load_clip
from tagjax.training.clip_dataset import clip_dataset

CLOCK = ClockAudit((ClockPiece(10**18, 400, 1.5, (1.4, 1.6), 20.0, (18.0, 22.0)),), 0.3, 400, 2, "unix")


def _with_reads(recording: Recording, **columns) -> Recording:
    return recording.with_reads(dataclasses.replace(recording.reads, **columns))


@pytest.fixture
def recording() -> Recording:
    return synthetic.recording(12)


def test_round_trip(recording, tmp_path):
    save_recording(dataclasses.replace(recording, clock=CLOCK), tmp_path / "a.zarr")
    again = open_recording(tmp_path / "a.zarr")
    for t in (0, 11):
        np.testing.assert_array_equal(again.colour[t], recording.colour[t])
        np.testing.assert_array_equal(again.depth[t], recording.depth[t])
        np.testing.assert_array_equal(again.truth.labels[t], recording.truth.labels[t])
    for field in dataclasses.fields(TagReads):
        np.testing.assert_array_equal(getattr(again.reads, field.name), getattr(recording.reads, field.name))
    assert again.intrinsics == recording.intrinsics
    assert again.clock == CLOCK
    assert again.truth.tag_to_label == dict(recording.truth.tag_to_label)
    np.testing.assert_array_equal(again.truth.tag_range_m["tag-a"], recording.truth.tag_range_m["tag-a"])
    assert isinstance(again.colour, StoredFrames)
    assert again.colour.array.chunks[0] == 1


def test_remote_store(recording):
    address = "memory://somewhere/a.zarr"
    write_recording(recording, zarr.open_group(address, mode="w", zarr_format=3))
    again = open_recording(address)
    assert again.store is None
    np.testing.assert_array_equal(again.depth[3], recording.depth[3])
    fsspec.filesystem("memory").rm("/somewhere", recursive=True)


def _complete(recording: Recording) -> Recording:
    """A recording with every optional part."""
    shape, count = recording.depth.shape, recording.reads.num_reads
    truth = dataclasses.replace(
        recording.truth,
        flow_px=np.ones((*shape, 2), np.float32),
        occluded=np.ones(shape, bool),
        boxes_px=np.ones((shape[0], 2, 4), np.float32),
        carrier_box_px={"tag-a": np.arange(4.0 * shape[0], dtype=np.float32).reshape(-1, 4)},
    )
    reads = dataclasses.replace(
        recording.reads, reader_time_ns=recording.reads.time_ns + 5, channel_index=np.ones(count, np.int16)
    )
    return recording.with_reads(reads, truth)


def test_every_optional_part_makes_the_round_trip(recording, tmp_path):
    whole = _complete(recording)
    save_recording(whole, tmp_path / "a.zarr")
    again = open_recording(tmp_path / "a.zarr")
    for name in ("labels", "flow_px", "occluded", "boxes_px"):
        np.testing.assert_array_equal(getattr(again.truth, name)[...], getattr(whole.truth, name))
    assert list(again.truth.carrier_box_px) == ["tag-a"]
    np.testing.assert_array_equal(again.truth.carrier_box_px["tag-a"], whole.truth.carrier_box_px["tag-a"])
    np.testing.assert_array_equal(again.reads.reader_time_ns, whole.reads.reader_time_ns)
    np.testing.assert_array_equal(again.reads.channel_index, whole.reads.channel_index)


@pytest.mark.parametrize(
    "name",
    [
        "truth/labels",
        "truth/flow_px",
        "truth/occluded",
        "truth/boxes_px",
        "truth/tag_range_m/0",
        "reads/reader_time_ns",
        "reads/channel_index",
        "reads/phase_rad",
    ],
)
def test_a_lost_array_is_an_error(recording, tmp_path, name):
    save_recording(_complete(recording), tmp_path / "a.zarr")
    shutil.rmtree(tmp_path / "a.zarr" / name)
    with pytest.raises(RecordingError, match=f"array '{name}' is missing"):
        open_recording(tmp_path / "a.zarr")


def test_recordings_of_the_first_releases_list_no_arrays_and_still_open(recording, tmp_path):
    save_recording(recording, tmp_path / "a.zarr")
    del zarr.open_group(str(tmp_path / "a.zarr"), mode="r+").attrs["arrays"]
    again = open_recording(tmp_path / "a.zarr")
    np.testing.assert_array_equal(again.truth.labels[3], recording.truth.labels[3])
    assert again.truth.flow_px is None
    assert again.reads.channel_index is None


def _cut(file: Path, share: float = 0.5) -> None:
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize(
    ("name", "chunk", "found"),
    [
        ("time_ns", "0", "'time_ns' cannot"),
        ("reads/phase_rad", "0", "'reads/phase_rad' cannot"),
        ("truth/tag_range_m/1", "0", "'truth/tag_range_m/1' cannot"),
        ("depth", "6/0/0", "'depth', frame 6 cannot"),
    ],
)
def test_a_shortened_file_is_found_when_it_is_read_at_opening(recording, tmp_path, name, chunk, found, share):
    save_recording(recording, tmp_path / "a.zarr")
    _cut(tmp_path / "a.zarr" / name / "c" / chunk, share)
    with pytest.raises(RecordingError, match=f"a.zarr: array {found} be read"):
        open_recording(tmp_path / "a.zarr")


def test_a_shortened_or_altered_file_is_found_when_its_frame_is_asked_for(recording, tmp_path):
    path = tmp_path / "a.zarr"
    noisy = np.random.default_rng(0).integers(0, 255, recording.colour.shape).astype(np.uint8)
    save_recording(dataclasses.replace(recording, colour=noisy), path)
    _cut(path / "colour" / "c" / "5" / "0" / "0" / "0")
    _cut(path / "truth" / "labels" / "c" / "2" / "0" / "0")
    file = path / "colour" / "c" / "8" / "0" / "0" / "0"
    altered = bytearray(file.read_bytes())
    altered[len(altered) // 2] ^= 1
    file.write_bytes(bytes(altered))
    again = open_recording(path)
    np.testing.assert_array_equal(again.colour[4], noisy[4])
    np.testing.assert_array_equal(again.colour[-1], noisy[-1])
    for index in (5, slice(3, 7), slice(None), (5, 3), (slice(4, 6), 3)):
        with pytest.raises(RecordingError, match=r"a\.zarr: array 'colour', frame 5 cannot be read"):
            again.colour[index]
    with pytest.raises(RecordingError, match="'colour', frame 8 cannot be read"):
        again.colour[8]
    with pytest.raises(RecordingError, match="'truth/labels', frame 2 cannot be read"):
        again.truth.labels[2]
    with pytest.raises(RecordingError, match="'colour', frame 5 cannot be read"):
        pair_flow(again, 0, 12, "dis_fast")
    with pytest.raises(IndexError):
        again.colour[12]


def test_a_file_lost_after_opening_is_no_black_picture(recording, tmp_path):
    save_recording(recording, tmp_path / "a.zarr")
    again = open_recording(tmp_path / "a.zarr")
    (tmp_path / "a.zarr" / "colour" / "c" / "7" / "0" / "0" / "0").unlink()
    for index in (7, slice(6, 9), -5, [2, 7]):
        with pytest.raises(RecordingError, match="'colour', frame 7 is missing"):
            again.colour[index]
    assert again.colour[6].any()


def _unchecked(value, **changes):
    """A copy with other fields, not checked as the tests' constructors do: programs that use tagjax go unchecked."""
    changed = copy.copy(value)
    for name, field in changes.items():
        object.__setattr__(changed, name, field)
    return changed


def test_numpy_values_in_attributes_are_made_plain(recording, tmp_path):
    lens = recording.intrinsics
    odd = _unchecked(
        recording,
        intrinsics=_unchecked(
            lens,
            fx_px=np.float32(lens.fx_px),
            width=np.int64(32),
            distortion=(np.float32(0.5), np.float64(0), 0.0, np.float32(0)),
        ),
        clock=_unchecked(CLOCK, residual_ms=np.float32("nan"), num_reads=np.int64(7)),
        name=np.str_("odd"),
        reads=_unchecked(
            recording.reads, hop_table_hz=np.array([9e8, 9.1e8]), pi_flips=np.bool_(True), phase_sign=np.int8(1)
        ),
        truth=_unchecked(
            recording.truth,
            tag_to_label={np.str_("tag-a"): np.int64(1), "tag-b": np.uint8(2)},
            visible={np.int64(1): np.ones(12, bool)},
        ),
    )
    save_recording(odd, tmp_path / "a.zarr")
    again = open_recording(tmp_path / "a.zarr")
    assert again.truth.tag_to_label == {"tag-a": 1, "tag-b": 2}
    assert again.intrinsics == dataclasses.replace(lens, distortion=(0.5, 0.0, 0.0, 0.0))
    assert again.clock.num_reads == 7
    assert np.isnan(again.clock.residual_ms)
    assert again.reads.hop_table_hz == (9e8, 9.1e8)
    assert again.reads.pi_flips is True
    assert again.name == "odd"
    np.testing.assert_array_equal(again.truth.visible[1], np.ones(12, bool))


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        ("truth", {"tag_to_label": {"tag-a": {1, 2}}}, r"truth\['tag_to_label'\]\['tag-a'\] holds \{1, 2\} \(set\)"),
        ("truth", {"tag_to_label": {3: 1}}, "the key 3; expected strings"),
        ("truth", {"visible": {1: np.array(["yes"])}}, "truth/visible/0 holds <U3"),
        ("clock", {"residual_ms": 1j}, r"clock\['residual_ms'\] holds 1j"),
        ("reads", {"antenna": np.array([None])}, "reads/antenna holds object"),
        (None, {"source": Path("somewhere")}, "source holds PosixPath"),
    ],
)
def test_what_cannot_be_stored_is_refused_before_any_frame_is_written(recording, tmp_path, part, change, message):
    class Unread:
        shape, dtype = recording.colour.shape, recording.colour.dtype

        def __getitem__(self, index):
            raise AssertionError("a frame was written")

    recording = dataclasses.replace(recording, colour=Unread(), clock=CLOCK)
    changed = change if part is None else {part: _unchecked(getattr(recording, part), **change)}
    with pytest.raises(RecordingError, match=message):
        save_recording(_unchecked(recording, **changed), tmp_path / "a.zarr")
    assert not list(tmp_path.iterdir())


@pytest.fixture
def web(tmp_path):
    """A web server of the folder `tmp_path`: its address, the paths asked for, and a switch that makes it fail."""
    pytest.importorskip("aiohttp", reason="needs the remote extra")
    asked: list[str] = []
    broken = threading.Event()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def send_head(self):
            asked.append(self.path)
            if broken.is_set():
                self.send_error(500)
                return None
            return super().send_head()

        def log_message(self, format, *args):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(tmp_path)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", asked, broken
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.mark.ci
def test_a_web_server_serves_frames_as_they_are_asked_for(recording, tmp_path, web):
    address, asked, broken = web
    noisy = np.random.default_rng(0).integers(1, 255, recording.colour.shape).astype(np.uint8)
    save_recording(dataclasses.replace(_complete(recording), colour=noisy), tmp_path / "a.zarr")
    again = open_recording(f"{address}/a.zarr")
    assert again.store is None
    assert not any("/colour/c/" in path for path in asked)
    np.testing.assert_array_equal(again.colour[4], noisy[4])
    assert [path for path in asked if "/colour/c/" in path] == ["/a.zarr/colour/c/4/0/0/0"]
    np.testing.assert_array_equal(again.truth.labels[0:3], recording.truth.labels[0:3])
    np.testing.assert_array_equal(again.depth[3], recording.depth[3])
    assert pair_flow(again, 0, 3, "dis_fast")[0].shape == (3, 24, 32, 2)
    shutil.rmtree(tmp_path / "a.zarr" / "colour" / "c" / "5")
    with pytest.raises(RecordingError, match="'colour', frame 5 is missing"):
        again.colour[5]
    broken.set()
    with pytest.raises(RecordingError, match=r"http://.*a\.zarr: array 'colour', frame 6 cannot be read"):
        again.colour[6]
    with pytest.raises(RecordingError, match="'depth', frame 2 cannot be read"):
        again.depth_metres(slice(2, 4))


@pytest.mark.ci
def test_a_web_address_without_a_recording_is_an_error(recording, tmp_path, web):
    address, _, broken = web
    with pytest.raises(RecordingError, match="no readable Zarr v3 group"):
        open_recording(f"{address}/nowhere.zarr")
    save_recording(_complete(recording), tmp_path / "a.zarr")
    shutil.rmtree(tmp_path / "a.zarr" / "truth" / "flow_px")
    with pytest.raises(RecordingError, match="'truth/flow_px' is missing"):
        open_recording(f"{address}/a.zarr")
    broken.set()
    with pytest.raises(RecordingError, match=r"a\.zarr: no readable Zarr v3 group"):
        open_recording(f"{address}/a.zarr")
    with pytest.raises(RecordingError, match="no readable Zarr v3 group"):
        open_recording("http://127.0.0.1:1/a.zarr")


def test_a_missing_package_for_an_address_is_named(monkeypatch):
    def absent(*args, **kwargs):
        raise ImportError("HTTPFileSystem requires aiohttp")

    monkeypatch.setattr(zarr, "open_group", absent)
    with pytest.raises(RecordingError, match=r"tagjax\[remote\]"):
        open_recording("https://example.org/a.zarr")


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


def test_missing_depth_gives_a_warning_and_is_refused_where_it_is_needed(recording, tmp_path):
    flat = dataclasses.replace(recording, depth=np.zeros_like(recording.depth))
    with pytest.warns(RecordingWarning, match="no depth at all: only systems that need no depth"):
        flat.check()
    flat.check(depth=False)
    save_recording(flat, tmp_path / "flat.zarr")
    with pytest.warns(RecordingWarning, match="no depth at all"):
        again = open_recording(tmp_path / "flat.zarr")
    for one in (flat, again):
        with pytest.raises(RecordingError, match="no depth at all; TagAttention needs depth"):
            load_clip(one, 0, 6, stride=2)


def test_a_frame_without_depth_is_carried(recording):
    hole = recording.depth.copy()
    hole[0] = 0
    with pytest.warns(RecordingWarning, match="frame 0 has no depth"):
        dataclasses.replace(recording, depth=hole).check()
    hole[:6] = 0
    clip = load_clip(dataclasses.replace(recording, depth=hole), 0, 6, stride=2)
    assert not np.any(clip.frames.depth_m)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx_px": 0.0}, "fx_px is 0.0; expected a positive"),
        ({"fy_px": float("nan")}, "fy_px is nan"),
        ({"cx_px": float("inf")}, "cx_px is inf; expected a finite"),
        ({"distortion": (0.1,)}, "in a number that OpenCV takes"),
        ({"distortion": (0.1, 0.0, 0.0, float("nan"))}, "expected finite k1"),
        ({"width": 0, "height": -3}, "0 x -3; expected positive integers"),
    ],
)
def test_intrinsics_that_no_camera_has_are_errors(recording, change, message):
    odd = dataclasses.replace(recording, intrinsics=dataclasses.replace(recording.intrinsics, **change))
    with pytest.raises(RecordingError, match=message):
        odd.check()


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


def test_one_read_is_accepted_and_its_distance_is_unknown(recording):
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
        _with_reads(recording, time_ns=recording.reads.time_ns + int(1e13)).check()
    with pytest.raises(RecordingError, match=r"count from 0, those of the reads do not: import with start="):
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


def test_unknown_carriers_give_a_warning_and_are_left_out(recording):
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
    relative = np.asarray(clip.frames.radio.relative_m)[-1, 1, 0]
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


def test_true_flow_is_what_the_recording_holds(recording):
    rng, shape = np.random.default_rng(0), (*recording.colour.shape[:3], 2)
    ahead, back = (rng.normal(size=shape).astype(np.float32) for _ in range(2))
    ahead[-1] = back[0] = back[3, 5:9] = np.nan
    known = dataclasses.replace(recording, truth=Truth(flow_px=ahead, backward_flow_px=back))
    forward, backward = pair_flow(known, 0, 5, "truth")
    assert not forward[0].any()
    assert not backward[0].any()
    np.testing.assert_array_equal(forward[1:], ahead[:4])
    np.testing.assert_array_equal(backward[1:3], back[1:3])
    assert not backward[3, 5:9].any()
    np.testing.assert_array_equal(pair_flow(known, 2, 5, "truth")[1], backward[2:])
    np.testing.assert_array_equal(
        pair_flow(time_reversed(known), 7, 9, "truth")[0], pair_flow(known, 4, 6, "truth")[1][::-1]
    )
    with pytest.raises(RecordingError, match="has no true flow"):
        pair_flow(recording, 0, 2, "truth")


_CACHE = Path("cache", "flow", "dis_fast")


@pytest.fixture
def moving(recording, tmp_path) -> Recording:
    """A stored recording whose pictures change, so that no flow is zero."""
    rng = np.random.default_rng(3)
    wall = rng.integers(0, 255, (12, 16, 3)).astype(np.uint8).repeat(6, 0).repeat(6, 1)
    shift = [2 * t for t in range(12)]
    colour = np.stack([np.roll(wall, s, axis=1) for s in shift])
    lens = dataclasses.replace(recording.intrinsics, width=96, height=72)
    depth = np.full((12, 72, 96), 2, np.float32)
    save_recording(
        dataclasses.replace(recording, colour=colour, depth=depth, intrinsics=lens, truth=None), tmp_path / "m.zarr"
    )
    return open_recording(tmp_path / "m.zarr")


def _direct(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """The flow of a recording, computed without the cache."""
    both = pair_flow(dataclasses.replace(recording, store=None), 0, recording.num_frames, "dis_fast")
    return both[0].astype(np.float16).astype(np.float32), both[1].astype(np.float16).astype(np.float32)


def _agrees(recording: Recording) -> None:
    held, direct = pair_flow(recording, 0, recording.num_frames, "dis_fast"), _direct(recording)
    for one, other in zip(held, direct, strict=True):
        assert all(frame.any() for frame in other[1:])
        np.testing.assert_array_equal(one, other)


def test_kept_flow_is_what_is_computed_whatever_stretch_is_asked_for(moving):
    direct = _direct(moving)
    alone = pair_flow(dataclasses.replace(moving, store=None), 3, 5, "dis_fast")
    for held, one, other in zip(pair_flow(moving, 3, 5, "dis_fast"), direct, alone, strict=True):
        np.testing.assert_array_equal(held, one[3:5])
        np.testing.assert_array_equal(other.astype(np.float16), one[3:5].astype(np.float16))
    _agrees(moving)
    assert not list((Path(moving.store.store.root) / _CACHE.parent).glob(".*"))


def test_flow_is_written_frame_by_frame(moving, monkeypatch):
    folder = Path(moving.store.store.root) / _CACHE.parent
    behind = []

    def watching(name):
        flow = make_flow(name)

        def compute(before, now):
            written = [len(list(way.glob("c/*"))) for way in folder.glob(".*.partial/array/*ward")]
            behind.append((len(behind) // 2 + 1, sorted(written)))
            return flow(before, now)

        return compute

    monkeypatch.setattr(flow_cache, "make_flow", watching)
    pair_flow(moving, 0, 2, "dis_fast")
    assert behind == [(pair, [pair, pair]) for pair in range(1, 12) for _ in range(2)]


@pytest.mark.parametrize("stop", [KeyboardInterrupt, RuntimeError])
def test_an_interrupted_flow_leaves_the_recording_usable(moving, monkeypatch, stop):
    def failing(name):
        left = [make_flow(name)] * 9

        def compute(before, now):
            if not left:
                raise stop
            return left.pop()(before, now)

        return compute

    with monkeypatch.context() as patch:
        patch.setattr(flow_cache, "make_flow", failing)
        with pytest.raises(stop):
            pair_flow(moving, 0, 12, "dis_fast")
    assert not list((Path(moving.store.store.root) / _CACHE.parent).iterdir())
    _agrees(open_recording(moving.store.store.root))


_KILLED = """
import os, signal, sys
from tagjax.flow import cache as flow_cache
from tagjax.recording import store
from tagjax.recording.store import open_recording

def slow(name):
    count = []
    def compute(before, now):
        count.append(1)
        if len(count) == 9:
            os.kill(os.getpid(), signal.SIGKILL)
        return make(name)(before, now)
    return compute

make, flow_cache.make_flow = flow_cache.make_flow, slow
flow_cache.pair_flow(open_recording(sys.argv[1]), 0, 12, "dis_fast")
"""


def test_partial_flow_of_a_killed_process_is_never_read_and_removed(moving, monkeypatch):
    path = Path(moving.store.store.root)
    killed = subprocess.run([sys.executable, "-c", _KILLED, str(path)], capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    folder = path / _CACHE.parent
    assert {file.name for file in folder.iterdir()} == {".dis_fast.partial", ".dis_fast.lock"}
    other = folder / ".farneback.partial"  # of another flow: it could be of a process that still runs
    shutil.copytree(folder / ".dis_fast.partial", other)
    _agrees(open_recording(path))
    assert {file.name for file in folder.iterdir()} == {"dis_fast", other.name}
    shutil.rmtree(path / _CACHE)
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 7200)
    _agrees(open_recording(path))
    assert {file.name for file in folder.iterdir()} == {"dis_fast"}


def test_flow_of_other_shape_or_version_or_without_its_mark_is_computed_again(moving):
    path = Path(moving.store.store.root)
    _agrees(moving)
    for change in ({"version": 0}, {"complete": False}, {"shape": [11, 72, 96, 2]}, None):
        group = zarr.open_group(str(path / _CACHE), mode="r+")
        group["forward"][:] = 7  # type: ignore[index]
        group.attrs.update(change) if change else group.attrs.clear()
        _agrees(open_recording(path))
    group = zarr.open_group(str(path / _CACHE), mode="r+")
    for way in ("forward", "backward"):  # arrays that do not fit the pictures
        del group[way]
        group.create_array(way, data=np.ones((12, 5, 5, 2), np.float16), chunks=(1, 5, 5, 2))
    _agrees(open_recording(path))


def test_damaged_flow_is_computed_again(moving):
    path = Path(moving.store.store.root)
    _agrees(moving)
    chunk = path / _CACHE / "backward" / "c" / "7" / "0" / "0" / "0"
    _cut(chunk)
    _agrees(moving)
    chunk.unlink()
    _agrees(moving)
    shutil.rmtree(path / _CACHE / "forward")
    _agrees(moving)
    assert sorted(file.name for file in (path / _CACHE.parent).iterdir()) == ["dis_fast"]


def test_of_two_that_ask_at_once_one_computes(moving, monkeypatch):
    path = Path(moving.store.store.root)
    computed, compute = [], flow_cache._compute

    def counting(recording, folder, *args):
        computed.append(folder)
        time.sleep(0.3)
        compute(recording, folder, *args)

    monkeypatch.setattr(flow_cache, "_compute", counting)
    found: list = []
    threads = [
        threading.Thread(target=lambda: found.append(pair_flow(open_recording(path), 0, 12, "dis_fast")))
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(computed) == 1
    assert len(found) == 2
    for both in found:
        for one, other in zip(both, _direct(moving), strict=True):
            np.testing.assert_array_equal(one, other)
    assert [file.name for file in (path / _CACHE.parent).iterdir()] == ["dis_fast"]


def test_pictures_replaced_after_opening_have_a_flow_of_their_own(moving):
    _agrees(moving)
    still = dataclasses.replace(moving, colour=np.zeros(moving.colour.shape, np.uint8))
    assert not pair_flow(still, 0, 12, "dis_fast")[0].any()
    _agrees(moving)


def test_the_clip_stream_is_shuffled_by_seed_and_resumes_exactly(recording):
    def stream(seed):
        return iter(clip_dataset([recording], clip_length=4, stride=4, step=1, seed=seed, estimator="literal"))

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


def test_two_processes_that_write_one_recording_leave_one_of_them(tmp_path, monkeypatch):
    """The second to finish is told so in words, and what the first wrote stays."""
    path = tmp_path / "a.zarr"
    write, calls = store.write_recording, []

    def overtaken(recording, root, **settings):
        write(recording, root, **settings)
        if not calls:
            calls.append(1)
            save_recording(recording, path)

    monkeypatch.setattr(store, "write_recording", overtaken)
    with pytest.raises(RecordingError, match="another process wrote it meanwhile"):
        save_recording(synthetic.recording(3), path)
    assert open_recording(path).num_frames == 3
    assert [item.name for item in tmp_path.iterdir()] == ["a.zarr"]
