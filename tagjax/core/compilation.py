"""Compilation of programs so large that it takes longer than many of their runs."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Literal, ParamSpec, TypeVar

import equinox as eqx
import jax

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def large_program(
    *, level: int | None = None, donate: Literal["none", "all-except-first"] = "none"
) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """`eqx.filter_jit` for programs of thousands of operations, not to be called within another transformation.

    On CPUs XLA's older emitters make the program: a step of the tracer's training is compiled in two thirds of the time
    and half of the memory, and takes as long. `level` is XLA's level of optimisation, 3 unless given; at 1 compilation is
    faster still, and what is not convolutions or matrix products slower.
    """

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        @functools.cache
        def compiled(backend: str) -> Callable[..., Any]:
            options: dict[str, bool | int] = {}
            if backend == "cpu" and jax.__version_info__ < (0, 11):  # an option that XLA does not know is an error
                options["xla_cpu_use_fusion_emitters"] = False
                if level is not None and not jax.config.read("jax_disable_most_optimizations"):
                    options["xla_backend_optimization_level"] = level
            jit: Any = eqx.filter_jit  # its overloads leave out what goes on to `jax.jit`
            return jit(function, donate=donate, compiler_options=options)

        @functools.wraps(function)
        def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            return compiled(jax.default_backend())(*args, **kwargs)

        return call

    return decorate
