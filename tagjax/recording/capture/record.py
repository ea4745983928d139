"""Record a camera and a reader at the same time, until the time is up, a played recording ends, or Ctrl-C."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ...core.errors import RecordingError
from ...core.interruption import signals_handled
from ..store import open_recording
from .camera import CameraError
from .finish import Finished, finish_recording
from .progress import Progress
from .reads import CapturedRead, ReaderError, ReaderEvent, ReaderInfo
from .settings import RecordConfig, SensorConfig, Sensors, make_reader, make_sensors
from .writer import RecordingWriter, VideoFormat
from .writing_thread import FilmingThread, Sink, Threads, WritingThread

_STATUS_S = 1.0
_POLL_S = 0.05
_LAST_READS_S = 0.25  # after the last frame, for reads that are under way
_QUIET_S = 5.0  # without a read, those of a played recording that are still missing are given up


def record(
    config: RecordConfig, folder: Path | None = None, *, on_status: Callable[[str], None] | None = None
) -> dict[str, Any]:
    """Record, finish the recording, and return its summary; `folder` gets preview.jpg, the last frame.

    Ctrl-C and SIGTERM end the recording as its time does. Raises `ConfigError`, `RecordingError`, `ReaderError`, `CameraError`
    or `WriteError`; what was recorded until then is finished and kept.
    """
    if config.finish is not None:
        return _summary(finish_recording(config.finish))
    assert config.out is not None
    if Path(config.out).exists():
        raise RecordingError(
            f"{config.out} exists. Remove it or choose another name; finish={config.out} completes it."
        )
    progress, begun = Progress(), time.monotonic()
    interrupted, error = asyncio.run(_record(config, folder, progress, on_status))
    lasted = max(time.monotonic() - begun, 1e-9)
    out = Path(config.out)
    if not (progress.num_frames or progress.num_reads):
        shutil.rmtree(out, ignore_errors=True)
        raise error or RecordingError(f"{out}: neither a frame nor a read came; nothing is kept. {progress.last_event}")
    finished = finish_recording(out)
    if isinstance(error, CameraError | ReaderError):
        raise type(error)(f"{error} What was recorded until then is in {out}.") from error
    if error is not None:
        raise error
    return {**_summary(finished), **progress.summary(), "recorded_s": round(lasted, 2), "interrupted": interrupted}


async def _record(
    config: RecordConfig, folder: Path | None, progress: Progress, on_status: Callable[[str], None] | None
) -> tuple[bool, Exception | None]:
    """Record until the end; whether a signal ended it, and the error that ended it."""
    sensors = make_sensors(config)
    loop, stop = asyncio.get_running_loop(), asyncio.Event()

    def make(video: VideoFormat) -> RecordingWriter:
        name = config.name or Path(config.out or "").stem
        writer = RecordingWriter(config.out or "", video, sensors.antennas_m, name=name, source=sensors.source)
        writer.camera = sensors.camera.describe()
        return writer

    preview = None if folder is None or not config.preview else folder / "preview.jpg"
    writing = WritingThread(make, progress, commit_s=config.commit_s, preview=preview)
    threads, error = Threads(FilmingThread(sensors.camera, writing), writing), None
    try:
        async with sensors.emulator or contextlib.nullcontext():
            reading = asyncio.create_task(hand_over_reads(config, sensors, threads.writing, progress))
            try:
                with signals_handled(lambda *_: loop.call_soon_threadsafe(stop.set)):
                    await _until_the_end(config, sensors, threads, reading, stop, progress, on_status)
            finally:
                threads.filming.close()
                reading.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await reading
    except Exception as raised:
        error = raised
    finally:
        threads.filming.close()
        threads.writing.close()
    return stop.is_set(), threads.error or error


async def hand_over_reads(config: SensorConfig, sensors: Sensors, sink: Sink, progress: Progress) -> None:
    """Hand over what the reader's stream yields. A playback begins where the reader is connected first.

    It does not end by itself. Raises `ReaderError`.
    """
    async with contextlib.aclosing(make_reader(config, sensors).stream()) as items:
        async for item in items:
            if isinstance(item, ReaderEvent):
                progress.event(item)
                if item.kind == "connected":
                    sensors.start.begin()
            if isinstance(item, CapturedRead) and item.antenna > len(sensors.antennas_m):
                text = f"a read of antenna {item.antenna}, whose position is unknown"
                item = ReaderEvent("malformed", text)
                progress.event(item)
            assert isinstance(item, CapturedRead | ReaderEvent | ReaderInfo)
            sink.put(item)


async def _until_the_end(
    config: RecordConfig,
    sensors: Sensors,
    threads: Threads,
    reading: asyncio.Task[None],
    stop: asyncio.Event,
    progress: Progress,
    on_status: Callable[[str], None] | None,
) -> None:
    """Wait for a signal, the end of the time or of the frames, or an error, which is raised."""
    begun, shown = None, time.monotonic()
    while not stop.is_set():
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_POLL_S):
                await stop.wait()
        now = time.monotonic()
        if on_status is not None and now - shown >= _STATUS_S:
            shown = now
            on_status(progress.line())
        if threads.error is not None:
            return
        if reading.done():
            reading.result()
        if begun is None and progress.num_frames:
            begun = now
        if config.duration_s is not None and begun is not None and now - begun >= config.duration_s:
            return
        if threads.filming.ended:
            await _last_reads(config, sensors, progress)
            return


async def _last_reads(config: RecordConfig, sensors: Sensors, progress: Progress) -> None:
    """Wait for reads that were made before the last frame, and are still under way; for all of a played recording's."""
    played, start_ns = sensors.played, sensors.start.time_ns
    if played is None or start_ns is None or config.address is not None:
        await asyncio.sleep(_LAST_READS_S)
        return
    last, until = -1, 0.0
    while (taken := progress.num_taken) < played.reads.num_reads:
        now = time.monotonic()
        if taken > last:
            last, until = taken, now + _QUIET_S + config.emulator.jitter_s
        if now > until:
            return
        await asyncio.sleep(_POLL_S)


def _summary(finished: Finished) -> dict[str, Any]:
    """What a finished recording holds, what its clocks were found to do, and whether it can be used as it is."""
    reads, frames = finished.reads, finished.frames
    summary: dict[str, Any] = {"out": str(finished.path), "frames": finished.num_frames, "reads": finished.num_reads}
    if reads is not None and reads.audit is not None:
        summary["reader_clock"] = {
            "drift_ppm": [
                round(-piece.drift_ppm, 1) for piece in reads.audit.pieces
            ],  # of the reader's clock, to the host's
            "residual_ms": round(reads.audit.residual_ms, 3),
            "num_set_aside": reads.audit.num_set_aside,
        }
    summary["notes"] = [one.note for one in (reads, frames) if one is not None and one.note]
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        try:
            open_recording(finished.path)
        except RecordingError as error:
            summary["notes"].append(str(error))
    summary["notes"] += [str(one.message) for one in found]
    return summary
