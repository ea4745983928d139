"""The experiment on real tracks: accuracy of every method's association, tables and figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from ...core.files import write_atomic
from ...core.progress import OnProgress, unobserved
from ...core.results import write_json
from ...recording.importers.tagged_walks import load_tagged, load_uwb
from .association import METHODS, accuracy, association_scores, windows
from .figures import accuracy_plot, speeds_plot
from .real_tags import SCORES, associate, speed_scores, speed_windows
from .scenes import TracksConfig, load_scenes
from .tables import markdown, real_tags_markdown


def run_tracks(config: TracksConfig, folder: Path, *, on_progress: OnProgress = unobserved) -> dict[str, Any]:
    """Accuracy of every method by scene and window length; writes `metrics.json`, `tables.md` and `accuracy.png`.

    Where there are real tags, their results are in both files as well, and `real_tags.png` shows them.
    """
    rows, done = [], 0
    scenes = load_scenes(config)
    for scene in scenes:
        for length_s in config.windows_s:
            on_progress("score", done, len(scenes) * len(config.windows_s), f"{scene.name}, {length_s:g} s")
            sampled = windows(scene, length_s, config)
            scored = (association_scores(window, seed=number) for number, window in enumerate(sampled))
            results = zip(
                (len(one.distance_m) for one in sampled), (one.carrier for one in sampled), scored, strict=True
            )
            rows += _accuracy(scene.name, length_s, METHODS, results)
            done += 1
    on_progress("score", done, done)
    accuracy_plot(folder / "accuracy.png", rows, METHODS)
    real = score_real_tags(config, folder, on_progress)
    write_json(folder / "metrics.json", {"virtual_tags": rows, **real})
    text = "Virtual tags on real tracks: fraction of windows in which the carrier scores highest.\n\n" + markdown(
        rows, METHODS
    )
    write_atomic(folder / "tables.md", text + real_tags_markdown(real))
    return {"rows": rows, **real}


def score_real_tags(config: TracksConfig, folder: Path, on_progress: OnProgress) -> dict[str, Any]:
    """Association of the real tags of the folder, by whole recordings and by windows; empty where there are none."""
    home, rows, whole = Path(config.folder), [], []
    scenes = {
        "kinect-rfid": load_tagged(home / "kinect-rfid", config.frame_rate_hz),
        "xovis-uwb": load_uwb(home / "xovis-uwb", config.frame_rate_hz, config.xovis_unit_m),
    }
    for number, (name, tagged) in enumerate(scenes.items()):
        if not tagged:
            continue
        on_progress("score real tags", number, len(scenes), name)
        associations = associate(tagged)
        whole += associations
        for length_s in config.windows_s:
            sampled = [window for one in associations for window in speed_windows(one, length_s, config.min_move_m)]
            scored = ((len(one.distance_m), one.carrier, speed_scores(one)) for one in sampled)
            rows += _accuracy(name, length_s, SCORES, scored)
    on_progress("score real tags", len(scenes), len(scenes))
    if not whole:
        return {}
    speeds_plot(folder / "real_tags.png", whole)
    return {"real_tags": rows, "real_tags_whole": [one.plain() for one in whole]}


def _accuracy(
    scene: str,
    length_s: float,
    methods: Sequence[str],
    scored: Iterable[tuple[int, int, Mapping[str, Shaped[np.ndarray, " people"]]]],
) -> list[dict[str, Any]]:
    """One row of a table from every window's number of candidates, carrier and scores; empty without a window."""
    counts, marks = [], {name: [] for name in methods}
    for num_candidates, carrier, scores in scored:
        counts.append(num_candidates)
        for name in methods:
            marks[name].append(accuracy(scores[name], carrier))
    if not counts:
        return []
    return [
        {
            "scene": scene,
            "window_s": length_s,
            "num_windows": len(counts),
            "candidates": float(np.mean(counts)),
            "chance": float(np.mean(1.0 / np.array(counts))),
            "accuracy": {name: float(np.mean(values)) for name, values in marks.items()},
        }
    ]
