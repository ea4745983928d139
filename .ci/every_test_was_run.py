"""Fail where a test of the given pytest reports (JUnit XML) was skipped in all of them.

Only tests of real recordings may be: they need data that is no part of the project. Where no browser could be installed,
its tests may be, too.
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

MAY_BE_SKIPPED = ("no real recordings at ", "Chromium is not installed")

_EXPECTED_FAILURE = "pytest.xfail"
"""The type of what a report calls skipped, although the test was run and failed as expected."""


def never_run(reports: list[Path]) -> dict[str, str]:
    """The tests that no report has run, each with the reason that was given last."""
    skipped: dict[str, str] = {}
    run: set[str] = set()
    for report in reports:
        for case in ElementTree.parse(report).getroot().iter("testcase"):
            name = f"{case.get('classname')}::{case.get('name')}"
            reason = case.find("skipped")
            if reason is None or reason.get("type") == _EXPECTED_FAILURE:
                run.add(name)
            else:
                skipped[name] = reason.get("message", "")
    return {
        name: reason
        for name, reason in skipped.items()
        if name not in run and not any(allowed in reason for allowed in MAY_BE_SKIPPED)
    }


def main() -> None:
    """Print what was never run, and end with 1 if there is any."""
    reports = [Path(name) for name in sys.argv[1:]]
    if not reports:
        raise SystemExit("every_test_was_run: found no report; expected the JUnit XML files of the pytest runs.")
    missing = never_run(reports)
    for name, reason in sorted(missing.items()):
        print(f"never run: {name}: {reason}")
    if missing:
        raise SystemExit(f"{len(missing)} tests were run by no command: give them the marker ci, or delete them.")


if __name__ == "__main__":
    main()
