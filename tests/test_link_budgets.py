"""Link budgets: the parts in free space in closed form, their sum against simulated reads, and the causes in `multi_4`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from tagjax.core.settings import from_mapping
from tagjax.radio.reader import HOP_TABLES_HZ
from tagjax.sim.link_budgets import TagBudget, budget_lines, tag_budgets
from tagjax.sim.radio.budget import LinkBudget, link_budget
from tagjax.sim.radio.channel import BACK_DB, NULL_DB
from tagjax.sim.radio.environment import room_environment
from tagjax.sim.record import simulate_recording
from tagjax.sim.suites import Counts, Item, Suite, item_scenario
from tagjax.sim.world.furniture import Panel

FOLDER = Path(__file__).parents[1] / "conf" / "suite"
PARTS = ("range_db", "antenna_db", "dipole_db", "bodies_db", "reflections_db")
AHEAD, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
CHANNELS_HZ = np.array(HOP_TABLES_HZ["etsi"])


def _suite(name: str) -> Suite:
    return from_mapping(Suite, yaml.safe_load((FOLDER / f"{name}.yaml").read_text()))


def _item(name: str, split: str, number: int = 0, variant: str = "all") -> Item:
    wanted = (variant, split, number)
    return next(item for item in _suite(name).items() if (item.variant.name, item.split, item.number) == wanted)


def _budget(range_m: float = 2.0, panels: tuple[Panel, ...] = (), **changed) -> LinkBudget:
    """The budget of a tag that stays ahead of the antenna, its dipole vertical, at -40 dBm at 1 m."""
    settings = {"transmission": np.ones(3), "dipole": np.tile(UP, (3, 1)), "boresight": AHEAD, **changed}
    return link_budget(
        np.tile(range_m * AHEAD, (3, 1)),
        np.zeros(3),
        CHANNELS_HZ,
        room_environment(panels, 0),
        scatterer_m=np.zeros((3, 0, 3)),
        rssi_at_1m_dbm=-40.0,
        **settings,
    )


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, (-12.04, 0, 0, 0, 0)),
        ({"range_m": 10.0}, (-40.0, 0, 0, 0, 0)),
        ({"transmission": np.full(3, 10 ** (-3 / 20))}, (-12.04, 0, 0, -6.0, 0)),
        ({"dipole": np.tile(AHEAD, (3, 1))}, (-12.04, 0, -NULL_DB, 0, 0)),
        ({"dipole": np.zeros((3, 3))}, (-12.04, 0, 0, 0, 0)),
        ({"boresight": -AHEAD}, (-12.04, -2 * BACK_DB, 0, 0, 0)),
    ],
)
def test_parts_in_free_space_are_those_of_the_formulas(changed, expected):
    budget = _budget(**changed)
    assert [getattr(budget, part) for part in PARTS] == pytest.approx(expected, abs=0.02)
    assert budget.rssi_dbm == pytest.approx(-40.0 + sum(expected), abs=0.1)
    assert budget.multipath_rad == pytest.approx(0.0, abs=0.01)


def test_a_reflection_is_the_rest():
    """A mirror below the path: its ray is longer by a known length, so that their sum is known on every channel."""
    floor = Panel((1.0, 0.0, -0.7), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (50.0, 50.0), -0.6)
    budget = _budget(panels=(floor,), dipole=np.zeros((3, 3)), boresight=np.zeros(3))
    path_m = np.hypot(2.0, 1.4)
    wave = 2 * np.pi * CHANNELS_HZ / 299_792_458.0
    field = np.exp(-1j * wave * 2.0) / 2.0 - 0.6 * np.exp(-1j * wave * path_m) / path_m
    expected = np.mean(40 * np.log10(np.abs(field) * 2.0))
    assert abs(expected) > 0.5
    assert budget.reflections_db == pytest.approx(expected, abs=0.02)
    assert budget.rssi_dbm == pytest.approx(-40.0 - 12.04 + expected, abs=0.03)


def test_a_blocked_line_of_sight_leaves_a_finite_budget():
    budget = _budget(transmission=np.zeros(3))
    assert budget.bodies_db == -200.0
    assert np.isfinite(dataclasses.astuple(budget)).all()


def test_the_sum_is_the_rssi_of_the_reads():
    """Of a box that is read all the time: mean over reads and mean over samples and channels differ little."""
    item = _item("single_static", "train", variant="box")
    scenario = item_scenario(item)
    scenario = dataclasses.replace(scenario, inventory=dataclasses.replace(scenario.inventory, outages_per_minute=0.0))
    (budget,) = tag_budgets(scenario)
    capture = dataclasses.replace(item.suite.capture, width=32, frame_rate_hz=1.0)
    reads = simulate_recording(scenario, capture, seed=item.seed, name=item.name).reads
    assert reads.num_reads > 150
    assert budget.link.rssi_dbm == pytest.approx(float(np.mean(reads.rssi_dbm)), abs=0.7)
    assert budget.object_name == "box"
    assert budget.in_the_way == {}
    parts = [getattr(budget.link, part) for part in PARTS]
    assert scenario.inventory.rssi_at_1m_dbm + sum(parts) == pytest.approx(budget.link.rssi_dbm)


def _toy_and_others(name: str, split: str, number: int) -> tuple[TagBudget, list[TagBudget]]:
    budgets = tag_budgets(item_scenario(_item(name, split, number)))
    (toy,) = [budget for budget in budgets if budget.object_name == "toy"]
    return toy, [budget for budget in budgets if budget is not toy]


def test_the_hand_and_the_dipole_weaken_the_toy_of_multi_4():
    bear, others = _toy_and_others("multi_4", "train", 1)
    assert bear.in_the_way == {"person 1": 1.0}
    assert bear.link.bodies_db == pytest.approx(-6.0, abs=0.1)  # the hand, 3 dB one way
    assert bear.link.dipole_db > -0.5
    assert bear.own_body_db == pytest.approx(-2.0, abs=0.1)
    assert all(other.link.bodies_db == 0 and other.in_the_way == {} for other in others)
    car, _ = _toy_and_others("multi_4", "test", 1)
    assert car.link.dipole_db < -15.0
    assert car.link.bodies_db == pytest.approx(-6.0, abs=0.1)


@pytest.mark.parametrize(("split", "number"), [("train", 0), ("train", 1), ("test", 1), ("test", 2)])
def test_a_clear_mounting_makes_the_tags_comparable(split, number):
    toy, others = _toy_and_others("multi_4_clear", split, number)
    for budget in (toy, *others):
        assert budget.in_the_way == {}
        assert budget.link.dipole_db > -0.5
        assert budget.own_body_db == 0
    weak, _ = _toy_and_others("multi_4", split, number)
    assert toy.link.rssi_dbm > weak.link.rssi_dbm + 3.0
    assert abs(toy.link.rssi_dbm - np.mean([other.link.rssi_dbm for other in others])) < 8.0
    assert toy.link.multipath_rad < 0.4


def test_the_table_has_a_line_for_each_tag_and_the_means_by_object():
    suite = dataclasses.replace(_suite("multi_4"), counts=Counts(1, 0, 0))
    header, *lines = budget_lines(suite, "train")
    assert header.split()[:2] == ["recording", "object"]
    assert [line.split()[:2] for line in lines] == [
        *[["all-train-0", kind] for kind in ("bottle", "toy", "box", "bottle")],
        *[["mean", kind] for kind in ("bottle", "box", "toy")],
    ]
    one, other, mean = (float(lines[number].split()[2]) for number in (0, 3, 4))
    assert mean == pytest.approx((one + other) / 2, abs=0.11)
    assert lines[1].endswith("person 1 94%")
    with pytest.raises(ValueError, match="multi_4 has no radio links in its test split"):
        budget_lines(suite, "test")
    with pytest.raises(ValueError, match="planar_101 has no radio links"):
        budget_lines(_suite("planar_101"), "test")
