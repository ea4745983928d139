"""Objects, people, paths and rooms of simulated worlds, against closed forms and bodies' limits."""

import dataclasses

import numpy as np
import pytest

from tagjax.sim.world import trajectory, walks
from tagjax.sim.world.bodies import STEP_S, World, rotation_matrix
from tagjax.sim.world.crowd import BODY_RADIUS_M, distance_to
from tagjax.sim.world.objects import OBJECT_KINDS, bounds, make_object
from tagjax.sim.world.people import Hands, carried_poses, hand_target, limb_bodies, make_person, move_person
from tagjax.sim.world.rooms import ROOMS, make_room
from tagjax.sim.world.rotation import frame, multiply, quaternion_of, turn_about


def straight(speed, length=6.0):
    return walks.walk_along(
        trajectory.path_through([[0, 0, 0], [length, 0, 0]], speed_m_s=speed, max_acceleration_m_s2=1.5)
    )


def test_quaternions_of_matrices_and_products():
    rng = np.random.default_rng(0)
    up, ahead = rng.normal(size=(2, 200, 3))
    matrix = frame(up, ahead)
    np.testing.assert_allclose(np.linalg.det(matrix), 1.0, atol=1e-12)
    np.testing.assert_allclose(rotation_matrix(quaternion_of(matrix)), matrix, atol=1e-12)
    a, b = quaternion_of(matrix), turn_about((0.0, 0.0, 1.0), rng.uniform(-3, 3, 200))
    np.testing.assert_allclose(rotation_matrix(multiply(a, b)), matrix @ rotation_matrix(b), atol=1e-12)


@pytest.mark.parametrize("seed", range(12))
def test_path_keeps_its_bounds_and_passes_its_points(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2, 2, (int(rng.integers(2, 7)), 3))
    speed, acceleration = rng.uniform(0.2, 3), rng.uniform(0.5, 10)
    path = trajectory.path_through(points, speed_m_s=speed, max_acceleration_m_s2=acceleration)
    assert trajectory.max_speed(path) <= speed * 1.001
    assert trajectory.max_acceleration(path) <= acceleration
    assert max(np.linalg.norm(path - point, axis=-1).min() for point in points) <= 0.5 * speed * STEP_S + 1e-3
    np.testing.assert_allclose(path[[0, -1]], points[[0, -1]], atol=1e-9)


def test_straight_path_is_a_trapezium():
    path = trajectory.path_through([[0, 0, 0], [3, 4, 0]], speed_m_s=1.25, max_acceleration_m_s2=2.0)
    assert trajectory.max_speed(path) == pytest.approx(1.25, rel=1e-6)
    # 1.5 m/s^2 (0.75 of the bound) up and down: length / speed + speed / acceleration.
    assert (len(path) - 1) * STEP_S == pytest.approx(5 / 1.25 + 1.25 / 1.5, abs=2 * STEP_S)


def test_timed_path_passes_its_points_in_time_or_is_refused():
    points, times = [[0, 0, 1], [0.5, 0.2, 1], [1.0, 0, 1.2]], [0, 1.0, 2.0]
    path = trajectory.path_through(points, times_s=times, max_acceleration_m_s2=4.0)
    np.testing.assert_allclose(path[[0, 100, 200]], points, atol=1e-9)
    with pytest.raises(ValueError, match="Multiply them"):
        trajectory.path_through(points, times_s=[0, 0.2, 0.4], max_acceleration_m_s2=4.0)


@pytest.mark.parametrize("kind", ["line", "circle", "eight", "random"])
@pytest.mark.parametrize("speed", [0.3, 1.0, 2.5])
def test_wave_has_the_given_peak_speed_and_zero_speed_at_both_ends(kind, speed):
    path = trajectory.wave(kind, (1, 2, 1), 6.0, peak_speed_m_s=speed, rng=np.random.default_rng(3))
    assert trajectory.max_speed(path) == pytest.approx(speed, rel=1e-9)
    assert trajectory.max_acceleration(path) <= 12.0
    np.testing.assert_allclose(path[[0, 1, -2, -1]], np.broadcast_to([1, 2, 1], (4, 3)), atol=1e-4)


def test_impossible_motions_are_refused():
    with pytest.raises(ValueError, match="Lower the speed"):
        trajectory.wave("line", (0, 0, 0), 5.0, peak_speed_m_s=2.5, amplitude_m=0.1)
    with pytest.raises(ValueError, match="same"):
        trajectory.path_through([[0, 0, 0], [0, 0, 0]], speed_m_s=1.0)
    with pytest.raises(ValueError, match="from the end of the previous one"):
        trajectory.join(trajectory.stay_at((0, 0, 0), 1.0), trajectory.stay_at((1, 0, 0), 1.0))
    with pytest.raises(ValueError, match="expected at most duration_s"):
        trajectory.wait_then_move(trajectory.stay_at((0, 0, 0), 2.0), 1.0, 2.0)


@pytest.mark.parametrize("speed", [0.5, 2.5])
def test_wait_then_move(speed):
    run = trajectory.path_through([[0, 0, 1], [3, 0, 1]], speed_m_s=speed, max_acceleration_m_s2=6.0)
    path = trajectory.wait_then_move(run, 1.5, 10.0)
    assert len(path) == trajectory.num_steps(10.0)
    assert trajectory.max_speed(path[:151]) == 0
    assert trajectory.max_speed(path) == pytest.approx(speed, rel=1e-3)
    assert trajectory.max_acceleration(path) <= 6.0


@pytest.mark.parametrize("name", ["meeting_room", "office", "shop_floor"])
def test_walkers_keep_their_distance_to_each_other_and_to_furniture(name):
    rng = np.random.default_rng(5)
    room = make_room(name, rng)
    num = 2 if name == "shop_floor" else 3
    people = walks.random_walks(
        num, 8.0, rng, area_m=room.walk_area_m, obstacles_m=room.obstacles_m, door=room.door, num_door=bool(room.door)
    )
    place = np.stack([walk.position_m for walk in people], axis=1)
    gap = np.linalg.norm(place[:, :, None] - place[:, None], axis=-1)[:, ~np.eye(num, dtype=bool)]
    assert gap.min() >= 0.6
    assert min(distance_to(box, place)[0].min() for box in room.obstacles_m) > BODY_RADIUS_M - 0.06
    for walk in people:
        assert trajectory.max_acceleration(walk.position_m) <= walks.MAX_ACCELERATION_M_S2 + 1e-9
        assert 0.3 < trajectory.max_speed(walk.position_m) <= 1.4 + 1e-9
    if room.door is not None:
        np.testing.assert_allclose(place[0, 0], room.door.outside_m[0])
        x0, y0, x1, y1 = room.walk_area_m
        assert np.any(np.all((place[:, 0] > [x0, y0]) & (place[:, 0] < [x1, y1]), axis=-1))


def test_walkers_without_room_are_refused():
    with pytest.raises(ValueError, match="No free place"):
        walks.random_walks(9, 1.0, np.random.default_rng(0), area_m=(0.0, 0.0, 1.0, 1.0))
    with pytest.raises(ValueError, match="num_door is 1"):
        walks.random_walks(2, 1.0, np.random.default_rng(0), area_m=(0.0, 0.0, 4.0, 4.0), num_door=1)


@pytest.mark.parametrize("speed", [0.5, 1.3, 2.0])
def test_standing_feet_do_not_slide_and_legs_stay_connected(speed):
    model = make_person(np.random.default_rng(1))
    walk = straight(speed)
    person = move_person(model, walk)
    assert person.slip_m_s < 0.02 * speed
    m = model.measures
    for side in ("left", "right"):
        ankle, knee = person.limbs[f"{side} foot"].position_m, person.limbs[f"{side} thigh"].position_m
        # The shin's frame sits at the ankle: the foot hangs on it, and its bones keep their lengths.
        np.testing.assert_allclose(person.limbs[f"{side} shin"].position_m, ankle, atol=2e-3)
        np.testing.assert_allclose(np.linalg.norm(knee - ankle, axis=-1), m.shin, atol=2e-3)
        assert ankle[:, 2].min() > 0.9 * m.ankle
        assert trajectory.max_speed(ankle) < 5 * speed + 1.0
        slowest = np.linalg.norm(np.diff(ankle, axis=0), axis=-1).min()
        assert slowest < 1e-9
    hips = person.limbs["hips"].position_m
    np.testing.assert_allclose(hips[:, :2], walk.position_m)
    assert hips[:, 2].min() > 0.8 * m.hip_height


def test_feet_end_side_by_side_after_a_walk():
    model = make_person(np.random.default_rng(1), height_m=1.75)
    path = trajectory.wait_then_move(trajectory.path_through([[0, 0, 0], [2, 0, 0]], speed_m_s=1.0), 0.5, 6.0)
    limbs = move_person(model, walks.walk_along(path)).limbs
    for side, sign in (("left", 1), ("right", -1)):
        np.testing.assert_allclose(
            limbs[f"{side} foot"].position_m[-1], [2, sign * model.measures.hip, model.measures.ankle], atol=0.04
        )


def test_hands_reach_targets_within_the_arms_length_only():
    model = make_person(np.random.default_rng(2), height_m=1.75)
    walk = straight(1.0)
    near, far = hand_target(walk, (0.35, -0.2, 1.2), 1.0, 4.0), hand_target(walk, (1.5, 0.3, 1.4), 2.0, 3.0)
    person = move_person(model, walk, Hands(left=far, right=near))
    asked = np.isfinite(near[:, 0])
    assert np.linalg.norm(person.right_hand.position_m - near, axis=-1)[asked].max() < 1e-3
    for side, hand in (("left", person.left_hand), ("right", person.right_hand)):
        arm = np.linalg.norm(hand.position_m - person.shoulder_m[side], axis=-1)
        assert arm.max() <= model.arm_m
        elbow = person.limbs[f"{side} upper arm"].position_m
        np.testing.assert_allclose(
            np.linalg.norm(elbow - person.shoulder_m[side], axis=-1), model.measures.upper_arm, atol=1e-6
        )
        np.testing.assert_allclose(np.linalg.norm(elbow - hand.position_m, axis=-1), model.measures.forearm, atol=1e-6)
        # Blended within 0.3 s: fast, but no jump.
        assert trajectory.max_speed(hand.position_m) < 8.0
    stretched = np.isfinite(far[:, 0])
    arm = np.linalg.norm(person.left_hand.position_m - person.shoulder_m["left"], axis=-1)
    assert arm[stretched].min() > 0.99 * model.arm_m


def test_arms_swing_against_the_legs():
    limbs = move_person(make_person(np.random.default_rng(3)), straight(1.2)).limbs
    middle = slice(150, 450)
    base = limbs["hips"].position_m[middle, 0]
    hand, foot = (limbs[name].position_m[middle, 0] - base for name in ("left hand", "right foot"))
    assert np.corrcoef(hand, foot)[0, 1] > 0.8
    assert np.ptp(hand) > 0.15


@pytest.mark.parametrize("style", ["upright", "fist", "hand"])
def test_carried_object_stays_in_the_hand(style):
    model = make_person(np.random.default_rng(4))
    walk = straight(1.0)
    hands = Hands(right=hand_target(walk, (0.3, -0.2, 1.1)))
    hand, item = move_person(model, walk, hands).right_hand, make_object("bottle", np.random.default_rng(0))
    poses = carried_poses(hand, item.grip_m, style)
    turn = rotation_matrix(poses.quaternion)
    np.testing.assert_allclose(poses.position_m + turn @ np.array(item.grip_m), hand.position_m, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(poses.quaternion, axis=-1), 1, atol=1e-12)
    assert np.abs(np.diff(poses.quaternion, axis=0)).max() < 0.1
    if style == "upright":
        np.testing.assert_allclose(turn[:, :, 2], np.broadcast_to([0, 0, 1], (len(turn), 3)), atol=1e-12)
        assert turn[:, 0, 0].min() > 0.5  # the front stays ahead


def test_limb_bodies_make_a_world():
    rng = np.random.default_rng(6)
    walk = walks.random_walks(1, 6.0, rng, area_m=(1.0, -1.5, 5.0, 1.5))[0]
    model = make_person(rng)
    bodies = limb_bodies(model, move_person(model, walk), label=3, name="ann")
    assert len(bodies) == 15
    assert {(body.name, body.label, body.role) for body in bodies} == {("ann", 3, "person")}
    World(bodies, (), len(walk.heading_rad), (6.0, 5.0, 2.8)).check()
    for body in bodies:
        assert np.isfinite(body.poses.quaternion).all()
        np.testing.assert_allclose(np.linalg.norm(body.poses.quaternion, axis=-1), 1, atol=1e-9)
        assert np.sum(body.poses.quaternion[1:] * body.poses.quaternion[:-1], axis=-1).min() > 0.9
        low = min(bounds(body.shapes)[0][2], 0.0)
        assert body.poses.position_m[:, 2].min() + low > -0.5
    trunk = [body for body in bodies if body.shapes[0].material.transmission_db >= 15]
    assert len(trunk) >= 1


@pytest.mark.parametrize("kind", OBJECT_KINDS)
def test_tags_lie_on_the_surface_and_equal_looks_give_equal_objects(kind):
    first = make_object(kind, np.random.default_rng(1), look=7)
    assert first == make_object(kind, np.random.default_rng(2), look=7)
    assert first != make_object(kind, np.random.default_rng(1), look=8)
    assert make_object(kind, np.random.default_rng(1)) == make_object(kind, np.random.default_rng(1))
    low, high = bounds(first.shapes)
    np.testing.assert_allclose(high, first.half_size_m, atol=1e-9)
    np.testing.assert_allclose(low, -np.array(first.half_size_m), atol=1e-9)
    assert 0.03 < max(first.half_size_m) < 0.6
    assert np.linalg.norm(first.dipole) == pytest.approx(1)
    # The tag is outside all shapes, and near one.
    distance = min(_outside(shape, np.array(first.tag_m)) for shape in first.shapes)
    assert 0 < distance < 0.012
    assert np.all(np.abs(first.grip_m) <= np.array(first.half_size_m) + 1e-9)
    double = make_object(kind, np.random.default_rng(1), look=7, scale=2.0)
    np.testing.assert_allclose(double.half_size_m, 2 * np.array(first.half_size_m))


def _outside(shape, point):
    """A distance from a shape, exact for boxes and round ones, a bound by the shortest axis for ellipsoids."""
    local = rotation_matrix(np.array(shape.quaternion)).T @ (point - np.array(shape.position_m))
    a, b, c = shape.size_m
    if shape.kind == "box":
        away = np.abs(local) - [a, b, c]
        return np.linalg.norm(np.maximum(away, 0)) + min(away.max(), 0)
    if shape.kind == "sphere":
        return np.linalg.norm(local) - a
    if shape.kind == "ellipsoid":
        return (np.linalg.norm(local / [a, b, c]) - 1) * min(a, b, c)
    away = np.array([np.hypot(*local[:2]) - a, abs(local[2]) - b])
    return np.linalg.norm(np.maximum(away, 0)) + min(away.max(), 0)


@pytest.mark.parametrize("name", ROOMS)
@pytest.mark.parametrize("seed", range(6))
def test_rooms_are_within_their_size_and_have_free_places(name, seed):
    room = make_room(name, np.random.default_rng(seed))
    length, width, height = room.size_m
    World(room.bodies, (), 1, room.size_m).check()
    for body in room.bodies:
        low, high = bounds(body.shapes)
        turn = rotation_matrix(body.poses.quaternion[0])
        reach = np.abs(turn) @ ((high - low) / 2)
        middle = body.poses.position_m[0] + turn @ ((high + low) / 2)
        assert np.all(middle - reach > [-1.0, -width / 2 - 0.2, -0.2])
        assert np.all(middle + reach < [length + 0.2, width / 2 + 0.2, height + 0.2])
        if body.role == "furniture":
            assert middle[2] - reach[2] >= -1e-9
    rng = np.random.default_rng(0)
    for _ in range(5):
        place = np.array(room.free_place(rng))
        assert min((distance_to(box, place)[0] for box in room.obstacles_m), default=1.0) >= 0.35
    for panel in room.panels:
        assert np.dot(panel.normal, panel.along) == 0
        assert np.linalg.norm(panel.normal) == pytest.approx(1)
    for point in (room.camera_position_m, *room.antennas_m, *(light.position_m for light in room.lights)):
        assert -0.5 <= point[0] <= length
        assert abs(point[1]) < width / 2
        assert 0 < point[2] < height


def test_people_behind_the_partition_are_invisible():
    for seed in range(6):
        room = make_room("meeting_room", np.random.default_rng(seed))
        screen = next(body for body in room.bodies if body.name == "screen")
        half, middle = screen.shapes[0].size_m, screen.poses.position_m[0]
        camera = np.array(room.camera_position_m)
        for outside in room.door.outside_m:
            for aside in (-0.25, 0.25):
                person = np.array([outside[0], outside[1] + aside, 1.0])
                share = (middle[0] - camera[0]) / (person[0] - camera[0])
                crossing = camera + share * (person - camera)
                assert abs(crossing[1] - middle[1]) < half[1]


def test_equal_seeds_give_equal_worlds():
    def draw(seed):
        rng = np.random.default_rng(seed)
        room = make_room("office", rng)
        people = walks.random_walks(2, 3.0, rng, area_m=room.walk_area_m, obstacles_m=room.obstacles_m)
        person = make_person(rng)
        return room, [w.position_m for w in people], person, limb_bodies(person, move_person(person, people[0]))

    (room, people, person, bodies), (room_2, people_2, person_2, bodies_2) = draw(3), draw(3)
    assert [b.shapes for b in room.bodies] == [b.shapes for b in room_2.bodies]
    assert dataclasses.replace(room, bodies=()) == dataclasses.replace(room_2, bodies=())
    assert person == person_2
    np.testing.assert_array_equal(people, people_2)
    for body, body_2 in zip(bodies, bodies_2, strict=True):
        np.testing.assert_array_equal(body.poses.quaternion, body_2.poses.quaternion)
    assert draw(4)[2] != person


def test_unknown_names_are_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="expected one of"):
        make_object("piano", rng)
    with pytest.raises(ValueError, match="expected one of"):
        make_room("attic", rng)
    with pytest.raises(ValueError, match=r"0\.9 to 2\.2"):
        make_person(rng, height_m=3.0)
    with pytest.raises(ValueError, match="steps"):
        move_person(make_person(rng), straight(1.0), Hands(left=np.zeros((3, 3))))
