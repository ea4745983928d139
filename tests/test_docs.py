"""README, CONTRIBUTING, CHANGELOG and docs/: files, links, anchors and modules that they name exist; README's Python runs."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
import synthetic_clips as synthetic

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")] + sorted((ROOT / "docs").glob("*.md"))
TOP_LEVEL = (".ci", "conf", "docs", "experiments", "tagjax", "tests")
MADE = {"docs/tables/<name>.json", "conf/table/<name>.yaml", "conf/<name>.yaml"}
"""Paths with a placeholder, or of files that a command makes."""
OLD = {"CHANGELOG.md": re.compile(r"\| before \| now \|\n(\|.*\n)+|^### Removed\n(?:(?!##).*\n)*", re.MULTILINE)}
"""Tables of old names, and lists of what was removed: these no longer exist."""


def prose(page: Path) -> str:
    """A page without blocks of code and without old names."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    return OLD[page.name].sub("", text) if page.name in OLD else text


def quoted(text: str) -> list[str]:
    """What stands in back quotes."""
    return re.findall(r"`([^`\n]+)`", text)


def paths_in(text: str) -> set[str]:
    """Back-quoted paths that begin with a folder of the repository."""
    return {one for one in quoted(text) if one.split("/")[0] in TOP_LEVEL and "/" in one and " " not in one} - MADE


def names_in(text: str) -> set[str]:
    """Back-quoted dotted names of the two Python packages."""
    return {one for one in quoted(text) if re.fullmatch(r"(tagjax|experiments)(\.\w+)+", one)}


def links_in(text: str) -> set[str]:
    """Targets of links and pictures within the repository."""
    return {one for one in re.findall(r"\]\(([^)\s]+)\)", text) if not re.match(r"\w+:", one)}


def anchors_of(page: Path) -> set[str]:
    """Anchors of a page's headings, formed as GitHub does."""
    headings = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def exists(path: str) -> bool:
    return any(ROOT.glob(path.rstrip("/"))) if "*" in path else (ROOT / path).exists()


def resolves(name: str) -> bool:
    """Whether a dotted name is a module, or an attribute of one."""
    try:
        importlib.import_module(name)
    except ModuleNotFoundError:
        parent, _, attribute = name.rpartition(".")
        return bool(parent) and resolves(parent) and hasattr(importlib.import_module(parent), attribute)
    return True


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_and_modules_that_a_page_names_exist(page: Path):
    assert sorted(path for path in paths_in(prose(page)) if not exists(path)) == []
    assert sorted(name for name in names_in(prose(page)) if not resolves(name)) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_of_a_page_lead_somewhere(page: Path):
    missing = []
    for link in links_in(prose(page)):
        file, _, anchor = link.partition("#")
        target = page.parent / file if file else page
        if not target.exists() or (anchor and anchor not in anchors_of(target)):
            missing.append(link)
    assert sorted(missing) == []


def test_names_are_found_in_a_page():
    text = (
        "`tagjax/gone.py`, [a](docs/b.md#c), ![d](e.jpg), <https://x.org> [f](https://x.org), `tagjax.gone`, `seed=1`"
    )
    assert paths_in(text) == {"tagjax/gone.py"}
    assert links_in(text) == {"docs/b.md#c", "e.jpg"}
    assert names_in(text) == {"tagjax.gone"}
    assert not resolves("tagjax.gone")
    assert resolves("tagjax.Recording")
    assert not exists("tagjax/gone.py")
    assert not exists("tests/gone_*.py")
    assert not any("conf/benchmark" in one for one in paths_in(prose(ROOT / "CHANGELOG.md")))


def test_readme_is_at_most_200_lines():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 200


@pytest.mark.ci
def test_python_of_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """A recording of one's own is saved, opened and traced; a small scene stands in for it."""
    save, trace = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    scene = synthetic.enlarged(synthetic.recording(num_frames=6), 4)
    shape = f"width={scene.intrinsics.width}, height={scene.intrinsics.height}"
    assert "width=512, height=424" in save
    reads = scene.reads
    given = {
        "colour": scene.colour,
        "depth": scene.depth,
        "frame_time_ns": scene.time_ns,
        "read_time_ns": reads.time_ns,
        **{
            name: getattr(reads, name)
            for name in ("epc", "antenna", "carrier_hz", "phase_rad", "rssi_dbm", "doppler_hz")
        },
    }
    monkeypatch.chdir(tmp_path)
    exec(save.replace("width=512, height=424", shape), given)
    assert (tmp_path / "recordings" / "mine.zarr").is_dir()
    exec(trace, {})
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines() if line[:1].isdigit()] == list("012345")
