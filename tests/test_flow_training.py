"""Flow training: where pictures come from, how pairs are varied, the update, and a run that stops and goes on."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
from pathlib import Path

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jaxtyping import Array, Float

from tagjax.core.settings import ConfigError, from_mapping
from tagjax.flow.augmentation import AugmentationSettings, augment
from tagjax.flow.estimates import NetworkFlow
from tagjax.flow.image_pairs import PairSource, StackedPairs, pair_dataset
from tagjax.flow.image_sequences import ImageFolder, open_sequence
from tagjax.flow.losses import FlowLossSettings
from tagjax.flow.network import AbstractFlowNetwork
from tagjax.flow.pyramid import PyramidFlow
from tagjax.flow.raft import RAFTSmall
from tagjax.flow.registry import make_flow
from tagjax.recording import RecordingError
from tagjax.sim.flow_pairs import FlowPair, FlowPairSettings
from tagjax.training import flow_sources
from tagjax.training.checkpoint import Checkpoints
from tagjax.training.flow_config import TrainFlowConfig
from tagjax.training.flow_run import flow_by_name, predict_flow, run_flow_training, scores
from tagjax.training.flow_sources import DrawnSettings, drawn_pairs, flow_dataset, validation_pairs
from tagjax.training.flow_step import FlowTrainState, batch_loss, flow_step
from tagjax.training.flow_teacher import cut_pairs, teacher_flow

SMALL = {
    "_target_": "tagjax.flow.pyramid.PyramidFlow",
    "widths": [8, 8],
    "radii": [1, 1],
    "decoder_widths": [[8], [8]],
}
PLAIN = AugmentationSettings(
    height=32, width=48, scale=(1.0, 1.0), rotation_deg=0.0, gain=0.0, gamma=0.0, tint=0.0, gain_difference=0.0, noise=0.0,
    grey_probability=0.0,
)  # fmt: skip


def small_network(seed: int = 0) -> PyramidFlow:
    return PyramidFlow(widths=(8, 8), radii=(1, 1), decoder_widths=((8,), (8,)), seed=seed)


def smooth_pictures(count: int, height: int, width: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack(
        [cv2.GaussianBlur(rng.integers(0, 256, (height, width, 3), np.uint8), (0, 0), 2) for _ in range(count)]
    )


# Sequences


def test_folder_of_pictures_is_read_in_order_of_names_as_rgb(tmp_path: Path) -> None:
    pictures = smooth_pictures(3, 40, 50)
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), picture[..., ::-1])
    (tmp_path / "notes.txt").write_text("no picture")
    found = open_sequence(str(tmp_path), tmp_path / "cache")
    assert found.shape == (3, 40, 50, 3)
    np.testing.assert_array_equal(found[1], pictures[1])


def test_numbers_in_names_of_pictures_count_by_their_value(tmp_path: Path) -> None:
    names = ["frame1.png", "frame01b.png", "frame2.png", "frame9.png", "frame10.png", "frame10-2.png", "frame10-11.png"]
    for level, name in enumerate(names):
        cv2.imwrite(str(tmp_path / name), np.full((4, 4, 3), level, np.uint8))
    found = ImageFolder(tmp_path)
    assert [int(found[number][0, 0, 0]) for number in range(len(names))] == list(range(len(names)))


def test_grey_and_16_bit_pictures_become_rgb_of_8_bits(tmp_path: Path) -> None:
    grey = np.arange(40 * 50, dtype=np.uint16).reshape(40, 50) * 32
    cv2.imwrite(str(tmp_path / "a.png"), grey)
    cv2.imwrite(str(tmp_path / "b.png"), (grey >> 8).astype(np.uint8))
    folder = ImageFolder(tmp_path)
    assert folder[0].shape == (40, 50, 3)
    np.testing.assert_allclose(folder[0].astype(int), folder[1].astype(int), atol=1)


@pytest.mark.parametrize("broken", ["one", "sizes", "cut", "nothing", "ending"])
def test_what_is_no_sequence_is_refused(tmp_path: Path, broken: str) -> None:
    pictures = smooth_pictures(2, 40, 50)
    names = ["a.png", "b.png"]
    for name, picture in zip(names, pictures, strict=True):
        cv2.imwrite(str(tmp_path / name), picture)
    path, result = str(tmp_path), ""
    if broken == "one":
        (tmp_path / "b.png").unlink()
        result = "holds 1 images"
    elif broken == "sizes":
        cv2.imwrite(str(tmp_path / "b.png"), pictures[1][:30])
        result = "50 x 30 pixels"
    elif broken == "cut":
        for name in names:
            (tmp_path / name).write_bytes((tmp_path / name).read_bytes()[:60])
        result = r"none of 2 images can be read. First: .*a\.png: the image is truncated"
    elif broken == "nothing":
        path, result = str(tmp_path / "nowhere"), "found nothing"
    else:
        (tmp_path / "x.txt").write_text("?")
        path, result = str(tmp_path / "x.txt"), "found a file"
    with pytest.raises(RecordingError, match=result):
        open_sequence(path, tmp_path / "cache")[1]


def test_bad_pictures_of_a_folder_are_named_when_it_is_opened(tmp_path: Path) -> None:
    pictures = smooth_pictures(20, 40, 50)
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(tmp_path / f"{number}.{'jpg' if number % 3 == 2 else 'png'}"), picture)
    cv2.imwrite(str(tmp_path / "0.png"), pictures[0][:30])  # the first is no measure of the others
    for name, share in (("9.png", 0.9), ("11.jpg", 0.9), ("19.png", 0.0)):
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(
        RecordingError, match="4 of 20 images cannot be used; expected complete images of 50 x 40"
    ) as found:
        open_sequence(str(tmp_path), tmp_path / "cache")
    for words in (
        "0.png: 50 x 30 pix",
        "9.png: the image is truncated",
        "11.jpg: the image is truncated",
        "19.png: no read",
    ):
        assert words in str(found.value)
    for number in range(20):
        cv2.imwrite(str(tmp_path / f"{number}.bmp"), pictures[0][:30])
    with pytest.raises(RecordingError, match=r"of 50 x 30 .* And 14 more\."):
        open_sequence(str(tmp_path), tmp_path / "cache")


def test_a_picture_that_changes_after_opening_is_named(tmp_path: Path) -> None:
    for number, picture in enumerate(smooth_pictures(2, 40, 50)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture)
    folder = ImageFolder(tmp_path)
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((30, 50, 3), np.uint8))
    with pytest.raises(RecordingError, match=r"1\.png has 50 x 30 pixels now; all images had 50 x 40"):
        folder[1]


def write_video(path: Path, frames: np.ndarray) -> None:
    height, width = frames.shape[1:3]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (width, height))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG videos")
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()


def test_video_is_decoded_once_and_kept(tmp_path: Path) -> None:
    frames = smooth_pictures(5, 64, 96)
    write_video(tmp_path / "film.avi", frames)
    cache = tmp_path / "cache"
    cache.mkdir()
    found = open_sequence(str(tmp_path / "film.avi"), cache)
    assert found.shape == (5, 64, 96, 3)
    # JPEG, and colour at half the resolution: nearer to its own frame than to any other.
    for number in range(5):
        distance = [np.mean(np.abs(found[number].astype(float) - frame)) for frame in frames.astype(float)]
        assert int(np.argmin(distance)) == number
    kept = list(cache.iterdir())
    open_sequence(str(tmp_path / "film.avi"), cache)
    assert list(cache.iterdir()) == kept


class StatedCapture:
    """A video that says that it holds another number of frames than it does; streamed webm says -1.4e17."""

    stated = 0.0
    opened = cv2.VideoCapture

    def __init__(self, path: str):
        self._capture = self.opened(path)
        self.read, self.release = self._capture.read, self._capture.release

    def get(self, what: int) -> float:
        return self.stated if what == cv2.CAP_PROP_FRAME_COUNT else self._capture.get(what)


@pytest.mark.parametrize("stated", [-1.4e17, 0.0, 3.0, 900.0, float("inf"), float("nan")])
def test_video_is_read_to_its_end_whatever_length_its_header_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stated: float
) -> None:
    write_video(tmp_path / "film.avi", smooth_pictures(5, 32, 48))
    monkeypatch.setattr(StatedCapture, "stated", stated)
    monkeypatch.setattr(cv2, "VideoCapture", StatedCapture)
    assert open_sequence(str(tmp_path / "film.avi"), tmp_path / "cache").shape[0] == 5


def test_video_of_one_frame_is_refused_and_not_kept(tmp_path: Path) -> None:
    write_video(tmp_path / "film.avi", smooth_pictures(1, 32, 48))
    with pytest.raises(RecordingError, match=r"film\.avi holds 1 image"):
        open_sequence(str(tmp_path / "film.avi"), tmp_path / "cache")
    assert not (tmp_path / "cache").exists() or not list((tmp_path / "cache").iterdir())


def test_broken_video_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"no video at all")
    with pytest.raises(RecordingError, match="cannot be decoded"):
        open_sequence(str(tmp_path / "film.mp4"), tmp_path / "cache")
    assert not (tmp_path / "cache").exists() or not list((tmp_path / "cache").iterdir())


def test_pairs_are_the_gaps_apart() -> None:
    frames = np.arange(5, dtype=np.uint8).reshape(5, 1, 1, 1) * np.ones((1, 4, 4, 3), np.uint8)
    source = PairSource(frames, (1, 3))
    found = {tuple(source[i][:, 0, 0, 0].tolist()) for i in range(len(source))}
    assert found == {(0, 1), (1, 2), (2, 3), (3, 4), (0, 3), (1, 4)}
    with pytest.raises(RecordingError, match="7 frames apart"):
        PairSource(frames, (7,))


# Variation


def test_without_variation_the_cut_is_a_piece_of_the_pictures() -> None:
    pair = smooth_pictures(2, 64, 80)
    for seed in range(6):
        cut = augment(pair, np.random.default_rng(seed), PLAIN)
        np.testing.assert_array_equal(cut["clean"], cut["augmented"])
        best = min(
            np.mean(np.abs(cv2.matchTemplate(candidate[which], cut["clean"][0], cv2.TM_SQDIFF_NORMED).min()))
            for which in (0, 1)
            for candidate in (pair, pair[:, ::-1], pair[:, :, ::-1], pair[:, ::-1, ::-1])
            for candidate in (np.ascontiguousarray(candidate),)
        )
        assert best < 2e-3  # cut between pixels


def test_both_pictures_are_cut_alike_and_variation_spares_the_clean_ones() -> None:
    picture = smooth_pictures(1, 100, 120)[0]
    pair = np.stack([picture, picture])
    settings = AugmentationSettings(height=64, width=64)
    for seed in range(4):
        found = augment(pair, np.random.default_rng(seed), settings)
        np.testing.assert_array_equal(found["clean"][0], found["clean"][1])
        assert np.any(found["augmented"] != found["clean"])
        again = augment(pair, np.random.default_rng(seed), settings)
        np.testing.assert_array_equal(found["augmented"], again["augmented"])


def test_small_pictures_are_enlarged_to_the_cut() -> None:
    found = augment(smooth_pictures(2, 20, 20), np.random.default_rng(0), PLAIN)
    assert found["clean"].shape == (2, 32, 48, 3)


def test_the_clean_pictures_reach_further_by_the_margin() -> None:
    settings = dataclasses.replace(PLAIN, margin_px=8)
    pair = smooth_pictures(2, 64, 80)
    for seed in range(4):
        found = augment(pair, np.random.default_rng(seed), settings)
        assert found["clean"].shape == (2, 48, 64, 3)
        np.testing.assert_array_equal(found["clean"][:, 8:-8, 8:-8], found["augmented"])
    wide = augment(smooth_pictures(2, 20, 20), np.random.default_rng(0), settings)
    assert wide["clean"].shape == (2, 48, 64, 3)


def _moved(flow: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """The picture that `flow`, of a plane's coordinates, takes to the given one."""
    height, width, _ = flow.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return cv2.remap(picture, x + flow[..., 0], y + flow[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)


def test_flow_is_cut_as_the_pictures_are() -> None:
    """What the cut flow says of the cut pictures is what the whole one says of the whole: turned, scaled, mirrored."""
    second = cv2.GaussianBlur(smooth_pictures(1, 120, 140)[0], (0, 0), 2)
    x, y = np.meshgrid(np.linspace(-1, 1, 140), np.linspace(-1, 1, 120))
    flow = np.stack([5 + 2 * y, -3 + 2 * x], axis=-1).astype(np.float32)
    pair = np.stack([_moved(flow, second), second])
    settings = dataclasses.replace(PLAIN, height=64, width=64, margin_px=8, scale=(0.8, 1.2), rotation_deg=30.0)
    inner = slice(12, -12), slice(12, -12)
    for seed in range(6):
        varied = dataclasses.replace(settings, transpose_probability=float(seed % 2))
        found = augment(pair, np.random.default_rng(seed), varied, flow)
        assert found["flow_px"].shape == (64, 64, 2)
        assert found["clean"].shape == (2, 80, 80, 3)
        one, other = found["augmented"].astype(np.float32)
        known = np.all(np.isfinite(found["flow_px"]), axis=-1)[inner]
        back = np.abs(_moved(np.nan_to_num(found["flow_px"]), other) - one)[inner][known]
        still = np.abs(other - one)[inner][known]
        assert known.mean() > 0.7
        assert back.mean() < 0.15 * still.mean(), (seed, back.mean(), still.mean())


def test_beyond_the_picture_there_is_no_flow() -> None:
    flow = np.ones((64, 64, 2), np.float32)
    settings = dataclasses.replace(PLAIN, height=64, width=64, rotation_deg=45.0)
    shares = [
        np.isnan(augment(smooth_pictures(2, 64, 64), np.random.default_rng(seed), settings, flow)["flow_px"]).mean()
        for seed in range(4)
    ]
    assert max(shares) > 0.05


def test_negatives_and_exchanged_colours_are_those() -> None:
    pair = smooth_pictures(2, 64, 80)
    plain = augment(pair, np.random.default_rng(0), PLAIN)
    negative = augment(pair, np.random.default_rng(0), dataclasses.replace(PLAIN, negative_probability=1.0))
    np.testing.assert_array_equal(negative["clean"], plain["clean"])
    np.testing.assert_allclose(negative["augmented"].astype(float), 255 - plain["augmented"].astype(float), atol=1)
    orders = set()
    for seed in range(8):
        found = augment(pair, np.random.default_rng(seed), dataclasses.replace(PLAIN, recolour_probability=1.0))
        order = [
            int(
                np.argmin(
                    [np.abs(found["augmented"][..., n].astype(int) - found["clean"][..., k]).sum() for k in range(3)]
                )
            )
            for n in range(3)
        ]
        np.testing.assert_array_equal(found["augmented"], found["clean"][..., order])
        orders.add(tuple(order))
    assert len(orders) > 2


# A teacher


def test_cuts_are_pieces_of_pictures_the_gaps_apart_where_most_changes() -> None:
    pictures = np.zeros((9, 40, 48, 3), np.uint8)
    pictures[..., 0] = np.arange(9).reshape(9, 1, 1)
    pictures[:, 4:12, 30:38, 1] = 20 * np.arange(9).reshape(9, 1, 1)
    cuts = cut_pairs(pictures, 96, (16, 20), (1, 4), seed=0)
    assert cuts.shape == (96, 2, 16, 20, 3)
    gaps = {int(cut[1, 0, 0, 0]) - int(cut[0, 0, 0, 0]) for cut in cuts}
    assert gaps == {1, 4}
    changing = np.mean([np.any(cut[0, ..., 1] != cut[1, ..., 1]) for cut in cuts])
    assert changing > 0.6  # one look of four would see it in a third of the cuts
    np.testing.assert_array_equal(cuts, cut_pairs(pictures, 96, (16, 20), (1, 4), seed=0))
    assert np.any(cuts != cut_pairs(pictures, 96, (16, 20), (1, 4), seed=1))


def test_impossible_cuts_are_refused() -> None:
    pictures = np.zeros((3, 40, 48, 3), np.uint8)
    with pytest.raises(RecordingError, match="48 x 40 pixels; cuts for a student take 64 x 32"):
        cut_pairs(pictures, 2, (32, 64), (1,), seed=0)
    with pytest.raises(RecordingError, match="No two of 3 pictures are 4 frames apart"):
        cut_pairs(pictures, 2, (32, 32), (4,), seed=0)


def test_a_teachers_flow_is_computed_once_and_goes_by_pairs_and_teacher(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tagjax.training import flow_teacher

    pairs = smooth_pictures(6, 40, 48).reshape(3, 2, 40, 48, 3)
    flows = teacher_flow(pairs, "dis_fast", tmp_path, progress=False)
    peer = make_flow("dis_fast")
    expected = np.stack([peer(first, second) for first, second in pairs]).astype(np.float16)
    np.testing.assert_array_equal(flows[:], expected)
    teacher_flow(pairs[:2], "dis_fast", tmp_path, progress=False)
    teacher_flow(pairs, "zero", tmp_path, progress=False)
    assert len(list(tmp_path.iterdir())) == 3

    def never(name: str):
        raise AssertionError(name)

    monkeypatch.setattr(flow_teacher, "make_flow", never)
    np.testing.assert_array_equal(teacher_flow(pairs, "dis_fast", tmp_path, progress=False)[:], expected)
    with pytest.raises(ValueError, match="Unknown optical flow 'nobody'"):
        teacher_flow(pairs, "nobody", tmp_path, progress=False)


def test_a_teacher_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tagjax.training import flow_teacher

    def broken(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        raise KeyboardInterrupt

    monkeypatch.setattr(flow_teacher, "make_flow", lambda name: broken)
    with pytest.raises(KeyboardInterrupt):
        teacher_flow(smooth_pictures(4, 32, 32).reshape(2, 2, 32, 32, 3), "dis", tmp_path, progress=False)
    assert not list(tmp_path.iterdir())


def test_a_teacher_goes_on_where_it_was_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tagjax.training import flow_teacher

    asked = []

    def teacher(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        asked.append(int(first[0, 0, 0]))
        if len(asked) == 4:
            raise KeyboardInterrupt
        return np.full((*first.shape[:2], 2), first[0, 0, 0], np.float32)

    monkeypatch.setattr(flow_teacher, "make_flow", lambda name: teacher)
    monkeypatch.setattr(flow_teacher, "_SHARD", 2)
    pairs = np.broadcast_to(np.arange(5, dtype=np.uint8).reshape(5, 1, 1, 1, 1), (5, 2, 32, 32, 3))
    with pytest.raises(KeyboardInterrupt):
        teacher_flow(pairs, "dis", tmp_path, progress=False)
    flows = teacher_flow(pairs, "dis", tmp_path, progress=False)
    assert asked == [0, 1, 2, 3, 2, 3, 4]
    np.testing.assert_array_equal(flows[:, 0, 0, 0], np.arange(5))
    assert len(list(tmp_path.iterdir())) == 1


def test_a_student_is_given_its_teachers_flow_of_drawn_pairs_and_of_cuts(tmp_path: Path) -> None:
    (tmp_path / "walk").mkdir()
    for number, picture in enumerate(smooth_pictures(5, 48, 64)):
        cv2.imwrite(str(tmp_path / "walk" / f"{number}.png"), picture)
    config = configured(tmp_path)
    settings = dataclasses.replace(
        config.data, teacher="dis_fast", sequences=(str(tmp_path / "walk"),), cuts_per_sequence=3
    )
    samples = iter(flow_dataset(settings, seed=0, progress=False))
    for _ in range(6):
        sample = next(samples)
        assert sample["flow_px"].shape == (32, 32, 2)
        assert sample["flow_px"].dtype == np.float32
        assert sample["augmented"].shape == (2, 32, 32, 3)
    samples.close()
    kept = {path.name.split("-")[0] for path in Path(settings.drawn.folder).iterdir()}
    assert kept == {"flow"}
    assert len(list(Path(settings.drawn.folder).glob("flow-of-*"))) == 2


@pytest.mark.ci
def test_a_student_learns_what_the_teacher_says() -> None:
    samples = batch(2)
    for sample in samples:
        sample["flow_px"] = np.broadcast_to(np.float32([1.0, -0.5]), (32, 32, 2)).copy()
    samples[1]["flow_px"][:3] = np.nan
    optimizer, settings = optax.adam(3e-3), FlowLossSettings(robustness=0.7)
    state = FlowTrainState.create(small_network(), optimizer, seed=0)
    found = []
    for _ in range(30):
        state, numbers = flow_step(state, samples, optimizer, settings, 10.0)
        found.append(numbers)
    assert set(found[0]) == {"distillation", "loss", "gradient_norm", "skipped"}
    assert found[0]["loss"] == found[0]["distillation"]
    assert found[-1]["loss"] < 0.8 * found[0]["loss"]
    assert not any(numbers["skipped"] for numbers in found)


@pytest.mark.parametrize(
    "change",
    [
        {"margin_px": -1},
        {"scale": (0.0, 1.0)},
        {"scale": (2.0, 1.0)},
        {"gaps": ()},
        {"gaps": (0,)},
        {"height": 8},
        {"negative_probability": 1.5},
    ],
)
def test_impossible_variation_is_refused(change: dict) -> None:
    with pytest.raises(ValueError, match=r"expected|too small"):
        AugmentationSettings(**change)


def test_stream_of_pairs_resumes_exactly() -> None:
    sources = [
        PairSource(smooth_pictures(5, 64, 80), (1,)),
        StackedPairs(smooth_pictures(6, 64, 80).reshape(3, 2, 64, 80, 3)),
    ]
    settings = AugmentationSettings(height=32, width=32)
    stream = iter(pair_dataset(sources, (0.5, 0.5), settings, seed=3))
    for _ in range(5):
        next(stream)
    place = stream.get_state()
    ahead = [next(stream)["augmented"] for _ in range(4)]
    other = iter(pair_dataset(sources, (0.5, 0.5), settings, seed=3))
    other.set_state(place)
    for expected in ahead:
        np.testing.assert_array_equal(next(other)["augmented"], expected)
    with pytest.raises(ValueError, match="positive weight"):
        pair_dataset(sources, (1.0,), settings, seed=0)


# Drawn pairs


def drawn(tmp_path: Path, **more) -> DrawnSettings:
    pairs = FlowPairSettings(height=32, width=32, radius_px=(4.0, 12.0), motion_px=(0.1, 4.0), num_layers=(1, 2))
    settings = {"num_pairs": 16, "num_validation": 16, "photographs": False, "folder": str(tmp_path), "pairs": pairs}
    return DrawnSettings(**{**settings, **more})


def test_drawn_pairs_are_made_once_and_follow_from_the_seed(tmp_path: Path) -> None:
    one = drawn_pairs(drawn(tmp_path), progress=False)
    assert one.shape == (16, 2, 32, 32, 3)
    assert len(list(tmp_path.iterdir())) == 1
    again = drawn_pairs(drawn(tmp_path), progress=False)
    np.testing.assert_array_equal(one[:], again[:])
    elsewhere = drawn_pairs(drawn(tmp_path / "other"), progress=False)
    np.testing.assert_array_equal(one[:], elsewhere[:])
    another = drawn_pairs(drawn(tmp_path, seed=1), progress=False)
    assert np.any(another[:] != one[:])
    held_out = validation_pairs(drawn(tmp_path))
    assert not any(np.array_equal(np.asarray(held_out.first[i] * 255, np.uint8), one[0, 0]) for i in range(16))
    with pytest.raises(ValueError, match="multiple of 16"):
        drawn(tmp_path, num_pairs=10)


def test_drawn_pairs_go_on_where_drawing_was_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn_at, batch_of = [], flow_sources._batch

    def noted(settings: DrawnSettings, photos: np.ndarray | None, seed: int, start: int) -> FlowPair:
        drawn_at.append(start)
        if drawn_at == [0, 16, 32]:
            raise KeyboardInterrupt
        return batch_of(settings, photos, seed, start)

    monkeypatch.setattr(flow_sources, "_batch", noted)
    monkeypatch.setattr(flow_sources, "_SHARD", 32)
    with pytest.raises(KeyboardInterrupt):
        drawn_pairs(drawn(tmp_path / "one", num_pairs=48), progress=False)
    found = drawn_pairs(drawn(tmp_path / "one", num_pairs=48), progress=False)
    assert drawn_at == [0, 16, 32, 32]
    assert len(list((tmp_path / "one").iterdir())) == 1
    np.testing.assert_array_equal(found[:], drawn_pairs(drawn(tmp_path / "two", num_pairs=48), progress=False)[:])


# The update


def batch(count: int = 2, seed: int = 0) -> list[dict[str, np.ndarray]]:
    pictures = smooth_pictures(2 * count, 32, 32, seed).reshape(count, 2, 32, 32, 3)
    return [{"clean": pair, "augmented": pair} for pair in pictures]


@pytest.mark.ci
def test_step_learns_counts_and_skips_what_is_not_finite() -> None:
    settings = FlowLossSettings(census_radius=1, census_stride=1)
    optimizer = optax.adam(1e-3)
    state = FlowTrainState.create(small_network(), optimizer, seed=0)
    before = [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(state.network, eqx.is_array))]
    state, numbers = flow_step(state, batch(), optimizer, settings, 10.0)
    assert int(state.step) == 1
    assert numbers["skipped"] == 0
    after = [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(state.network, eqx.is_array))]
    assert any(np.any(a != b) for a, b in zip(before, after, strict=True))
    broken = eqx.tree_at(
        lambda s: s.network.upsampler.bias,
        state,
        jnp.full_like(state.network.upsampler.bias, jnp.nan),  # pyright: ignore[reportAttributeAccessIssue]
    )
    unchanged = lambda state: jax.tree.leaves((state.optimizer_state, eqx.filter(state.average, eqx.is_array)))  # noqa: E731
    kept = [np.asarray(leaf) for leaf in unchanged(broken)]
    broken, numbers = flow_step(broken, batch(), optimizer, settings, 10.0)
    assert numbers["skipped"] == 1
    for a, b in zip(kept, unchanged(broken), strict=True):
        np.testing.assert_array_equal(a, np.asarray(b))
    with pytest.raises(ValueError, match="at least one pair"):
        flow_step(state, [], optimizer, settings, 10.0)


@pytest.mark.ci
def test_a_recurrent_network_learns_by_its_sequence_beyond_the_crop() -> None:
    settings = FlowLossSettings(census_radius=1, census_stride=1, sequence_decay=0.8)
    optimizer = optax.adam(1e-3)
    network = eqx.filter_jit(lambda: RAFTSmall(updates=2, levels=1, radius=1))()
    samples = [
        {
            "clean": np.pad(sample["clean"], ((0, 0), (8, 8), (8, 8), (0, 0)), mode="reflect"),
            "augmented": sample["augmented"],
        }
        for sample in batch()
    ]
    state = FlowTrainState.create(network, optimizer, seed=0)
    state, numbers = flow_step(state, samples, optimizer, settings, 10.0)
    assert numbers["skipped"] == 0
    assert numbers["gradient_norm"] > 0
    assert np.isfinite(numbers["loss"])
    with pytest.raises(ValueError, match="one shape before the last"):
        flow_step(FlowTrainState.create(small_network(), optimizer, seed=0), samples, optimizer, settings, 10.0)


@pytest.mark.ci
def test_average_of_the_weights_is_the_mean_at_first_and_a_running_one_later() -> None:
    settings = FlowLossSettings(census_radius=1, census_stride=1)
    optimizer = optax.sgd(0.1)
    state = FlowTrainState.create(small_network(), optimizer, seed=0)
    seen = []
    for number in range(4):
        state, _ = flow_step(state, batch(seed=number), optimizer, settings, 3.0)
        seen.append(np.asarray(state.network.upsampler.weight, np.float64))  # pyright: ignore[reportAttributeAccessIssue]
    expected = np.mean(seen[:3], axis=0)
    expected = expected + (seen[3] - expected) / 3
    average = state.average.upsampler.weight  # pyright: ignore[reportAttributeAccessIssue]
    np.testing.assert_allclose(np.asarray(average), expected, atol=1e-7)


class ShiftingNetwork(AbstractFlowNetwork):
    """One pixel to the right towards the darker picture and back; in small pictures to the right both ways."""

    shift_px: Float[Array, ""]
    divisor: int = eqx.field(static=True)

    def encode(self, image: Float[Array, "height width 3"]) -> Float[Array, "height width 3"]:
        return image

    def decode(
        self, first: Float[Array, "height width 3"], second: Float[Array, "height width 3"]
    ) -> tuple[Float[Array, "_ _ 2"], ...]:
        height, width, _ = first.shape
        back = (jnp.mean(first) < jnp.mean(second)) & (height >= 32)
        right = jnp.where(back, -self.shift_px, self.shift_px)
        return (jnp.zeros((height, width, 2)).at[..., 0].set(right),)


@pytest.mark.ci
def test_nothing_is_hidden_until_the_flow_has_begun_to_mean_something() -> None:
    settings = FlowLossSettings(census_radius=1, census_stride=1, occlusion_after=5)
    network = ShiftingNetwork(shift_px=jnp.asarray(1.0), divisor=1)
    pictures = jnp.asarray(np.stack([sample["clean"][:, :31] for sample in batch()]), jnp.float32) / 255
    shares = [
        float(
            batch_loss(network, pictures, pictures, jnp.asarray(step), settings, self_supervise=False)[1][
                "occluded_fraction"
            ]
        )
        for step in (4, 5)
    ]
    assert shares[0] == pytest.approx(1 / 32)  # what leaves the picture
    assert shares[1] == 1.0


@pytest.mark.ci
def test_the_teachers_weight_begins_late_and_then_rises() -> None:
    settings = FlowLossSettings(
        census_radius=1, census_stride=1, self_supervision=1.0, self_supervision_after=10, self_supervision_ramp=10,
        self_supervision_border_px=8,
    )  # fmt: skip
    dark = np.stack([sample["clean"] for sample in batch()]).astype(np.float32) / 255
    pictures = jnp.asarray(dark * np.asarray([1.0, 0.5], np.float32).reshape(1, 2, 1, 1, 1))
    network = ShiftingNetwork(shift_px=jnp.asarray(1.0), divisor=1)
    teaching = [
        float(
            batch_loss(network, pictures, pictures, jnp.asarray(step), settings, self_supervise=True)[1][
                "self_supervision"
            ]
        )
        for step in (10, 15, 20, 40)
    ]
    # Backward, the student is two pixels off in one of two axes where the teacher is sure; forward it is right.
    np.testing.assert_allclose(teaching, [0.0, 0.5, 1.0, 1.0], atol=0.01)


# Whole runs


def configured(tmp_path: Path, **more) -> TrainFlowConfig:
    values = {
        "flow": SMALL,
        "optimizer": {"_target_": "optax.adam", "learning_rate": 1e-3},
        "average_over": 5,
        "loss": {"census_radius": 1, "census_stride": 1, "occlusion_after": 2},
        "data": {"variation": {"height": 32, "width": 32}},
        "loop": {"num_steps": 5, "batch_size": 2, "checkpoint_every": 2, "validate_every": 5, "log_every": 1, "progress": False},
        "logger": {"mode": "disabled"},
        **more,
    }  # fmt: skip
    config = from_mapping(TrainFlowConfig, values)
    return dataclasses.replace(config, data=dataclasses.replace(config.data, drawn=drawn(tmp_path / "drawn")))


@pytest.mark.ci
def test_run_ends_with_scores_beside_the_peers_and_weights(tmp_path: Path) -> None:
    (tmp_path / "walk").mkdir()
    for number in range(3):  # one picture, shifted by two pixels each time
        shifted = np.roll(smooth_pictures(1, 64, 80)[0], 2 * number, axis=1)
        cv2.imwrite(str(tmp_path / "walk" / f"{number}.png"), shifted)
    config = configured(tmp_path)
    config = dataclasses.replace(config, data=dataclasses.replace(config.data, sequences=(str(tmp_path / "walk"),)))
    score = run_flow_training(config, tmp_path / "run")
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["steps"] == 5
    assert set(found["warped_levels"]) == {"learned", "zero", "dis_ultrafast", "dis_fast", "dis"}
    assert found["warped_levels"]["dis"] < 0.5 * found["warped_levels"]["zero"]
    assert set(found["epe_px"]) == {"learned", "zero", "dis_ultrafast", "dis_fast", "dis"}
    np.testing.assert_allclose(score, found["epe_px"]["learned"]["all"])
    assert (tmp_path / "run" / "weights.safetensors").is_file()


@pytest.mark.ci
def test_interrupted_run_goes_on_bit_for_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import tagjax.training.flow_run as module

    straight = configured(tmp_path)
    run_flow_training(straight, tmp_path / "straight")
    steps = {"done": 0}
    real = module.flow_step

    def interrupting(*arguments):
        found = real(*arguments)
        steps["done"] += 1
        if steps["done"] == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return found

    monkeypatch.setattr(module, "flow_step", interrupting)
    with pytest.raises(KeyboardInterrupt):
        run_flow_training(straight, tmp_path / "broken")
    monkeypatch.setattr(module, "flow_step", real)
    run_flow_training(straight, tmp_path / "broken")
    one, two = (_last_arrays(tmp_path / name) for name in ("straight", "broken"))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)


def _last_arrays(folder: Path) -> list[np.ndarray]:
    like = FlowTrainState.create(
        PyramidFlow(widths=(8, 8), radii=(1, 1), decoder_widths=((8,), (8,))),
        optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-3)),
        seed=0,
    )
    with Checkpoints(folder / "checkpoints", create=False) as checkpoints:
        state, _ = checkpoints.restore(like)
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(state, eqx.is_array))]


def test_peers_and_scores_are_what_they_are_called(tmp_path: Path) -> None:
    pairs = validation_pairs(drawn(tmp_path))
    truth = np.asarray(pairs.forward_px)
    assert scores(truth, pairs)["all"] == 0.0
    zero = scores(flow_by_name("zero", pairs), pairs)
    np.testing.assert_allclose(zero["all"], np.mean(np.linalg.norm(truth, axis=-1)), rtol=1e-5)
    assert scores(flow_by_name("dis", pairs), pairs)["visible"] < zero["visible"]
    assert predict_flow(small_network(), pairs).shape == truth.shape


def test_networks_are_validated_on_pairs_of_any_size() -> None:
    network = small_network()
    pictures = smooth_pictures(4, 70, 90).astype(np.float32) / 255
    firsts, seconds = pictures[:2], pictures[2:]
    flows, hidden = jnp.zeros((2, 70, 90, 2)), jnp.zeros((2, 70, 90), bool)
    pairs = FlowPair(jnp.asarray(firsts), jnp.asarray(seconds), flows, flows, hidden, hidden)
    assert 70 % network.divisor
    assert 90 % network.divisor
    expected = [NetworkFlow(network)(first, second) for first, second in zip(firsts, seconds, strict=True)]
    np.testing.assert_allclose(predict_flow(network, pairs), expected, atol=1e-5)


def test_what_cannot_be_trained_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="average_over"):
        configured(tmp_path, average_over=0)
    with pytest.raises(ConfigError, match="Nothing to learn from"):
        configured(tmp_path, data={"drawn": {"num_pairs": 0}})
    for name, value in (("height", 36), ("margin_px", 4)):
        odd = configured(tmp_path, data={"variation": {"height": 32, "width": 32, name: value}})
        with pytest.raises(ValueError, match=f"variation.{name} is {value}; this network needs multiples of 8"):
            run_flow_training(odd, tmp_path / "run")
    for border, size, result in ((6, 32, "leaves 20 pixels"), (16, 32, "leaves 0 pixels")):
        cut = {"loss": {"self_supervision": 0.3, "self_supervision_border_px": border}}
        odd = configured(tmp_path, data={"variation": {"height": size, "width": size}}, **cut)
        with pytest.raises(ValueError, match=f"{result} of data.variation.height.*set a multiple of 4"):
            run_flow_training(odd, tmp_path / "run")
    with pytest.raises(ConfigError, match="self_supervision_border_px is 0"):
        configured(tmp_path, loss={"self_supervision_border_px": 0})
    with pytest.raises(ConfigError, match="num_validation is 0; expected a multiple of 16, 16 or more"):
        configured(tmp_path, data={"drawn": {"num_validation": 0}})
    with pytest.raises(ConfigError, match="expected one of 'bfloat16'"):
        configured(tmp_path, matmul_precision="bf16")
    with pytest.raises(ValueError, match=r"flow: found _target_ .*DISFlow.*expected one of tagjax\.flow"):
        run_flow_training(configured(tmp_path, flow={"_target_": "tagjax.flow.opencv.DISFlow"}), tmp_path / "run")


@pytest.fixture
def drawn_stream(tmp_path: Path):
    config = configured(tmp_path)
    return iter(flow_dataset(config.data, seed=0, progress=False))


def test_stream_without_sequences_is_drawn_only(drawn_stream) -> None:
    assert next(drawn_stream)["clean"].shape == (2, 32, 32, 3)
