"""Large programs are compiled once, for any mixture of arrays and settings, and give what the function gives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from tagjax.core.compilation import large_program


@pytest.mark.parametrize("level", [None, 1])
def test_a_program_is_its_function_compiled_once(level: int | None) -> None:
    traced: list[str] = []

    def scaled(x: Array, name: str, *, times: float) -> Array:
        """What `name` says of x."""
        traced.append(name)
        return times * (jnp.sin(x) if name == "sine" else jnp.cos(x))

    program = large_program(level=level)(scaled)
    x = np.linspace(0.0, 3.0, 7, dtype=np.float32)
    for name, expected in (("sine", np.sin), ("cosine", np.cos)):
        for shift in (0.0, 1.0):
            found = program(jnp.asarray(x + np.float32(shift)), name, times=2.0)
            np.testing.assert_allclose(found, 2 * expected(x + np.float32(shift)), rtol=1e-5, atol=1e-6)
    assert traced == ["sine", "cosine"]
    assert program.__doc__ == scaled.__doc__
    with pytest.raises(ValueError, match="top-level"):
        jax.grad(lambda x: jnp.sum(program(x, "sine", times=2.0)))(jnp.asarray(x))


def test_all_but_the_first_argument_may_be_given_up() -> None:
    def added(kept: Array, used: Array) -> Array:
        return kept + used

    program = large_program(donate="all-except-first")(added)
    kept, used = jnp.ones(3), jnp.ones(3)
    np.testing.assert_array_equal(program(kept, used), np.full(3, 2.0))
    assert used.is_deleted()
    assert not kept.is_deleted()
