"""The paper's cut on segments, for a tracer without a body stage: the segments beyond the last corner of the CDF.

The likelihoods exp(l) of all segments are min-max normalised; a corner of their CDF is a rise after a flat stretch. Source:
Shi et al., ToN 2021, III.G and Fig. 6.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..literal import SIGNIFICANCE
from ..segmentation import cdf_cut

_WIDTH = 1e-8  # a step, as in the paper


def cut_segments(
    log_likelihood: Float[Array, "tag segment"], exists: Bool[Array, " segment"]
) -> Float[Array, "tag segment"]:
    """1 for the segments that belong to each tag's object, 0 for the others; no gradient.

    A corner is a rise by `SIGNIFICANCE` of the segments. A tag for which all segments are alike has none.
    """
    significance, width = jnp.asarray(SIGNIFICANCE), jnp.asarray(_WIDTH)

    def of_tag(one: Float[Array, " segment"]) -> Float[Array, " segment"]:
        return cdf_cut(one[None], exists[None], significance, width)[0]

    return jax.lax.stop_gradient(jax.vmap(of_tag)(log_likelihood))
