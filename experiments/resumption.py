"""What to type to resume a command that Ctrl-C or SIGTERM has ended."""

from __future__ import annotations

import contextlib
import re
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig

from .errors import sweeping

_FOLDERS = re.compile(r"\+{0,2}(hydra\.(run|sweep)\.dir|resume)=")
"""Arguments that are replaced: where the command writes, and `resume=false`, with which a run does not resume."""

_PLAIN = re.compile(r"[\w./:~-]+", re.ASCII)
"""A value that Hydra reads as it stands; another one is quoted."""


@contextlib.contextmanager
def resumable(command: str) -> Iterator[None]:
    """Within the block the exception of Ctrl-C or SIGTERM gets a note with the command that resumes."""
    job = HydraConfig.get()
    key, folder = ("hydra.sweep.dir", job.sweep.dir) if sweeping() else ("hydra.run.dir", job.runtime.output_dir)
    try:
        yield
    except KeyboardInterrupt as error:
        error.add_note(f"resume with: {resume_command(command, sys.argv, f'{key}={_value(Path(folder))}')}")
        raise


def resume_command(command: str, argv: Sequence[str], folder: str) -> str:
    """The command line `argv` (program, arguments) with the override `folder`, ready for a shell."""
    program = Path(argv[0]).name
    if not program.startswith("tagjax-"):  # the console script of an installed package
        program = f"python -m {__name__.rpartition('.')[0]}.{command}"
    return shlex.join([*program.split(), *(one for one in argv[1:] if not _FOLDERS.match(one)), folder])


def _value(folder: Path) -> str:
    """A path as Hydra reads it: from the working directory where it lies within, quoted where it has other characters."""
    with contextlib.suppress(ValueError):
        folder = folder.resolve().relative_to(Path.cwd().resolve())
    text = str(folder)
    if _PLAIN.fullmatch(text):
        return text
    return "'" + re.sub(r"(\\*)('|$)", lambda found: 2 * found[1] + ("\\'" if found[2] else ""), text) + "'"
