"""One frame of a recording stage by stage, as pictures: colour, depth, flow, change of distance, log odds or attention, masks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from ..core.names import short_name
from ..core.results import write_json
from ..metrics.recordings import Picture
from ..recording import Recording
from ..recording.image_files import write_image
from ..tagattention.attention import att_corr, att_rbf, attention, centre_first
from ..tagattention.motion import empty_motion, push_splat
from ..tracing.tracer import Camera, Frame
from .flow import flow_colours
from .overlay import PALETTE_RGB

STAGES = "stages.json"
"""File name of the list of a recording's stage pictures, each with its title and what it shows."""

ALPHA_M2, BETA = 5e-4, 0.8
"""Of the attention as published (Eqs. 4 and 6)."""

MOST_NATS = 8
"""Log odds at which their colour is full."""

_WIDTH = 320
_MAX_TAGS = 6

Image = UInt8[np.ndarray, "height width 3"]


def stage_picture(pictures: Sequence[Picture], from_frame: int) -> Picture | None:
    """The picture with most detections, of several the middle one, from a frame on if there is one; None where none is given."""
    late = [one for one in pictures if one.frame >= from_frame] or pictures
    most = max((int(one.detected.sum()) for one in late), default=0)
    best = [one for one in late if int(one.detected.sum()) == most]
    return best[len(best) // 2] if best else None


def write_stages(folder: Path, recording: Recording, picture: Picture, camera: Camera, frames: Frame) -> None:
    """Write a small JPEG of each stage at the frame of `picture`, and `stages.json` with their titles.

    `frames` are the tracer's inputs with the tags of the picture (leading time axis), up to that frame. The log odds of
    soft masks are shown. Where a tracer's masks are 0 or 1, the paper's attention is computed from the inputs instead.
    """
    rays = np.asarray(camera.rays)
    depth_m = np.asarray(frames.depth_m)
    ranges_m = np.asarray(camera.ranges_m(jnp.asarray(depth_m[..., None] * rays))[0])
    window = frames.radio.relative_m.shape[-1]
    motion = empty_motion(depth_m.shape[1], depth_m.shape[2], window)
    for number in range(len(depth_m)):
        range_m = np.where(depth_m[number] > 0, ranges_m[number], 0.0)
        motion = push_splat(motion, frames.forward_px[number], jnp.asarray(range_m))
    rho_m = centre_first(motion.distance_m, motion.valid)
    tag_mm = 1e3 * np.asarray(frames.radio.relative_m[-1, :, 0, -1] - frames.radio.relative_m[-1, :, 0, 0])
    known = np.asarray(motion.valid[..., 0] & motion.valid[..., -1])
    change_mm = np.where(known, 1e3 * np.asarray(rho_m[..., -1]), np.nan)
    flow_px = np.asarray(frames.backward_px[-1], np.float32)
    speed = np.linalg.norm(flow_px, axis=-1)
    largest_px = max(1.0, float(np.percentile(speed, 99)))
    largest_mm = max(20.0, 1.5 * float(np.max(np.abs(tag_mm), initial=0.0)))  # beyond it are jumps at edges, not motion
    shown: list[tuple[str, str, Image]] = [
        ("colour", "what the camera sees", np.asarray(recording.colour[picture.frame])),
        ("depth", "near is bright; black: no measurement", depth_colours(depth_m[-1])),
        (
            "optical flow",
            f"since the frame before; hue: direction, full colour at {largest_px:.1f} px",
            # The flow at hand points back in time.
            flow_colours(-flow_px, largest_px),
        ),
        (
            "change of distance to the antenna",
            f"over {window} frames; orange: away by {largest_mm:.0f} mm or more, blue: nearer, grey: unknown",
            change_colours(change_mm, largest_mm),
        ),
    ]
    soft = picture.soft_masks
    is_soft = soft is not None and bool(np.any((soft > 0.0) & (soft < 1.0)))
    for tag, epc in list(enumerate(picture.epcs))[:_MAX_TAGS]:
        if soft is not None and is_soft:
            title = f"log odds of {short_name(epc)}"
            meaning = f"that a pixel is of the tag's object: orange for it, blue against it, by {MOST_NATS} nats or more; grey: not followed"
            text = "likewise" if tag else meaning
            shown.append((title, text, change_colours(log_odds(soft[tag]), float(MOST_NATS))))
            continue
        rd_m, std_m = np.asarray(frames.radio.relative_m[-1, tag, 0]), np.asarray(frames.radio.std_m[-1, tag, 0])
        valid = motion.valid & motion.valid[..., :1] & jnp.isfinite(jnp.asarray(std_m))[None, None]
        agreement = np.asarray(_attention(rho_m, jnp.asarray(rd_m), valid))
        if not np.isfinite(std_m).any():  # not read: without a distance of the tag nothing can agree
            continue
        shown.append(
            (
                f"attention of {short_name(epc)}",
                f"pixels whose distance changes as the tag's does (Eq. 6), here by {tag_mm[tag]:+.0f} mm over {window} frames",
                grey(np.where(np.asarray(valid).any(axis=-1), agreement, 0.0)),
            )
        )
    shown.append(("masks", "the tracer's result, one colour a tag", mask_colours(picture)))
    listed: list[dict[str, Any]] = []
    for number, (title, text, image) in enumerate(shown):
        name = f"stage{number}.jpg"
        write_image(folder / name, _small(image), jpeg_quality=80)
        listed.append({"file": name, "title": title, "text": text})
    write_json(folder / STAGES, {"frame": picture.frame, "stages": listed})


def _attention(
    rho_m: Float[Array, "height width window"], rd_m: Float[Array, " window"], valid: Bool[Array, "height width window"]
) -> Float[Array, "height width"]:
    rd = jnp.broadcast_to(rd_m - rd_m[0], rho_m.shape)
    return attention(att_rbf(rho_m, rd, valid, jnp.float32(ALPHA_M2)), att_corr(rho_m, rd, valid), jnp.float32(BETA))


def depth_colours(depth_m: Float[np.ndarray, "height width"]) -> Image:
    """Near bright, far dark, between the 2nd and the 98th percentile; missing depth black."""
    known = depth_m > 0
    low, high = np.percentile(depth_m[known], [2, 98]) if known.any() else (0.0, 1.0)
    level = np.clip((high - depth_m) / max(high - low, 1e-6), 0.0, 1.0)
    coloured = cv2.applyColorMap((40 + 215 * level).astype(np.uint8), cv2.COLORMAP_CIVIDIS)[..., ::-1]
    return np.where(known[..., None], coloured, 0).astype(np.uint8)


def change_colours(change_mm: Float[np.ndarray, "height width"], largest_mm: float) -> Image:
    """Blue for nearer, white for none, orange for farther; NaN grey. Distinct for people with any kind of colour vision."""
    level = np.clip(np.nan_to_num(change_mm) / largest_mm, -1.0, 1.0)[..., None]
    away, nearer, white = np.array([200, 90, 0]), np.array([0, 90, 170]), np.array([247, 247, 247])
    coloured = np.where(level > 0, white + level * (away - white), white - level * (nearer - white))
    return np.where(np.isfinite(change_mm)[..., None], coloured, 150).astype(np.uint8)


def log_odds(mask: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Those of a soft mask, at most `MOST_NATS` either way; NaN where it is 0, which is where nothing is followed."""
    inside = np.clip(mask.astype(np.float64), 1e-12, 1.0 - 1e-12)
    nats = np.clip(np.log(inside) - np.log1p(-inside), -MOST_NATS, MOST_NATS)
    return np.where(mask > 0, nats, np.nan)


def grey(level: Float[np.ndarray, "height width"]) -> Image:
    """0 black to 1 white."""
    return np.repeat((255 * np.clip(level, 0.0, 1.0)).astype(np.uint8)[..., None], 3, axis=-1)


def mask_colours(picture: Picture) -> Image:
    """Each detected tag's mask in its colour on black."""
    drawn = np.zeros((*picture.masks.shape[1:], 3), np.uint8)
    for tag, mask in enumerate(picture.masks):
        if picture.detected[tag]:
            drawn[mask] = PALETTE_RGB[tag % len(PALETTE_RGB)]
    return drawn


def _small(image: Image) -> UInt8[np.ndarray, "rows columns 3"]:
    """Of the width of a stage's picture; pixels of small pictures stay visible."""
    height = max(1, round(image.shape[0] * _WIDTH / image.shape[1]))
    way = cv2.INTER_AREA if image.shape[1] > _WIDTH else cv2.INTER_NEAREST
    return cv2.resize(np.ascontiguousarray(image), (_WIDTH, height), interpolation=way).astype(np.uint8)
