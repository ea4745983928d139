"""Unit quaternions w x y z of simulated bodies: from axes and angles, from matrices, products, continuous signs.

Plain NumPy rather than `scipy.spatial.transform.Rotation`: rounding decides bytes of the simulated recordings.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def multiply(a: Float[np.ndarray, "*#batch 4"], b: Float[np.ndarray, "*#batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """Hamilton product: the rotation b followed by the rotation a."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def turn_about(axis: tuple[float, float, float], angle_rad: np.ndarray | float) -> Float[np.ndarray, "*batch 4"]:
    """Quaternions of rotations by `angle_rad` (any shape) about a unit axis."""
    half = np.asarray(angle_rad, float) / 2
    return np.concatenate([np.cos(half)[..., None], np.sin(half)[..., None] * np.asarray(axis, float)], axis=-1)


def frame(up: Float[np.ndarray, "*batch 3"], ahead: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices whose z axis is `up` and whose x axis is nearest to `ahead`; neither needs unit length."""
    z = unit(up)
    x = ahead - np.sum(ahead * z, axis=-1, keepdims=True) * z
    # Where `ahead` is parallel to `up`, any perpendicular direction will do.
    spare = np.where(np.abs(z[..., :1]) < 0.9, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    spare = spare - np.sum(spare * z, axis=-1, keepdims=True) * z
    x = unit(np.where(np.linalg.norm(x, axis=-1, keepdims=True) < 1e-9, spare, x))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def unit(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Vectors of length 1; a zero vector stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def quaternion_of(matrix: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternions of rotation matrices, by the largest of the four components (Shepperd, 1978)."""
    m = matrix
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    trace = xx + yy + zz
    # Row k is 4 q_k q for each component q_k: the one with the largest q_k is the best conditioned.
    rows = np.stack(
        [
            np.stack(
                [1 + trace, m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]], -1
            ),
            np.stack(
                [
                    m[..., 2, 1] - m[..., 1, 2],
                    1 + 2 * xx - trace,
                    m[..., 1, 0] + m[..., 0, 1],
                    m[..., 0, 2] + m[..., 2, 0],
                ],
                -1,
            ),
            np.stack(
                [
                    m[..., 0, 2] - m[..., 2, 0],
                    m[..., 1, 0] + m[..., 0, 1],
                    1 + 2 * yy - trace,
                    m[..., 2, 1] + m[..., 1, 2],
                ],
                -1,
            ),
            np.stack(
                [
                    m[..., 1, 0] - m[..., 0, 1],
                    m[..., 0, 2] + m[..., 2, 0],
                    m[..., 2, 1] + m[..., 1, 2],
                    1 + 2 * zz - trace,
                ],
                -1,
            ),
        ],
        axis=-2,
    )
    best = np.argmax(np.einsum("...kk->...k", rows), axis=-1)
    chosen = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    return chosen / np.linalg.norm(chosen, axis=-1, keepdims=True)


def continuous(quaternion: Float[np.ndarray, "steps 4"]) -> Float[np.ndarray, "steps 4"]:
    """The same rotations with signs that keep neighbouring steps close (q and -q are the same rotation)."""
    flips = np.sum(quaternion[1:] * quaternion[:-1], axis=-1) < 0
    sign = np.where(np.cumsum(flips) % 2, -1.0, 1.0)
    return np.concatenate([quaternion[:1], quaternion[1:] * sign[:, None]])
