"""The Rerun viewer's file: what is logged is what was recorded and traced."""

from __future__ import annotations

import builtins
import time
from pathlib import Path
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from test_segment_tracer import EPCS, scene

from experiments.view import with_run
from tagjax.core.settings import ConfigError
from tagjax.evaluation.view import ViewConfig, view_recording
from tagjax.recording.store import save_recording
from tagjax.report import viewer
from tagjax.report.motion_error import MotionError
from tagjax.tagattention.tracer_settings import make_tracer
from tagjax.tracing.clips import ClipSettings, clip_loader
from tagjax.tracing.recordings import trace_recording
from tagjax.tracing.tracer import Trace

TRACER = {"_target_": "tagjax.tagattention.TagAttention", "segments": {"segmenter": {"num_segments": 256}}}
CLIPS = {"stride": 1, "flow": "zero"}


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    save_recording(scene(40), folder / "scene.zarr")
    return folder / "scene.zarr"


def _logged(file: Path, entity: str) -> list[Any]:
    """The rows of an entity's values in order of time."""
    from rerun.chunk import RrdReader

    rows = []
    for chunk in RrdReader(file).stream().to_chunks():
        if chunk.entity_path == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            name = next(
                one for one in batch.schema.names if one not in ("rerun.controls.RowId", "time", "log_time", "log_tick")
            )
            times = np.asarray(batch.column("time").cast("int64"))
            rows += zip(times.tolist(), batch.column(name).to_pylist(), strict=True)
    return sorted(rows, key=lambda row: row[0])


def _image_sizes(file: Path, entity: str) -> set[tuple[int, int]]:
    """Widths and heights of the images of an entity."""
    from rerun.chunk import RrdReader

    sizes = set()
    for chunk in RrdReader(file).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if chunk.entity_path == entity and name.endswith(":format"):
                sizes |= {(one[0]["width"], one[0]["height"]) for one in batch.column(name).to_pylist() if one}
    return sizes


def _num_chunks(file: Path, entity: str) -> int:
    from rerun.chunk import RrdReader

    return sum(one.entity_path == entity and not one.is_static for one in RrdReader(file).stream().to_chunks())


def test_the_file_holds_reads_pictures_and_what_was_traced(path: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    done = []
    config = ViewConfig(recording=str(path), tracer=TRACER, clips=CLIPS)

    def progress(*one: Any) -> None:
        done.append(one)
        time.sleep(0.02)  # as a slow machine: a file's size must not depend on it

    out = view_recording(config, tmp_path, on_progress=progress)
    assert out == tmp_path / f"{scene(40).name}.rrd"
    assert out.stat().st_size < 5e6
    assert _num_chunks(out, f"/confidence/{next(iter(EPCS))}") == 1
    assert done == [("trace", 0, 40, "compiling"), *(("trace", number, 40) for number in range(1, 41))]
    traces = list(trace_recording(make_tracer(TRACER), scene(40), clip_loader(ClipSettings(**CLIPS)), epcs=list(EPCS)))
    for tag, epc in enumerate(EPCS):
        reads = scene(40).reads.select(epc)
        phases = _logged(out, f"/phase/{epc}")
        np.testing.assert_allclose([value[0] for _, value in phases], reads.phase_rad)
        np.testing.assert_allclose([time for time, _ in phases], reads.time_ns - scene(40).time_ns[0], atol=1000)
        confidence = [value[0] for _, value in _logged(out, f"/confidence/{epc}")]
        np.testing.assert_allclose(confidence, [trace.confidence[tag] for _, trace in traces])
        for name in ("body", "stationary", "free", "best_segment"):
            nats = [value[0] for _, value in _logged(out, f"/evidence/{epc}/{name}")]
            np.testing.assert_allclose(nats, [getattr(trace.evidence, name)[tag] for _, trace in traces])
        assert len(_logged(out, f"/log_odds/{epc}")) == 40
        low, middle, high = (
            {time: value[0] for time, value in _logged(out, f"/distance/{epc}{edge}") if np.isfinite(value[0])}
            for edge in ("/low", "", "/high")
        )
        assert len(middle) == sum(bool(trace.detected[tag]) for _, trace in traces)
        assert all(high[time] - one == pytest.approx(one - low[time]) for time, one in middle.items())
        assert max(high[time] - one for time, one in middle.items()) < 0.1
    assert len(_logged(out, "/camera/picture/masks")) == 40
    assert any("detected" in value[0] for _, value in _logged(out, "/status"))


def test_log_odds_are_shown_in_whole_nats() -> None:
    nats = np.array([[-30.0, -8.4, -1.2, 0.0], [0.4, 2.6, 7.6, 30.0]])
    classes = viewer.log_odds_classes((1.0 / (1.0 + np.exp(-nats))).astype(np.float32))
    assert classes.tolist() == [[0, 0, 7, 8], [8, 11, 16, 16]]
    assert viewer.log_odds_classes(np.array([[0.0, 1.0]], np.float32)).tolist() == [[0, 16]]
    assert [number for number, _, _ in viewer._log_odds_classes()] == list(range(17))
    assert viewer._log_odds_classes()[8][1] == "+0 nats"


def test_pictures_are_small_unless_asked_for(path: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    made = {}
    for full_size in (False, True):
        folder = tmp_path / str(full_size)
        folder.mkdir()
        config = ViewConfig(
            recording=str(path), tracer=TRACER, clips={**CLIPS, "stride": 2}, frames=(0, 20), full_size=full_size
        )
        made[full_size] = view_recording(config, folder)
    height, width = scene(40).intrinsics.height, scene(40).intrinsics.width
    for full_size, out in made.items():
        assert out is not None
        divided = 1 if full_size else 2
        (picture,) = _logged(out, "/camera/picture")[0][1]
        shape = cv2.imdecode(np.frombuffer(bytes(picture), np.uint8), cv2.IMREAD_COLOR).shape
        assert shape == (height // divided, width // divided, 3)
        assert _image_sizes(out, "/camera/picture/masks") == {(width // divided, height // divided)}
        (odds,) = _image_sizes(out, f"/log_odds/{next(iter(EPCS))}")
        assert odds == (width // (2 * divided), height // (2 * divided))


def test_a_quality_that_is_none_is_refused(path: Path) -> None:
    with pytest.raises(ConfigError, match="quality is 0; expected a value from 1 to 100"):
        ViewConfig(recording=str(path), tracer=TRACER, quality=0)


def test_a_band_grows_with_the_way_and_is_forgotten() -> None:
    error = MotionError(drift_m=1e-4, memory_s=4.0)

    def frame(step_m: float) -> Trace:
        return Trace(
            mask=jnp.zeros((2, 1, 1)),
            box_px=jnp.zeros((2, 4)),
            centre_px=jnp.zeros((2, 2)),
            centre_m=jnp.array([[0.5, 0.0, 2.0]] * 2),
            step_m=jnp.array([[step_m], [0.0]]),
            confidence=jnp.zeros(2),
            detected=jnp.zeros(2, bool),
        )

    np.testing.assert_allclose(error.after(0.0, frame(0.0)), [0.0, 0.0])
    np.testing.assert_allclose(error.after(0.1, frame(-0.25)), [0.01, 0.0])  # sqrt(1e-4 * 2^2 * 0.25)
    np.testing.assert_allclose(error.after(4.1, frame(0.0)), [0.01 * np.exp(-0.5), 0.0], rtol=1e-6)
    np.testing.assert_allclose(error.after(4.1, frame(np.nan)), [0.01 * np.exp(-0.5), 0.0], rtol=1e-6)


def test_a_run_gives_its_tracer_and_its_weights(tmp_path: Path) -> None:
    values = {"recording": "a.zarr", "tracer": {"_target_": "other"}, "weights": None, "run": None}
    assert with_run(values) == {"recording": "a.zarr", "tracer": {"_target_": "other"}, "weights": None}
    values["run"] = str(tmp_path)
    with pytest.raises(FileNotFoundError, match="expected a run folder of experiments"):
        with_run(values)
    (tmp_path / "config.yaml").write_text(f"tracer:\n  _target_: {TRACER['_target_']}\n")
    found = with_run(values)
    assert found == {
        "recording": "a.zarr",
        "tracer": {"_target_": TRACER["_target_"]},
        "weights": str(tmp_path / "weights.json"),
    }
    assert ViewConfig(**found).weights == found["weights"]
    with pytest.raises(ValueError, match=r"found both run=.* and weights=default"):
        with_run(values | {"weights": "default"})


def test_a_missing_package_is_reported_before_the_work(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def without(name: str, *more: Any, **named: Any) -> Any:
        if name == "rerun":
            raise ImportError(name)
        return real(name, *more, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError, match=r"needs rerun-sdk, which is not installed: pip install .*\[viewer\]"):
        view_recording(ViewConfig(recording=str(path), tracer=TRACER), tmp_path)
    with pytest.raises(ConfigError):
        viewer.rerun()
