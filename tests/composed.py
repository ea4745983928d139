"""Configurations as the commands compose them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, TypeVar

from hydra import compose, initialize_config_dir

from experiments.command import plain_values
from tagjax.core.settings import from_mapping

CONF = Path(__file__).parents[1] / "conf"

T = TypeVar("T")


def composed(command: str, *overrides: str) -> dict[str, Any]:
    """The plain values that a command gets."""
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        return plain_values(compose(command, list(overrides)))


def settings(schema: type[T], command: str, *overrides: str) -> T:
    """The checked settings of a command, without the keys that only the command itself reads."""
    known = {field.name for field in dataclasses.fields(schema)}  # type: ignore[arg-type]
    return from_mapping(schema, {name: v for name, v in composed(command, *overrides).items() if name in known})
