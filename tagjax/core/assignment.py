"""Which tag goes with which object: the best one-to-one assignment, and its differentiable relaxation (Sinkhorn)."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer
from scipy.optimize import linear_sum_assignment


class SoftAssignment(eqx.Module):
    """Shares in [0, 1]: how much of each row (tag) goes to each column (object), and how much to none."""

    pairs: Float[Array, "rows columns"]
    unmatched_row: Float[Array, " rows"]
    unmatched_column: Float[Array, " columns"]


def hard_assignment(
    score: Float[np.ndarray, "rows columns"], *, unmatched_score: float | None = None
) -> Integer[np.ndarray, " rows"]:
    """The column of each row in the one-to-one assignment of highest total score; -1 for a row that gets none.

    On the host, by SciPy's `linear_sum_assignment`. A pair of score -inf is forbidden. With `unmatched_score`, what is
    maximised is the sum of (score - unmatched_score) over the pairs made, so that a pair worth less is left alone;
    without it as many pairs as possible are made first. Raises `ValueError` for NaN and +inf.
    """
    score = np.asarray(score, np.float64)
    if np.isnan(score).any() or np.isposinf(score).any():
        raise ValueError("The scores hold NaN or +inf; expected finite ones, or -inf for a pair that is forbidden.")
    allowed = np.isfinite(score)
    if unmatched_score is None:
        # One more allowed pair outweighs whatever the others can gain by giving it up.
        lowest, highest = score.min(where=allowed, initial=0.0), score.max(where=allowed, initial=0.0)
        worth = np.where(allowed, score, lowest - (highest - lowest + 1.0) * (min(score.shape) + 1))
    else:
        allowed &= score > unmatched_score
        worth = np.where(allowed, score - unmatched_score, 0.0)
    rows, columns = linear_sum_assignment(worth, maximize=True)
    chosen = np.full(score.shape[0], -1)
    chosen[rows] = np.where(allowed[rows, columns], columns, -1)
    return chosen


def sinkhorn(
    score: Float[Array, "rows columns"],
    *,
    temperature: float | Float[Array, ""],
    num_iterations: int,
    unmatched_score: float | Float[Array, ""] | None = None,
) -> SoftAssignment:
    """The plan P of highest sum P score + temperature * entropy(P), each row and column of total 1 (Cuturi, 2013).

    A dustbin row and column take what stays unmatched. With `unmatched_score` z (of every dustbin entry) they have
    room for everything (Sarlin et al., SuperGlue, 2020, Eq. 8): a pair is worth making if its score is above z.
    Without it they take only the surplus of the longer side. As the temperature (in the scores' unit) goes to 0 the
    plan goes to `hard_assignment`; lower temperatures need more iterations.

    A pair of score -inf is masked: share 0, gradient 0. A row or column without any pair goes to the dustbin with
    `unmatched_score` and takes no part without it (all its shares are 0), which is how padding is left out. Where the
    mask admits no complete assignment, give an `unmatched_score`: without it the columns' totals cannot all be met.
    The rows' totals hold after any number of iterations, the columns' in the limit. One sample; vmap for more. Raises
    `ValueError` for no iteration or a temperature that is not positive.
    """
    if num_iterations < 1:
        raise ValueError(f"num_iterations is {num_iterations}; expected at least 1.")
    if isinstance(temperature, float | int) and not temperature > 0:
        raise ValueError(f"temperature is {temperature}; expected a positive number.")
    dtype = score.dtype
    heat = jnp.asarray(temperature, dtype)
    pair = score > -jnp.inf
    row_takes_part, column_takes_part = jnp.any(pair, axis=1), jnp.any(pair, axis=0)
    if unmatched_score is not None:
        row_takes_part, column_takes_part = jnp.ones_like(row_takes_part), jnp.ones_like(column_takes_part)
    num_rows, num_columns = (jnp.sum(part).astype(dtype) for part in (row_takes_part, column_takes_part))
    if unmatched_score is None:
        spare_row, spare_column = jax.nn.relu(num_columns - num_rows), jax.nn.relu(num_rows - num_columns)
        dustbin = jnp.zeros((), dtype)  # any constant: the surplus is what it is
    else:
        spare_row, spare_column = num_columns, num_rows
        dustbin = jnp.asarray(unmatched_score, dtype)
    row_total = jnp.concatenate([row_takes_part.astype(dtype), spare_row[None]])
    column_total = jnp.concatenate([column_takes_part.astype(dtype), spare_column[None]])
    allowed = jnp.pad(pair, ((0, 1), (0, 1)), constant_values=True)
    allowed = allowed & (row_total > 0)[:, None] & (column_total > 0)[None, :]
    extended = jnp.full((score.shape[0] + 1, score.shape[1] + 1), dustbin).at[:-1, :-1].set(jnp.where(pair, score, 0.0))
    extended = extended / heat
    log_row, log_column = (jnp.log(jnp.where(total > 0, total, 1.0)) for total in (row_total, column_total))

    def balance(potential: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        row, _column = potential
        column = log_column - _log_sum(extended + row[:, None], allowed, 0)
        row = log_row - _log_sum(extended + column[None, :], allowed, 1)
        return (row, column), None

    start = (jnp.zeros_like(log_row), jnp.zeros_like(log_column))
    (row, column), _ = jax.lax.scan(balance, start, None, length=num_iterations)
    exponent = extended + row[:, None] + column[None, :]
    plan = jnp.where(allowed, jnp.exp(jnp.where(allowed, exponent, 0.0)), 0.0)
    return SoftAssignment(plan[:-1, :-1], plan[:-1, -1], plan[-1, :-1])


def _log_sum(x: Float[Array, "rows columns"], allowed: Bool[Array, "rows columns"], axis: int) -> Float[Array, " kept"]:
    """Log of the sum of exp over the allowed elements; 0, with gradient 0, where there is none."""
    highest = jax.lax.stop_gradient(jnp.max(x, axis=axis, keepdims=True, where=allowed, initial=-jnp.inf))
    total = jnp.sum(jnp.where(allowed, jnp.exp(jnp.where(allowed, x - highest, 0.0)), 0.0), axis=axis)
    return jnp.where(total > 0, jnp.log(jnp.where(total > 0, total, 1.0)) + jnp.squeeze(highest, axis), 0.0)
