"""The structure of the package: strict layers, light imports, documented public names, thin entry points."""

import ast
import subprocess
import sys
from pathlib import Path

import equinox as eqx

import tagjax.tagattention
import tagjax.tagattention.literal
import tagjax.tracing.tracer

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "tagjax"

LAYERS = (
    {"core"},
    {"image", "radio"},
    {"recording"},
    {"flow", "sim", "stereo"},
    {"tracing"},
    {"tagattention", "metrics"},
    {"report"},
    {"training", "baselines", "live"},
    {"evaluation", "benchmarks"},
)
"""Packages from the bottom up. A package imports only packages of the layers below its own."""

LAYER = {name: number for number, names in enumerate(LAYERS) for name in names}

MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path.parent != PACKAGE)


def _package(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0]


def _imports(path: Path) -> set[tuple[str, ...]]:
    """Dotted names, split, of every module that a file imports, at its top or inside of a function."""
    here = path.relative_to(ROOT).with_suffix("").parts
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            base = here[: len(here) - node.level] if node.level else ()
            module = (*base, *(node.module.split(".") if node.module else ()))
            found |= {(*module, alias.name) for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {tuple(alias.name.split(".")) for alias in node.names}
    return found


def test_packages_import_only_lower_layers():
    assert {_package(path) for path in MODULES} == set(LAYER)
    wrong = [
        f"{path.relative_to(ROOT)} (layer {LAYER[_package(path)]}) imports {name[1]} (layer {LAYER[name[1]]})"
        for path in MODULES
        for name in _imports(path)
        if name[0] == "tagjax" and len(name) > 1 and name[1] != _package(path)
        and LAYER.get(name[1], 0) >= LAYER[_package(path)]
    ]  # fmt: skip
    assert not wrong, "\n".join(wrong)


def test_only_the_entry_points_import_hydra_and_nothing_unpickles():
    forbidden = {"hydra", "omegaconf", "pickle", "cloudpickle", "dill"}
    wrong = [
        f"{path.relative_to(ROOT)}: {name[0]}" for path in MODULES for name in _imports(path) if name[0] in forbidden
    ]
    assert not wrong, "\n".join(wrong)


def test_public_names_are_documented():
    wrong = []
    for path in [PACKAGE / "__init__.py", *MODULES]:
        tree = ast.parse(path.read_text())
        named = [node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
        wrong += [] if ast.get_docstring(tree) else [str(path.relative_to(ROOT))]
        wrong += [
            f"{path.relative_to(ROOT)}: {node.name}"
            for node in named
            if not node.name.startswith("_") and not ast.get_docstring(node)
        ]
    assert not wrong, "\n".join(wrong)


def test_the_package_imports_light():
    code = (
        "import sys, tagjax; heavy = {'hydra', 'matplotlib', 'mujoco', 'wandb', 'cv2'} & set(sys.modules); "
        "sys.exit(', '.join(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_interface_of_the_baselines_needs_no_opencv():
    code = "import sys, tagjax.baselines; tagjax.baselines.host_trace; sys.exit('cv2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_tracers_are_abstract_or_final():
    for module in (tagjax.tracing.tracer, tagjax.tagattention, tagjax.tagattention.literal):
        for thing in vars(module).values():
            if isinstance(thing, type) and issubclass(thing, eqx.Module) and thing is not eqx.Module:
                for base in thing.__bases__:
                    assert base is eqx.Module or base.__name__.startswith("Abstract"), thing


def test_entry_points_are_thin():
    texts = {path.name: path.read_text() for path in (ROOT / "experiments").glob("*.py")}
    lengths = {name: len(text.splitlines()) for name, text in texts.items() if "\n@command\n" in text}
    assert len(lengths) >= 15
    assert {name: length for name, length in lengths.items() if length >= 80} == {}
