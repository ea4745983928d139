"""New segments where none is: the holes of a label picture, cut by a regular grid of cells of two sizes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

NO_LABEL = -1
"""The label of a pixel that belongs to no segment."""

NOT_NEW = -2
"""The source of a slot that no new segment took."""

_COARSE_FROM = 1.5  # a cell is coarse where segments should be at least so many fine sides wide


def row_sources(newborn_source: Int[Array, " segment"]) -> Int[Array, " segment"]:
    """The slot of the last frame that each one's rows come from: its own, that of a newborn segment's source, or 0 for none.

    Take all rows at once, for a source may be replaced itself.
    """
    slot = jnp.arange(newborn_source.shape[0], dtype=newborn_source.dtype)
    return jnp.where((newborn_source <= NOT_NEW) | (slot == 0), slot, jnp.maximum(newborn_source, 0))


def births(
    hole: Bool[Array, "height width"],
    side_px: Float[Array, "height width"],
    carried: Int[Array, "height width"],
    free: Bool[Array, " segment"],
    *,
    min_side_px: int,
    min_pixels: int,
) -> tuple[Int[Array, "height width"], Int[Array, " segment"], Int[Array, ""]]:
    """New segments for the pixels of `hole`, one for each cell with more than `min_pixels` of them.

    Cells have `min_side_px` a side, or twice that where the mean `side_px` of the cell's holes asks for it. They take free
    slots in order, coarse cells first, each size row by row. Returns the slot of each pixel (-1 = none), the source of
    each slot (the most common `carried` label of its pixels, of equally common ones the smallest; in a coarse cell the most
    common one of its four quarters' by their counts; -2 = no new segment), and the number of cells that found no free slot.
    """
    height, width = hole.shape
    coarse_px = 2 * min_side_px
    pad = (0, -height % coarse_px), (0, -width % coarse_px)
    holes, label = jnp.pad(hole, pad), jnp.pad(carried, pad)
    wanted = jnp.where(holes, jnp.pad(side_px, pad), 0.0)

    members = _cells(holes, min_side_px)
    number = jnp.sum(members, axis=-1, dtype=jnp.int32)
    total = _quarters(number).sum(axis=-1, dtype=jnp.int32)
    side = jnp.sum(_cells(wanted, coarse_px), axis=-1) / jnp.maximum(total, 1).astype(wanted.dtype)
    coarse = side >= _COARSE_FROM * min_side_px
    taken_coarse = coarse & (total > min_pixels)
    taken_fine = ~_repeated(coarse, 2) & (number > min_pixels)

    # The next free slot for each cell, while there are any.
    taken = jnp.concatenate([taken_coarse.reshape(-1), taken_fine.reshape(-1)])
    rank = jnp.cumsum(taken, dtype=jnp.int32) - 1
    (slots,) = jnp.nonzero(free, size=free.shape[0], fill_value=0)
    placed = taken & (rank < jnp.sum(free, dtype=jnp.int32))
    slot = jnp.where(placed, slots.astype(jnp.int32)[jnp.clip(rank, 0, free.shape[0] - 1)], NO_LABEL)
    slot_coarse, slot_fine = slot[: coarse.size].reshape(coarse.shape), slot[coarse.size :].reshape(number.shape)
    picture = jnp.where(
        _repeated(coarse, coarse_px), _repeated(slot_coarse, coarse_px), _repeated(slot_fine, min_side_px)
    )
    picture = jnp.where(hole, picture[:height, :width], NO_LABEL)

    common, votes = _most_common(_cells(label, min_side_px), members.astype(jnp.int32))
    common_coarse, _ = _most_common(_quarters(common), _quarters(votes))
    cause = jnp.concatenate([common_coarse.reshape(-1), common.reshape(-1)])
    nowhere = free.shape[0]
    source = jnp.full(nowhere, NOT_NEW, jnp.int32).at[jnp.where(placed, slot, nowhere)].set(cause, mode="drop")
    return picture, source, jnp.sum(taken & ~placed, dtype=jnp.int32)


def _cells(picture: Array, side_px: int) -> Array:
    """(rows, columns, side * side): the pixels of each cell of a picture whose sides are multiples of the cell's."""
    rows, columns = picture.shape[0] // side_px, picture.shape[1] // side_px
    split = picture.reshape(rows, side_px, columns, side_px)
    return jnp.swapaxes(split, 1, 2).reshape(rows, columns, side_px**2)


def _quarters(cells: Array) -> Array:
    return _cells(cells, 2)


def _repeated(cells: Array, side_px: int) -> Array:
    rows, columns = cells.shape
    picture = jnp.broadcast_to(cells[:, None, :, None], (rows, side_px, columns, side_px))
    return picture.reshape(rows * side_px, columns * side_px)


def _most_common(
    label: Int[Array, "row column member"], weight: Int[Array, "row column member"]
) -> tuple[Int[Array, "row column"], Int[Array, "row column"]]:
    """The label with the largest summed weight of each cell, of equals the smallest; and that weight."""
    equal = label[..., :, None] == label[..., None, :]  # within the sum XLA makes no array of all pairs
    votes = jnp.sum(jnp.where(equal, weight[..., None, :], 0), axis=-1, dtype=weight.dtype)
    votes = jnp.where(weight > 0, votes, 0)
    most = jnp.max(votes, axis=-1)
    largest = jnp.iinfo(jnp.int32).max
    winner = jnp.min(jnp.where((votes == most[..., None]) & (weight > 0), label, largest), axis=-1)
    return jnp.where(most > 0, winner, NO_LABEL), jax.lax.stop_gradient(most)
