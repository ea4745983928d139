"""How a command says what is wrong."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode


@contextlib.contextmanager
def in_a_line(command: str, *more: type[Exception]) -> Iterator[None]:
    """What the user can mend (`ValueError`, a missing file, and `more`) and Ctrl-C end the command with one line.

    The exit status is 1, and 130 after Ctrl-C. HYDRA_FULL_ERROR=1 shows where it happened; the jobs of a sweep raise as
    ever, so that Hydra tells failed ones from others.
    """
    try:
        yield
    except (ValueError, FileNotFoundError, *more) as error:
        if os.environ.get("HYDRA_FULL_ERROR", "0") not in ("", "0") or sweeping():
            raise
        raise SystemExit(f"{command}: {error}") from error
    except KeyboardInterrupt:
        if sweeping():
            raise
        print(f"\n{command}: interrupted.", flush=True)
        raise SystemExit(130) from None


def sweeping() -> bool:
    """Whether this is a job of a sweep."""
    return HydraConfig.initialized() and HydraConfig.get().mode is RunMode.MULTIRUN


def refuse_dropped_choices(hints: Mapping[str, str] | None = None) -> None:
    """Raise `ValueError` for a group's choice that does not exist: of optional groups Hydra drops it without a word.

    `hints` say what to do instead, by `<group>=<choice>`.
    """
    runtime = HydraConfig.get().runtime
    folders = [Path(source.path) for source in runtime.config_sources if source.schema == "file"]
    for key, chosen in runtime.choices.items():
        group = str(key).partition("@")[0]
        if chosen is None or group.split("/")[0] == "hydra":
            continue
        known = sorted({path.stem for folder in folders for path in (folder / group).glob("*.yaml")})
        for choice in [chosen] if isinstance(chosen, str) else list(chosen):
            if not any((folder / group / f"{str(choice).removesuffix('.yaml')}.yaml").is_file() for folder in folders):
                hint = (hints or {}).get(f"{group}={choice}", f"known are {', '.join(known)}.")
                raise ValueError(f"{key}={choice}: there is no such choice; {hint}")
