"""FlyingChairs: pairs, splits, training without its flow, scores with it, and messages about what is wrong."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from tagjax.evaluation.flow import FlowEvaluationSettings, evaluate_flows
from tagjax.flow.augmentation import AugmentationSettings
from tagjax.flow.flo_files import write_flo
from tagjax.flow.flying_chairs import SPLIT_FILE, FlyingChairs, is_flying_chairs
from tagjax.flow.image_sequences import open_sequence
from tagjax.recording import RecordingError
from tagjax.training.flow_sources import DrawnSettings, FlowDataSettings, flow_dataset, open_images, successive
from tagjax.training.flow_teacher import cut_stored_pairs

HEIGHT, WIDTH, SHIFT_PX = 40, 64, 2


def smooth_picture(height: int, width: int, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(height, width, 3))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


@pytest.fixture
def chairs(tmp_path: Path) -> Path:
    """Five pairs, each of its own picture, that move by (2, 0)."""
    folder = tmp_path / "FlyingChairs_release" / "data"
    folder.mkdir(parents=True)
    flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    flow[..., 0] = SHIFT_PX
    for number in range(1, 6):
        wall = smooth_picture(HEIGHT, WIDTH + SHIFT_PX, number)
        for k, picture in ((1, wall[:, SHIFT_PX:]), (2, wall[:, :WIDTH])):
            cv2.imwrite(str(folder / f"{number:05d}_img{k}.ppm"), picture[..., ::-1])
        write_flo(folder / f"{number:05d}_flow.flo", flow)
    return folder


def picture(folder: Path, number: int, k: int) -> np.ndarray:
    found = cv2.imread(str(folder / f"{number:05d}_img{k}.ppm"))
    assert found is not None
    return found[..., ::-1]


def split(folder: Path, marks: str) -> None:
    folder.joinpath(SPLIT_FILE).write_text("".join(f"{mark}\n" for mark in marks))


def settings(folder: Path, tmp_path: Path, **more) -> FlowDataSettings:
    plain = AugmentationSettings(
        height=32, width=32, scale=(1.0, 1.0), rotation_deg=0.0, gain=0.0, gamma=0.0, tint=0.0, gain_difference=0.0,
        noise=0.0, grey_probability=0.0,
    )  # fmt: skip
    drawn = DrawnSettings(num_pairs=0, num_validation=16, folder=str(tmp_path / "drawn"))
    return FlowDataSettings(drawn=drawn, sequences=(str(folder),), variation=plain, **more)


# The folder


def test_pairs_are_read_as_rgb_when_indexed(chairs: Path) -> None:
    assert is_flying_chairs(chairs)
    assert not is_flying_chairs(chairs.parent)
    pairs = FlyingChairs(chairs, "training")
    assert pairs.shape == (5, 2, HEIGHT, WIDTH, 3)
    assert pairs.dtype == np.uint8
    for index in range(5):
        for k in (1, 2):
            np.testing.assert_array_equal(pairs[index][k - 1], picture(chairs, index + 1, k))
    assert pairs.flow_px(3)[7, 5].tolist() == [SHIFT_PX, 0]


def test_opening_reads_one_picture_only(chairs: Path) -> None:
    for number in range(2, 6):
        (chairs / f"{number:05d}_img1.ppm").write_bytes(b"")
    pairs = FlyingChairs(chairs, "training")
    pairs.check_flow()
    np.testing.assert_array_equal(pairs[0][1], picture(chairs, 1, 2))
    with pytest.raises(
        RecordingError, match=r"00004_img1\.ppm: no readable image \(0 bytes\); expected a complete image"
    ):
        pairs[3]


@pytest.mark.parametrize("place", ["inside", "above"])
def test_the_split_chooses_the_pairs(chairs: Path, place: str) -> None:
    split(chairs if place == "inside" else chairs.parent, "12112")
    training, validation = (FlyingChairs(chairs, name) for name in ("training", "validation"))
    assert training.numbers == ("00001", "00003", "00004")
    assert validation.numbers == ("00002", "00005")
    np.testing.assert_array_equal(training[1][0], picture(chairs, 3, 1))
    np.testing.assert_array_equal(validation[1][1], picture(chairs, 5, 2))


@pytest.mark.parametrize(
    ("marks", "message"),
    [
        (
            "1211",
            r"holds 4 lines; expected 5, one for each pair of the folder: 1 for training, 2 for validation\. Copy",
        ),
        ("121121", "holds 6 lines; expected 5"),
        ("12312", "holds 5 lines, some of them '3'; expected 5"),
        ("22222", "has no pair for training; expected at least one line 1"),
    ],
)
def test_a_split_that_does_not_fit_is_refused(chairs: Path, marks: str, message: str) -> None:
    split(chairs, marks)
    with pytest.raises(RecordingError, match=f"{SPLIT_FILE} {message}"):
        FlyingChairs(chairs, "training")


def test_incomplete_pairs_are_named(chairs: Path) -> None:
    (chairs / "00002_img2.ppm").unlink()
    with pytest.raises(RecordingError, match=r"00002_img2\.ppm missing; expected <n>_img1.*Unpack the data set again"):
        FlyingChairs(chairs, "training")
    for number in range(1, 6):
        (chairs / f"{number:05d}_img2.ppm").unlink(missing_ok=True)
    with pytest.raises(RecordingError, match=r"00001_img2\.ppm, 00002_img2\.ppm, 00003_img2\.ppm and 2 more missing"):
        FlyingChairs(chairs, "training")


def test_files_of_another_size_are_refused_when_they_are_read(chairs: Path) -> None:
    cv2.imwrite(str(chairs / "00003_img2.ppm"), np.zeros((30, WIDTH, 3), np.uint8))
    write_flo(chairs / "00004_flow.flo", np.zeros((HEIGHT, 50, 2), np.float32))
    pairs = FlyingChairs(chairs, "training")
    with pytest.raises(RecordingError, match=r"img2\.ppm has 64 x 30 pixels; expected 64 x 40, the size of 00001_img1"):
        pairs[2]
    with pytest.raises(RecordingError, match=r"00004_flow\.flo has 50 x 40 pixels; expected 64 x 40"):
        pairs.flow_px(3)


# Training


def test_it_is_no_sequence(chairs: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"found the pairs of FlyingChairs; expected a sequence.*data\.sequences"):
        open_sequence(str(chairs), tmp_path)


def matches(sample: np.ndarray, other: np.ndarray) -> bool:
    """Whether a crop is a piece of a picture, perhaps mirrored."""
    flips = (other, other[::-1], other[:, ::-1], other[::-1, ::-1])
    return min(cv2.matchTemplate(np.ascontiguousarray(f), sample, cv2.TM_SQDIFF_NORMED).min() for f in flips) < 5e-3


def test_training_takes_pairs_of_the_training_split_and_no_flow(chairs: Path, tmp_path: Path) -> None:
    split(chairs.parent, "12112")
    for file in chairs.glob("*.flo"):
        file.unlink()
    samples = iter(flow_dataset(settings(chairs, tmp_path), seed=0, progress=False))
    seen = set()
    for _ in range(12):
        sample = next(samples)
        assert set(sample) == {"clean", "augmented"}
        (number,) = {n for n in range(1, 6) for k in (1, 2) if matches(sample["clean"][0], picture(chairs, n, k))}
        assert any(matches(sample["clean"][1], picture(chairs, number, k)) for k in (1, 2))
        assert np.any(sample["clean"][0] != sample["clean"][1])
        seen.add(number)
    samples.close()
    assert seen == {1, 3, 4}
    assert not (tmp_path / "drawn").exists()


def test_sequences_and_chairs_are_mixed(chairs: Path, tmp_path: Path) -> None:
    walk = tmp_path / "walk"
    walk.mkdir()
    for number in range(5):
        cv2.imwrite(str(walk / f"{number}.png"), np.full((HEIGHT, WIDTH, 3), 50, np.uint8))
    both = dataclasses.replace(settings(chairs, tmp_path), sequences=(str(chairs), str(walk)))
    samples = iter(flow_dataset(both, seed=0, progress=False))
    flat = [bool(np.all(next(samples)["clean"] == 50)) for _ in range(20)]
    samples.close()
    assert 0 < sum(flat) < 20


def test_a_student_gets_its_teachers_flow_of_cuts_of_the_pairs(chairs: Path, tmp_path: Path) -> None:
    split(chairs, "21222")
    drawn = dataclasses.replace(
        DrawnSettings(num_pairs=0, num_validation=16, folder=str(tmp_path / "drawn")),
        pairs=dataclasses.replace(DrawnSettings().pairs, height=32, width=48),
    )
    taught = dataclasses.replace(settings(chairs, tmp_path, teacher="dis", cuts_per_sequence=3), drawn=drawn)
    (tmp_path / "drawn").mkdir()
    samples = iter(flow_dataset(taught, seed=0, progress=False))
    for _ in range(4):
        sample = next(samples)
        assert sample["flow_px"].shape == (32, 32, 2)
        assert any(matches(sample["clean"][0], picture(chairs, 2, k)) for k in (1, 2))
        assert abs(np.nanmedian(np.abs(sample["flow_px"][..., 0])) - SHIFT_PX) < 0.3
    samples.close()


def test_cuts_of_stored_pairs_are_pieces_of_one_pair(chairs: Path) -> None:
    pairs = FlyingChairs(chairs, "training")
    cuts = cut_stored_pairs(pairs, 12, (24, 32), seed=0)
    assert cuts.shape == (12, 2, 24, 32, 3)
    numbers = set()
    for cut in cuts:
        (number,) = {n for n in range(1, 6) if matches(cut[0], picture(chairs, n, 1))}
        assert matches(cut[1], picture(chairs, number, 2))
        numbers.add(number)
    assert len(numbers) > 2
    np.testing.assert_array_equal(cuts, cut_stored_pairs(pairs, 12, (24, 32), seed=0))
    with pytest.raises(RecordingError, match="64 x 40 pixels; cuts for a student take 96 x 24"):
        cut_stored_pairs(pairs, 1, (24, 96), seed=0)


def test_successive_images_of_chairs_are_its_pairs(chairs: Path, tmp_path: Path) -> None:
    images = open_images(str(chairs), tmp_path)
    found = list(successive(images, 3))
    for pair, number in zip(found, (1, 3, 5), strict=True):
        np.testing.assert_array_equal(pair, np.stack([picture(chairs, number, k) for k in (1, 2)]))
    frames = np.arange(6, dtype=np.uint8).reshape(6, 1, 1, 1) * np.ones((1, 4, 4, 3), np.uint8)
    assert [pair[:, 0, 0, 0].tolist() for pair in successive(frames, 3)] == [[0, 1], [2, 3], [4, 5]]


# Evaluation


def evaluated(folder: Path, report: Path, **more) -> dict:
    chosen = FlowEvaluationSettings(
        flows=("zero", "dis"), num_pairs=0, folders=(str(folder),), num_panels=1, progress=False, **more
    )
    return evaluate_flows(chosen, report)["materials"]


def test_the_validation_pairs_are_scored_with_truth(chairs: Path, tmp_path: Path) -> None:
    split(chairs.parent, "12212")
    scores = evaluated(chairs, tmp_path / "report")
    assert list(scores) == ["FlyingChairs, validation"]
    zero, dis = (scores["FlyingChairs, validation"][name]["all"] for name in ("zero", "dis"))
    assert zero["epe_px"] == pytest.approx(SHIFT_PX)
    assert zero["num_pixels"] == 3 * HEIGHT * WIDTH
    assert dis["epe_px"] < 0.3 * zero["epe_px"]
    assert [path.name for path in (tmp_path / "report" / "panels").iterdir()] == ["chairs-00002.png"]
    (chairs.parent / SPLIT_FILE).unlink()
    capped = evaluated(chairs, tmp_path / "capped", max_pairs=4)
    assert capped["FlyingChairs"]["zero"]["all"]["num_pixels"] == 4 * HEIGHT * WIDTH


def test_pairs_without_truth_are_refused_before_anything_is_computed(chairs: Path, tmp_path: Path) -> None:
    (chairs / "00002_flow.flo").unlink()
    with pytest.raises(RecordingError, match=re.escape("00002_flow.flo missing")):
        evaluated(chairs, tmp_path / "report")
    assert not (tmp_path / "report").exists()
    split(chairs, "11112")
    assert evaluated(chairs, tmp_path / "report")
