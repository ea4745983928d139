"""What MkDocs does beside its plugins: equations become MathML, and each package gets a page of the API reference.

Everything happens at build time. The pages need neither a script nor a font from the network.
"""

from __future__ import annotations

import ast
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor
from mkdocs.structure.files import File

PACKAGES = (
    "core", "image", "radio", "recording", "flow", "sim", "tracing", "tagattention", "metrics", "report", "training",
    "baselines", "live", "evaluation",
)  # fmt: skip
"""Packages with a page in the reference, from the bottom up."""

_ROOT = Path(__file__).parents[2]
_BEFORE_ESCAPES = 185
"""Between code (190), in which a dollar is a dollar, and escapes (180), which would take the backslashes."""

_LATE_IN_SEARCH = "---\nsearch: {boost: 0.3}\n---\n"
"""Front matter of the reference's pages: the guide comes before them."""

_BAR, _PRIME = '<mo stretchy="false">&#x0007C;</mo>', "<mi>&#x02032;</mi>"
_SET_CLOSER = {
    re.compile(_BAR): _BAR.replace("<mo", '<mo lspace="0" rspace="0"'),
    re.compile(f"<msup>(<mi>[^<]*</mi>){_PRIME}</msup>"): r'<mrow>\1<mo lspace="0" rspace="0">&#x02032;</mo></mrow>',
    re.compile(r"(?<!<msub>)(?<!<msup>)(<mi>(?:log|exp)</mi>)(?=<m(?:i|sub|sup|row)>)"): r'\1<mspace width="0.17em"/>',
}
"""Bars as fences, which would be spaced like operators; primes, which are raised already; a space between a function and its letter."""

_NUM_CHILDREN = {"mfrac": 2, "msub": 2, "msup": 2, "mover": 2, "munder": 2, "mroot": 2, "msubsup": 3, "munderover": 3}


class Equations(InlineProcessor):
    """LaTeX between dollars as MathML, `$...$` in the line and `$$...$$` in a line of its own.

    Python-Markdown takes <math> for a block, which would end the paragraph; a <span> around it does not.
    """

    def __init__(self, pattern: str, md: Markdown, display: bool) -> None:
        super().__init__(pattern, md)
        self.display = display

    def handleMatch(self, m: re.Match[str], data: str) -> tuple[str, int, int]:  # noqa: N802
        latex = m.group(1).strip()
        kind = 'class="equation" tabindex="0"' if self.display else 'class="inline-equation"'  # the keyboard scrolls it
        return self.md.htmlStash.store(f"<span {kind}>{mathml_of(latex, display=self.display)}</span>"), *m.span(0)


def mathml_of(latex: str, *, display: bool) -> str:
    """The equation as MathML. Raises `ValueError` for what latex2mathml cannot convert."""
    try:
        mathml = convert(latex, display="block" if display else "inline")
    except Exception as error:
        raise ValueError(f"Equation {latex!r} is not LaTeX that latex2mathml reads: {error!r}. Correct it.") from error
    parts = [(one.tag.rpartition("}")[2], one) for one in ElementTree.fromstring(mathml).iter()]
    unknown = [one.text for _, one in parts if one.text and "\\" in one.text]
    incomplete = [tag for tag, one in parts if len(one) != _NUM_CHILDREN.get(tag, len(one))]
    if unknown or incomplete:
        raise ValueError(f"Equation {latex!r}: latex2mathml leaves {[*unknown, *incomplete]}. Correct it.")
    for found, closer in _SET_CLOSER.items():
        mathml = found.sub(closer, mathml)
    return mathml


class EquationExtension(Extension):
    """Markdown with equations."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802
        display, inline = r"\$\$(?s:(.+?))\$\$", r"(?<![\\$\w])\$(?![\s$])([^$\n]*(?:\n[^$\n]+)*?)(?<!\s)\$(?![\w$])"
        md.inlinePatterns.register(Equations(display, md, True), "display equation", _BEFORE_ESCAPES + 1)
        md.inlinePatterns.register(Equations(inline, md, False), "inline equation", _BEFORE_ESCAPES)


def on_config(config: Any) -> Any:
    """Markdown of pages and docstrings has equations."""
    config.markdown_extensions.append(EquationExtension())
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of the reference."""
    files.append(File.generated(config, "reference/index.md", content=reference_index()))
    for name in PACKAGES:
        files.append(File.generated(config, f"reference/{name}.md", content=reference_page(name)))
    return files


def on_page_markdown(markdown: str, page: Any, **kwargs: Any) -> str:
    """The start page has no lists of pages beside it: its table leads to them."""
    if page.file.src_uri == "index.md":
        page.meta["hide"] = ["navigation", "toc"]
    return markdown


def reference_index() -> str:
    """The page that leads to the packages: the first sentence of each one's docstring."""
    rows = [
        "# Reference\n",
        "From the bottom up: a package imports only packages of lower layers.\n",
        "| package | content |",
        "|---|---|",
    ]
    for name in PACKAGES:
        docstring = ast.get_docstring(ast.parse((_ROOT / "tagjax" / name / "__init__.py").read_text())) or ""
        first = docstring.split("\n\n")[0].replace("\n", " ")
        rows.append(f"| [`tagjax.{name}`]({name}.md) | {first} |")
    return "\n".join([*rows, ""])


def reference_page(name: str) -> str:
    """The page of a package: its docstring, then each public module with what it defines."""
    modules = [f"tagjax.{name}", *sorted(_modules(_ROOT / "tagjax" / name, f"tagjax.{name}"))]
    parts = [f"{_LATE_IN_SEARCH}# {name}\n"]
    for module in modules:
        heading = "" if module == modules[0] else f"## {module.removeprefix(modules[0] + '.')} {{ #{module} }}\n\n"
        parts.append(f"{heading}::: {module}\n")
    return "\n".join(parts)


def _modules(folder: Path, name: str) -> list[str]:
    found = []
    for path in folder.iterdir():
        if path.name.startswith("_"):
            continue
        if path.suffix == ".py":
            found.append(f"{name}.{path.stem}")
        elif (path / "__init__.py").is_file():
            found += [f"{name}.{path.name}", *_modules(path, f"{name}.{path.name}")]
    return found
