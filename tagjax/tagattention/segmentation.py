"""From likelihood to mask (TagAttention, III.G): 3D K-means segments, CDF-corner cut, box and centre."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

_FAR = 1e30


class Segments(eqx.Module):
    """Soft K-means segments on a grid of cells: each pixel belongs to the 3 x 3 segments around its own cell.

    With `objects` the pixels of each given object belong to one segment of its own, and to no other.

    `share` sums to 1 over its first axis for valid pixels and to 0 for the others; neighbour n of a pixel in cell
    (i, j) is the segment (i + n // 3 - 1, j + n % 3 - 1).
    """

    share: Float[Array, "9 height width"]
    weight: Float[Array, "rows columns"]  # pixels in each segment
    cell: int = eqx.field(static=True)
    objects: Float[Array, "object height width"] | None = None  # membership of given objects, 0 or 1

    @property
    def num_cell_rows(self) -> int:
        """Rows of the grid that are cells of the picture; given objects are segments in rows below these."""
        return -(-self.share.shape[1] // self.cell)


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
    objects: Float[Array, "object height width"] | None = None,
) -> Segments:
    """Soft K-means of pixel features (3D position in metres first), seeded by cells of the picture.

    Pixels of the given `objects` are segments of their own (`Segments.objects`).

    Assignments are softmax(-||f - c||^2 / (2 temperature^2)) over the nine nearest seeds (the local search of SLIC:
    Achanta et al., 2012), so the cost does not grow with the number of segments; temperature -> 0 is hard K-means
    (TagAttention, III.G, after Jaimez et al., 2017).
    """
    height, width, _ = features.shape
    if objects is not None:
        objects = jnp.where(valid[None], objects, 0.0)
        valid = valid & (jnp.sum(objects, axis=0) == 0)
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
    weight = seeds[-1]
    if objects is not None:
        weight = jnp.concatenate([weight, _below(jnp.sum(objects, axis=(1, 2))[:, None], weight.shape[1])[..., 0]])
    return Segments(_whole(assign(seeds), height, width), weight, cell, objects)


def _places(num: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Row below the cells, and column, of each given object: none is next to a cell or to another object."""
    row, column = np.divmod(np.arange(num), -(-columns // 2))
    return 2 * row + 1, 2 * column


def _below(values: Float[Array, "object channel"], columns: int) -> Float[Array, "rows columns channel"]:
    """Values of given objects as rows below the grid of cells; zero between them."""
    row, column = _places(values.shape[0], columns)
    return jnp.zeros((int(row[-1]) + 1, columns, values.shape[1]), values.dtype).at[row, column].set(values)


def pool(
    segments: Segments, values: Float[Array, "height width channel"], weight: Float[Array, "height width"]
) -> tuple[Float[Array, "rows columns channel"], Float[Array, "rows columns"]]:
    """Weighted mean of pixel values over each segment, and the weight that stands behind it (0 where none)."""
    stacked = jnp.concatenate([values * weight[..., None], weight[..., None]], axis=-1)
    share = _blocks(jnp.moveaxis(segments.share, 0, -1), segments.cell)
    summed = jnp.moveaxis(_summed(share, _blocks(stacked, segments.cell)), 0, -1)
    if segments.objects is not None:
        sums = jnp.einsum("ohw,hwc->oc", segments.objects, stacked)
        summed = jnp.concatenate([summed, _below(sums, summed.shape[1])])
    mass = summed[..., -1]
    mean = summed[..., :-1] / jnp.where(mass > 1e-6, mass, 1.0)[..., None]
    return jnp.where(mass[..., None] > 1e-6, mean, 0.0), mass


def unpool(segments: Segments, grid: Float[Array, "rows columns channel"]) -> Float[Array, "height width channel"]:
    """Segment values handed back to the pixels by their shares."""
    _, height, width = segments.share.shape
    share = _blocks(jnp.moveaxis(segments.share, 0, -1), segments.cell)
    cells = grid[: segments.num_cell_rows]
    near = jnp.stack(_shifted(jnp.moveaxis(cells, -1, 0)))
    spread = jnp.einsum("nrycx,nfrc->frycx", share, near)
    values = jnp.moveaxis(_whole(spread, height, width), 0, -1)
    if segments.objects is None:
        return values
    row, column = _places(segments.objects.shape[0], grid.shape[1])
    own = grid[segments.num_cell_rows :][row, column]
    return values + jnp.einsum("ohw,oc->hwc", segments.objects, own)


def membership(objects: Int[Array, "height width"], num: int) -> Float[Array, "object height width"]:
    """Membership of pixels in objects that are numbered from 1 to `num`."""
    return jnp.moveaxis(jax.nn.one_hot(objects - 1, num), -1, 0)


def diffuse(
    values: Float[Array, "rows columns"],
    affinity: Float[Array, "9 rows columns"],
    rate: Float[Array, ""],
    *,
    num_iterations: int = 4,
) -> Float[Array, "rows columns"]:
    """Let segments that belong together share their log odds: x <- (1 - rate) values + rate (affinity x), repeated.

    `affinity` sums to at most 1 over its first axis. rate = 0 leaves the values alone. A limb that swings against the
    body for a moment is held by the body.
    """

    def spread(x: Float[Array, "rows columns"], _: None):
        near = jnp.concatenate(_shifted(x[None]))
        return (1.0 - rate) * values + rate * jnp.sum(near * affinity, axis=0), None

    out, _ = jax.lax.scan(spread, values, None, length=num_iterations)
    return out


def segment_affinity(
    segments: Segments,
    centre: Float[Array, "rows columns 3"],
    step: Float[Array, "rows columns"],
    length: Float[Array, ""],
) -> Float[Array, "9 rows columns"]:
    """How much each segment and its eight neighbours are one thing: near in 3D and moving alike; sums to 1.

    `length` is in the units of `centre`; steps are in units of what still counts as alike.
    """
    alive = segments.weight > 1.0
    told = jnp.concatenate([centre, step[..., None], alive.astype(step.dtype)[..., None]], axis=-1)
    near = jnp.moveaxis(jnp.stack(_shifted(jnp.moveaxis(told, -1, 0))), 1, -1)
    apart = jnp.sum(jnp.square(near[..., :3] - centre[None]), axis=-1) / (2.0 * length**2)
    unlike = jnp.square(near[..., 3] - step[None]) / 2.0
    raw = jnp.where((near[..., 4] > 0.5) & alive[None], jnp.exp(-apart - unlike), 0.0)
    return raw / jnp.maximum(jnp.sum(raw, axis=0, keepdims=True), 1e-6)


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


def mean_shift(
    points_m: Float[Array, "height width 3"],
    weight: Float[Array, "height width"],
    start_m: Float[Array, " 3"],
    bandwidth_m: Float[Array, ""],
    *,
    num_iterations: int = 5,
) -> Float[Array, " 3"]:
    """The mode of weighted points next to `start_m`: Gaussian mean shift; the start where no weight is near."""

    def shift(centre: Float[Array, " 3"], _: None):
        kernel = weight * jnp.exp(-jnp.sum(jnp.square(points_m - centre[None, None]), axis=-1) / (2.0 * bandwidth_m**2))
        total = jnp.sum(kernel)
        mean = jnp.sum(points_m * kernel[..., None], axis=(0, 1)) / jnp.maximum(total, 1e-6)
        return jnp.where(total > 1e-6, mean, centre), None

    centre, _ = jax.lax.scan(shift, start_m, None, length=num_iterations)
    return centre


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


def compact_cut(
    points_m: Float[Array, "height width 3"],
    valid: Bool[Array, "height width"],
    log_odds: Float[Array, "height width"],
    *,
    level: Float[Array, ""],
    share: Float[Array, ""],
    margin: Float[Array, ""],
    width: Float[Array, ""],
    extent_m: Float[Array, ""],
) -> tuple[Float[Array, "height width"], Float[Array, " 3"]]:
    """A soft mask that is one compact thing in 3D, and its centre.

    The mask is sigmoid((l - threshold - |p - c|^2 / (2 extent^2)) / width) with threshold = min(level + share
    max(best - level, 0), best - margin),
    where c is the mode (mean shift) of the points whose l passes, started at the best of them. No gradient goes through c.
    """
    best = jnp.max(jnp.where(valid, log_odds, -1e3))
    threshold = jnp.minimum(level + share * jax.nn.relu(best - level), best - margin)
    known = valid.astype(log_odds.dtype)
    weight = jax.nn.sigmoid((log_odds - threshold) / width) * known
    peak = jnp.where(valid, jnp.exp(jnp.minimum(log_odds - best, 0.0) / width), 0.0)
    start = jnp.sum(points_m * peak[..., None], axis=(0, 1)) / jnp.maximum(jnp.sum(peak), 1e-6)
    # Between two modes mean shift multiplies gradients by thousands, step by step; the mask's own edge says enough.
    centre = jax.lax.stop_gradient(mean_shift(points_m, weight, start, extent_m))
    spread = jnp.sum(jnp.square(points_m - centre[None, None]), axis=-1) / (2.0 * jnp.square(extent_m))
    return jax.nn.sigmoid((log_odds - threshold - spread) / width) * known, centre


def bounding_box(mask: Float[Array, "height width"], tail: float) -> Float[Array, " 4"]:
    """Box x0 y0 x1 y1 (first and last pixel, both inside) that leaves at most the share `tail` of the mask outside on each side.

    tail = 0 is the exact bounding box of a binary mask; a small tail keeps a stray pixel from stretching it, and takes
    off what is thin at an end. An empty mask gives zeros.
    """

    def span(profile: Float[Array, " size"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        total = jnp.sum(profile)
        below = jnp.cumsum(profile)
        above = jnp.flip(jnp.cumsum(jnp.flip(profile)))
        first = jnp.sum(below <= tail * total + 1e-6 * total)
        last = profile.shape[0] - 1 - jnp.sum(above <= tail * total + 1e-6 * total)
        some = total > 0
        return jnp.where(some, first, 0).astype(mask.dtype), jnp.where(some, last, 0).astype(mask.dtype)

    x0, x1 = span(jnp.sum(mask, axis=0))
    y0, y1 = span(jnp.sum(mask, axis=1))
    return jnp.stack([x0, y0, x1, y1])
