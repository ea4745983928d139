"""The sub-packages of the simulator import downwards only, and only ray casting needs MuJoCo."""

import ast
import subprocess
import sys
from pathlib import Path

SIM = Path(__file__).parents[1] / "tagjax" / "sim"
LAYERS = {
    "world": 0,
    "flow_pairs": 0,
    "rendering": 1,
    "radio": 1,
    "stories": 2,
    "propagation": 3,
    "record": 4,
    "suites": 5,
    "contact_sheet": 6,
    "link_budgets": 6,
    "flow_truth": 6,
}
"""Layer of each part of the simulator. Two parts of one layer do not import each other."""


def _imports(path: Path) -> set[str]:
    """Absolute names of the modules that a file imports."""
    package = ["tagjax", "sim", *path.relative_to(SIM).parts[:-1]]
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *(node.module.split(".") if node.module else [])])
            names |= {f"{module}.{alias.name}" for alias in node.names} | {module}
    return names


def test_parts_of_the_simulator_import_downwards():
    for path in SIM.rglob("*.py"):
        own = path.relative_to(SIM).parts[0].removesuffix(".py")
        others = {name.split(".")[2] for name in _imports(path) if name.startswith("tagjax.sim.")}
        for other in others & set(LAYERS) - {own}:
            assert own in LAYERS, f"{path.name} imports {other} from outside of the layers"
            assert LAYERS[other] < LAYERS[own], f"{path} (layer {LAYERS[own]}) imports {other} (layer {LAYERS[other]})"


def test_only_rendering_imports_mujoco():
    users = {path.relative_to(SIM) for path in SIM.rglob("*.py") if "mujoco" in _imports(path)}
    assert users == {Path("rendering/raycast.py")}


def test_the_simulator_imports_without_mujoco():
    blocked = (
        "import sys\n"
        "sys.modules['mujoco'] = None\n"
        "sys.modules['matplotlib'] = None\n"
        "import tagjax.sim.flow_pairs, tagjax.sim.stories, tagjax.sim.suites\n"
        "import tagjax.sim.rendering.textures\n"
    )
    subprocess.run([sys.executable, "-c", blocked], check=True)
