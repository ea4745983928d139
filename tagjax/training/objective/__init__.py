"""Label-free objective: the motion of a tag's mask must explain the phases of this tag's reads, and of no other's.

The soft mask's distance over time, linear between frames, is compared with the raw phases by coherence or likelihood:
phases are not unwrapped, and labels are not used. Each term is a function of `ObjectiveInputs`; `TERMS` lists the terms,
`ObjectiveSettings` their weights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from jaxtyping import Array, Float

from ...tracing.tracer import AbstractTracer, Camera, Frame
from .inputs import TERM_NAMES, ObjectiveInputs, ObjectiveSettings, clip_reads, objective_inputs
from .masks import area, compactness, coverage, future_agreement, steadiness
from .reads import Agreement, agreement, calibration, contrast, distance_at

__all__ = [
    "TERMS",
    "TERM_NAMES",
    "Agreement",
    "ObjectiveInputs",
    "ObjectiveSettings",
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
    "objective_inputs",
    "steadiness",
]

Term = Callable[[ObjectiveInputs, ObjectiveSettings, Array], tuple[Float[Array, ""], dict[str, Array]]]

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
    inputs = objective_inputs(tracer, camera, frames, settings)
    terms, diagnostics = {}, {}
    for name in settings.weights():
        terms[name], more = TERMS[name](inputs, settings, key)
        diagnostics.update(more)
    return terms, diagnostics
