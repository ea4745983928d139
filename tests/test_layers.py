"""The house rules: imports point down, the package imports light, public names are documented and tracers final."""

import ast
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import pytest

import tagjax.tagattention
import tagjax.tagattention_paper
import tagjax.tracer

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "tagjax"

LAYERS = {
    "_types": 0,
    "_numerics": 0,
    "_compile": 0,
    "arrays_file": 0,
    "recording": 1,
    "geometry": 1,
    "association": 1,
    "image": 1,
    "rf": 1,
    "flow": 2,
    "motion": 2,
    "attention": 2,
    "propagation": 2,
    "common_fate": 2,
    "segmentation": 2,
    "anchor": 2,
    "background": 2,
    "phases": 2,
    "parameters": 1,
    "tracer": 3,
    "view": 3,
    "phase_memory": 3,
    "tagattention": 3,
    "tagattention_paper": 3,
    "learned": 3,
    "baselines": 3,
    "sim": 3,
    "data": 3,
    "training": 4,
    "evaluation": 4,
    "viz": 4,
    "config": 4,
}

MODULES = sorted(PACKAGE.rglob("*.py"))


def _part(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def _imported_parts(path: Path) -> set[str]:
    here = path.relative_to(ROOT).with_suffix("").parts
    if here[-1] == "__init__":
        here = (*here[:-1], "")
    parts = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level] if node.level else ()
            full = [*base, *(node.module.split(".") if node.module else [])]
            if full and full[0] == "tagjax":
                parts |= {full[1]} if len(full) > 1 else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            parts |= {a.name.split(".")[1] for a in node.names if a.name.startswith("tagjax.")}
    return parts


@pytest.mark.parametrize("path", [m for m in MODULES if m.parent != PACKAGE or m.name != "__init__.py"], ids=str)
def test_imports_point_down(path):
    own = LAYERS[_part(path)]
    for part in _imported_parts(path) & set(LAYERS):
        assert LAYERS[part] <= own, f"{path.name} (layer {own}) imports {part} (layer {LAYERS[part]})"


def test_every_module_has_a_layer():
    assert {_part(path) for path in MODULES} - {"__init__"} <= set(LAYERS)


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_hydra_stays_in_the_entry_points(path):
    imported = {
        alias.name.split(".")[0]
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Import)
        for alias in node.names
    } | {
        (node.module or "").split(".")[0]
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and not node.level
    }
    assert not imported & {"hydra", "omegaconf", "pickle", "cloudpickle", "dill"}


def test_the_package_imports_light():
    code = (
        "import sys, tagjax; heavy = {'hydra', 'matplotlib', 'mujoco', 'wandb', 'cv2'} & set(sys.modules); "
        "sys.exit(', '.join(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_what_the_forerunners_share_needs_no_opencv():
    code = "import sys, tagjax.baselines; tagjax.baselines.host_trace; sys.exit('cv2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.mark.parametrize("path", MODULES, ids=str)
def test_public_names_are_documented(path):
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree)
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{path.name}: {node.name}"


def test_tracers_are_abstract_or_final():
    for module in (tagjax.tracer, tagjax.tagattention, tagjax.tagattention_paper):
        for thing in vars(module).values():
            if isinstance(thing, type) and issubclass(thing, eqx.Module) and thing is not eqx.Module:
                for base in thing.__bases__:
                    assert base is eqx.Module or base.__name__.startswith("Abstract"), thing


@pytest.mark.parametrize("path", sorted((ROOT / "experiments").glob("*.py")), ids=str)
def test_entry_points_are_thin(path):
    assert len(path.read_text().splitlines()) < 80
