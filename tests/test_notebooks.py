"""The notebooks of docs/: stored with their outputs, which are small, without errors, and hold nothing of one machine.

That they run is checked by nbmake: `pytest --nbmake docs/notebooks`, as `.ci/run` does.
"""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[1] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
MAX_BYTES = 300_000


def _cells(path: Path, kind: str) -> list[dict[str, Any]]:
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == kind]


def test_both_are_there() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["from-reads-to-mask", "your-own-recording"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_are_stored_small_and_without_errors(path: Path) -> None:
    cells = _cells(path, "code")
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert len(json.dumps(outputs)) < MAX_BYTES
    assert outputs
    assert not [output for output in outputs if output["output_type"] == "error"]
    assert not [output for output in outputs if output.get("name") == "stderr"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_they_read_well_anywhere(path: Path) -> None:
    text = path.read_text()
    assert not re.search(r"(/home/|/root/|/work/|/Users/)", text)
    for cell in _cells(path, "code"):
        ast.parse("".join(cell["source"]))
    links = [link for cell in _cells(path, "markdown") for link in re.findall(r"\]\(([^)#]+)", "".join(cell["source"]))]
    assert [link for link in links if not (FOLDER / link).is_file()] == []
    assert json.loads(text)["metadata"]["kernelspec"]["name"] == "python3"
