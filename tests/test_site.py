"""The documentation as a site: it builds strictly and offline, shows every page, public name and equation, and fits phones."""

from __future__ import annotations

import ast
import html
import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PAGES = sorted(path.stem for path in (ROOT / "docs").glob("*.md"))


def _leaves(nav: list[Any]) -> Iterator[str]:
    for one in nav:
        for value in one.values() if isinstance(one, dict) else [one]:
            yield from [value] if isinstance(value, str) else _leaves(value)


def test_every_page_is_in_the_navigation_once() -> None:
    listed = list(_leaves(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]))
    own = [one for one in listed if not one.startswith("reference/")]
    assert sorted(own) == [f"{page}.md" for page in PAGES]


def _hook(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(f"docs_{name}", ROOT / "docs" / "site" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _converted(text: str) -> str:
    from markdown import Markdown

    return Markdown(extensions=["tables", _hook("hooks").EquationExtension()]).convert(text)


@pytest.mark.ci
def test_an_equation_at_the_start_of_a_line_stays_in_its_paragraph() -> None:
    found = _converted("$x$ is here,\n$y$ there.")
    assert found.count("<p>") == 1
    assert found.count("<math") == 2
    assert re.sub(r"<span.*?</span>", "#", found) == "<p># is here,\n# there.</p>"


@pytest.mark.ci
def test_an_equation_in_its_own_line_scrolls_and_keeps_its_backslashes() -> None:
    found = _converted("with\n\n$$P' \\leftarrow \\frac{a\\,b_1}{c_2} ,\n\\qquad |P|\\!$$\n\nfor *all*")
    assert '<span class="equation" tabindex="0"><math' in found
    assert "<mfrac>" in found
    assert 'display="block"' in found
    assert "<em>all</em>" in found
    assert "<em>" not in found[: found.index("</math>")]


@pytest.mark.ci
def test_a_function_is_set_apart_from_its_letter() -> None:
    assert '<mi>log</mi><mspace width="0.17em"/><msub><mi>I</mi>' in _converted("$\\log I_0$")
    assert "<mspace" not in _converted("$\\log(x) + \\log_b(x) + \\max(x)$")


@pytest.mark.ci
@pytest.mark.parametrize("text", ["`$a$ and ${b}`", "5$ or 6$", "$ 5 and 6 $", "\\$a\\$", "US$5 and A$6"])
def test_other_dollars_are_dollars(text: str) -> None:
    assert "<math" not in _converted(text)


@pytest.mark.ci
@pytest.mark.parametrize("latex", ["\\nosuchcommand{x}", "\\frac{a}", "\\left( a"])
def test_an_equation_that_cannot_be_converted_is_an_error(latex: str) -> None:
    with pytest.raises(ValueError, match=r"Equation .*latex2mathml"):
        _converted(f"${latex}$")


@pytest.mark.ci
def test_comments_of_fields_are_their_descriptions(tmp_path: Path) -> None:
    griffe = pytest.importorskip("griffe")
    (tmp_path / "sample.py").write_text(
        'class A:\n    """A thing."""\n\n'
        "    x_m: float = 1.0  # metres, from the left\n    # to the right\n"
        "    y: int = field(default=3, converter=int)\n    _z: int = 0  # hidden\n"
    )
    extensions = griffe.load_extensions(_hook("fields").Fields)
    found = griffe.load("sample", search_paths=[tmp_path], extensions=extensions)["A"].docstring
    assert found.value.splitlines() == [
        "A thing.",
        "",
        "Attributes:",
        "    x_m: Metres, from the left to the right. Default: `1.0`.",
        "    y: Default: `3`.",
    ]
    assert [one.kind.value for one in found.parsed] == ["text", "attributes"]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built from another folder than the repository's."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(ROOT / "mkdocs.yml"), "-d", str(folder)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder.parent, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return folder


@pytest.mark.ci
def test_every_public_name_is_in_the_reference(site: Path) -> None:
    missing = []
    for package in _hook("hooks").PACKAGES:
        shown = (site / "reference" / f"{package}.html").read_text()
        for path in sorted((ROOT / "tagjax" / package).rglob("*.py")):
            names = path.relative_to(ROOT).with_suffix("").parts
            if any(name.startswith("_") for name in names):
                continue  # what a package re-exports is shown where it is defined
            module = ".".join(names)
            defined = [
                node for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef | ast.ClassDef)
            ]
            ids = [module, *(f"{module}.{node.name}" for node in defined if not node.name.startswith("_"))]
            missing += [one for one in ids if f'id="{one}"' not in shown]
    assert missing == []
    recording = (site / "reference" / "recording.html").read_text()
    assert "(num_frames,) int64 host clock." in recording


@pytest.mark.ci
def test_every_equation_is_shown(site: Path) -> None:
    counts = {}
    for page in PAGES:
        text = re.sub(r"```.*?```|`[^`]*`", "", (ROOT / "docs" / f"{page}.md").read_text(), flags=re.DOTALL)
        shown = (site / f"{page}.html").read_text()
        counts[page] = text.count("$") - 2 * text.count("$$")
        assert shown.count("<math") == counts[page] // 2 + text.count("$$") // 2, page
        plain = html.unescape(re.sub(r"<(script|pre|code|math).*?</\1>", "", shown, flags=re.DOTALL))
        assert "$" not in plain, page
    assert counts["concepts"] > 20
    assert counts["tracer"] > 20


@pytest.mark.ci
def test_the_font_that_comes_along_has_every_character_of_the_equations(site: Path) -> None:
    from fontTools.ttLib import TTFont

    font = TTFont(site / "site" / "math.woff")
    assert "MATH" in font
    known = {chr(code) for code in font.getBestCmap() or {}}
    for page in PAGES:
        equations = re.findall(r"<math.*?</math>", (site / f"{page}.html").read_text(), flags=re.DOTALL)
        shown = set(html.unescape(re.sub(r"<[^>]*>", "", "".join(equations)))) - {"\n"}
        assert shown - known == set(), page
    assert "math.woff" in (site / "site" / "style.css").read_text()


@pytest.mark.ci
def test_nothing_comes_from_the_network(site: Path) -> None:
    for path in site.rglob("*.html"):
        text = path.read_text()
        loaded = re.findall(
            r'<(?:script|img|iframe|link(?=[^>]*rel="?(?:stylesheet|preconnect|icon)))[^>]*?(?:src|href)="([^"]+)', text
        )
        assert loaded
        assert [one for one in loaded if re.match(r"(https?:)?//", one)] == [], path.name
    styles = " ".join(path.read_text() for path in site.rglob("*.css"))
    assert re.findall(r"(?:@import|url\()[\"']?(?:https?:)?//[^)]*", styles) == []


def _open(browser: Any, address: str, width: int) -> tuple[Any, list[str]]:
    problems: list[str] = []
    page = browser.new_page(viewport={"width": width, "height": 900})
    page.on("console", lambda message: problems.append(message.text))
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("request", lambda request: problems.append(request.url) if request.url.startswith("http") else None)
    page.goto(address)
    return page, problems


@pytest.mark.ci
@pytest.mark.parametrize("width", [390, 1400])
def test_every_page_fits_and_reports_no_error(site: Path, browser: Any, width: int) -> None:
    wide, shown = {}, 0
    for name in [*PAGES, "reference/recording", "reference/radio"]:
        page, problems = _open(browser, (site / f"{name}.html").as_uri(), width)
        wide[name] = page.evaluate("document.documentElement.scrollWidth")
        assert page.evaluate("[...document.images].every(one => one.loading === 'lazy' || one.naturalWidth > 0)"), name
        shown += page.evaluate(
            "[...document.querySelectorAll('.equation')].filter(one => one.offsetHeight > 20).length"
        )
        assert problems == [], name
        page.close()
    assert {name: pixels for name, pixels in wide.items() if pixels > width} == {}
    assert shown > 20


@pytest.mark.ci
def test_search_works_in_a_page_opened_as_a_file(site: Path, browser: Any) -> None:
    page, problems = _open(browser, (site / "reference" / "core.html").as_uri(), 1400)
    page.locator("input[name=query]").press_sequentially("antennas_m")  # the page listens to keys
    page.locator(".md-search-result__link").first.wait_for(timeout=60_000)
    assert "own-recordings" in [
        Path(str(one.get_attribute("href")).split("?")[0]).stem for one in page.locator(".md-search-result__link").all()
    ]
    assert problems == []
    page.close()
