"""Link budgets of a suite's tags: why a tag is read strongly or weakly. Nothing is rendered, so a recording takes a second."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..core.progress import OnProgress, unobserved
from ..radio.reader import HOP_TABLES_HZ
from .propagation import propagation
from .radio.budget import LinkBudget, link_budget
from .stories.scenario import Scenario
from .suites import PLANAR, Item, Suite, item_scenario
from .world.sightline import line_of_sight

_MAX_CHANNELS = 8
"""Channels of a budget, evenly spaced over the hop table: reflections differ by several dB over the band."""

_BEHIND = 0.02
"""A body counts as in the way if it is there for more than this fraction of the time."""

_PARTS = ("range", "antenna", "dipole", "bodies", "reflections")
_COLUMNS = ("recording", "object", "RSSI dBm", "= at 1 m", *_PARTS, "multipath rad", "own body", "in the way")
_WIDTHS = (22, 9, 8, 8, 7, 7, 7, 7, 11, 13, 8, 0)


@dataclasses.dataclass(frozen=True)
class TagBudget:
    """The budget of a tag's link to the first antenna, and what stands between them.

    `own_body_db` is what the object's own shapes would take if they blocked; the simulator lets a tag's own body pass.
    `in_the_way` has the fraction of the time by name of the body.
    """

    epc: str
    object_name: str
    link: LinkBudget
    own_body_db: float
    in_the_way: dict[str, float]


def tag_budgets(scenario: Scenario) -> list[TagBudget]:
    """The budgets of all tags of a scenario, on the reader's channels, over the whole duration."""
    world, around = scenario.world, propagation(scenario)
    if not world.tags:
        return []
    steps = around.sampled
    antenna = around.antennas_m[0]
    table = np.sort(np.asarray(HOP_TABLES_HZ[scenario.inventory.region]))
    channels = table[np.unique(np.linspace(0, len(table) - 1, _MAX_CHANNELS).round().astype(int))]
    scatterers = np.zeros((len(steps), 0, 3)) if around.scatterer_path is None else around.scatterer_path[1]
    found = []
    for tag in world.tags:
        path = np.asarray(around.paths[tag.epc].position_m)[steps]
        link = link_budget(
            path,
            antenna,
            channels,
            around.environment,
            transmission=around.transmission[tag.epc][steps, 0],
            dipole=around.dipole[tag.epc][steps],
            boresight=around.boresight[0],
            scatterer_m=scatterers,
            rssi_at_1m_dbm=scenario.inventory.rssi_at_1m_dbm,
        )
        start = np.broadcast_to(antenna, path.shape)
        others = line_of_sight(world, start, path, steps, exclude=(tag.body,))
        own = line_of_sight(world, start, path, steps).loss_db - others.loss_db
        names = [body.name for body in world.bodies]
        crossed = {
            name: float(others.crossed[:, [one == name for one in names]].any(axis=1).mean()) for name in set(names)
        }
        in_the_way = {name: fraction for name, fraction in sorted(crossed.items()) if fraction > _BEHIND}
        found.append(TagBudget(tag.epc, names[tag.body], link, -2 * float(np.nan_to_num(own).mean()), in_the_way))
    return found


def budget_lines(suite: Suite, split: str, *, on_progress: OnProgress = unobserved) -> list[str]:
    """A table of the budgets of all tags in a split of a suite, one line a tag, and the means by object.

    `on_progress` counts the recordings.
    """
    items = [item for item in suite.items() if item.split == split]
    if suite.story == PLANAR or not items:
        raise ValueError(
            f"{suite.name} has no radio links in its {split} split; expected a suite with pictures and at least one "
            "recording there."
        )
    rows: list[tuple[str, TagBudget]] = []
    for number, item in enumerate(items):
        on_progress("link budgets", number, len(items), item.name)
        rows += [(_short(item), budget) for budget in tag_budgets(item_scenario(item))]
    on_progress("link budgets", len(items), len(items))
    lines = [_row(_COLUMNS), *(_line(name, budget.object_name, [budget]) for name, budget in rows)]
    for kind in sorted({budget.object_name for _, budget in rows}):
        lines.append(_line("mean", kind, [budget for _, budget in rows if budget.object_name == kind]))
    return lines


def _short(item: Item) -> str:
    return f"{item.variant.name}-{item.split}-{item.number}"


def _line(name: str, kind: str, budgets: Sequence[TagBudget]) -> str:
    link = {
        field.name: float(np.mean([getattr(one.link, field.name) for one in budgets]))
        for field in dataclasses.fields(LinkBudget)
    }
    parts = [link[f"{part}_db"] for part in _PARTS]
    at_1m = link["rssi_dbm"] - sum(parts)
    own = float(np.mean([one.own_body_db for one in budgets]))
    alone = budgets[0].in_the_way.items() if len(budgets) == 1 else ()
    numbers = [f"{link['rssi_dbm']:.1f}", f"{at_1m:.1f}", *(f"{part:+.1f}" for part in parts)]
    behind = ", ".join(f"{body} {fraction:.0%}" for body, fraction in alone)
    return _row((name, kind, *numbers, f"{link['multipath_rad']:.2f}", f"{own:+.1f}", behind))


def _row(cells: Sequence[str]) -> str:
    """Cells as one line of a table: names to the left, numbers to the right of their columns."""
    aligned = (
        cell.ljust(width) if column in (0, 1, len(cells) - 1) else cell.rjust(width)
        for column, (cell, width) in enumerate(zip(cells, _WIDTHS, strict=True))
    )
    return "  ".join(aligned).rstrip()
