"""How a command reports an error, and how it ends after Ctrl-C and SIGTERM."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.types import RunMode
from omegaconf.errors import OmegaConfBaseException

from tagjax.core.files import WriteError, refusal
from tagjax.core.interruption import exit_status, interruption, last_signal, message, raise_on_signals, signal_number

_FULL_ERROR = "HYDRA_FULL_ERROR"

_USER_VALUE = os.environ.get(_FULL_ERROR)

TRACEBACK_WANTED = (_USER_VALUE or "0") != "0"
"""Whether the user wants tracebacks (HYDRA_FULL_ERROR=1); read once, because `ending_in_one_line` sets the variable."""


@contextlib.contextmanager
def errors_in_one_line(command: str, *more: type[Exception]) -> Iterator[None]:
    """Errors that the user can correct (`ValueError`, `OSError`, and `more`) end the command in one line, with status 1.

    HYDRA_FULL_ERROR=1 shows the traceback. The jobs of a sweep raise the error itself, so that Hydra can tell failed jobs
    from others. An error that follows from Ctrl-C or SIGTERM becomes the exception of that signal.
    """
    try:
        with _full_error(_USER_VALUE):  # programs that the command starts inherit the user's value
            yield
    except Exception as error:
        if (number := last_signal()) is not None:
            raise interruption(number) from error
        if not isinstance(error, (ValueError, OSError, *more)) or TRACEBACK_WANTED or sweeping():
            raise
        raise SystemExit(f"{command}: {error}") from error


@contextlib.contextmanager
def ending_in_one_line(command: str) -> Iterator[None]:
    """For the whole of a command, with Hydra's part: Ctrl-C and SIGTERM end it in one line, with status 130 and 143.

    The notes of their exception follow, one a line.
    A run folder that Hydra cannot write and an error of a sweep's job that the user can correct (`ValueError`, `OSError`)
    end it in one line as well, with status 1.
    """
    # By default Hydra prints the traceback of an error in its own code and ends the process itself.
    with raise_on_signals(), _full_error("1"):
        try:
            yield
        except KeyboardInterrupt as error:
            raise _ended(command, signal_number(error), error) from None
        except Exception as error:
            if (number := last_signal()) is not None:
                raise _ended(command, number, error) from error
            if TRACEBACK_WANTED:
                raise
            if isinstance(error, CompactHydraException):  # Hydra has written it for the user
                cause = [str(error.__cause__)] if isinstance(error.__cause__, OmegaConfBaseException) else []
                raise SystemExit("\n".join([str(error), *cause])) from error
            if isinstance(error, OSError) and (number := refusal(error)) is not None:
                refused = (
                    error
                    if isinstance(error, WriteError)
                    else WriteError(error.filename or "Hydra's part of the run folder", number)
                )
                raise SystemExit(f"{command}: {refused}") from error
            if isinstance(error, (ValueError, OSError)):
                raise SystemExit(f"{command}: {error}") from error
            raise


def _ended(command: str, number: int, error: BaseException) -> SystemExit:
    """Says what ended the command, and below it the notes of the exception: what is saved, and how to resume."""
    lines = [f"{command}: {message(number)}", *getattr(error, "__notes__", ())]
    print("", *lines, sep="\n", file=sys.stderr, flush=True)
    return SystemExit(exit_status(number))


@contextlib.contextmanager
def _full_error(value: str | None) -> Iterator[None]:
    """Within the block HYDRA_FULL_ERROR has a value; None: it is not set."""
    before = os.environ.get(_FULL_ERROR)
    _set_full_error(value)
    try:
        yield
    finally:
        _set_full_error(before)


def _set_full_error(value: str | None) -> None:
    if value is None:
        os.environ.pop(_FULL_ERROR, None)
    else:
        os.environ[_FULL_ERROR] = value


def sweeping() -> bool:
    """Whether this is a job of a sweep."""
    return HydraConfig.initialized() and HydraConfig.get().mode is RunMode.MULTIRUN
