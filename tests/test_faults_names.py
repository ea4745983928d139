"""Names that leave a folder, are formulas or markup, and recordings whose data lie outside of their domain."""

import csv
import dataclasses
import io
import json
import os

import numpy as np
import pytest
import zarr
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from tagjax.core.names import name_fault, plain_label, safe_file_name, valid_name
from tagjax.core.results import write_csv
from tagjax.recording import Recording, RecordingError, RecordingWarning, TagReads, Truth
from tagjax.recording.store import open_recording, save_recording
from tests import synthetic_clips as synthetic

HOSTILE = [
    "/somewhere/x",
    "../../up",
    "..",
    ".hidden",
    "a/b",
    "a\\b",
    "C:\\x",
    "a\0b",
    "a\nb",
    "$\\foo{$",
    "x[/b]",
    "[bold]x",
    "=1+1",
    "-1+1",
    "@SUM(A1)",
    "<script>",
    "x" * 300,
    "",
    " ",
    "a ",
    "a\u202eb",
    "\ud800",
]


@pytest.fixture
def recording() -> Recording:
    return synthetic.recording(6)


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_names_are_refused_before_anything_is_traced(recording, name):
    with pytest.raises(RecordingError, match="The recording's name: found"):
        dataclasses.replace(recording, name=name).check()
    reads = dataclasses.replace(recording.reads, epc=np.array([name] * recording.reads.num_reads, dtype=object))
    if "\0" not in name and name != "\ud800":  # NumPy's text has no such characters
        reads = dataclasses.replace(reads, epc=np.array([name] * recording.reads.num_reads))
        with pytest.raises(RecordingError, match="an EPC: found"):
            recording.with_reads(reads).check()
    with pytest.raises(RecordingError, match="an EPC: found"):
        dataclasses.replace(recording, truth=dataclasses.replace(recording.truth, tag_to_label={name: 1})).check()


@pytest.mark.parametrize(
    "name", ["E280 1191", "tag-a", "walkers-people-test-3", "Größe 1", "label1-seed0", "a.b_c", "0"]
)
def test_ordinary_names_are_allowed_and_become_file_names(name):
    assert name_fault(name) is None
    assert valid_name(name) == name
    assert safe_file_name(name).startswith(name[:4].replace(" ", "_"))


@given(st.text(max_size=400))
def test_any_text_becomes_a_file_name_inside_of_its_folder(text):
    name = safe_file_name(text)
    assert os.path.basename(name) == name
    assert name not in ("", ".", "..")
    assert not name.startswith(".")
    assert len(name.encode()) <= 255
    assert "\0" not in name
    assert name_fault(valid_name(text)) is None


@given(st.lists(st.text(max_size=120), min_size=2, max_size=2, unique=True))
def test_two_texts_never_share_a_file_name(texts):
    assert safe_file_name(texts[0]) != safe_file_name(texts[1])


@pytest.mark.parametrize("name", ["walkers-people-test-0", "E2801191", "a-c14cddc", "con-1", "Größe", "console.txt"])
def test_an_ordinary_name_stays_as_it_is_in_files(name):
    assert safe_file_name(name) == name


@pytest.mark.parametrize("text", ["a/b", "x" * 300, "con", "é" * 50])
def test_a_text_that_looks_like_a_file_name_of_another_does_not_share_it(text):
    assert safe_file_name(safe_file_name(text)) != safe_file_name(text)


@pytest.mark.parametrize("text", ["\u00e9" * 100, "\u4e2d" * 100, "\U00020000" * 100, "x" + "\u00e9" * 100])
def test_a_file_name_is_limited_in_bytes(text):
    name = safe_file_name(text)
    assert len(name.encode()) <= 90
    assert text.startswith(name.rpartition("-")[0])
    assert len(name.rpartition("-")[0].encode()) >= 77


@pytest.mark.parametrize("text", ["con", "NUL", "Com1", "lpt9.txt", "aux.a.b", "prn.", "com\u00b9"])
def test_no_file_name_is_a_device_of_windows(text):
    assert safe_file_name(text).startswith("_")
    assert safe_file_name(text).partition(".")[0].lower() != text.partition(".")[0].lower()


@pytest.mark.parametrize("text", ["-x", "+", "-"])
def test_a_name_made_of_a_text_begins_as_names_do(text):
    assert name_fault(valid_name(text)) is None


def test_a_formula_is_a_text_in_a_csv_file(tmp_path):
    row = ["=1+1", "+a", "@x", "-2.5", "-1e-05", "nan", "-inf", 3, None, "plain"]
    write_csv(tmp_path / "a.csv", [str(k) for k in range(len(row))], [row])
    with open(tmp_path / "a.csv", newline="") as file:
        written = list(csv.reader(file))[1]
    assert written == ["'=1+1", "'+a", "'@x", "-2.5", "-1e-05", "nan", "-inf", "3", "", "plain"]


def test_markup_and_formulas_are_shown_as_they_are(tmp_path):
    from tagjax.report.report import score_table

    pytest.importorskip("matplotlib")
    from tagjax.report.curves import score_curves

    scores = {"iou": 0.5, "num_frames": 3}
    text = io.StringIO()
    console = Console(file=text, width=200, markup=False)
    console.print(score_table({"x[/b]": {"all": scores}}, title="report: [bold]"))
    assert "x[/b]" in text.getvalue()
    assert "report: [bold]" in text.getvalue()
    line = {"iou": np.ones(3), "cle_px": np.ones(3)}
    score_curves(tmp_path / "a.png", {"x": line}, np.ones(3, bool), title=plain_label("$\\foo{$"))
    assert (tmp_path / "a.png").stat().st_size > 0


def test_imported_folders_with_odd_names_get_a_name(tmp_path):
    assert name_fault(valid_name("$\\foo{$")) is None
    assert valid_name("rgbd_dataset_freiburg1_xyz") == "rgbd_dataset_freiburg1_xyz"


def test_names_listed_twice_are_refused(recording, tmp_path):
    save_recording(recording, tmp_path / "a.zarr")
    path = tmp_path / "a.zarr" / "zarr.json"
    sound = path.read_text()
    for change in (
        lambda one: one.update(epcs=["tag-a"] * len(one["epcs"])),
        lambda one: one["truth"].update(tag_range_m=["tag-a"] * len(one["truth"]["tag_range_m"])),
    ):
        stored = json.loads(sound)
        change(stored["attributes"])
        path.write_text(json.dumps(stored))
        with pytest.raises(RecordingError, match="tag-a more than once"):
            open_recording(tmp_path / "a.zarr")


def _lens(recording, **change):
    return {"intrinsics": dataclasses.replace(recording.intrinsics, **change)}


def _reads(recording, **change):
    return {"reads": dataclasses.replace(recording.reads, **change)}


def _truth(recording, **change):
    return {"truth": dataclasses.replace(recording.truth, **change)}


def _later(recording, fraction):
    """Times of reads, the last ones of them ten seconds later."""
    number = recording.reads.num_reads
    return recording.reads.time_ns + 10**10 * (np.arange(number) >= (1 - fraction) * number)


FAULTS = {
    "kind of depth": (lambda r: {"depth_kind": "z"}, "depth_kind is 'z'; expected 'depth'"),
    "antenna in mm": (
        lambda r: {"antennas_m": np.array([[1200.0, 0, 0]])},
        "1200 m from the camera; expected at most 100",
    ),
    "no antenna": (lambda r: {"antennas_m": np.zeros((0, 3))}, "one row at least"),
    "antennas as text": (lambda r: {"antennas_m": np.array([["a", "b", "c"]])}, "expected .antennas, 3. metres"),
    "antenna not finite": (lambda r: {"antennas_m": np.array([[np.nan, 0, 0]])}, "not finite"),
    "focal length in mm": (lambda r: _lens(r, fx_px=0.004), "fx_px is 0.004 .*must be converted"),
    "focal length of another image": (lambda r: _lens(r, fy_px=1e5), "fy_px is 1e.05"),
    "phase sign": (lambda r: _reads(r, phase_sign=0), "phase_sign is 0; expected 1"),
    "phase period": (lambda r: _reads(r, phase_period_rad=360.0), "phase_period_rad is 360.0; expected radians"),
    "phase period not finite": (lambda r: _reads(r, phase_period_rad=float("nan")), "phase_period_rad is nan"),
    "phase period as a boolean": (lambda r: _reads(r, phase_period_rad=True), "phase_period_rad is True"),
    "flips as a number": (lambda r: _reads(r, pi_flips=1), "pi_flips is 1; expected true, false, or null"),
    "flips as a text": (lambda r: _reads(r, pi_flips="no"), "pi_flips is 'no'"),
    "hop table in MHz": (lambda r: _reads(r, hop_table_hz=(920.0,)), "hop_table_hz is .920.0.*in Hz"),
    "times of reads as floats": (
        lambda r: _reads(r, time_ns=r.reads.time_ns.astype(float)),
        "column time_ns is float64",
    ),
    "antenna numbers as floats": (lambda r: _reads(r, antenna=r.reads.antenna + 0.5), "column antenna is float"),
    "phase as text": (lambda r: _reads(r, phase_rad=r.reads.phase_rad.astype(str)), "column phase_rad is <U"),
    "times of frames as floats": (lambda r: {"time_ns": r.time_ns * 1e-9}, "time_ns is float64"),
    "short truth": (
        lambda r: _truth(r, tag_range_m={"tag-a": np.ones(5)}),
        r"truth.tag_range_m\['tag-a'\] is float64 of shape \(5,\); expected floats of shape 6",
    ),
    "labels of another size": (lambda r: _truth(r, labels=np.zeros((6, 2, 2), np.uint8)), "truth.labels is uint8"),
    "labels as floats": (
        lambda r: _truth(r, labels=np.zeros((6, *r.image_shape), np.float32)),
        "truth.labels is float32",
    ),
    "label 0": (lambda r: _truth(r, tag_to_label={"tag-a": 0}), "tag-a the label 0; expected 1 to 254"),
    "label 255": (lambda r: _truth(r, tag_to_label={"tag-a": 255}), "the label 255"),
    "visible as numbers": (lambda r: _truth(r, visible={1: np.ones(6)}), "truth.visible.1. is float64"),
    "boxes": (lambda r: _truth(r, boxes_px=np.zeros((6, 2), np.float32)), "truth.boxes_px is float32"),
    "most reads after the video": (
        lambda r: _reads(r, time_ns=_later(r, 0.8)),
        "of the reads fall outside of the video's time.*clock=arrival",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_data_outside_of_their_domain_are_refused(recording, fault):
    change, message = FAULTS[fault]
    try:
        faulty = dataclasses.replace(recording, **change(recording))
    except Exception:  # the runtime type checker of the tests is first
        faulty = _unchecked(recording, change)
    with pytest.raises(RecordingError, match=message):
        faulty.check()


def _unchecked(recording, change):
    """As made by a caller whose types nobody checks."""

    class Free:
        pass

    def copy(one, **changes):
        other = object.__new__(type(one))
        for field in dataclasses.fields(one):
            object.__setattr__(other, field.name, changes.get(field.name, getattr(one, field.name)))
        return other

    original, dataclasses.replace = dataclasses.replace, copy
    try:
        return copy(recording, **change(recording))
    finally:
        dataclasses.replace = original


def test_some_reads_outside_of_the_video_give_a_warning_with_their_fraction(recording):
    later = dataclasses.replace(recording.reads, time_ns=_later(recording, 0.25))
    with pytest.warns(RecordingWarning, match=r"2\d% of the reads fall outside"):
        recording.with_reads(later).check()


def test_a_sound_recording_is_not_refused(recording):
    recording.check()
    dataclasses.replace(recording, truth=Truth()).check()
    with pytest.warns(RecordingWarning, match="no tag read"):
        recording.with_reads(TagReads.empty()).check()


def test_the_trials_of_names_and_targets(tmp_path):
    from tagjax.benchmarks.faults import names, targets

    for outcome in (*names.trial(300, 1, tmp_path), *targets.trial(1200, 1, tmp_path)):
        assert outcome.failed == 0, outcome
        assert outcome.tried == 300


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda one: one.update(epcs=one["epcs"][:-1]), "reads/epc holds 0 to 1 .*; expected integers from 0 to 0"),
        (lambda one: one.update(epcs=[]), "reads/epc holds"),
        (lambda one: one.update(epcs=[1, 2]), "epcs is .1, 2.; expected a list of texts"),
        (lambda one: one.update(epcs="ab"), "epcs is ab; expected a list of texts"),
        (lambda one: one.update(name=5), "name is 5; expected a text"),
        (lambda one: one.update(source=None), "source is None; expected a text"),
        (lambda one: one["reads"].update(pi_flips="no"), "pi_flips"),
        (lambda one: one["reads"].update(phase_period_rad=True), "phase_period_rad"),
    ],
)
def test_attributes_of_another_type_are_refused(recording, tmp_path, change, message):
    epcs = np.where(np.arange(recording.reads.num_reads) % 2, "tag-a", "tag-b")
    reads = dataclasses.replace(recording.reads, epc=epcs)
    save_recording(recording.with_reads(reads), tmp_path / "a.zarr")
    path = tmp_path / "a.zarr" / "zarr.json"
    stored = json.loads(path.read_text())
    change(stored["attributes"])
    path.write_text(json.dumps(stored))
    with pytest.raises(RecordingError, match=message):
        open_recording(tmp_path / "a.zarr")


@pytest.mark.parametrize("index", [-1, 5, 2**31 - 1])
def test_an_index_outside_of_the_list_of_epcs_is_refused(recording, tmp_path, index):
    save_recording(recording, tmp_path / "a.zarr")
    array = zarr.open_group(str(tmp_path / "a.zarr"), mode="r+")["reads/epc"]
    array[0] = index
    with pytest.raises(RecordingError, match=f"reads/epc holds .*{index}.*expected integers from 0 to"):
        open_recording(tmp_path / "a.zarr")
