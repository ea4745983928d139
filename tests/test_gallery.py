"""The gallery of suites: which recording and which frame it shows, and what is drawn there."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_segment_tracer import EPCS, scene

from tagjax.core.settings import ConfigError
from tagjax.evaluation import gallery as module
from tagjax.evaluation.gallery import GalleryConfig, make_gallery
from tagjax.recording.image_files import read_colour
from tagjax.recording.store import save_recording
from tagjax.report.overlay import PALETTE_RGB
from tagjax.tracing.tracer import Trace

TRACER = {
    "_target_": "tagjax.tagattention.TagAttention",
    "segments": {"segmenter": {"num_segments": 256}},
    "clips": {"stride": 1, "flow": "zero"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two suites with a recording of 40 frames, one of them with a longer one beside, and one without a validation split."""
    root = tmp_path_factory.mktemp("recordings")
    for suite, number in (("b", 0), ("a", 0), ("a", 1)):
        save_recording(scene(40 if number == 0 else 45), root / suite / "validation" / f"{suite}-{number}.zarr")
    (root / "c" / "train").mkdir(parents=True)
    return root


def _config(folder: Path, out: Path, **changed: Any) -> GalleryConfig:
    return GalleryConfig(**{"tracer": TRACER, "recordings_dir": str(folder), "out": str(out), **changed})


def test_a_suite_shows_its_first_recording_of_the_split(folder: Path, tmp_path: Path) -> None:
    found = _config(folder, tmp_path).recordings()
    assert {name: path.name for name, path in found.items()} == {"a": "a-0.zarr", "b": "b-0.zarr"}
    assert list(_config(folder, tmp_path, suites=("b",)).recordings()) == ["b"]


def test_what_is_not_there_is_an_error_that_names_the_command(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no validation recording of c, d in .*simulate suite=c"):
        _config(folder, tmp_path, suites=("a", "c", "d")).recordings()
    for empty in (folder / "c", folder / "nothing"):
        with pytest.raises(ConfigError, match=r"Found no validation recording in .*simulate suite="):
            _config(empty, tmp_path).recordings()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"split": "all"}, "split is 'all'; expected one of train, validation, test"),
        ({"at_s": -1.0}, "at_s is -1"),
        ({"at_s": np.inf}, "at_s is inf"),
        ({"width": 320}, "width is 320; expected at least 480"),
        ({"quality": 0}, "quality is 0"),
    ],
)
def test_wrong_settings_are_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        GalleryConfig(tracer=TRACER, out="a", **changed)


@pytest.mark.parametrize(("at_s", "frame"), [(0.0, 0), (0.5, None), (100.0, 39)])
def test_the_frame_follows_from_the_time_alone(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_s: float, frame: int | None
) -> None:
    shown = []

    def overlay(traced: Any, number: int, trace: Trace, width: int, *, caption: str) -> np.ndarray:
        shown.append((number, caption))
        return np.zeros((8, width, 3), np.uint8)

    monkeypatch.setattr(module, "frame_overlay", overlay)
    recording = scene(40)
    times_s = (recording.time_ns - recording.time_ns[0]) * 1e-9
    expected = int(np.argmax(times_s >= at_s - 1e-6)) if frame is None else frame
    module.still(_config(folder, tmp_path, at_s=at_s), folder / "a" / "validation" / "a-0.zarr", "a")
    assert shown == [(expected, f"a, {times_s[expected]:.1f} s")]


@pytest.mark.ci
def test_each_suite_becomes_a_picture_with_a_box_of_each_tag(folder: Path, tmp_path: Path) -> None:
    done: list[tuple[Any, ...]] = []
    config = dataclasses.replace(_config(folder, tmp_path / "new"), at_s=100.0)
    written = make_gallery(config, on_progress=lambda *one: done.append(one[:3]))
    assert [path.name for path in written] == ["a.jpg", "b.jpg"]
    assert done[-1] == ("suite", 2, 2)
    image = read_colour(written[0])
    assert image.shape[1] == 480
    shades = np.array(PALETTE_RGB[: len(EPCS)])
    near = np.abs(image.astype(int)[:, :, None] - shades).max(axis=-1) < 40
    assert near.any(axis=(0, 1)).all()
