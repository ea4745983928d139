"""Label-free objective: where the mask goes must explain what the tag's reads say, and nobody else's.

The soft mask's distance over time, linear between frames, is held against raw phases by their coherence or likelihood:
nothing is unwrapped, and no label is used. Each term is a function of a `Seen` clip; `TERMS` names them, settings weigh them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from jaxtyping import Array, Float

from ...tracing.tracer import AbstractTracer, Camera, Frame
from ._masks import area, compactness, coverage, future_agreement, steadiness
from ._reads import Agreement, agreement, calibration, contrast, distance_at
from ._seen import TERM_NAMES, ObjectiveSettings, Seen, clip_reads, see

__all__ = [
    "TERMS",
    "TERM_NAMES",
    "Agreement",
    "ObjectiveSettings",
    "Seen",
    "agreement",
    "area",
    "calibration",
    "clip_reads",
    "compactness",
    "contrast",
    "coverage",
    "distance_at",
    "future_agreement",
    "objective",
    "see",
    "steadiness",
]

Term = Callable[[Seen, ObjectiveSettings, Array], tuple[Float[Array, ""], dict[str, Array]]]

TERMS: Mapping[str, Term] = {
    "contrast": contrast,
    "coverage": coverage,
    "area": area,
    "compactness": compactness,
    "steadiness": steadiness,
    "calibration": calibration,
}
"""The terms of the objective by name (`TERM_NAMES`); `ObjectiveSettings` has a weight of each name."""


def objective(
    tracer: AbstractTracer, camera: Camera, frames: Frame, key: Array, settings: ObjectiveSettings
) -> tuple[dict[str, Float[Array, ""]], dict[str, Array]]:
    """Every term that has a weight, unweighted, and diagnostics, of one clip."""
    seen = see(tracer, camera, frames, settings)
    terms, diagnostics = {}, {}
    for name in settings.weights():
        terms[name], more = TERMS[name](seen, settings, key)
        diagnostics.update(more)
    return terms, diagnostics
