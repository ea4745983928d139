"""The Rerun viewer's file: what is logged is what was recorded and traced."""

from __future__ import annotations

import builtins
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_segment_tracer import EPCS, scene

from tagjax.core.settings import ConfigError
from tagjax.evaluation.view import ViewConfig, view_recording
from tagjax.recording.store import save_recording
from tagjax.report import viewer
from tagjax.tagattention.tracer_settings import make_tracer
from tagjax.tracing.clips import ClipSettings, clip_loader
from tagjax.tracing.recordings import trace_recording

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
    assert len(_logged(out, "/camera/picture/masks")) == 40
    assert any("detected" in value[0] for _, value in _logged(out, "/status"))


def test_log_odds_are_shown_in_whole_nats() -> None:
    nats = np.array([[-30.0, -8.4, -1.2, 0.0], [0.4, 2.6, 7.6, 30.0]])
    classes = viewer.log_odds_classes((1.0 / (1.0 + np.exp(-nats))).astype(np.float32))
    assert classes.tolist() == [[1, 1, 8, 9], [9, 12, 17, 17]]
    assert viewer.log_odds_classes(np.array([[0.0, 1.0]], np.float32)).tolist() == [[0, 17]]


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
