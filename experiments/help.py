"""What `--help` tells: what a command is for, what can be chosen, and its configuration with the comments that explain it."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from omegaconf import DictConfig, ListConfig, OmegaConf

_CONF = Path(__file__).resolve().parents[1] / "conf"


def answer_help(about: str | None, config_name: str) -> None:
    """Print `help_text` and end the program, if its arguments ask for help. Hydra's own is `--hydra-help`."""
    if {"--help", "-h"} & set(sys.argv[1:]):
        print(help_text(about or "", config_name))
        raise SystemExit(0)


def help_text(about: str, config_name: str) -> str:
    """The command's docstring, its groups with their choices, and its own file under conf/ with comments."""
    path = _CONF / f"{config_name}.yaml"
    parts = [about.strip()]
    groups = [_group_line(name, chosen) for name, chosen in _defaults(path)]
    if groups:
        parts.append("\n".join(["Groups (name=choice; each choice is a file of conf/<group>/):", *groups]))
    parts.append(f"Keys (name=value, a.b=value), as they come:\n{_own_lines(path)}")
    parts.append("`--cfg job` prints everything as composed; `--hydra-help` is about Hydra's own options.")
    return "\n\n".join(parts)


def _defaults(path: Path) -> list[tuple[str, str | None]]:
    """The groups of a file's defaults list, as they are overridden, and what is chosen."""
    config = OmegaConf.load(path)
    assert isinstance(config, DictConfig)
    listed = config.get("defaults", ListConfig([]))
    found = [next(iter(one.items())) for one in listed if isinstance(one, DictConfig)]
    return [(str(name).removeprefix("optional ").strip("/"), chosen) for name, chosen in found]


def _group_line(name: str, chosen: str | None) -> str:
    choices = sorted(path.stem for path in (_CONF / name.split("@")[0]).glob("*.yaml"))
    return f"  {name}={chosen or 'null'}  ({', '.join(choices)})"


def _own_lines(path: Path) -> str:
    """The file without its defaults list and Hydra's part."""
    blocks = re.split(r"^(?=\S)", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return "".join(block for block in blocks if not block.startswith(("defaults:", "hydra:"))).strip()
