"""A run folder with a report of the tiny synthetic scene, for the tests of its page."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import synthetic_clips as synthetic

from tagjax.core.results import write_json
from tagjax.metrics.recordings import ScoreSettings, evaluate_recording
from tagjax.recording import Recording
from tagjax.report.report import Results, overlay_folder, write_report
from tagjax.report.stages import stage_picture, write_stages
from tagjax.report.video import overlay_video

NUM_FRAMES = 30


def textured(recording: Recording) -> Recording:
    """The recording with a picture that changes, so that frames of a video differ."""
    colour = np.array(recording.colour)
    colour[np.arange(len(colour)), 0, np.arange(len(colour)) % synthetic.WIDTH] = 255
    return dataclasses.replace(recording, colour=colour)


def report_run(folder: Path, *, num_scenes: int = 2, truth: bool = True) -> Path:
    """Recordings with two tags each, traced by a good and a blunt tracer, as `evaluate` leaves them but for the page."""
    sharp, blunt = synthetic.SmallTracer(), synthetic.SmallTracer(1.0)
    scenes = [textured(synthetic.recording(NUM_FRAMES, seed=seed, name=f"scene{seed}")) for seed in range(num_scenes)]
    settings = ScoreSettings(num_pictures=3)
    results: dict[str, list] = {}
    for name, tracer in (("learned", sharp), ("blunt", blunt)):
        for scene in scenes:

            def load(_, start, stop, *, epcs, known=scene):  # the clip still needs the true radio
                return synthetic.load(known, start, stop, epcs=epcs)

            given = scene if truth else dataclasses.replace(scene, truth=None)
            kept = overlay_folder(folder, scene.name, name)
            with overlay_video(kept, given) as on_picture:
                one = evaluate_recording(tracer, given, load, stride=1, settings=settings, on_picture=on_picture)
            results.setdefault(name, []).append(one)
            picture = stage_picture(one.pictures, synthetic.WINDOW - 1)
            assert picture is not None
            clip = load(scene, picture.frame - synthetic.WINDOW + 1, picture.frame + 1, epcs=picture.epcs)
            write_stages(kept, scene, picture, clip.camera, clip.frames)
    written: Results = results
    write_report(folder, written)
    (folder / "config.yaml").write_text("tracer: small\n")
    write_json(
        folder / "run.json", {"command": "python -m experiments.evaluate tracer=small", "versions": {"jax": "1.2"}}
    )
    return folder
