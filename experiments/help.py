"""The text of `--help`: what the command does, its groups with their choices, and every key with its comment.

It is the help template in conf/hydra/default.yaml, so overrides have an effect: `--help tracer=tagattention_published` shows
the keys of that tracer.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from .yaml_comments import key_comments, lines_with_keys


def command_help(conf: Path, *, _root_: DictConfig) -> str:
    """The help of the command with the composed configuration `_root_`; `conf` is the folder of the configuration."""
    name = str(_root_.hydra.job.name)
    choices = {str(group): choice for group, choice in _root_.hydra.runtime.choices.items()}
    about = importlib.import_module(f"{__package__}.{name}").__doc__ or ""
    groups = [
        f"  {group}={'null' if choice is None else choice}  ({', '.join(_options(conf, group))})"
        for group, choice in sorted(choices.items())
        if not group.startswith("hydra") or group in ("hydra/launcher", "hydra/sweeper")
    ]
    text = "\n\n".join(
        [
            about.strip(),
            "\n".join(["Groups (group=choice; a choice is a file conf/<group>/<choice>.yaml):", *groups]),
            f"Keys (name=value, a.b=value) and their values as composed:\n{_keys(conf, name, choices, _root_)}",
            "`--help group=choice` shows the keys of that choice; `--hydra-help` explains Hydra's own options.",
        ]
    )
    return text.replace("$", "$$")  # Hydra takes the text as a string.Template


def _options(conf: Path, group: str) -> list[str]:
    folder = group.partition("@")[0]
    if folder.startswith("hydra/"):
        from hydra.core.global_hydra import GlobalHydra

        return GlobalHydra.instance().config_loader().get_group_options(folder)
    return sorted(path.stem for path in (conf / folder).glob("*.yaml"))


def _keys(conf: Path, name: str, choices: dict[str, str | None], config: DictConfig) -> str:
    comments = dict(key_comments(conf / f"{name}.yaml", ""))
    for group, choice in choices.items():
        folder, _, package = group.partition("@")
        # A key without a comment gets the comment of the group's default.
        for path in [*_chain(conf / folder / "default.yaml"), *_chain(conf / folder / f"{choice}.yaml")]:
            comments |= dict(key_comments(path, package or folder.replace("/", ".")))
    own = OmegaConf.create({key: value for key, value in config.items_ex(resolve=False) if key != "hydra"})
    lines = []
    for path, line in lines_with_keys(OmegaConf.to_yaml(own).splitlines()):
        comment = comments.get(path)
        lines.append(f"{line}  # {comment}" if comment else line)
    return "\n".join(lines)


def _chain(path: Path) -> Iterator[Path]:
    """A group's file, preceded by the files of the same group in its defaults list."""
    if not path.is_file():
        return
    config = OmegaConf.load(path)
    for one in (config.get("defaults") or []) if isinstance(config, DictConfig) else []:
        if isinstance(one, str) and one != "_self_":
            yield from _chain(path.with_name(f"{one}.yaml"))
    yield path
