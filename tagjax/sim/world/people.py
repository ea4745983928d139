"""Articulated people: limbs of given proportions and clothes, a gait without sliding feet, hands that reach.

Body frame: x ahead, y left, z up, origin on the floor below the hips. Proportions after Winter, Biomechanics and Motor
Control of Human Movement (2009), table 4.1, as fractions of the height.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Float

from .bodies import STEP_S, Body, Material, Poses, rotation_matrix
from .figure import REACH, PersonModel, bone_poses, limb_shapes, two_bone_joints
from .gait import FootPlan, FootSize, pelvis_height, plan_feet
from .rotation import continuous, frame, multiply, quaternion_of, turn_about, unit
from .trajectory import smooth_step
from .walks import Walk

Target = Float[np.ndarray, "steps 3"] | None

BLEND_S = 0.3
"""Time of the transition between a freely swinging hand and its target."""


@dataclasses.dataclass(frozen=True)
class Hands:
    """Target positions of the hands, world, (steps, 3). Hands swing freely where rows are NaN, and for None."""

    left: Target = None
    right: Target = None


@dataclasses.dataclass(frozen=True)
class PersonMotion:
    """A person's limbs over time, the real positions of both hands, and how far standing feet slide."""

    limbs: dict[str, Poses]
    left_hand: Poses
    right_hand: Poses
    slip_m_s: float  # mean speed of standing feet over the floor
    shoulder_m: dict[str, np.ndarray]  # by side, (steps, 3)


def make_person(rng: np.random.Generator, *, height_m: float | None = None) -> PersonModel:
    """Draw a person: height (1.52 to 1.93 m if not given), build, skin, hair and clothes.

    Raises `ValueError` for a height outside 0.9 to 2.2 m.
    """
    height = float(rng.uniform(1.52, 1.93)) if height_m is None else float(height_m)
    if not 0.9 <= height <= 2.2:
        raise ValueError(f"height_m is {height}; expected 0.9 to 2.2 m.")
    seeds = rng.integers(0, 2**31, 4)

    def cloth(number: int, transmission: float, dark: float) -> Material:
        texture = str(rng.choice(["noise", "stripes", "checker", "plain", "speckle"], p=[0.35, 0.25, 0.2, 0.1, 0.1]))
        colour = tuple(float(c) for c in np.clip(rng.uniform(0.03, dark) + rng.uniform(-0.3, 0.3, 3), 0.02, 0.9))
        return Material(
            colour,  # pyright: ignore[reportArgumentType]
            texture,  # pyright: ignore[reportArgumentType]
            scale=float(rng.uniform(8, 30)),
            contrast=float(rng.uniform(0.25, 0.8)) if texture != "plain" else 0.04,
            seed=int(seeds[number]),
            transmission_db=transmission,
        )

    tone = rng.uniform(0.12, 0.75)
    skin = Material(
        (tone, tone * rng.uniform(0.68, 0.78), tone * rng.uniform(0.5, 0.66)), "noise", 12.0, 0.08, transmission_db=3.0
    )
    shade = rng.uniform(0.02, 0.35)
    hair = Material(
        (shade, shade * rng.uniform(0.6, 0.9), shade * rng.uniform(0.3, 0.8)),
        "stripes",
        60.0,
        0.4,
        seed=int(seeds[3]),
        transmission_db=3.0,
    )
    # Assumed: 15 to 20 dB one way through a trunk. No measurement at 900 MHz was found; bodies attenuate blocked links
    # at 3 to 11 GHz by 15 dB and more.
    loss = float(rng.uniform(15.0, 20.0))
    return PersonModel(
        height_m=height,
        build=float(rng.uniform(0.88, 1.15)),
        shirt=cloth(0, loss, 0.8),
        trousers=cloth(1, loss, 0.5),
        shoes=Material((shade / 2, shade / 2, shade / 2), "plain", contrast=0.1, shine=0.2, transmission_db=6.0),
        skin=skin,
        hair=hair,
        sleeves=str(rng.choice(["long", "short"])),
        long_hair=bool(rng.random() < 0.4),
    )


def limb_bodies(model: PersonModel, motion: PersonMotion, *, label: int = 0, name: str = "person") -> tuple[Body, ...]:
    """The limbs of a person with a given motion as bodies of role person, all with the same name and label."""
    shapes = limb_shapes(model)
    return tuple(Body(name, shapes[limb], poses, "person", label) for limb, poses in motion.limbs.items())


def badge_m(model: PersonModel) -> tuple[float, float, float]:
    """Position of a badge in the torso's frame: at the centre of the chest, one centimetre in front of the shirt."""
    chest = limb_shapes(model)["torso"][1]
    x, y, z = chest.position_m
    return x + chest.size_m[0] + 0.01, y, z


def hand_target(
    walk: Walk, offset_m: tuple[float, float, float], from_s: float = 0.0, to_s: float = np.inf
) -> Float[np.ndarray, "steps 3"]:
    """Hand target at a fixed position in the body frame (x ahead, y left, z above the floor); NaN outside the times."""
    c, s = np.cos(walk.heading_rad), np.sin(walk.heading_rad)
    x, y, z = offset_m
    ground = walk.position_m + np.stack([c * x - s * y, s * x + c * y], axis=-1)
    path = np.concatenate([ground, np.full((len(ground), 1), z)], axis=-1)
    time_s = np.arange(len(path)) * STEP_S
    path[(time_s < from_s) | (time_s > to_s)] = np.nan
    return path


def carried_poses(
    hand: Poses, grip_m: tuple[float, float, float], style: Literal["upright", "fist", "hand"] = "upright"
) -> Poses:
    """Poses of an object that a hand holds at `grip_m` (object frame).

    `upright`: z stays vertical and the object rotates with the hand about the vertical, as a bag or a full mug does;
    `fist`: z points to the thumb's side, as of a stick or bottle held at its middle; `hand`: the hand's frame.
    """
    turn = rotation_matrix(hand.quaternion)
    if style == "upright":
        # The thumb's side tilts as the arm lifts; the direction across the palm still gives the heading.
        across = turn[..., :, 1] * np.array([1.0, 1.0, 0.0])
        ahead = np.cross(unit(across), np.broadcast_to([0.0, 0.0, 1.0], across.shape))
        turn = frame(np.broadcast_to([0.0, 0.0, 1.0], ahead.shape), ahead)
    elif style == "fist":
        turn = frame(turn[..., :, 0], -turn[..., :, 2])
    return Poses(hand.position_m - turn @ np.asarray(grip_m, float), continuous(quaternion_of(turn)))


def move_person(model: PersonModel, walk: Walk, hands: Hands | None = None) -> PersonMotion:
    """The motion of all limbs along a walk, with the hands at their targets where these are in reach."""
    hands = hands or Hands()
    steps = len(walk.heading_rad)
    for target in (hands.left, hands.right):
        if target is not None and len(target) != steps:
            raise ValueError(f"A hand's target has {len(target)} steps; expected {steps}, as the walk has.")
    m = model.measures
    foot = FootSize(m.ankle, m.ball, m.heel, m.hip)
    plans = plan_feet(walk, foot)
    heading = _smooth(np.unwrap(walk.heading_rad), 0.08)
    yaw = turn_about((0.0, 0.0, 1.0), heading)
    ground = np.concatenate([walk.position_m, np.zeros((steps, 1))], axis=-1)
    limbs: dict[str, Poses] = {}

    def place(quaternion: np.ndarray, origin: np.ndarray, local) -> np.ndarray:
        return origin + np.einsum("nij,j->ni", rotation_matrix(quaternion), np.asarray(local, float))

    flat = [place(yaw, ground, (0.0, side * m.hip, 0.0)) for side in (1, -1)]
    height = pelvis_height((flat[0], flat[1]), (plans[0].ankle_m, plans[1].ankle_m), m.thigh + m.shin, m.hip_height)
    pelvis = ground + height[:, None] * np.array([0.0, 0.0, 1.0])
    # How far each foot is ahead of the hips, in leg lengths: it drives arms and pelvis.
    ahead = rotation_matrix(yaw)[..., :, 0]
    reach = [np.sum((plan.ankle_m - pelvis) * ahead, axis=-1) / (m.thigh + m.shin) for plan in plans]
    stride = _smooth(reach[1] - reach[0], 0.05)  # right ahead positive
    speed = _smooth(np.linalg.norm(walk.velocity_m_s, axis=-1), 0.15)
    hips_turn = multiply(yaw, turn_about((0.0, 0.0, 1.0), 0.12 * stride))
    lean = turn_about((0.0, 1.0, 0.0), 0.03 + 0.03 * speed)
    chest_turn = multiply(multiply(yaw, turn_about((0.0, 0.0, 1.0), -0.12 * stride)), lean)
    limbs["hips"] = Poses(pelvis, hips_turn)
    waist = place(hips_turn, pelvis, (0.0, 0.0, m.waist))
    limbs["torso"] = Poses(waist, chest_turn)
    neck = place(chest_turn, waist, (0.0, 0.0, m.trunk))
    limbs["head"] = Poses(neck, yaw)
    contact_speed = []
    for number, side in enumerate(("left", "right")):
        sign = 1.0 if side == "left" else -1.0
        hip = place(hips_turn, pelvis, (0.0, sign * m.hip, 0.0))
        plan = plans[number]
        toes = turn_about((0.0, 0.0, 1.0), plan.heading_rad)
        knee_way = rotation_matrix(toes)[..., :, 0]
        knee, ankle = two_bone_joints(hip, plan.ankle_m, knee_way, m.thigh, m.shin)
        limbs[f"{side} thigh"] = bone_poses(hip, knee, knee_way)
        limbs[f"{side} shin"] = bone_poses(knee, ankle, knee_way)
        foot_turn = multiply(toes, turn_about((0.0, 1.0, 0.0), plan.pitch_rad))
        limbs[f"{side} foot"] = Poses(ankle, foot_turn)
        contact_speed.append(_slip(ankle, foot_turn, plan, foot))
    hand_poses, shoulders = {}, {}
    for number, side in enumerate(("left", "right")):
        sign = 1.0 if side == "left" else -1.0
        shoulder = place(chest_turn, waist, (0.0, sign * m.shoulder, m.shoulder_height))
        shoulders[side] = shoulder
        # An arm swings with the opposite leg.
        free = _free_hand(shoulder, chest_turn, 0.75 * (reach[1 - number] - 0.1), sign, m.upper_arm, m.forearm)
        target = hands.left if side == "left" else hands.right
        if target is not None:
            # Clamped before the blend too: a hand must not move fast towards a target out of reach.
            target = _clamped(shoulder, target, m.upper_arm, m.forearm)
        wanted = _blended(free, target, walk.position_m, heading)
        wanted = _clamped(shoulder, wanted, m.upper_arm, m.forearm)
        away = np.einsum("nij,j->ni", rotation_matrix(chest_turn), np.array([-0.55, sign * 0.45, -0.75]))
        elbow, grip = two_bone_joints(shoulder, wanted, away, m.upper_arm, m.forearm)
        front = rotation_matrix(chest_turn)[..., :, 0]
        limbs[f"{side} upper arm"] = bone_poses(shoulder, elbow, front)
        lower = bone_poses(elbow, grip, _thumb(elbow, grip, chest_turn))
        limbs[f"{side} forearm"] = lower
        hand_poses[side] = Poses(grip, lower.quaternion)
        limbs[f"{side} hand"] = hand_poses[side]
    return PersonMotion(limbs, hand_poses["left"], hand_poses["right"], float(np.mean(contact_speed)), shoulders)


def _smooth(values: np.ndarray, sigma_s: float) -> np.ndarray:
    """Gaussian average over time; the first and last value continue beyond the ends."""
    half = min(int(3 * sigma_s / STEP_S), 60)
    weight = np.exp(-0.5 * (np.arange(-half, half + 1) * STEP_S / sigma_s) ** 2)
    return np.convolve(np.pad(values, half, mode="edge"), weight / weight.sum(), mode="valid")


def _thumb(elbow: np.ndarray, grip: np.ndarray, chest: np.ndarray) -> np.ndarray:
    """Direction of the thumb: ahead for a hanging forearm, up for a level one, continuous in between."""
    turn = rotation_matrix(chest)
    level = np.sum(unit(grip - elbow) * turn[..., :, 0], axis=-1, keepdims=True)
    return turn[..., :, 0] * (1.0 - np.clip(level, 0.0, 1.0)) + turn[..., :, 2] * (0.25 + np.clip(level, 0.0, 1.0))


def _free_hand(
    shoulder: np.ndarray, chest: np.ndarray, swing_rad: np.ndarray, sign: float, upper_m: float, lower_m: float
) -> np.ndarray:
    """Grip of an arm that swings by an angle (steps,), forward positive; the elbow bends more when forward."""
    bend = 0.25 + 0.5 * np.clip(swing_rad, -0.2, 1.0)
    splay = np.full_like(swing_rad, sign * 0.12)
    upper = np.stack([np.sin(swing_rad), splay, -np.cos(swing_rad)], axis=-1)
    lower = np.stack([np.sin(swing_rad + bend), splay * 0.3, -np.cos(swing_rad + bend)], axis=-1)
    return shoulder + np.einsum("nij,nj->ni", rotation_matrix(chest), upper_m * unit(upper) + lower_m * unit(lower))


def _blended(free: np.ndarray, target: np.ndarray | None, ground: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """The target where it is known, the free swing elsewhere, and a smooth transition of `BLEND_S` between the two.

    Gaps between targets are filled by interpolation in the body's frame, so that the hand moves with the body.
    """
    if target is None:
        return free
    known = np.asarray(np.isfinite(target).all(axis=-1))
    if not known.any():
        return free
    c, s = np.cos(heading), np.sin(heading)
    away = target[:, :2] - ground
    local = np.stack([c * away[:, 0] + s * away[:, 1], -s * away[:, 0] + c * away[:, 1], target[:, 2]], axis=-1)
    index = np.arange(len(target))
    filled = np.stack([np.interp(index, index[known], local[known, axis]) for axis in range(3)], axis=-1)
    world = np.stack(
        [
            ground[:, 0] + c * filled[:, 0] - s * filled[:, 1],
            ground[:, 1] + s * filled[:, 0] + c * filled[:, 1],
            filled[:, 2],
        ],
        axis=-1,
    )
    nearest = np.abs(index[:, None] - np.flatnonzero(np.diff(known.astype(int), prepend=0, append=0))[None])
    gap = np.where(known, 0, nearest.min(axis=-1, initial=len(target)))
    weight = smooth_step(1.0 - gap * STEP_S / BLEND_S)[:, None]
    return np.where(known[:, None], target, weight * world + (1 - weight) * free)


def _clamped(shoulder: np.ndarray, target: np.ndarray, upper_m: float, lower_m: float) -> np.ndarray:
    """Targets within the arm's length."""
    toward = target - shoulder
    distance = np.linalg.norm(toward, axis=-1, keepdims=True)
    return shoulder + unit(toward) * np.minimum(distance, REACH * (upper_m + lower_m))


def _slip(ankle: np.ndarray, quaternion: np.ndarray, plan: FootPlan, size: FootSize) -> float:
    """Mean speed of the sole's pivot over the floor while the foot stands, m/s."""
    pivot = np.where(plan.pitch_rad >= 0, size.ball_m, -size.heel_m)
    local = np.stack([pivot, np.zeros_like(pivot), np.full_like(pivot, -size.ankle_m)], axis=-1)
    sole = ankle + np.einsum("nij,nj->ni", rotation_matrix(quaternion), local)
    same = plan.contact[1:] & plan.contact[:-1] & (pivot[1:] == pivot[:-1])
    speed = np.linalg.norm(np.diff(sole[:, :2], axis=0), axis=-1) / STEP_S
    return float(speed[same].mean()) if same.any() else 0.0
