"""From likelihood to mask (TagAttention, III.G): 3D K-means segments, CDF-corner cut, box and centre."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

_FAR = 1e30


class Segments(eqx.Module):
    """Soft K-means segments on a grid of cells: each pixel belongs to the 3 x 3 segments around its own cell.

    `share` sums to 1 over its first axis for valid pixels and to 0 for the others; neighbour n of a pixel in cell
    (i, j) is the segment (i + n // 3 - 1, j + n % 3 - 1).
    """

    share: Float[Array, "9 height width"]
    weight: Float[Array, "rows columns"]  # pixels in each segment
    cell: int = eqx.field(static=True)


def _blocks(image: Float[Array, "height width channel"], cell: int) -> Float[Array, "channel rows cell columns cell"]:
    """The picture as cells, filled up with zeros; channels first, where XLA vectorises best on a CPU."""
    height, width, channels = image.shape
    rows, columns = -(-height // cell), -(-width // cell)
    padded = jnp.pad(image, ((0, rows * cell - height), (0, columns * cell - width), (0, 0)))
    return jnp.moveaxis(padded.reshape(rows, cell, columns, cell, channels), -1, 0)


def _whole(blocks: Float[Array, "channel rows cell columns cell"], height: int, width: int) -> Array:
    """Adjoint of `_blocks`, channels first: the cells as a picture."""
    channels, rows, cell, columns, _ = blocks.shape
    return blocks.reshape(channels, rows * cell, columns * cell)[:, :height, :width]


def _shifted(grid: Float[Array, "channel rows columns"]) -> list[Float[Array, "channel rows columns"]]:
    """The grid as seen from each cell's nine neighbours, in the order of `Segments.share`; zero beyond the edge."""
    _, rows, columns = grid.shape
    padded = jnp.pad(grid, ((0, 0), (1, 1), (1, 1)))
    return [padded[:, dy : dy + rows, dx : dx + columns] for dy in range(3) for dx in range(3)]


def _unshift_sum(parts: Float[Array, "9 channel rows columns"]) -> Float[Array, "channel rows columns"]:
    """Adjoint of `_shifted`: hand each neighbour its part back."""
    padded = [jnp.pad(part, ((0, 0), (n // 3, 2 - n // 3), (n % 3, 2 - n % 3))) for n, part in enumerate(parts)]
    return sum(padded[1:], start=padded[0])[:, 1:-1, 1:-1]


def _summed(
    share: Float[Array, "9 rows cell columns cell"], values: Float[Array, "channel rows cell columns cell"]
) -> Float[Array, "channel rows columns"]:
    """Sum of the values of each segment's pixels, by their shares."""
    return _unshift_sum(jnp.einsum("nrycx,frycx->nfrc", share, values))


def segment(
    features: Float[Array, "height width feature"],
    valid: Bool[Array, "height width"],
    temperature: Float[Array, ""],
    *,
    cell: int,
    num_iterations: int = 3,
) -> Segments:
    """Soft K-means of pixel features (3D position in metres first), seeded by cells of the picture.

    Assignments are softmax(-||f - c||^2 / (2 temperature^2)) over the nine nearest seeds (the local search of SLIC:
    Achanta et al., 2012), so the cost does not grow with the number of segments; temperature -> 0 is hard K-means
    (TagAttention, III.G, after Jaimez et al., 2017).
    """
    height, width, _ = features.shape
    known = _blocks(valid.astype(features.dtype)[..., None], cell)
    pixels = jnp.concatenate([_blocks(jnp.where(valid[..., None], features, 0.0), cell), known])

    def centres(summed: Float[Array, "channel rows columns"]) -> Float[Array, "channel rows columns"]:
        return jnp.concatenate([summed[:-1] / jnp.maximum(summed[-1:], 1e-6), summed[-1:]])

    def assign(seeds: Float[Array, "channel rows columns"]) -> Float[Array, "9 rows cell columns cell"]:
        scores = []
        for near in _shifted(seeds):
            apart = [
                jnp.square(one - centre[:, None, :, None]) for one, centre in zip(pixels[:-1], near[:-1], strict=True)
            ]
            squared = sum(apart[1:], start=apart[0])
            scores.append(jnp.where(near[-1][:, None, :, None] > 0.5, -squared / (2.0 * temperature**2), -_FAR))
        return jax.nn.softmax(jnp.stack(scores), axis=0) * known

    def iterate(seeds: Float[Array, "channel rows columns"], _: None):
        return centres(_summed(assign(seeds), pixels)), None

    seeds, _ = jax.lax.scan(iterate, centres(jnp.sum(pixels, axis=(2, 4))), None, length=num_iterations)
    return Segments(_whole(assign(seeds), height, width), seeds[-1], cell)


def pool(
    segments: Segments, values: Float[Array, "height width channel"], weight: Float[Array, "height width"]
) -> tuple[Float[Array, "rows columns channel"], Float[Array, "rows columns"]]:
    """Weighted mean of pixel values over each segment, and the weight that stands behind it (0 where none)."""
    stacked = jnp.concatenate([values * weight[..., None], weight[..., None]], axis=-1)
    share = _blocks(jnp.moveaxis(segments.share, 0, -1), segments.cell)
    summed = jnp.moveaxis(_summed(share, _blocks(stacked, segments.cell)), 0, -1)
    mass = summed[..., -1]
    mean = summed[..., :-1] / jnp.where(mass > 1e-6, mass, 1.0)[..., None]
    return jnp.where(mass[..., None] > 1e-6, mean, 0.0), mass


def unpool(segments: Segments, grid: Float[Array, "rows columns channel"]) -> Float[Array, "height width channel"]:
    """Segment values handed back to the pixels by their shares."""
    _, height, width = segments.share.shape
    share = _blocks(jnp.moveaxis(segments.share, 0, -1), segments.cell)
    near = jnp.stack(_shifted(jnp.moveaxis(grid, -1, 0)))
    spread = jnp.einsum("nrycx,nfrc->frycx", share, near)
    return jnp.moveaxis(_whole(spread, height, width), 0, -1)


def min_max(value: Float[Array, "height width"], valid: Bool[Array, "height width"]) -> Float[Array, "height width"]:
    """Min-max normalisation to [0, 1] over valid pixels (III.G); 0 elsewhere, and everywhere if nothing varies."""
    low = jnp.min(jnp.where(valid, value, jnp.inf))
    high = jnp.max(jnp.where(valid, value, -jnp.inf))
    varies = high > low
    span = jnp.where(varies, high - low, 1.0)
    return jnp.where(valid & varies, (value - jnp.where(varies, low, 0.0)) / span, 0.0)


def cdf_corner(
    probability: Float[Array, "height width"],
    valid: Bool[Array, "height width"],
    significance: Float[Array, ""],
    width: Float[Array, ""],
    *,
    num_bins: int = 64,
) -> Float[Array, ""]:
    """The last corner of the CDF of normalised probabilities (III.G, Fig. 6): where to cut the object out.

    A corner is a bin at which the CDF leaves a flat stretch: its slope (the share of the pixels in a bin) is below
    `significance` and rises by more than that in the next bin. Pixels are binned linearly, so the corner moves
    smoothly with them. The last corner is taken softly, w_i = s_i prod_{j > i} (1 - s_j) with s the product of
    sigmoid((significance - slope) / width) and sigmoid((rise - significance) / width): hard as width -> 0.
    Without any corner the cut is 0.5.
    """
    position = jnp.clip(probability, 0.0, 1.0) * (num_bins - 1)
    lower = jnp.clip(jnp.floor(position), 0, num_bins - 2)
    share = position - lower
    known = valid.astype(probability.dtype)
    index = lower.astype(jnp.int32).reshape(-1)
    histogram = (
        jnp.zeros(num_bins)
        .at[index]
        .add(((1.0 - share) * known).reshape(-1))
        .at[index + 1]
        .add((share * known).reshape(-1))
    ) / jnp.maximum(jnp.sum(known), 1.0)
    rise = histogram[1:] - histogram[:-1]
    flat = jax.nn.sigmoid((significance - histogram[:-1]) / width)
    score = flat * jax.nn.sigmoid((rise - significance) / width)
    later = jnp.flip(jnp.cumprod(jnp.flip(1.0 - score)))
    weight = score * jnp.concatenate([later[1:], jnp.ones(1)])
    edges = (jnp.arange(num_bins - 1, dtype=probability.dtype) + 0.5) / (num_bins - 1)
    return jnp.sum(weight * edges) + (1.0 - jnp.sum(weight)) * 0.5


def cdf_cut(
    log_likelihood: Float[Array, "height width"],
    valid: Bool[Array, "height width"],
    significance: Float[Array, ""],
    width: Float[Array, ""],
) -> Float[Array, "height width"]:
    """The paper's mask (III.G): min-max normalised exp(l), cut at the last corner of its CDF; hard as width -> 0.

    `width` is the softness of the corner; the mask's edge is ten times as soft. Nothing varies: an empty mask.
    """
    top = jnp.max(jnp.where(valid, log_likelihood, -jnp.inf))
    top = jnp.where(jnp.isfinite(top), top, 0.0)
    probability = min_max(jnp.exp(jnp.where(valid, log_likelihood - top, 0.0)), valid)
    corner = cdf_corner(probability, valid, significance, width)
    mask = jax.nn.sigmoid((probability - corner) / (10.0 * width))
    return jnp.where(valid & (jnp.max(probability) > 0), mask, 0.0)


def bounding_box(mask: Float[Array, "height width"]) -> Float[Array, " 4"]:
    """Box x0 y0 x1 y1 (first and last pixel, both inside) of the pixels that are not 0; zeros if there are none."""

    def span(occupied: Bool[Array, " size"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        first, from_end = jnp.argmax(occupied), jnp.argmax(jnp.flip(occupied))
        last = jnp.where(jnp.any(occupied), occupied.shape[0] - 1 - from_end, 0)
        return first.astype(mask.dtype), last.astype(mask.dtype)

    x0, x1 = span(jnp.any(mask != 0, axis=0))
    y0, y1 = span(jnp.any(mask != 0, axis=1))
    return jnp.stack([x0, y0, x1, y1])
