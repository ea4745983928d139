"""How a command reports an error."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode


@contextlib.contextmanager
def errors_in_one_line(command: str, *more: type[Exception]) -> Iterator[None]:
    """Errors that the user can correct (`ValueError`, a missing file, and `more`) and Ctrl-C end the command in one line.

    The exit status is 1, and 130 after Ctrl-C. HYDRA_FULL_ERROR=1 shows the traceback. The jobs of a sweep raise the
    error itself, so that Hydra can tell failed jobs from others.
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
