"""Progress: a line a stage with count, rate and remaining time on a terminal, and not a character elsewhere."""

from __future__ import annotations

import contextlib
import io
import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from tagjax.core.progress import progress_lines, rate_text, time_text, tracked

ROOT = Path(__file__).parents[1]


class Terminal(io.StringIO):
    """A terminal, as far as `Console` looks, with its own clock."""

    def __init__(self) -> None:
        super().__init__()
        self.now_s = 0.0

    def isatty(self) -> bool:
        return True

    def console(self) -> Console:
        environment = {"TERM": "xterm", "COLUMNS": "80"}
        return Console(file=self, force_terminal=True, get_time=lambda: self.now_s, _environ=environment)

    def last_lines(self) -> list[str]:
        """What stays on the screen: the text after the last time that the cursor went back up."""
        plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", lambda code: "\r" if code[0].endswith("A") else "", self.getvalue())
        return [line.rstrip() for line in plain.rpartition("\r")[2].splitlines() if line.strip()]


@pytest.mark.parametrize(
    ("per_s", "text"),
    [(None, ""), (0.0, ""), (250.4, "250/s"), (12.34, "12.3/s"), (1.0, "1.0/s"), (0.4, "2.5 s each"), (1 / 150, "2.5 min each")],
)  # fmt: skip
def test_a_rate_in_words(per_s: float | None, text: str) -> None:
    assert rate_text(per_s) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "-:--"), (0.4, "0:00"), (61.0, "1:01"), (59.6, "1:00"), (3599.6, "1:00:00"), (90_061.0, "25:01:01")],
)
def test_a_duration_in_words(seconds: float | None, text: str) -> None:
    assert time_text(seconds) == text


def test_the_rate_leaves_out_what_was_there_before_and_the_first_unit_which_includes_compilation() -> None:
    terminal = Terminal()
    with progress_lines(console=terminal.console()) as report:
        report("trace", 100, 200, "compiling")
        for done, now_s in ((101, 60.0), (102, 62.0), (110, 78.0)):  # two seconds each, after a minute of compilation
            terminal.now_s = now_s
            report("trace", done, 200, "walkers-0")
    (line,) = terminal.last_lines()
    assert line.startswith("trace")
    for part in ("110/200", "2.0 s each", "0:01:18", "left 3:00", "walkers-0"):
        assert part in line


def test_one_unit_gives_a_rate_and_the_end_has_no_time_left() -> None:
    terminal = Terminal()
    with progress_lines(console=terminal.console()) as report:
        report("first", 0, 3)
        terminal.now_s = 10.0
        report("first", 1, 3)
        report("second", 0, 0)  # its total is not known
        report("third", 4, 4)
    first, second, third = terminal.last_lines()
    assert "10.0 s each" in first
    assert "left 0:20" in first
    assert "left -:--" in second
    assert "0/?" in second
    assert "4/4" in third
    assert "left" not in third


def test_names_are_no_markup_and_long_ones_stay_on_their_line() -> None:
    terminal = Terminal()
    with progress_lines(console=terminal.console()) as report:
        report("[bold]x " + 20 * "y", 1000, 2000, "[/] " + 40 * "long name ")
        terminal.now_s = 400.0
        report("[bold]x " + 20 * "y", 1001, 2000, "[/] " + 40 * "long name ")
    (line,) = terminal.last_lines()
    assert line.startswith("[bold]x")
    assert len(line) <= 80
    for part in ("1001/2000", "6.7 min each", "0:06:40", "left 111:00:00"):  # numbers are never cut
        assert part in line


def test_work_within_shown_work_has_its_line_only_while_it_lasts(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("tagjax.core.progress.Console", lambda **_: terminal.console())
    with progress_lines(console=terminal.console()) as report:
        report("outer", 0, 2)
        assert list(tracked([1, 2], "inner")) == [1, 2]
        report("outer", 2, 2)
    assert "inner" in terminal.getvalue()
    (line,) = terminal.last_lines()
    assert line.startswith("outer")
    with progress_lines(console=terminal.console()) as report:  # the display is free again, also after an error
        report("next", 1, 1)
    assert terminal.last_lines()[-1].startswith("next")


def test_an_error_frees_the_display() -> None:
    terminal = Terminal()
    interrupted = (number for number in [1] if number > 1)
    with pytest.raises(StopIteration), progress_lines(console=terminal.console()) as report:
        report("broken", next(interrupted), 2)
    with progress_lines(console=terminal.console()) as report:
        report("next", 1, 1)
    assert terminal.last_lines()[-1].startswith("next")


@pytest.mark.parametrize("forced", [False, True], ids=["file", "forced_colour"])
def test_a_file_gets_nothing(forced: bool) -> None:
    file = io.StringIO()
    with progress_lines(console=Console(file=file, force_terminal=forced)) as report:
        report("trace", 1, 2)
    assert file.getvalue() == ""


def test_a_terminal_gets_nothing_that_is_not_to_be_shown() -> None:
    terminal = Terminal()
    with progress_lines(shown=False, console=terminal.console()) as report:
        report("trace", 1, 2)
    dumb = Console(file=terminal, force_terminal=True, _environ={"TERM": "dumb"})
    with progress_lines(console=dumb) as report:
        report("trace", 1, 2)
    assert terminal.getvalue() == ""


def test_nothing_else_shows_progress() -> None:
    """Other bars would have no rate, or would be written to files."""
    files = [path for folder in ("tagjax", "experiments") for path in (ROOT / folder).rglob("*.py")]
    found = [path for path in files if re.search(r"rich\.progress|\.status\(\"|tqdm", path.read_text())]
    # A recording in the making has no end that is known; its line counts frames and reads.
    assert {str(path.relative_to(ROOT)) for path in found} == {"tagjax/core/progress.py", "experiments/record.py"}


def test_every_command_shows_its_progress_or_is_done_at_once() -> None:
    own = {"import_recording", "record"}  # frames are counted where they are written
    in_library = {"evaluate", "evaluate_flow", "train", "train_flow"}  # the settings' `progress` reaches the library
    names = {path.stem for path in (ROOT / "experiments").glob("*.py") if (ROOT / "conf" / path.name).with_suffix(".yaml").is_file()}  # fmt: skip
    assert len(names) >= 20
    without = {name for name in names if "progress_lines" not in (ROOT / "experiments" / f"{name}.py").read_text()}
    assert without == own | in_library
    for name in names - {"import_recording"} - {"train", "train_flow"}:
        assert re.search(r"^progress: true", (ROOT / "conf" / f"{name}.yaml").read_text(), re.MULTILINE), name
    assert "progress: true" in (ROOT / "conf" / "loop" / "default.yaml").read_text()


def _read_all(terminal: int) -> bytes:
    """What is written to a pseudo-terminal until its other end is closed."""
    parts = []
    with os.fdopen(terminal, "rb", buffering=0) as file, contextlib.suppress(OSError):  # Linux ends it by an error
        while part := file.read(4096):
            parts.append(part)
    return b"".join(parts)


@pytest.mark.ci
def test_a_command_shows_lines_on_a_terminal_and_not_in_a_pipe(tmp_path: Path) -> None:
    run = [sys.executable, "-m", "experiments.fault_trial", "kinds=[clocks]", "number=4", f"hydra.run.dir={tmp_path}"]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "100"}
    piped = subprocess.run(run, capture_output=True, text=True, cwd=ROOT, env=environment, check=True)
    assert "\x1b" not in piped.stdout + piped.stderr
    assert "left" not in piped.stdout
    main, second = pty.openpty()
    with subprocess.Popen(run, stdout=second, stderr=subprocess.PIPE, cwd=ROOT, env=environment) as shown:
        os.close(second)
        written = _read_all(main)
    assert shown.returncode == 0
    assert b"clocks" in written
    assert b"4/4" in written
