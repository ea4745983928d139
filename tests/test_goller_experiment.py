"""Goller et al.: the experiments."""

from __future__ import annotations

import dataclasses

import goller_scenes as scenes
import numpy as np
import pytest
from composed import composed

from tagjax.baselines.goller import GollerSettings
from tagjax.baselines.goller.detection import BlobSettings
from tagjax.baselines.goller.experiment import GollerExperiment, run_goller
from tagjax.baselines.goller.experiment.ablation import CONDITIONS, sensor_ablation
from tagjax.baselines.goller.experiment.handover import find_handover, mean_curve
from tagjax.baselines.goller.experiment.rates import Example
from tagjax.baselines.goller.offline import observe
from tagjax.baselines.goller.rssi import RssiFrames
from tagjax.baselines.goller.slots import BlobTracks
from tagjax.baselines.goller.truth import true_tags
from tagjax.core.settings import from_mapping
from tagjax.recording import Recording
from tagjax.recording.store import open_recording, save_recording


@pytest.fixture(scope="module")
def shop():
    return scenes.shop()


@pytest.fixture(scope="module")
def calibration():
    return scenes.calibration()


def _handed_over(renamed: bool):
    """Times, the tag's path and two people's blobs: the tag goes from one to the other at 4 s, is still from 8 s on."""
    time_s = np.arange(0, 12, 0.1)
    giver = np.interp(time_s, [0.5, 3.5, 4.5, 8.0], [0.0, 2.0, 2.0, 0.0])
    taker = np.interp(time_s, [0.0, 3.5, 4.5, 8.0], [5.0, 2.6, 2.6, 5.0])
    tag = np.where(time_s < 4.0, giver + 0.3, taker - 0.3)
    tag = np.interp(time_s, [0.5, 3.5, 4.5, 8.0], [0.3, 2.2, 2.4, 4.7])
    identity = np.tile([1, 2], (len(time_s), 1))
    if renamed:
        identity[time_s > 6.0, 1] = 5
    place = np.stack([np.stack([x, np.full(len(x), y)], axis=-1) for x, y in ((giver, 0.3), (taker, -0.3))], axis=1)
    box = np.full((*identity.shape, 4), np.nan, np.float32)
    blobs = BlobTracks(identity.astype(np.int32), place.astype(np.float32), box, 0)
    return time_s, np.stack([tag, np.zeros(len(tag))], axis=-1), blobs


@pytest.mark.parametrize("renamed", [False, True])
def test_probabilities_follow_the_roles_of_a_hand_over(renamed):
    time_s, path, blobs = _handed_over(renamed)
    state = np.select([time_s < 4.75, time_s < 9.05], [1, 2], 0)
    found = find_handover(time_s, path, 0.1 / 3 + 0.9 * np.eye(3)[state], blobs)
    assert found is not None
    assert 3.5 < found.handover_s < 4.5
    assert found.stop_s == pytest.approx(8.0, abs=0.11)
    assert found.handover_s + found.taker_delay_s == pytest.approx(4.8, abs=0.11)
    assert found.stop_s + found.stop_delay_s == pytest.approx(9.1, abs=0.11)
    np.testing.assert_allclose(found.probability.sum(axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(found.probability[:, 2], 0.1 / 3 + 0.9 * (state == 2), atol=1e-6)
    times, mean, deviation = mean_curve([found, found])
    np.testing.assert_allclose(deviation, 0, atol=1e-9)
    assert mean[np.searchsorted(times, -1.0), 1] > 0.9
    never = find_handover(time_s, path, np.tile([0.2, 0.5, 0.3], (len(time_s), 1)), blobs)
    assert never is not None
    assert np.isnan(never.taker_delay_s)
    assert np.isnan(never.stop_delay_s)


def test_no_hand_over_is_found_where_one_person_carries_the_tag():
    time_s, path, blobs = _handed_over(False)
    even = np.full((len(time_s), 3), 1 / 3)
    assert find_handover(time_s, np.zeros_like(path), even, blobs) is None
    alone = dataclasses.replace(blobs, identity=np.where(blobs.identity == 2, 0, blobs.identity))
    assert find_handover(time_s, path, even, alone) is None


def test_the_truth_in_place_of_a_faulty_sensor_restores_detection(shop, calibration):
    observed, truth = observe(shop, scenes.LOOKING_DOWN), true_tags(shop)
    good = [Example("sp_st_still", observed, truth)]
    conditions = sensor_ablation(calibration, good, good, scenes.LOOKING_DOWN)
    assert set(conditions) == set(CONDITIONS)
    for row in conditions.values():
        assert (row["all"].detected, row["all"].false_alarm) == (1.0, 0.0)
        assert (row["sp_st_still"].num_leaves, row["sp_st_still"].num_still) == (1, 2)

    def detected(faulty):
        # The threshold is that of the unchanged recordings.
        found = sensor_ablation(calibration, good, [Example("sp_st_still", faulty, truth)], scenes.LOOKING_DOWN)
        return [
            found[name]["all"].detected for name in ("measured", "true blobs", "true positions of tags", "both true")
        ]

    blind = dataclasses.replace(
        observed, blobs=dataclasses.replace(observed.blobs, identity=0 * observed.blobs.identity)
    )
    assert detected(blind) == [0.0, 1.0, 0.0, 1.0]
    # Only the far antenna receives anything: no tag seems to move.
    far = np.any(observed.rssi.received, axis=2, keepdims=True) & (np.arange(3) == 2)
    deaf = dataclasses.replace(observed, rssi=RssiFrames(np.where(far, np.float32(-60.0), np.float32(0.0)), far))
    assert detected(deaf) == [0.0, 0.0, 1.0, 1.0]


def test_the_configuration_lists_every_setting():
    values = composed("goller")
    assert values.pop("progress") is True  # read by the command itself
    config = from_mapping(GollerExperiment, values)
    assert config.settings == GollerSettings()
    names = lambda kind: {field.name for field in dataclasses.fields(kind)}  # noqa: E731
    assert set(values) == names(GollerExperiment)
    assert set(values["settings"]) == names(GollerSettings)
    assert set(values["settings"]["blobs"]) == names(BlobSettings)


def test_missing_recordings_are_named_before_any_is_opened(tmp_path):
    def opened(path: str) -> Recording:
        raise AssertionError(f"{path} is opened, although recordings are missing")

    grid, shop = tmp_path / "grid.zarr", tmp_path / "shop_exit"
    config = GollerExperiment(grid=str(grid), scenarios=str(shop), handover=str(tmp_path / "nowhere"))
    with pytest.raises(ValueError, match=r"suite=shop_grid.*no recording in train/, validation/, test/.*shop_exit"):
        run_goller(config, tmp_path, open_recording=opened)
    grid.mkdir()
    for split in ("train", "validation", "test"):
        with pytest.raises(ValueError, match=rf"shop_exit: no recording in .*{split}/"):
            run_goller(dataclasses.replace(config, handover=None), tmp_path, open_recording=opened)
        (shop / split / f"shop_exit-sp_st-{split}-0.zarr").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"handover=.*nowhere: .*simulate suite=shop_handover`"):
        run_goller(config, tmp_path, open_recording=opened)
    # By default the recordings beside the scenarios are used, if there are any.
    default = dataclasses.replace(config, handover=None)
    with pytest.raises(AssertionError, match=r"grid\.zarr is opened"):
        run_goller(default, tmp_path, open_recording=opened)
    assert default.handover_recordings() == []
    there = tmp_path / "shop_handover" / "test" / "shop_handover-all-test-0.zarr"
    there.mkdir(parents=True)
    assert default.handover_recordings() == [str(there)]
    assert dataclasses.replace(config, handover=str(there)).handover_recordings() == [str(there)]
    assert dataclasses.replace(config, handover=str(there.parents[1])).handover_recordings() == [str(there)]


@pytest.mark.ci
def test_a_run_writes_tables_metrics_and_plots(tmp_path):
    save_recording(scenes.grid_recording(), tmp_path / "grid.zarr")
    leaves, stays = scenes.straight((4.6, 0.3), (-1.6, 0.3)), scenes.straight((4.6, 0.3), (2.4, 0.3))
    for split in ("train", "validation", "test"):
        for number, walk in enumerate((leaves, stays)):
            name = f"shop-sp_st_still-{split}-{number}"
            recording = scenes.drawn_shop({"w": walk}, {"s": (0.6, -1.0), "t": (1.2, -1.0)}, name=name, seed=number)
            save_recording(recording, tmp_path / "shop" / split / f"{name}.zarr")
    config = GollerExperiment(
        grid=str(tmp_path / "grid.zarr"),
        scenarios=str(tmp_path / "shop"),
        handover=str(tmp_path / "shop" / "test" / "shop-sp_st_still-test-0.zarr"),
        settings=scenes.LOOKING_DOWN,
        fit_steps=4,
    )
    out = tmp_path / "out"
    metrics = run_goller(config, out, open_recording=open_recording)
    assert metrics["num_recordings"] == {"train": 2, "validation": 2, "test": 2}
    assert metrics["paper"]["table_1"]["rfid"] == {"detected": 0.86, "false_alarm": 0.40}
    assert metrics["paper"]["table_2"]["mp_mt_still"] == {
        "detected_run": 1.0,
        "detected": 0.8438,
        "false_alarm": 0.0219,
    }
    assert metrics["table_1"]["fused"]["num_leaves"] == 1
    assert metrics["table_1"]["fused"]["detected"] == 1.0
    for file in ("metrics.json", "outcomes.json", "calibration.json", "tables.md", "roc.png", "antennas.png", "handover.png",
                 "handover_scene.png"):  # fmt: skip
        assert (out / file).stat().st_size > 0
    tables = (out / "tables.md").read_text()
    assert "| RFID + CV | 1 |" in tables
    assert "| RFID + CV, at the paper's P_FA | 1 | 1.000" in tables
    assert set(metrics["table_1_at_papers_false_alarms"]) == {"rfid", "fused"}
    assert "| true blobs | 1.000 / 0.000 | 1.000 / 0.000 |" in tables
    assert metrics["ablation"]["both true"]["all"]["detected"] == 1.0
    assert metrics["handover"] == {"num_recordings": 1, "num_followed": 0}
    with pytest.raises(ValueError, match="no recording"):
        run_goller(dataclasses.replace(config, scenarios=str(tmp_path)), out, open_recording=open_recording)
    (tmp_path / "shop" / "test" / "other.zarr").mkdir()
    with pytest.raises(ValueError, match="expected a name"):
        config.scenario_recordings("test")
