"""What CI relies on: markers that some command runs, README's test command, and the check that every test was run."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
CHECK = ROOT / ".ci" / "every_test_was_run.py"


def _report(path: Path, *cases: tuple[str, str | None]) -> Path:
    """A pytest report with these tests; with a reason, the test was skipped."""
    texts = []
    for name, reason in cases:
        skipped = "" if reason is None else f'<skipped type="pytest.skip" message="{reason}"/>'
        texts.append(f'<testcase classname="tests.test_a" name="{name}">{skipped}</testcase>')
    path.write_text(f"<testsuites><testsuite>{''.join(texts)}</testsuite></testsuites>")
    return path


def _check(*reports: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(CHECK), *map(str, reports)], capture_output=True, text=True, check=False)


def test_a_test_that_was_skipped_in_every_run_is_named(tmp_path: Path) -> None:
    default = _report(
        tmp_path / "a.xml", ("test_one", None), ("test_two", "ci: add --ci to run it"), ("test_three", "x")
    )
    long = _report(tmp_path / "b.xml", ("test_two", None))
    found = _check(default, long)
    assert found.returncode == 1
    assert found.stdout.splitlines() == ["never run: tests.test_a::test_three: x"]


def test_an_expected_failure_was_run(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text("import pytest\n\ndef test_stale():\n    pytest.xfail('stale')\n")
    report = tmp_path / "a.xml"
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--junitxml={report}", "test_it.py"]
    subprocess.run(command, cwd=tmp_path, capture_output=True, check=True)
    found = _check(report)
    assert found.returncode == 0, found.stdout


def test_tests_of_real_recordings_and_of_a_missing_browser_may_be_skipped(tmp_path: Path) -> None:
    reasons = ("no real recordings at somewhere", "Chromium is not installed (Debian: ...)")
    report = _report(tmp_path / "a.xml", ("test_one", None), *((f"test_{one[:2]}", one) for one in reasons))
    assert _check(report).returncode == 0
    assert _check().returncode == 1  # without a report nothing was checked


def test_the_markers_are_those_that_a_command_runs() -> None:
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    assert [marker.split(":")[0] for marker in options["markers"]] == ["ci", "real_data"]
    assert "--strict-markers" in options["addopts"]


def test_every_test_file_named_by_ci_exists() -> None:
    script = (ROOT / ".ci" / "run").read_text()
    named = {word.split("::")[0].strip('()"') for word in script.split() if "tests/test_" in word}
    files = {word[word.index("tests/test_") :] for word in named}
    assert len(files) >= 5
    for name in files:
        assert list(ROOT.glob(name)), name


def test_readme_has_a_test_command_that_ends_with_pytest() -> None:
    block = (ROOT / "README.md").read_text().split("<!-- test command -->")[1].split("```")[1]
    assert block.removeprefix("bash").strip().rpartition(" && ")[2].startswith(".venv/bin/python -m pytest")
