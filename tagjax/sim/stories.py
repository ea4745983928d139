"""What happens in a simulated recording: who carries, waves, hides and hands over what, in which room.

Every story is a function of a random generator, a duration and its own settings, and gives a `Filmed` world. `STORIES`
names them; `tell` checks settings against their signatures.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ._crowd import is_free
from ._rotation import quaternion_of, turn_about
from .inventory import InventorySettings
from .motion import Walk, num_steps, path_through, random_walks, smooth_step, still_then_move, walk_along, wave
from .objects import ObjectModel, make_object
from .people import Hands, PersonModel, PersonMotion, carried, hold, limb_bodies, make_person, move_person
from .record import Filmed
from .rooms import Room, make_room
from .virtual_tag import default_epc
from .world import STEP_S, Body, Material, Poses, Shape, Tag, World, rotation_matrix

KINDS = ("bottle", "box", "toy", "notebook", "bag")
"""The five objects of the single-object experiments."""

_UP = (0.0, 0.0, 1.0)
_HAND_M = (0.36, 0.27, 1.12)  # where a hand is held before the body: ahead, to the side, above the floor


class _Set:
    """Bodies, tags and labels of a world in the making."""

    def __init__(self, room: Room, duration_s: float):
        self.room, self.steps = room, num_steps(duration_s)
        self.bodies: list[Body] = list(room.bodies)
        self.tags: list[Tag] = []
        self.names: dict[int, str] = {}

    def person(self, model: PersonModel, walk: Walk, hands: Hands) -> PersonMotion:
        """Put a person on a walk; what comes back says where the hands really are."""
        number = len({body.name for body in self.bodies if body.role == "person"})
        motion = move_person(model, walk, hands)
        self.bodies += limb_bodies(model, motion, name=f"person {number + 1}")
        return motion

    def object(self, model: ObjectModel, poses: Poses, *, tagged: bool = True, labelled: bool = True) -> None:
        label = len(self.names) + 1 if labelled else 0
        if labelled:
            self.names[label] = model.name
        self.bodies.append(Body(model.name, model.shapes, poses, "object", label))
        if tagged:
            self.tags.append(Tag(default_epc(len(self.tags) + 1), len(self.bodies) - 1, model.tag_m, model.dipole))

    def inside(self, path_m: np.ndarray) -> np.ndarray:
        """A hand's path kept off the walls: who walks along a wall does not reach through it."""
        length, width, _ = self.room.size_m
        low, high = np.array([0.0, 0.3 - width / 2, 0.0]), np.array([length - 0.3, width / 2 - 0.3, np.inf])
        return np.clip(path_m, low, high)

    def filmed(
        self, note: str, *, look_at_m: Sequence[float] | None = None, num_antennas: int = 1, **inventory: Any
    ) -> Filmed:
        room = self.room
        if not 1 <= num_antennas <= len(room.antennas_m):
            raise ValueError(
                f"{num_antennas} antennas asked for; the {room.name} has places for {len(room.antennas_m)}."
            )
        world = World(
            bodies=tuple(self.bodies),
            tags=tuple(self.tags),
            num_steps=self.steps,
            size_m=room.size_m,
            lights=room.lights,
            ambient=room.ambient,
            names=self.names,
            note=note,
        )
        x, y, z = room.camera_look_at_m if look_at_m is None else look_at_m
        return Filmed(
            world,
            room.camera_position_m,
            (float(x), float(y), float(z)),
            room.antennas_m[:num_antennas],
            room.panels,
            InventorySettings(**inventory),
        )


def _standing(place: tuple[float, float], heading_rad: float, steps: int) -> Walk:
    return walk_along(np.broadcast_to(np.array(place), (steps, 2)), heading_rad)


def _facing(place: Sequence[float], other: Sequence[float]) -> float:
    """Heading from a place on the floor towards another, radians."""
    return float(np.arctan2(other[1] - place[1], other[0] - place[0]))


def _resting(model: ObjectModel, place: Sequence[float], yaw_rad: float = 0.0) -> Poses:
    """An object that stands at a place: x, y, and the height of what is below it."""
    x, y, z = place
    return Poses.fixed((x, y, z + model.half_size_m[2]), turn_about(_UP, yaw_rad))


def _waved(
    walk: Walk, side: int, rng: np.random.Generator, duration_s: float, speed_m_s: float, still_s: float
) -> np.ndarray:
    """World path of a hand that is still before the body, then waves at random with the given peak speed."""
    offset = (_HAND_M[0], side * _HAND_M[1], _HAND_M[2] + float(rng.uniform(-0.05, 0.1)))
    start = hold(walk, offset)
    still_s = min(still_s, 0.4 * duration_s)
    moving = duration_s - still_s
    # An arm that stays in front of the body reaches about 0.3 m around; faster waves need harder pushes.
    push = max(12.0, 5.5 * speed_m_s**2)
    path = wave("random", (0.0, 0.0, 0.0), moving, peak_speed_m_s=speed_m_s, max_acceleration_m_s2=push, rng=rng)
    offsets = still_then_move(path, still_s, duration_s)
    return start + _fit(offsets, len(start))


def _ease(share: np.ndarray) -> np.ndarray:
    """0 to 1 with the first derivative zero at both ends; gentler in the middle than `smooth_step`."""
    return share * share * (3 - 2 * share)


def _fit(path: np.ndarray, steps: int) -> np.ndarray:
    """The path cut, or its end held, to a number of steps."""
    return path[np.minimum(np.arange(steps), len(path) - 1)]


def _holders(
    room: Room, rng: np.random.Generator, count: int, distance_m: tuple[float, float]
) -> list[tuple[float, float]]:
    """Places (x, y) beside each other before the camera, clear of furniture."""
    camera = np.array(room.camera_position_m[:2])
    for _ in range(2000):
        away = rng.uniform(*distance_m)
        gap = 1.15
        middle = rng.uniform(-0.4, 0.4)
        places = [(camera[0] + away, camera[1] + middle + gap * (k - (count - 1) / 2)) for k in range(count)]
        if all(_clear(room, place) for place in places):
            return places
    raise ValueError(f"No place for {count} people {distance_m} m before the camera of the {room.name}.")


def _clear(room: Room, place: tuple[float, float]) -> bool:
    """Whether somebody can stand there: as walkers, or up to 0.2 m nearer to the camera."""
    x0, y0, x1, y1 = room.walk_area_m
    return is_free(np.asarray(place), (x0 - 0.2, y0, x1, y1), room.obstacles_m, 0.35)


def handheld(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "meeting_room",
    kinds: Sequence[str] = ("bottle",),
    lookalikes: Sequence[str] = (),
    speed_m_s: float = 1.0,
    still_s: float = 0.7,
    num_walkers: int = 0,
    one_grip: bool = False,
    passing: bool = False,
    num_still_tags: int = 0,
    num_antennas: int = 1,
    distance_m: Sequence[float] = (1.7, 2.3),
) -> Filmed:
    """People before the camera wave an object in each hand, at rest for `still_s` first
    (two fifths of the time at most).

    `lookalikes` names kinds whose objects look exactly alike; `one_grip` puts all objects into one hand, side by side;
    `passing` lets a notebook in the other hand pass before the (one) object; `num_walkers` walk behind;
    `num_still_tags` lie around.
    """
    if passing and len(kinds) != 1:
        raise ValueError(f"A notebook passes before one object; found {len(kinds)} kinds.")
    stage = _Set(make_room(room, rng), duration_s)
    looks = {kind: int(rng.integers(2**31)) for kind in lookalikes}
    models = [make_object(kind, rng, look=looks.get(kind)) for kind in kinds]
    count = 1 if one_grip else -(-len(models) // 2)
    places = _holders(stage.room, rng, count, (distance_m[0], distance_m[1]))
    camera = stage.room.camera_position_m
    for number, place in enumerate(places):
        facing = _facing(place, camera) + float(rng.uniform(-0.2, 0.2))
        walk = _standing(place, facing, stage.steps)
        mine = models if one_grip else models[2 * number : 2 * number + 2]
        right = _waved(walk, -1, rng, duration_s, speed_m_s, still_s)
        left = _waved(walk, 1, rng, duration_s, speed_m_s, still_s) if len(mine) > 1 and not one_grip else None
        if passing:
            left = _before(walk, right, camera, duration_s)
        person, hands = make_person(rng), Hands(left=left, right=right)
        motion = stage.person(person, walk, hands)
        if one_grip:
            _together(stage, mine, motion.right_hand)
        else:
            for model, hand in zip(mine, (motion.right_hand, motion.left_hand), strict=False):
                stage.object(model, carried(hand, model.grip_m))
        if passing:
            notebook = make_object("notebook", rng, scale=1.25)
            stage.object(notebook, _upright_sheet(notebook, motion.left_hand, camera), tagged=False)
    _walkers(stage, rng, num_walkers, duration_s, places)
    _still_tags(stage, rng, num_still_tags)
    middle = np.mean(places, axis=0)
    return stage.filmed("people wave objects", look_at_m=(middle[0], 0.8 * middle[1], 1.1), num_antennas=num_antennas)


def _together(stage: _Set, models: Sequence[ObjectModel], hand: Poses) -> None:
    """All objects as one rigid bundle in a hand."""
    first = carried(hand, models[0].grip_m)
    turn = rotation_matrix(first.quaternion)
    reach = 0.0
    for number, model in enumerate(models):
        if number:
            reach += models[number - 1].half_size_m[1] + model.half_size_m[1] + 0.005
        stage.object(model, Poses(first.position_m + turn @ np.array([0.0, reach, 0.0]), first.quaternion))


def _before(walk: Walk, object_m: np.ndarray, camera_m: Sequence[float], duration_s: float) -> np.ndarray:
    """A hand that brings a notebook between camera and object for a second, about the middle, and takes it away."""
    time_s = np.arange(len(object_m)) * STEP_S
    toward = np.asarray(camera_m) - object_m
    cover = object_m + 0.2 * toward / np.linalg.norm(toward, axis=1, keepdims=True)
    aside = hold(walk, (0.3, 0.45, 1.0))
    begin = 0.55 * duration_s
    share = np.clip(np.minimum((time_s - begin) / 0.5, (begin + 2.0 - time_s) / 0.5), 0, 1)
    share = (_ease(share))[:, None]
    return (1 - share) * aside + share * cover


def _upright_sheet(model: ObjectModel, hand: Poses, camera_m: Sequence[float]) -> Poses:
    """A flat object that faces the camera, held at its middle."""
    toward = np.asarray(camera_m) - hand.position_m
    toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    side = np.cross([0.0, 0.0, 1.0], toward)
    side = side / np.linalg.norm(side, axis=1, keepdims=True)
    thin = int(np.argmin(model.half_size_m))
    axes: list[np.ndarray] = [np.cross(toward, side), side, toward]
    columns = [axes[(k - thin - 1) % 3] for k in range(3)]  # the thin axis looks at the camera
    return Poses(hand.position_m.copy(), quaternion_of(np.stack(columns, axis=-1)))


def _walkers(
    stage: _Set, rng: np.random.Generator, count: int, duration_s: float, taken: Sequence[tuple[float, float]]
) -> None:
    """People with empty hands who walk behind those who stand."""
    if not count:
        return
    room = stage.room
    x0, y0, x1, y1 = room.walk_area_m
    behind = max((place[0] for place in taken), default=x0) + 0.7
    walks = random_walks(
        count, duration_s, rng, area_m=(min(behind, x1 - 1.2), y0, x1, y1), obstacles_m=room.obstacles_m
    )
    for walk in walks:
        stage.person(make_person(rng), _trimmed(walk, stage.steps), Hands())


def _trimmed(walk: Walk, steps: int) -> Walk:
    index = np.minimum(np.arange(steps), len(walk.heading_rad) - 1)
    return Walk(*(getattr(walk, field.name)[index] for field in dataclasses.fields(walk)))


def _still_tags(stage: _Set, rng: np.random.Generator, count: int) -> None:
    """Small tagged things that lie on tables, shelves and the floor; they are not labelled."""
    tables = stage.room.tables
    for _ in range(count):
        model = make_object(str(rng.choice(["book", "mug", "box"])), rng, scale=0.8)
        if tables and rng.random() < 0.8:
            table = tables[int(rng.integers(len(tables)))]
            x0, y0, x1, y1 = table.top_m
            place = (rng.uniform(x0 + 0.05, x1 - 0.05), rng.uniform(y0 + 0.05, y1 - 0.05), table.height_m)
        else:
            place = (*stage.room.free_place(rng), 0.0)
        stage.object(model, _resting(model, place, rng.uniform(0, 2 * np.pi)), labelled=False)


def approach(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "meeting_room",
    kind: str = "bag",
    speed_m_s: float = 0.8,
) -> Filmed:
    """A person walks towards the sensor and away again, to and fro, at a speed, an object in the right hand."""
    stage = _Set(make_room(room, rng), duration_s)
    area = stage.room.walk_area_m
    camera = np.array(stage.room.camera_position_m)
    for _ in range(500):
        y = rng.uniform(area[1] + 0.3, area[3] - 0.3) * 0.6
        near = max(camera[0] + 1.5, area[0] - 0.1)
        far = min(area[2], near + rng.uniform(1.6, 2.9))
        line = np.linspace(near, far, 20)
        if all(_clear(stage.room, (x, y)) for x in line):
            break
    else:
        raise ValueError(f"No free line towards the camera in the {stage.room.name}; try another seed.")
    turns = max(2, int(np.ceil(speed_m_s * duration_s / (far - near))) + 2)
    ends = [(far if k % 2 == 0 else near, y + (0.12 if k % 2 else 0.0), 0.0) for k in range(turns)]
    path = path_through(ends, speed_m_s=speed_m_s, max_acceleration_m_s2=3.0)
    walk = _trimmed(walk_along(path), stage.steps)
    person, model = make_person(rng), make_object(kind, rng)
    hands = Hands(right=hold(walk, (0.25, -0.3, 1.0)))
    motion = stage.person(person, walk, hands)
    stage.object(model, carried(motion.right_hand, model.grip_m))
    return stage.filmed(f"a person walks to and fro at {speed_m_s} m/s", look_at_m=((near + far) / 2, 0.5 * y, 0.95))


def crowd(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "office",
    num_people: int = 6,
    objects_each: int = 2,
    speed_m_s: Sequence[float] = (0.4, 1.2),
    num_door: int = 0,
    num_still_tags: int = 0,
) -> Filmed:
    """People walk about, each with an object in one hand or in both; `num_door` of them enter and leave."""
    if objects_each not in (1, 2):
        raise ValueError(f"objects_each is {objects_each}; people have two hands: 1 or 2.")
    stage = _Set(make_room(room, rng), duration_s)
    walks = random_walks(
        num_people,
        duration_s,
        rng,
        area_m=stage.room.walk_area_m,
        obstacles_m=stage.room.obstacles_m,
        speed_m_s=(speed_m_s[0], speed_m_s[1]),
        door=stage.room.door,
        num_door=num_door,
    )
    for walk in walks:
        walk = _trimmed(walk, stage.steps)
        swing = [stage.inside(_waved(walk, side, rng, duration_s, 0.5, 0.0)) for side in (-1, 1)]
        hands = Hands(right=swing[0], left=swing[1] if objects_each == 2 else None)
        person = make_person(rng)
        motion = stage.person(person, walk, hands)
        for hand in (motion.right_hand, motion.left_hand)[:objects_each]:
            model = make_object(str(rng.choice(KINDS)), rng)
            stage.object(model, carried(hand, model.grip_m))
    _still_tags(stage, rng, num_still_tags)
    return stage.filmed(f"{num_people} people walk, {objects_each} objects each")


def handover(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "meeting_room",
    kind: str = "box",
    speed_m_s: float = 0.9,
) -> Filmed:
    """One person waves an object and hands it to another, who waves it on."""
    stage = _Set(make_room(room, rng), duration_s)
    (place,) = _holders(stage.room, rng, 1, (2.0, 2.6))
    half = 0.45
    camera = np.array(stage.room.camera_position_m[:2])
    across = np.array([-(place[1] - camera[1]), place[0] - camera[0]])
    across = across / np.linalg.norm(across)
    spots = [np.array(place) - half * across, np.array(place) + half * across]
    # Half turned to each other, half to the camera.
    toward = (camera - place) / np.linalg.norm(camera - place)
    walks = []
    for spot, side in zip(spots, (1, -1), strict=True):
        ahead = toward + side * across
        walks.append(_standing((float(spot[0]), float(spot[1])), float(np.arctan2(ahead[1], ahead[0])), stage.steps))
    time_s = np.arange(stage.steps) * STEP_S
    meet_s = 0.5 * duration_s
    meeting = np.array([*(0.5 * (spots[0] + spots[1]) + 0.3 * toward), 1.15])
    away = [_waved(walk, side, rng, duration_s, speed_m_s, 0.5) for walk, side in zip(walks, (1, -1), strict=True)]
    near = np.clip(1.25 * (1 - np.abs(time_s - meet_s) / 0.9), 0, 1)
    near = (_ease(near))[:, None]
    targets = [(1 - near) * path + near * meeting for path in away]
    people = [make_person(rng), make_person(rng)]
    hands = [Hands(left=targets[0]), Hands(right=targets[1])]
    motions = [stage.person(person, walk, hand) for person, walk, hand in zip(people, walks, hands, strict=True)]
    model = make_object(kind, rng)
    giver, taker = carried(motions[0].left_hand, model.grip_m), carried(motions[1].right_hand, model.grip_m)
    # Both hands are at the meeting point for a moment; the object goes over within it.
    share = np.clip((time_s - meet_s) / 0.2 + 0.5, 0, 1)[:, None]
    share = _ease(share)
    turn = (1 - share) * giver.quaternion + share * taker.quaternion * np.sign(
        np.sum(giver.quaternion * taker.quaternion, axis=1, keepdims=True) + 1e-12
    )
    position = (1 - share) * giver.position_m + share * taker.position_m
    stage.object(model, Poses(position, turn / np.linalg.norm(turn, axis=1, keepdims=True)))
    return stage.filmed("an object is handed over", look_at_m=(place[0], 0.8 * place[1], 1.1))


def put_down(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "meeting_room",
    kind: str = "bottle",
    speed_m_s: float = 1.0,
) -> Filmed:
    """A person waves an object, puts it down on a stand, and takes the hand away: it stays there."""
    stage = _Set(make_room(room, rng), duration_s)
    (place,) = _holders(stage.room, rng, 1, (1.9, 2.5))
    camera = stage.room.camera_position_m
    walk = _standing(place, _facing(place, camera), stage.steps)
    time_s = np.arange(stage.steps) * STEP_S
    down_s = 0.6 * duration_s
    waved = _waved(walk, -1, rng, duration_s, speed_m_s, 0.5)
    spot, aside = hold(walk, (0.42, -0.3, 0.95)), hold(walk, (0.12, -0.34, 0.85))
    # Down to the spot, a moment of rest there, then back to the side.
    lower = smooth_step(np.clip((time_s - down_s + 0.8) / 0.8, 0, 1))[:, None]
    leave = smooth_step(np.clip((time_s - down_s - 0.2) / 0.6, 0, 1))[:, None]
    hands = Hands(right=(1 - leave) * ((1 - lower) * waved + lower * spot) + leave * aside)
    person, model = make_person(rng), make_object(kind, rng)
    held = carried(stage.person(person, walk, hands).right_hand, model.grip_m)
    release = min(int(np.ceil((down_s + 0.1) / STEP_S)), stage.steps - 1)
    index = np.minimum(np.arange(stage.steps), release)
    stage.object(model, Poses(held.position_m[index], held.quaternion[index]))
    x, y, z = held.position_m[release]
    top = z - model.half_size_m[2]
    wood = Material((0.45, 0.32, 0.2), "stripes", 25.0, 0.25, transmission_db=2.0)
    stand = Shape("box", (0.16, 0.16, float(top) / 2), wood)
    stage.bodies.append(Body("stand", (stand,), Poses.fixed((x, y, top / 2)), "furniture"))
    return stage.filmed("an object is put down", look_at_m=(place[0], 0.8 * place[1], 1.0))


def tabletop(
    rng: np.random.Generator,
    duration_s: float,
    *,
    num_objects: int = 4,
    kind: str = "train",
    speed_m_s: Sequence[float] = (0.25, 0.5),
    tracks: str = "loops",
    num_tunnels: int = 0,
    spacing_m: float = 0.164,
    antenna: str = "ceiling",
) -> Filmed:
    """Toy trains on a table top of 1.5 x 3 m, seen from the ceiling.

    `tracks`: "loops" (rounded closed tracks, one each), "parallel" (straight lines `spacing_m` apart, the same motion),
    "curves" (open curves over the table). Trains disappear under `num_tunnels` for a while. `antenna`: "ceiling"
    beside the camera, or "side", at the table's edge and height.
    """
    if tracks not in ("loops", "parallel", "curves"):
        raise ValueError(f"tracks is {tracks!r}; expected loops, parallel or curves.")
    if antenna not in ("ceiling", "side"):
        raise ValueError(f"antenna is {antenna!r}; expected ceiling or side.")
    stage = _Set(make_room("ceiling_view", rng), duration_s)
    table = stage.room.tables[0]
    time_s = np.arange(stage.steps) * STEP_S
    lines = _track_lines(tracks, num_objects, table.top_m, time_s, rng, (speed_m_s[0], speed_m_s[1]), spacing_m)
    for line in lines:
        model = make_object(kind, rng)
        velocity = np.gradient(line, axis=0)
        yaw = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
        z = np.full(stage.steps, table.height_m + model.half_size_m[2])
        stage.object(model, Poses(np.column_stack([line, z]), turn_about(_UP, yaw)))
    roof = Material((0.35, 0.3, 0.28), "speckle", 30.0, 0.3, transmission_db=1.0)
    for number in range(num_tunnels):
        line = lines[number % len(lines)]
        x, y = line[int(rng.uniform(0.3, 0.7) * len(line))]
        size = (0.14, 0.16, 0.006)
        shape = Shape("box", size, roof)
        stage.bodies.append(Body("tunnel", (shape,), Poses.fixed((x, y, table.height_m + 0.2)), "furniture"))
    filmed = stage.filmed(f"{num_objects} trains on {tracks}")
    if antenna == "side":
        place = (table.top_m[2] + 0.4, float(rng.uniform(-0.4, 0.4)), table.height_m + 0.1)
        filmed = dataclasses.replace(filmed, antennas_m=(place,))
    return filmed


def _track_lines(kind, count, top_m, time_s, rng, speed_m_s, spacing_m) -> list[np.ndarray]:
    """Paths (steps, 2) on the table top."""
    x0, y0, x1, y1 = top_m
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    lines = []
    if kind == "parallel":
        pace = rng.uniform(*speed_m_s)
        swing = 0.5 * (y1 - y0) - 0.25
        along = swing * np.sin(pace / swing * time_s + rng.uniform(-0.5, 0.5))
        for number in range(count):
            across = (number - (count - 1) / 2) * spacing_m
            lines.append(np.stack([np.full_like(along, middle[0] + across), middle[1] + along], axis=-1))
        return lines
    for number in range(count):
        if kind == "loops":
            # Tracks beside each other along the table, each with its own oval.
            span = (y1 - y0) / count
            centre = np.array([middle[0], y0 + span * (number + 0.5)])
            radius = np.array([rng.uniform(0.3, 0.55), span / 2 - 0.13])
            if min(radius) < 0.08:
                raise ValueError(f"{count} loops do not fit a table of {y1 - y0:.1f} m; ask for fewer.")
            turn = rng.choice([-1, 1]) * rng.uniform(*speed_m_s) / np.mean(radius)
            angle = rng.uniform(0, 2 * np.pi) + turn * time_s
            lines.append(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        else:
            low, high = np.array([x0 + 0.15, y0 + 0.15]), np.array([x1 - 0.15, y1 - 0.15])
            points = [np.array([*rng.uniform(low, high), 0.0])]
            while len(points) < 12:
                point = np.array([*rng.uniform(low, high), 0.0])
                if np.linalg.norm(point - points[-1]) > 0.5:
                    points.append(point)
            path = path_through(points, speed_m_s=rng.uniform(*speed_m_s), max_acceleration_m_s2=1.0)[:, :2]
            lines.append(np.clip(_fit(path, len(time_s)), low - 0.1, high + 0.1))
    return lines


def shop_exit(
    rng: np.random.Generator,
    duration_s: float,
    *,
    num_people: int = 1,
    tags_each: int = 1,
    num_still_tags: int = 0,
    stay_share: float = 0.5,
) -> Filmed:
    """People with tagged things walk about a shop of 3 x 7 m; each leaves through the exit, or stays (`stay_share`)."""
    stage = _Set(make_room("shop_floor", rng), duration_s)
    room = stage.room
    x0, _, x1, _ = room.walk_area_m
    lanes = np.linspace(-0.5, 0.5, num_people) if num_people > 1 else [0.0]
    for lane in lanes:
        points = [(rng.uniform(x1 - 1.2, x1), lane, 0.0)]
        leaves = rng.random() >= stay_share
        inner = rng.uniform(3.2, 4.2)
        points.append((inner, lane + rng.uniform(-0.15, 0.15), 0.0))
        points.append((x0 - 0.9 if leaves else rng.uniform(x1 - 1.5, x1 - 0.3), lane, 0.0))
        path = path_through(points, speed_m_s=rng.uniform(0.7, 1.2), max_acceleration_m_s2=2.0)
        walk = _trimmed(walk_along(still_then_move(path, rng.uniform(0.0, 1.0))), stage.steps)
        person = make_person(rng)
        hands = Hands(
            right=hold(walk, (0.2, -0.28, 0.95)), left=hold(walk, (0.2, 0.28, 0.95)) if tags_each > 1 else None
        )
        motion = stage.person(person, walk, hands)
        for number in range(tags_each):
            model = make_object(str(rng.choice(["bag", "box", "bottle", "toy"])), rng, scale=0.8)
            hand = (motion.right_hand, motion.left_hand)[number % 2]
            pose = carried(hand, model.grip_m)
            lift = 0.22 * (number // 2)
            stage.object(model, Poses(pose.position_m + np.array([0.0, 0.0, lift]), pose.quaternion))
    _still_tags(stage, rng, num_still_tags)
    return stage.filmed(
        f"{num_people} people, {tags_each} tags each, {num_still_tags} still", num_antennas=3, rounds_per_antenna=2
    )


def grid(
    rng: np.random.Generator, duration_s: float, *, spacing_m: float = 0.5, height_m: float = 1.0, rest_s: float = 2.0
) -> Filmed:
    """A tag on a stand that rests at each point of a grid on the shop floor in turn: for antenna calibration."""
    stage = _Set(make_room("shop_floor", rng), duration_s)
    x0, y0, x1, y1 = stage.room.walk_area_m
    points = [
        (x, y)
        for row, x in enumerate(np.arange(x0, x1 + 1e-9, spacing_m))
        for y in (np.arange(y0, y1 + 1e-9, spacing_m)[:: 1 if row % 2 == 0 else -1])
    ]
    model = make_object("box", rng, scale=0.5)
    path, pause = [], num_steps(rest_s)
    for number, (x, y) in enumerate(points):
        path += [(x, y)] * pause
        if number + 1 < len(points):
            share = np.linspace(0, 1, 51)[1:-1, None]
            smooth = _ease(share)
            path += list((1 - smooth) * np.array([x, y]) + smooth * np.array(points[number + 1]))
    line = _fit(np.array(path), stage.steps)
    place = np.column_stack([line, np.full(stage.steps, height_m)])
    stage.object(model, Poses(place, np.broadcast_to([1.0, 0.0, 0.0, 0.0], (stage.steps, 4)).copy()))
    return stage.filmed("a tag rests at each point of a grid", num_antennas=3, rounds_per_antenna=2)


STORIES: Mapping[str, Callable[..., Filmed]] = {
    "handheld": handheld,
    "approach": approach,
    "crowd": crowd,
    "handover": handover,
    "put_down": put_down,
    "tabletop": tabletop,
    "shop_exit": shop_exit,
    "grid": grid,
}
"""What can be told, by name."""


def tell(name: str, rng: np.random.Generator, duration_s: float, settings: Mapping[str, Any] | None = None) -> Filmed:
    """The story of a name with its settings; an unknown name or setting raises `ValueError`."""
    if name not in STORIES:
        raise ValueError(f"Unknown story {name!r}; known are {', '.join(STORIES)}.")
    if not duration_s > 0:
        raise ValueError(f"A story of {duration_s} s; a positive duration is needed.")
    known = list(inspect.signature(STORIES[name]).parameters)[2:]
    unknown = sorted(set(settings or {}) - set(known))
    if unknown:
        raise ValueError(f"{name}: unknown setting {', '.join(unknown)}; known are {', '.join(known)}.")
    return STORIES[name](rng, duration_s, **(settings or {}))
