"""The binary quadratic programme that identifies all traces (Tagview, V.D, Eq. 10), solved to a proven bound by
HiGHS.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array


@dataclasses.dataclass(frozen=True)
class Selection:
    """The chosen edges, their objective value, and the proven upper bound."""

    chosen: Bool[np.ndarray, " edges"]
    value: float
    bound: float

    @property
    def gap(self) -> float:
        """(bound - value) / |bound|: no selection is better by more than this fraction; 0 at the optimum."""
        return max(self.bound - self.value, 0.0) / max(abs(self.bound), 1e-9)


def select_edges(
    weight: Float[np.ndarray, " edges"],
    quadratic: Float[np.ndarray, "edges edges"],
    cliques: Sequence[Int[np.ndarray, " _"]],
    *,
    time_limit_s: float = 10.0,
) -> Selection:
    """max_x x^T Q x + w^T x, x binary, at most one edge of every clique: Eq. 10 with mu within Q.

    Q is symmetric. Its diagonal counts too (Eq. 9 does not define the agreement of an edge with itself;
    `edge_agreement` sets 0). Each product x_e x_f of compatible edges becomes a variable y_ef, 0 to 1. For an edge e
    and a clique K without it, x_e times "at most one of K" gives sum_{f in K} y_ef <= x_e: this relaxation is far
    tighter than y_ef <= x_e for each f, and its solution is mostly integral at the root. Where Q is negative, y_ef >=
    x_e + x_f - 1. HiGHS ends at the optimum, or at the time limit with a proven bound; in the worst case nothing is
    chosen and the bound is the sum of all positive terms. Raises `ValueError` for a Q that is not symmetric or not
    finite.
    """
    weight, quadratic = np.asarray(weight, np.float64), np.asarray(quadratic, np.float64)
    num = len(weight)
    if not (np.all(np.isfinite(weight)) and np.all(np.isfinite(quadratic))):
        raise ValueError("Weights or agreements are not finite; expected finite numbers.")
    if not np.allclose(quadratic, quadratic.T):
        raise ValueError("The quadratic term is not symmetric; expected one value for every two edges.")
    linear = weight + np.diag(quadratic)
    if num == 0:
        return Selection(np.zeros(0, bool), 0.0, 0.0)
    incompatible = np.zeros((num, num), bool)
    for clique in cliques:
        incompatible[np.ix_(clique, clique)] = True
    first, second = np.nonzero(np.triu(~incompatible & (quadratic != 0), 1))
    product = np.full((num, num), -1)
    product[first, second] = product[second, first] = num + np.arange(len(first))
    cost = -np.concatenate([linear, 2.0 * quadratic[first, second]])
    limits = _rows(num, product, quadratic < 0, cliques, len(cost))
    integrality = np.concatenate([np.ones(num), np.zeros(len(first))])
    options = {"time_limit": time_limit_s, "mip_rel_gap": 0.0}
    found = milp(cost, integrality=integrality, bounds=Bounds(0, 1), constraints=limits, options=options)
    trivial = float(np.maximum(linear, 0.0).sum() + 2.0 * np.maximum(quadratic[first, second], 0.0).sum())
    bound = trivial if found.mip_dual_bound is None else min(trivial, -float(found.mip_dual_bound))
    chosen = np.zeros(num, bool) if found.x is None else found.x[:num] > 0.5
    value = float(linear @ chosen + quadratic[np.ix_(chosen, chosen)].sum() - np.diag(quadratic)[chosen].sum())
    return Selection(chosen, value, max(bound, value))


def _rows(
    num: int,
    product: Int[np.ndarray, "edges edges"],
    negative: Bool[np.ndarray, "edges edges"],
    cliques: Sequence[Int[np.ndarray, " _"]],
    size: int,
) -> list[LinearConstraint]:
    """P x <= 1, and the bounds of each product by its edges: upper ones for positive Q, lower ones for negative Q."""
    row, column, entry, upper = [], [], [], []

    def add(columns: Sequence[int], values: Sequence[float], limit: float) -> None:
        row.extend([len(upper)] * len(columns))
        column.extend(columns)
        entry.extend(values)
        upper.append(limit)

    for clique in cliques:
        add(clique.tolist(), [1.0] * len(clique), 1.0)
    for edge, other in zip(*np.nonzero(np.triu((product >= 0) & negative)), strict=True):
        add([int(edge), int(other), int(product[edge, other])], [1.0, 1.0, -1.0], 1.0)
    product = np.where(negative, -1, product)
    for edge in range(num):
        unbounded = product[edge] >= 0
        for clique in cliques:
            terms = product[edge, clique]
            terms = terms[terms >= 0]
            if len(terms):
                unbounded[clique] = False
                add([*terms.tolist(), edge], [1.0] * len(terms) + [-1.0], 0.0)
        for term in product[edge, unbounded]:
            add([int(term), edge], [1.0, -1.0], 0.0)
    if not upper:
        return []
    matrix = coo_array((entry, (row, column)), shape=(len(upper), size)).tocsc()
    return [LinearConstraint(matrix, ub=np.asarray(upper))]  # pyright: ignore[reportArgumentType]
