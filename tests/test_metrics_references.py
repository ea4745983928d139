"""Scores against programs of others: TrackEval, motmetrics and scikit-image, on random cases.

They need an environment of their own, because TrackEval brings another OpenCV. MOTA is compared with TrackEval's alone:
motmetrics keeps a match of any earlier frame, not of the last one only.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from tagjax.metrics.boxes import box_iou
from tagjax.metrics.masks import boundary, boundary_f, mask_iou
from tagjax.metrics.multi_object import LEVELS, MatchFrame, MultiObjectScores

pytestmark = pytest.mark.ci

SEEDS = range(20)


def _sequence(seed: int) -> list[MatchFrame]:
    """Objects and tracks that appear, vanish and swap; the overlaps are those of boxes."""
    rng = np.random.default_rng(seed)
    num_true, num_frames = int(rng.integers(1, 6)), int(rng.integers(1, 40))
    centre, velocity = rng.uniform(0, 60, (num_true, 2)), rng.normal(0, 2, (num_true, 2))
    names = rng.permutation(20)[:num_true]
    frames = []
    for number in range(num_frames):
        centre = centre + velocity
        if rng.random() < 0.1 and num_true > 1:
            names = rng.permutation(names)
        true = np.flatnonzero(rng.random(num_true) < 0.85)
        kept = np.flatnonzero(rng.random(num_true) < 0.85)
        boxes = np.concatenate([centre, centre + 20], axis=1)
        noisy = boxes[kept] + rng.normal(0, 3, (len(kept), 4))
        extra = rng.uniform(0, 60, (int(rng.integers(0, 3)), 2))
        found_boxes = np.concatenate([noisy, np.concatenate([extra, extra + 20], axis=1)])
        ids = np.concatenate([names[kept], 100 + number * 10 + np.arange(len(extra))]).astype(int)
        pairs = np.repeat(boxes[true][:, None], len(ids), axis=1), np.repeat(found_boxes[None], len(true), axis=0)
        frames.append(MatchFrame(true, ids, box_iou(*pairs)))
    return frames


def _for_trackeval(frames: list[MatchFrame]) -> dict[str, Any]:
    true_ids = np.unique(np.concatenate([frame.true_ids for frame in frames]))
    found_ids = np.unique(np.concatenate([frame.found_ids for frame in frames]))
    return {
        "num_gt_ids": len(true_ids),
        "num_tracker_ids": len(found_ids),
        "num_gt_dets": sum(len(frame.true_ids) for frame in frames),
        "num_tracker_dets": sum(len(frame.found_ids) for frame in frames),
        "num_timesteps": len(frames),
        "gt_ids": [np.searchsorted(true_ids, frame.true_ids) for frame in frames],
        "tracker_ids": [np.searchsorted(found_ids, frame.found_ids) for frame in frames],
        "similarity_scores": [frame.overlap for frame in frames],
    }


@pytest.mark.parametrize("seed", SEEDS)
def test_tracks_score_as_in_trackeval(seed: int) -> None:
    trackeval = pytest.importorskip("trackeval")
    metrics, quiet = trackeval.metrics, {"PRINT_CONFIG": False}
    sequences = {f"s{number}": _sequence(10 * seed + number) for number in range(3)}
    total = MultiObjectScores()
    theirs: dict[str, dict[str, Any]] = {}
    for name, frames in sequences.items():
        data = _for_trackeval(frames)
        own = MultiObjectScores.of(frames)
        total = total.merge(own)
        theirs[name] = {
            "hota": metrics.HOTA().eval_sequence(data),
            "clear": metrics.CLEAR(quiet).eval_sequence(data),
            "identity": metrics.Identity(quiet).eval_sequence(data),
        }
        _compare(own.result(), **theirs[name])
    merged = {
        "hota": metrics.HOTA().combine_sequences({name: one["hota"] for name, one in theirs.items()}),
        "clear": metrics.CLEAR(quiet).combine_sequences({name: one["clear"] for name, one in theirs.items()}),
        "identity": metrics.Identity(quiet).combine_sequences({name: one["identity"] for name, one in theirs.items()}),
    }
    _compare(total.result(), **merged)


def _compare(own: dict[str, Any], hota: dict[str, Any], clear: dict[str, Any], identity: dict[str, Any]) -> None:
    assert len(hota["HOTA"]) == len(LEVELS)
    for name, value in (("hota", hota["HOTA"]), ("deta", hota["DetA"]), ("assa", hota["AssA"])):
        assert own[name] == pytest.approx(np.mean(value), abs=1e-9), name
    assert own["mota"] == pytest.approx(clear["MOTA"])
    assert own["id_switches"] == clear["IDSW"]
    assert own["idf1"] == pytest.approx(identity["IDF1"])


@pytest.mark.parametrize("seed", SEEDS)
def test_identities_score_as_in_motmetrics(seed: int) -> None:
    motmetrics = pytest.importorskip("motmetrics")
    frames = _sequence(seed)
    tracks = motmetrics.MOTAccumulator(auto_id=True)
    for frame in frames:
        tracks.update(frame.true_ids, frame.found_ids, np.where(frame.overlap >= 0.5, 1 - frame.overlap, np.nan))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pandas, for its own future
        theirs = motmetrics.metrics.create().compute(tracks, metrics=["idf1", "idtp", "idfp", "idfn"])
    expected = {name: float(theirs[name].iloc[0]) for name in ("idf1", "idtp", "idfp", "idfn")}
    own = MultiObjectScores.of(frames)
    assert own.result()["idf1"] == pytest.approx(expected["idf1"])
    counts = (own.identity_matches, own.identity_false, own.identity_misses)
    assert counts == (expected["idtp"], expected["idfp"], expected["idfn"])


def _blobs(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    smooth = ndimage.gaussian_filter(rng.standard_normal((2, 60, 80)), (0, 5, 5))
    return smooth[0] > 0.05, smooth[0] + 0.3 * smooth[1] > 0.05


@pytest.mark.parametrize("seed", SEEDS)
def test_boundaries_score_as_with_dilations_by_discs(seed: int) -> None:
    morphology = pytest.importorskip("skimage.morphology")
    mask, true = _blobs(seed)
    found, wanted = boundary(mask), boundary(true)
    for radius in (1, 2, 3, 8):
        near_wanted = morphology.dilation(wanted, morphology.disk(radius))
        near_found = morphology.dilation(found, morphology.disk(radius))
        precision, recall = np.mean(near_wanted[found]), np.mean(near_found[wanted])
        expected = 2 * precision * recall / (precision + recall)
        assert boundary_f(mask, true, (float(radius),))[0] == pytest.approx(expected)


@pytest.mark.parametrize("seed", SEEDS)
def test_regions_score_as_in_scikit_image(seed: int) -> None:
    skimage = pytest.importorskip("skimage.metrics")
    mask, true = _blobs(seed)
    table = np.asarray(skimage.contingency_table(true.astype(int), mask.astype(int)).todense())
    expected = table[1, 1] / (table.sum() - table[0, 0])
    assert mask_iou(mask, true.astype(np.uint8), 1) == pytest.approx(expected)
