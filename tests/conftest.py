"""Shared fixtures: strict dtype and rank promotion for every test, and the door to the real recordings."""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
# Most of the time of a run is compilation: what XLA saves in the runs of tests, it spends several times over before.
jax.config.update("jax_disable_most_optimizations", True)
# Calls run on the thread that makes them. On the pool, two at once (a test's and that of a pipeline which is still reading
# ahead) can each hold a thread that the other's parts wait for: with two cores there are no more.
jax.config.update("jax_cpu_enable_async_dispatch", False)
if jax.__version_info__ < (0, 11):  # XLA ends a process that gives it a flag it does not know
    # The older emitters compile a large graph in 22 s where the present ones take 56. Programs that tests start inherit it.
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false".strip()


# Examples are drawn anew in the same order each time: a run that passes, passes again. Compilation has no deadline.
_EXAMPLES = {"derandomize": True, "database": None, "deadline": None, "print_blob": False}
hypothesis.settings.register_profile("quick", max_examples=12, **_EXAMPLES)
hypothesis.settings.register_profile("ci", max_examples=150, **_EXAMPLES)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--ci", action="store_true", help="also run the tests marked ci")


def pytest_configure(config: pytest.Config) -> None:
    """What one worker, file or program of a run has compiled, no other compiles again."""
    settings = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2"}
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # workers find that of the process that starts them
        folder = tempfile.TemporaryDirectory(prefix="tagjax_compiled_", ignore_cleanup_errors=True)
        config.add_cleanup(folder.cleanup)
        settings["JAX_COMPILATION_CACHE_DIR"] = folder.name
    os.environ.update(settings)
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    if not config.getoption("--hypothesis-profile"):
        hypothesis.settings.load_profile("ci" if config.getoption("--ci") else "quick")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--ci"):
        for item in items:
            if item.get_closest_marker("ci"):
                item.add_marker(pytest.mark.skip(reason="ci: add --ci to run it"))


@pytest.fixture(autouse=True, scope="session")
def _ctrl_c_arrives():
    """In the background a shell ignores Ctrl-C, and programs inherit that."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module", autouse=True)
def _forgotten():
    """What a file's tests compiled, over a megabyte a program, goes with them: the more is kept, the slower the next."""
    yield
    jax.clear_caches()


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real recordings, which are not part of the project; the test is skipped without it."""
    named = os.environ.get("TAGJAX_REAL_DATA")
    folder = Path(named) if named else Path(__file__).parents[1] / ".." / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder} (set TAGJAX_REAL_DATA)")
    return folder.resolve()


@pytest.fixture(scope="session")
def small_walkers():
    """A recording of the suite `walkers` in small (160 pixels wide, 2.4 s), with exact flow in its truth."""
    pytest.importorskip("mujoco")
    from tagjax.core.settings import from_mapping
    from tagjax.sim.record import simulate_recording
    from tagjax.sim.suites import Suite, item_scenario

    settings = yaml.safe_load((Path(__file__).parents[1] / "conf" / "suite" / "walkers.yaml").read_text())
    suite = from_mapping(Suite, settings, where="suite").smoke()
    capture = dataclasses.replace(suite.capture, width=160, frame_rate_hz=10.0, flow=True)
    (item,) = suite.items()
    return simulate_recording(item_scenario(item), capture, seed=item.seed, name=item.name)


def check_gradients(function, arguments, *, atol: float = 1e-6, rtol: float = 1e-5, step: float = 1e-6) -> None:
    """Compare reverse-mode gradients of a scalar projection with central differences, in x64, element by element."""
    with jax.enable_x64(True):
        arguments = tuple(jnp.asarray(np.asarray(a), jnp.float64) for a in arguments)
        shape = jax.eval_shape(function, *arguments)
        direction = jnp.asarray(np.random.default_rng(0).normal(size=shape.shape))

        @jax.jit
        def scalar(*args):
            return jnp.sum(direction * function(*args))

        gradients = jax.grad(scalar, argnums=tuple(range(len(arguments))))(*arguments)
        for position, (argument, gradient) in enumerate(zip(arguments, gradients, strict=True)):
            flat = np.asarray(argument).reshape(-1)
            numeric = np.empty_like(flat)
            for i in range(flat.size):
                ends = []
                for sign in (1, -1):
                    moved = flat.copy()
                    moved[i] += sign * step
                    args = list(arguments)
                    args[position] = jnp.asarray(moved.reshape(argument.shape))
                    ends.append(float(scalar(*args)))
                numeric[i] = (ends[0] - ends[1]) / (2 * step)
            np.testing.assert_allclose(np.asarray(gradient).reshape(-1), numeric, atol=atol, rtol=rtol)


@pytest.fixture(scope="session")
def gradients_agree():
    """`check_gradients`, for tests."""
    return check_gradients


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder of an evaluation, for the tests of its page, which write nothing into it."""
    from report_runs import report_run

    return report_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless Chromium."""
    chromium = next(
        (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
    )
    if chromium is None:
        pytest.skip("Chromium is not installed (Debian: apt-get install chromium)")
    driving = pytest.importorskip("playwright.sync_api", reason="playwright, of the dev extra, is not installed")
    with driving.sync_playwright() as driver:
        sandbox = [] if os.geteuid() else ["--no-sandbox"]  # Chromium's sandbox does not run as root
        opened = driver.chromium.launch(executable_path=chromium, args=sandbox)
        yield opened
        opened.close()
