"""Without mujoco and matplotlib: modules import, and a recording is trained on, evaluated and traced."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
import synthetic_clips as synthetic

from tagjax.flow.weights import packaged_weights
from tagjax.recording.store import save_recording
from tagjax.tagattention.learned import packaged_parameters

ROOT = Path(__file__).parents[1]
BLOCKED = {"mujoco", "matplotlib"}
BLOCK = f"import sys; sys.modules.update(dict.fromkeys({sorted(BLOCKED)})); "


def _imports(path: Path, modules: set[str]) -> set[str]:
    """Absolute names of what a module imports when it is imported itself, so not inside of functions."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    package = parts[:-1]
    names: set[str] = set()
    pending: list[ast.AST] = [ast.parse(path.read_text())]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *([node.module] if node.module else [])])
            names |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
        pending.extend(ast.iter_child_nodes(node))
    return {name for name in names if name in modules or name.partition(".")[0] in BLOCKED}


def _importable() -> tuple[list[str], set[str]]:
    """Modules of tagjax that need neither blocked package by their imports, and those that do."""
    paths = {}
    for path in sorted((ROOT / "tagjax").rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        paths[name] = path
    edges = {name: _imports(path, set(paths)) for name, path in paths.items()}
    for name in paths:  # importing a module imports its packages
        edges[name] |= {parent for parent in paths if name.startswith(f"{parent}.")}
    needing = {name for name in paths if any(each.partition(".")[0] in BLOCKED for each in edges[name])}
    while more := {name for name in paths if name not in needing and edges[name] & needing}:
        needing |= more
    return [name for name in paths if name not in needing], needing


def _run(code: str) -> None:
    done = subprocess.run([sys.executable, "-c", BLOCK + code], capture_output=True, text=True, timeout=500, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-3000:]


def test_modules_import_without_mujoco_and_matplotlib() -> None:
    importable, needing = _importable()
    assert {"tagjax.report.figure", "tagjax.sim.contact_sheet"} <= needing  # the rule sees what does need them
    # In these packages no module may need the extras; elsewhere only figures do.
    free = ("core", "image", "radio", "recording", "flow", "tracing", "tagattention", "metrics", "training")
    wrong = [name for name in needing if name.split(".")[1:2] and name.split(".")[1] in free]
    assert not wrong, wrong
    assert "tagjax.evaluation.run" in importable
    _run(f"import importlib; [importlib.import_module(name) for name in {importable}]")


@pytest.mark.ci
def test_a_recording_is_trained_on_evaluated_and_traced_without_mujoco_and_matplotlib(tmp_path: Path) -> None:
    for seed in range(2):
        scene = synthetic.enlarged(synthetic.recording(26, seed=seed, name=f"scene{seed}"), 4)
        save_recording(scene, tmp_path / f"scene{seed}.zarr")
    tracer = {"_target_": "tagjax.tagattention.literal.TagAttentionLiteral", "cell": 4, "softness": 0.3}
    values = {
        "tracer": tracer,
        "optimizer": {"_target_": "optax.adam", "learning_rate": 0.03},
        "data": {
            "recordings": [str(tmp_path / "scene0.zarr")],
            "validation": [str(tmp_path / "scene1.zarr")],
            "clips": {"stride": 4, "length": 10},
        },
        "objective": {"span_frames": 5, "skip_frames": 3, "max_reads": 64, "num_channels": 4, "future_stride": 1},
        "loop": {"num_steps": 2, "checkpoint_every": 1, "validate_every": 2, "progress": False},
        "logger": {"mode": "disabled"},
        "scores": {"num_pictures": 2, "from_s": 0.5},
    }
    evaluation = {"run": str(tmp_path / "run"), "progress": False}
    _run(
        f"""
from pathlib import Path
import jax
import numpy as np
from tagjax.core.settings import from_mapping
from tagjax.evaluation.run import EvaluateConfig, run_evaluation
from tagjax.recording.store import open_recording
from tagjax.tagattention.tracer_settings import make_tracer
from tagjax.tracing.clips import ClipSettings, clip_loader
from tagjax.tracing.recordings import trace_recording
from tagjax.training.config import TrainConfig
from tagjax.training.run import run_training
values, folder = {values!r}, Path({str(tmp_path)!r})
assert np.isfinite(run_training(from_mapping(TrainConfig, values), folder / "run"))
summary = run_evaluation(from_mapping(EvaluateConfig, {evaluation!r}), folder / "report", run_values=values)
assert summary["learned"]["all"]["num_frames"] > 0
recording = open_recording(folder / "scene1.zarr")
traces = trace_recording(make_tracer({tracer!r}), recording, clip_loader(ClipSettings(stride=4)), epcs=recording.resolve_epcs(None))
assert len(list(traces)) == recording.num_frames
"""
    )


def _documented(pattern: str) -> set[tuple[str, str]]:
    """(page, name) of what follows a key in README.md and docs/; files and placeholders are left out."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    names = {(page.name, one) for page in pages for one in re.findall(pattern, page.read_text())}
    return {(page, name) for page, name in names if not re.search(r"[./<]", name)}


def test_every_documented_recipe_and_weights_exist() -> None:
    recipes = {path.stem for path in (ROOT / "conf" / "recipe").glob("*.yaml")}
    weights = {"default", "null", "None", *packaged_parameters(), *packaged_weights()}
    documented_recipes = _documented(r"\brecipe=([\w./<-]+)")
    documented_weights = _documented(r"\bweights=([\w./<-]+)")
    assert documented_recipes
    assert documented_weights
    assert {name for _, name in documented_recipes} <= recipes, sorted(documented_recipes)
    assert {name for _, name in documented_weights} <= weights, sorted(documented_weights)
