"""Licences of what is installed with tagjax: no GPL in the core, nor in the extras that the tests use."""

from __future__ import annotations

import importlib.metadata
import itertools
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path

import pytest
from packaging.requirements import Requirement

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
GPL = re.compile(r"\bA?GPL|(?<!Lesser )(?<!Library )General Public License", re.IGNORECASE)  # the LGPL is none


def required(requirements: Iterable[str]) -> dict[str, importlib.metadata.Distribution]:
    """The installed packages that requirements need, directly or not, by name."""
    found: dict[str, importlib.metadata.Distribution] = {}
    pending = [Requirement(one) for one in requirements]
    while pending:
        one = pending.pop()
        name = re.sub(r"[-_.]+", "-", one.name).lower()
        if name in found or (one.marker is not None and not one.marker.evaluate({"extra": ""})):
            continue
        try:
            found[name] = importlib.metadata.distribution(one.name)
        except importlib.metadata.PackageNotFoundError:  # an extra that is not installed
            continue
        for more in map(Requirement, found[name].requires or ()):
            if more.marker is None or any(more.marker.evaluate({"extra": extra}) for extra in ("", *one.extras)):
                pending.append(Requirement(str(more).split(";")[0]))
    return found


def licence(package: importlib.metadata.Distribution) -> str:
    """What the metadata state: the expression, the field's first line, and the classifiers."""
    fields = package.metadata
    stated = [fields[name].strip().splitlines()[:1] for name in ("License-Expression", "License") if name in fields]
    kinds = [one for one in fields.get_all("Classifier") or () if one.startswith("License ::")]
    return "; ".join([*itertools.chain(*stated), *kinds])


def test_the_core_needs_nothing_under_the_gpl() -> None:
    core = required(PROJECT["dependencies"])
    assert {"jax", "jaxlib", "numpy", "opencv-python-headless", "zarr"} <= set(core)
    stated = {name: licence(package) for name, package in core.items()}
    assert [name for name, text in stated.items() if not text] == []
    assert {name: text for name, text in stated.items() if GPL.search(text)} == {}


@pytest.mark.parametrize("extra", ["reader", "bags", "sim", "viz", "viewer"])
def test_the_extras_that_are_tested_need_nothing_under_the_gpl(extra: str) -> None:
    """Those of the cameras' makers are not installed for the tests."""
    found = required(PROJECT["optional-dependencies"][extra])
    assert len(found) >= len(PROJECT["optional-dependencies"][extra])
    assert {name: licence(package) for name, package in found.items() if GPL.search(licence(package))} == {}


@pytest.mark.parametrize(
    ("text", "is_gpl"),
    [
        ("GPL-3.0-or-later", True),
        ("License :: OSI Approved :: GNU General Public License v2 (GPLv2)", True),
        ("AGPL-3.0", True),
        ("GNU Affero General Public License v3", True),
        ("LGPL-2.1", False),
        ("License :: OSI Approved :: GNU Lesser General Public License v3 (LGPLv3)", False),
        ("Apache-2.0", False),
    ],
)
def test_what_counts_as_gpl(text: str, is_gpl: bool) -> None:
    assert bool(GPL.search(text)) is is_gpl
