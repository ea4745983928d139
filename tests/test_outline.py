"""Masks, boxes and centroids of segments, against NumPy on dense pictures."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.benchmarks.segments_numpy.outline import filled_labels as filled_by_numpy
from tagjax.tagattention.segments.outline import (
    dense_masks,
    filled_labels,
    joined_boxes,
    joined_centroids,
    segment_boxes,
    segment_centroids,
)

NUM_SEGMENTS = 9


def picture(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.repeat(np.repeat(rng.integers(-1, NUM_SEGMENTS - 1, (6, 8)), 3, axis=0), 3, axis=1).astype(np.int32)


def test_boxes_and_centroids_are_those_of_the_dense_mask():
    labels, member = picture(), np.random.default_rng(1).uniform(size=(4, NUM_SEGMENTS)) < 0.3
    member[:, 0], member[3] = False, False
    boxes = joined_boxes(segment_boxes(jnp.asarray(labels), NUM_SEGMENTS), jnp.asarray(member))
    centroids = joined_centroids(segment_centroids(jnp.asarray(labels), NUM_SEGMENTS), jnp.asarray(member))
    for tag in range(3):
        y, x = np.nonzero(member[tag][labels] & (labels > 0))
        np.testing.assert_array_equal(boxes[tag], [x.min(), y.min(), x.max(), y.max()])
        np.testing.assert_allclose(centroids[tag], [x.mean(), y.mean()], rtol=1e-5)
    np.testing.assert_array_equal(boxes[3], 0.0)
    np.testing.assert_array_equal(centroids[3], 0.0)


def test_a_member_without_pixels_adds_nothing():
    labels = np.zeros((4, 5), np.int32)
    labels[1:3, 2:4] = 2
    member = np.zeros((1, NUM_SEGMENTS), bool)
    member[0, [2, 7]] = True
    box = joined_boxes(segment_boxes(jnp.asarray(labels), NUM_SEGMENTS), jnp.asarray(member))
    np.testing.assert_array_equal(box[0], [2, 1, 3, 2])


def test_masks_are_the_table_of_the_labels():
    labels, probability = picture(2), np.random.default_rng(3).uniform(size=(2, NUM_SEGMENTS)).astype(np.float32)
    masks = np.asarray(dense_masks(jnp.asarray(labels), jnp.asarray(probability)))
    expected = np.where(labels > 0, probability[:, np.maximum(labels, 0)], 0.0)
    np.testing.assert_array_equal(masks, expected)


def test_a_pixel_between_surfaces_joins_the_neighbour_of_its_depth():
    labels = np.array([[1, -1, 2], [1, -1, -1], [1, -1, 2]], np.int32)
    depth = np.array([[1.0, 1.02, 2.0], [1.0, 1.5, 2.0], [1.0, 0.0, 2.0]], np.float32)
    filled = np.asarray(filled_labels(jnp.asarray(labels), jnp.asarray(depth)))
    np.testing.assert_array_equal(filled, [[1, 1, 2], [1, -1, 2], [1, -1, 2]])


def test_a_gap_below_a_segment_is_filled_unless_one_sees_past_it():
    labels = np.full((6, 5), -1, np.int32)
    depth = np.zeros((6, 5), np.float32)
    labels[0], depth[0] = [3, 3, 3, 3, 0], 2.0  # the last column: background above
    labels[5], depth[5] = (
        [0, 0, -1, 4, 0],
        [2.1, 4.0, 0.0, 1.0, 2.0],
    )  # floor, a wall far behind, nothing, something in front
    filled = np.asarray(filled_labels(jnp.asarray(labels), jnp.asarray(depth)))
    np.testing.assert_array_equal(filled[1:5, 0], 3)
    np.testing.assert_array_equal(filled[1:5, 1], -1)
    np.testing.assert_array_equal(filled[1:, 2], -1)
    np.testing.assert_array_equal(filled[1:5, 3], 3)
    np.testing.assert_array_equal(filled[1:5, 4], -1)
    np.testing.assert_array_equal(filled[[0, 5]], labels[[0, 5]])


@pytest.mark.parametrize("seed", range(3))
def test_labels_are_filled_as_by_numpy(seed: int):
    rng, shape = np.random.default_rng(seed), (23, 17)
    labels = np.where(rng.random(shape) < 0.7, -1, rng.integers(0, 5, shape)).astype(np.int32)
    depth = np.where((labels < 0) & (rng.random(shape) < 0.8), 0.0, rng.choice([1.0, 1.1, 1.3], shape)).astype(
        np.float32
    )
    filled = np.asarray(filled_labels(jnp.asarray(labels), jnp.asarray(depth)))
    np.testing.assert_array_equal(filled, filled_by_numpy(labels, depth))
    assert np.sum(filled != labels) > 20
