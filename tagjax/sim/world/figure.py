"""A person's proportions, the shapes of the limbs in their own frames, and two-bone inverse kinematics."""

from __future__ import annotations

import dataclasses

import numpy as np

from .bodies import Material, Poses, Shape
from .rotation import continuous, frame, quaternion_of, unit

REACH = 0.999
"""Largest fraction of a limb's length that is used: a straight joint has no direction to bend."""

_ACROSS = (0.7071067811865476, 0.7071067811865476, 0.0, 0.0)  # rotates z to y: a capsule from side to side


@dataclasses.dataclass(frozen=True)
class Measures:
    """Lengths in metres. Heights of the trunk are measured from the joint below."""

    ankle: float  # above the floor
    ball: float  # of the foot, ahead of the ankle
    heel: float  # behind the ankle
    hip: float  # half the distance between the hip joints
    hip_height: float  # above the floor, standing
    thigh: float
    shin: float
    waist: float  # above the hip joints
    trunk: float  # waist to neck
    shoulder: float  # half the distance between the shoulder joints
    shoulder_height: float  # above the waist
    upper_arm: float
    forearm: float  # elbow to grip


@dataclasses.dataclass(frozen=True)
class PersonModel:
    """Height, build (1 = average girth), materials and clothing of a person."""

    height_m: float
    build: float
    shirt: Material
    trousers: Material
    shoes: Material
    skin: Material
    hair: Material
    sleeves: str = "long"
    long_hair: bool = False

    @property
    def measures(self) -> Measures:
        """Lengths as fractions of the height (Winter, 2009); the grip is 0.06 of the height beyond the wrist."""
        fractions = Measures(
            ankle=0.039,
            ball=0.085,
            heel=0.035,
            hip=0.052,
            hip_height=0.529,
            thigh=0.245,
            shin=0.246,
            waist=0.085,
            trunk=0.235,
            shoulder=0.112,
            shoulder_height=0.203,
            upper_arm=0.178,
            forearm=0.205,
        )
        return Measures(**{key: value * self.height_m for key, value in dataclasses.asdict(fractions).items()})

    @property
    def arm_m(self) -> float:
        """Reach of the grip from the shoulder joint."""
        return self.measures.upper_arm + self.measures.forearm


def limb_shapes(model: PersonModel) -> dict[str, tuple[Shape, ...]]:
    """Shapes of every limb by its name. Trunk: origin at its lower joint, z up. Bones: origin at the lower end."""
    h, w, m = model.height_m, model.height_m * model.build, model.measures
    shirt, trousers, skin, hair, shoes = model.shirt, model.trousers, model.skin, model.hair, model.shoes
    arm = _radio(shirt, 4.0)
    bare = arm if model.sleeves == "long" else skin
    leg = _radio(trousers, 8.0)
    # The head contains water too, but less than the trunk.
    face = _radio(skin, 10.0)

    def bone(radius: float, length: float, material: Material) -> Shape:
        return Shape("capsule", (radius, length / 2, 0.0), material, (0.0, 0.0, length / 2))

    limbs: dict[str, tuple[Shape, ...]] = {
        "hips": (
            Shape("ellipsoid", (0.066 * w, 0.094 * w, 0.068 * h), trousers, (-0.002 * h, 0.0, 0.022 * h)),
            Shape("ellipsoid", (0.062 * w, 0.088 * w, 0.05 * h), shirt, (0.0, 0.0, 0.085 * h)),
        ),
        "torso": (
            Shape("ellipsoid", (0.064 * w, 0.088 * w, 0.095 * h), shirt, (0.0, 0.0, 0.045 * h)),
            Shape("ellipsoid", (0.066 * w, 0.1 * w, 0.112 * h), shirt, (0.0, 0.0, 0.125 * h)),
            Shape("capsule", (0.036 * w, 0.076 * h, 0.0), shirt, (-0.004 * h, 0.0, 0.2 * h), _ACROSS),
        ),
        "head": (
            Shape("capsule", (0.031 * w, 0.03 * h, 0.0), skin, (0.0, 0.0, 0.012 * h)),
            Shape("ellipsoid", (0.054 * h, 0.043 * h, 0.067 * h), face, (0.012 * h, 0.0, 0.083 * h)),
            Shape("ellipsoid", (0.012 * h, 0.009 * h, 0.014 * h), skin, (0.066 * h, 0.0, 0.077 * h)),
            Shape("ellipsoid", (0.056 * h, 0.048 * h, 0.054 * h), hair, (0.0, 0.0, 0.102 * h)),
        ),
    }
    if model.long_hair:
        limbs["head"] += (Shape("ellipsoid", (0.026 * h, 0.046 * h, 0.075 * h), hair, (-0.036 * h, 0.0, 0.055 * h)),)
    for side in ("left", "right"):
        limbs[f"{side} thigh"] = (
            bone(0.035 * w, m.thigh, leg),
            Shape("ellipsoid", (0.05 * w, 0.047 * w, 0.125 * h), leg, (0.0, 0.0, 0.155 * h)),
        )
        limbs[f"{side} shin"] = (
            bone(0.026 * w, m.shin, leg),
            Shape("ellipsoid", (0.034 * w, 0.032 * w, 0.085 * h), leg, (-0.008 * h, 0.0, 0.15 * h)),
        )
        limbs[f"{side} foot"] = (
            # The sole lies at the ankle's height below the joint.
            Shape("box", (0.066 * h, 0.025 * h, 0.012 * h), shoes, (0.034 * h, 0.0, 0.012 * h - m.ankle)),
            Shape("ellipsoid", (0.068 * h, 0.027 * h, 0.026 * h), shoes, (0.032 * h, 0.0, 0.024 * h - m.ankle)),
            Shape("ellipsoid", (0.034 * h, 0.026 * h, 0.034 * h), shoes, (-0.004 * h, 0.0, 0.0)),
        )
        limbs[f"{side} upper arm"] = (
            bone(0.026 * w, m.upper_arm, bare),
            Shape("ellipsoid", (0.034 * w, 0.032 * w, 0.07 * h), arm, (0.0, 0.0, 0.135 * h)),
        )
        wrist = 0.06 * h
        limbs[f"{side} forearm"] = (
            Shape(
                "capsule",
                (0.02 * w, (m.forearm - wrist) / 2, 0.0),
                bare,
                (0.0, 0.0, (m.forearm + wrist) / 2),
            ),
        )
        limbs[f"{side} hand"] = (
            Shape("ellipsoid", (0.024 * h, 0.014 * h, 0.045 * h), skin, (0.0, 0.0, 0.012 * h)),
            Shape("capsule", (0.008 * h, 0.016 * h, 0.0), skin, (0.022 * h, 0.0, 0.012 * h)),
        )
    return limbs


def _radio(material: Material, transmission_db: float) -> Material:
    """The same cloth with the radio loss of a thinner part of the body."""
    return dataclasses.replace(material, transmission_db=transmission_db)


def two_bone_joints(
    root: np.ndarray, end: np.ndarray, pole: np.ndarray, first_m: float, second_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Middle joint and end (steps, 3) of two bones from `root` to `end`, bent towards `pole`. The end is kept in reach."""
    toward = end - root
    distance = np.linalg.norm(toward, axis=-1, keepdims=True)
    far = np.clip(distance, abs(first_m - second_m) + 1e-3, REACH * (first_m + second_m))
    along = unit(toward)
    side = unit(pole - np.sum(pole * along, axis=-1, keepdims=True) * along)
    # The law of cosines.
    fraction = (first_m**2 - second_m**2 + far**2) / (2 * far)
    height = np.sqrt(np.maximum(first_m**2 - fraction**2, 0.0))
    return root + fraction * along + height * side, root + far * along


def bone_poses(start: np.ndarray, end: np.ndarray, ahead: np.ndarray) -> Poses:
    """Poses with the origin at the bone's end, z back along it and x nearest to `ahead`."""
    return Poses(end, continuous(quaternion_of(frame(start - end, ahead))))
