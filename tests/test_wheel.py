"""The built wheel, installed beside nothing of the clone: what it puts where, and that its console commands run."""

from __future__ import annotations

import os
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.ci
PIP = ("-m", "pip", "--disable-pip-version-check", "--no-input")


def _run(*command: str | Path, cwd: Path, **environment: str) -> str:
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(one) for one in command], cwd=cwd, env={**inherited, **environment}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
    return done.stdout


def _environment(folder: Path) -> tuple[Path, Path]:
    """A fresh environment's commands and packages; what the running one has can be imported, but is not installed."""
    venv.create(folder, with_pip=False)
    (packages,) = folder.glob("lib/python*/site-packages")
    # A .pth that adds the folders as they are: theirs, such as that of an editable install of the clone, are not read.
    known = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    (packages / "running.pth").write_text("\n".join(known) + "\n")
    return folder / "bin", packages


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("hatchling", reason="needs the dev extra")
    folder = tmp_path_factory.mktemp("wheel")
    _run(sys.executable, *PIP, "wheel", "--no-deps", "--no-build-isolation", "-w", folder, ROOT, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


def test_a_wheel_has_one_package_at_its_top_level(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    tops = {name.split("/")[0] for name in names}
    assert tops == {"tagjax", wheel.name.removesuffix("-py3-none-any.whl") + ".dist-info"}
    for folder in ("conf", "experiments"):
        here = {
            path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob("*") if path.suffix in (".yaml", ".py")
        }
        assert {f"tagjax/{name}" for name in here} <= names


def test_an_installed_wheel_runs_its_commands(wheel: Path, tmp_path: Path) -> None:
    commands, packages = _environment(tmp_path / "environment")
    before = {path.name for path in packages.iterdir()}
    _run(
        *(sys.executable, *PIP, "--python", commands / "python", "install", "--no-deps", "--no-index", wheel),
        cwd=tmp_path,
    )
    added = {path.name for path in packages.iterdir()} - before
    assert added == {"tagjax", wheel.name.removesuffix("-py3-none-any.whl") + ".dist-info"}
    scripts = {path.name for path in commands.glob("tagjax-*")}
    entry_points = [path.stem for path in (ROOT / "conf").glob("*.yaml")]
    assert scripts == {f"tagjax-{name.replace('_', '-')}" for name in entry_points}
    text = _run(commands / "tagjax-train", "--help", cwd=tmp_path)
    assert text.startswith("Train a tracer")
    found = _run(
        commands / "python", "-c", "import tagjax, tagjax.experiments.train as t; print(t.__file__)", cwd=tmp_path
    )
    assert Path(found.strip()) == packages / "tagjax" / "experiments" / "train.py"
    lines = _run(
        *(commands / "tagjax-evaluate-flow", "flows=[zero]", "num_pairs=1", "pairs.height=64", "pairs.width=64"),
        *("num_panels=0", "progress=false"),
        cwd=tmp_path,
        JAX_PLATFORMS="cpu",
    ).splitlines()
    assert '"epe_px"' in lines[-1]
    (run,) = (tmp_path / "outputs" / "evaluate_flow").iterdir()
    assert "flows:" in (run / "config.yaml").read_text()


def test_an_editable_install_runs_the_clone(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="needs the dev extra")
    commands, packages = _environment(tmp_path / "environment")
    before = {path.name for path in packages.iterdir()}
    _run(
        *(sys.executable, *PIP, "--python", commands / "python", "install", "--no-deps", "--no-build-isolation"),
        *("--no-index", "-e", ROOT),
        cwd=tmp_path,
    )
    assert not {"tagjax", "experiments", "conf"} & ({path.name for path in packages.iterdir()} - before)
    assert _run(commands / "tagjax-simulate", "--help", cwd=tmp_path).startswith("Simulate a suite")
    where = _run(commands / "python", "-c", "import experiments; print(experiments.__file__)", cwd=tmp_path)
    assert Path(where.strip()) == ROOT / "experiments" / "__init__.py"
