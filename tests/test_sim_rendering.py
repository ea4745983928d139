"""Ray casting, shading, depth sensors and exact flow, against closed forms, stated laws and brute force."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from tagjax.recording import Intrinsics
from tagjax.sim.rendering import textures
from tagjax.sim.rendering.exact_flow import flow_between
from tagjax.sim.rendering.exposure import GAMMA, ILLUMINATION, auto_exposure
from tagjax.sim.rendering.raycast import Raycaster
from tagjax.sim.rendering.sensors import SENSORS, KinectV2, Xtion, frame_times, kinect_v2_intrinsics, xtion_intrinsics
from tagjax.sim.rendering.shading import Shader
from tagjax.sim.rendering.viewpoint import look_at
from tagjax.sim.world.bodies import Body, Light, Material, Poses, Shape, World
from tagjax.sim.world.sightline import chord_m, line_of_sight

GREY = Material((0.5, 0.5, 0.5), "plain")
CAMERA = Intrinsics(140.0, 140.0, 63.5, 47.5, 128, 96)
AHEAD = look_at(CAMERA, [0.0, 0.0, 1.0], [1.0, 0.0, 1.0])
STILL_Q = (1.0, 0.0, 0.0, 0.0)


def part(kind, size, material=GREY, position=(0.0, 0.0, 0.0), quaternion=STILL_Q):
    return Shape(kind, tuple(float(s) for s in size), material, position, quaternion)


def body(name, kind, size, poses, material=GREY, **kwargs):
    poses = poses if isinstance(poses, Poses) else Poses.fixed(poses)
    return Body(name, (part(kind, size, material),), poses, **kwargs)


def world(*bodies, num_steps=1, **kwargs):
    return World(tuple(bodies), (), num_steps, (8.0, 8.0, 4.0), **kwargs)


def wall(distance_m, material=GREY):
    """A wall across the view, `distance_m` away."""
    return body("wall", "box", (0.1, 9, 9), (distance_m + 0.1, 0, 1), material)


def turned(degrees, axis=(0, 0, 1)):
    half = np.radians(degrees) / 2
    return np.concatenate([[np.cos(half)], np.sin(half) * np.asarray(axis) / np.linalg.norm(axis)])


def moving(positions, quaternions=None):
    positions = np.asarray(positions, float)
    return Poses(positions, np.tile(STILL_Q, (len(positions), 1)) if quaternions is None else np.asarray(quaternions))


def rays(view):
    """World direction of every pixel with z = 1 along the camera's axis, (height, width, 3)."""
    k = view.intrinsics
    x, y = np.meshgrid(np.arange(k.width), np.arange(k.height))
    flat = np.stack([(x - k.cx_px) / k.fx_px, (y - k.cy_px) / k.fy_px, np.ones(x.shape)], axis=-1)
    return flat @ view.rotation.T


def project(view, points):
    camera = view.to_camera(points)
    k = view.intrinsics
    return np.stack(
        [k.fx_px * camera[..., 0] / camera[..., 2] + k.cx_px, k.fy_px * camera[..., 1] / camera[..., 2] + k.cy_px], -1
    )


def office():
    """A small busy world: walls, a table, two walkers' limbs and a turning box."""
    t = np.linspace(0, 1, 40)
    walk = np.stack([2.6 + 0 * t, -0.5 + 0.8 * t, 0.9 + 0 * t], -1)
    other = np.stack([3.3 - 0.3 * t, 0.5 - 0.5 * t, 1.0 + 0 * t], -1)
    noise = Material((0.6, 0.4, 0.3), "noise", scale=9.0, contrast=0.4, seed=3)
    return world(
        wall(5.0, Material((0.7, 0.7, 0.6), "noise", contrast=0.3)),
        body("floor", "box", (5, 5, 0.1), (2, 0, -0.1), Material((0.4, 0.4, 0.5), "stripes", scale=3.0)),
        body("table", "box", (0.4, 0.5, 0.3), (3.8, 0.9, 0.3), noise, role="furniture"),
        body("ann", "capsule", (0.2, 0.3, 0), moving(walk), noise, role="person", label=1),
        body("bob", "capsule", (0.2, 0.3, 0), moving(other), noise, role="person", label=2),
        body(
            "box",
            "box",
            (0.15, 0.1, 0.2),
            moving(np.stack([2.2 + 0 * t, 0.3 * t, 1.3 - 0.2 * t], -1), [turned(60 * s, (1, 1, 3)) for s in t]),
            Material((0.8, 0.2, 0.2), "checker", scale=20.0, contrast=0.6),
            role="object",
            label=3,
        ),
        num_steps=40,
        lights=(Light((1.0, 0.5, 2.8)),),
    )


# --- casting ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moves", [False, True])
def test_depth_of_a_sphere_a_plane_and_a_turned_box(moves):
    def placed(position, quaternion=STILL_Q):
        rows = 3 if moves else 1
        return Poses(np.tile(np.asarray(position, float), (rows, 1)), np.tile(quaternion, (rows, 1)))

    view = look_at(CAMERA, [0.0, 0.2, 1.4], [3.0, 0.0, 0.8])
    direction = rays(view)
    away = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    centre, radius = np.array([2.5, 0.1, 1.0]), 0.4
    hits = Raycaster(world(body("ball", "sphere", (radius, 0, 0), placed(centre)), num_steps=3)).cast(view)
    along = np.sum(away * (centre - view.position_m), axis=-1)
    root = radius**2 - (np.sum((centre - view.position_m) ** 2) - along**2)
    expected = (along - np.sqrt(np.maximum(root, 0))) / np.linalg.norm(direction, axis=-1)
    assert np.mean((root > 0) == (hits.geom >= 0)) > 0.9999
    inside = root > 1e-4
    np.testing.assert_allclose(hits.depth_m[inside], expected[inside], atol=1e-6)
    normal = (hits.world_m - centre) / radius
    np.testing.assert_allclose(hits.normal[inside], normal[inside], atol=1e-5)

    hits = Raycaster(world(body("floor", "box", (9, 9, 0.5), placed((0, 0, -0.5))), num_steps=3)).cast(view)
    down = direction[..., 2] < -0.16
    np.testing.assert_allclose(hits.depth_m[down], (-view.position_m[2] / direction[..., 2])[down], atol=1e-6)

    quaternion, half = turned(37, (1, 2, 3)), np.array([0.3, 0.5, 0.2])
    hits = Raycaster(world(body("box", "box", half, placed(centre, quaternion)), num_steps=3)).cast(view)
    face = np.abs(np.abs(hits.local_m) - half) < 1e-6
    on = hits.geom >= 0
    assert on.sum() > 500
    assert np.all(np.any(face[on], axis=-1))
    reached = view.position_m + direction * hits.depth_m[..., None]
    np.testing.assert_allclose(reached[hits.geom >= 0], hits.world_m[hits.geom >= 0], atol=1e-6)


def test_casting_does_not_depend_on_what_was_cast_before():
    raycaster, fresh = Raycaster(office()), Raycaster(office())
    for step in (30, 0, 12):
        raycaster.pose(step)
        late = raycaster.cast(AHEAD)
    fresh.pose(12)
    early = fresh.cast(AHEAD)
    np.testing.assert_array_equal(late.geom, early.geom)
    np.testing.assert_array_equal(late.depth_m, early.depth_m)
    assert set(np.unique(raycaster.labels(late))) == {0, 1, 2, 3}
    whole, _, _ = raycaster._shoot(AHEAD.position_m, raycaster._background(AHEAD)[0], None)
    np.testing.assert_array_equal(whole.reshape(late.geom.shape), late.geom)


def test_half_a_step_is_halfway():
    raycaster = Raycaster(world(body("a", "sphere", (0.2, 0, 0), moving([[2, 0, 1], [2, 0.4, 1]])), num_steps=2))
    raycaster.pose(0.5)
    np.testing.assert_allclose(raycaster.cast(AHEAD).geom_position_m[0], [2, 0.2, 1])


def test_cameras():
    view = look_at(CAMERA, [0.3, -0.2, 2.0], [2.0, 0.5, 0.4])
    np.testing.assert_allclose(project(view, np.array([2.0, 0.5, 0.4])), [CAMERA.cx_px, CAMERA.cy_px], atol=1e-9)
    # Up in the world is up in the picture, left is left.
    assert project(view, np.array([2.0, 0.5, 0.6]))[1] < CAMERA.cy_px
    assert project(view, np.array([1.0, 0.6, 1.0]))[0] < project(view, np.array([1.0, -0.6, 1.0]))[0]
    above = look_at(CAMERA, [1.0, 0.0, 3.0], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(above.rotation @ above.rotation.T, np.eye(3), atol=1e-12)
    assert project(above, np.array([1.5, 0.0, 0.0]))[1] < CAMERA.cy_px
    with pytest.raises(ValueError, match="two different points"):
        look_at(CAMERA, [1.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    for k, width, height in ((kinect_v2_intrinsics(), 70.0, 60.0), (xtion_intrinsics(), 62.0, 48.4)):
        assert abs(2 * np.degrees(np.arctan(k.width / 2 / k.fx_px)) - width) < 1
        assert abs(2 * np.degrees(np.arctan(k.height / 2 / k.fy_px)) - height) < 1
    assert (kinect_v2_intrinsics(256).width, kinect_v2_intrinsics(256).height) == (256, 212)


# --- lines of sight --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        ("box", (0.3, 0.2, 0.5)),
        ("sphere", (0.4, 0, 0)),
        ("ellipsoid", (0.3, 0.2, 0.5)),
        ("cylinder", (0.3, 0.4, 0)),
        ("capsule", (0.2, 0.4, 0)),
    ],
)
def test_chords_agree_with_mujoco(kind, size):
    """MuJoCo's way in from one end and from the other."""
    rng = np.random.default_rng(1)
    shape = part(kind, size, position=(0.1, -0.2, 0.3), quaternion=tuple(float(q) for q in turned(50, (1, 2, -1))))
    start = rng.normal(size=(300, 3)) * 0.4 + [3, 0, 0]
    end = rng.normal(size=(300, 3)) * 0.4 - [3, 0, 0]
    raycaster = Raycaster(world(Body("a", (shape,), Poses.fixed((0, 0, 0)))))
    length = np.linalg.norm(end - start, axis=1)
    expected = np.zeros(300)
    for number, (one, two) in enumerate(zip(start, end, strict=True)):
        ray = ((two - one) / length[number])[None]
        geom, near, _ = raycaster._shoot(one, ray, None)
        _, far, _ = raycaster._shoot(two, -ray, None)
        expected[number] = length[number] - near[0] - far[0] if geom[0] >= 0 else 0
    assert 20 < np.sum(expected > 0.01) < 300
    np.testing.assert_allclose(chord_m(shape, start, end), expected, atol=1e-6)


def test_lines_of_sight_are_blocked_dimmed_or_free():
    flesh = Material((0.7, 0.5, 0.4), transmission_db=12.0)
    metal = Material((0.7, 0.7, 0.7), reflection=-1.0, transmission_db=3.0)
    walk = moving([[2, -2, 1], [2, 0, 1]])
    scene = world(
        body("ann", "capsule", (0.2, 0.3, 0), walk, flesh, role="person"),
        body("ann", "sphere", (0.1, 0, 0), moving([[2.3, -2, 1], [2.3, 0, 1]]), flesh, role="person"),
        body("bob", "sphere", (0.2, 0, 0), (3, 0, 1), flesh, role="person"),
        body("cabinet", "box", (0.2, 0.2, 0.2), (4, 0, 1), metal),
        num_steps=2,
    )
    start = np.tile([0.0, 0.0, 1.0], (5, 1))
    end = np.array([[2.7, 0, 1], [2.7, 0, 1], [3.5, 0, 1], [5, 0, 1], [3.5, 2.0, 1]])
    sight = line_of_sight(scene, start, end, np.array([0, 1, 1, 0, 1]))
    np.testing.assert_array_equal(sight.loss_db, [0, 12, 24, np.inf, 0])
    np.testing.assert_array_equal(sight.crossed[2], [True, True, True, False])
    np.testing.assert_allclose(sight.inside_m[1], [0.4, 0.2, 0, 0], atol=1e-9)
    late = np.ones(1)
    np.testing.assert_array_equal(line_of_sight(scene, start[:1], end[:1], late).loss_db, [12])
    np.testing.assert_array_equal(line_of_sight(scene, start[:1], end[:1], late, exclude=(0, 1)).loss_db, [0])
    # Up to the surface, not into it.
    assert line_of_sight(scene, start[:1], np.array([[1.8, 0, 1]]), late).loss_db[0] == 0


# --- light -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moves", [False, True])
def test_shadow_is_where_geometry_says(moves):
    light, centre, radius = np.array([1.5, 0.3, 3.0]), np.array([2.2, 0.0, 1.0]), 0.3
    ball = moving([centre, centre]) if moves else Poses.fixed(centre)
    raycaster = Raycaster(
        world(
            body("floor", "box", (9, 9, 0.5), (0, 0, -0.5)),
            body("ball", "sphere", (radius, 0, 0), ball),
            num_steps=2,
            lights=(Light(tuple(float(x) for x in light)),),
        )
    )
    hits = raycaster.cast(look_at(CAMERA, [0.0, 0.0, 2.0], [2.5, 0.0, 0.2]))
    lit = raycaster.lit(hits, light)
    floor = hits.geom == np.flatnonzero([shape.kind == "box" for shape in raycaster.geom_shape])[0]
    ray = hits.world_m - light
    away = np.linalg.norm(ray, axis=-1)
    along = np.clip(np.sum(ray * (centre - light), axis=-1) / away**2, 0, 1)
    gap = np.linalg.norm(light + along[..., None] * ray - centre, axis=-1)
    assert np.sum(floor & (gap < radius)) > 200
    np.testing.assert_array_equal(lit[floor], (gap >= radius)[floor])
    shader = Shader(raycaster)
    bright, flat = shader.radiance(hits), shader.radiance(hits, shadows=False)
    assert np.all(bright[floor & ~lit] < 0.8 * flat[floor & ~lit])
    np.testing.assert_array_equal(bright[floor & lit], flat[floor & lit])


def test_bodies_that_move_under_a_table_do_not_shade_its_top():
    """Nor the floor on which it stands: both touch."""
    raycaster = Raycaster(
        world(
            body("floor", "box", (9, 9, 0.5), (0, 0, -0.5)),
            body("top", "box", (0.5, 0.5, 0.02), (2.5, 0, 0.5)),
            body("ball", "sphere", (0.2, 0, 0), moving([[2.5, 0, 0.2]] * 2)),
            num_steps=2,
            lights=(Light((2.4, 0.1, 3.0)),),
        )
    )
    hits = raycaster.cast(look_at(CAMERA, [0.0, 0.0, 2.0], [2.5, 0.0, 0.4]))
    top = np.abs(hits.world_m[..., 2] - 0.52) < 1e-6
    assert top.sum() > 500
    assert raycaster.lit(hits, raycaster.world.lights[0].position_m)[top].all()


def test_light_decreases_with_the_cosine_and_the_square_of_distance():
    """Lambert on a white floor under a lamp, and full light at 2 m from a lamp of power 1."""
    white = Material((0.9, 0.9, 0.9), "plain")
    floor = body("floor", "box", (9, 9, 0.5), (0, 0, -0.5), white)
    raycaster = Raycaster(world(floor, lights=(Light((1.0, 0.0, 2.0)),), ambient=0.0))
    hits = raycaster.cast(look_at(CAMERA, [1.0, 0.0, 1.9], [1.0, 0.0, 0.0]))
    radiance = Shader(raycaster).radiance(hits)
    away = np.linalg.norm(hits.world_m - [1, 0, 2], axis=-1)
    np.testing.assert_allclose(radiance[..., 1], 0.9 * (4.09 / (away**2 + 0.09)) * 2 / away, rtol=1e-4)
    assert abs(radiance.max() - 0.9) < 1e-3


def test_highlights_lie_where_the_lamp_is_reflected():
    glossy = Material((0.1, 0.1, 0.1), "plain", shine=0.8)
    raycaster = Raycaster(world(wall(3.0, glossy), lights=(Light((0.0, 0.6, 1.0)),), ambient=0.1))
    hits = raycaster.cast(AHEAD)
    radiance = Shader(raycaster).radiance(hits)[..., 0]
    row, column = np.unravel_index(np.argmax(radiance), radiance.shape)
    np.testing.assert_allclose(hits.world_m[row, column], [3, 0.3, 1], atol=0.06)
    assert radiance.max() > 3 * np.median(radiance)


def test_three_levels_of_light():
    raycaster = Raycaster(office())
    hits = raycaster.cast(AHEAD)
    radiance = Shader(raycaster).radiance(hits)
    rng = np.random.default_rng(0)
    exposure = auto_exposure(radiance)
    assert abs(np.quantile(radiance * exposure, 0.95) - 0.8) < 0.05
    mean = {name: level.expose(radiance, rng, exposure=exposure).mean() for name, level in ILLUMINATION.items()}
    assert 110 < mean["bright"] < 220
    assert 0.5 < mean["dim"] / mean["bright"] < 0.85
    assert 0.25 < mean["dark"] / mean["bright"] < 0.6
    # Signal to noise of a grey wall: good, fair, poor.
    snr = {
        name: 0.4 * level.light * level.gain / level.noise(np.full(1, 0.4))[0] for name, level in ILLUMINATION.items()
    }
    assert snr["bright"] > 40 > snr["dim"] > 15 > snr["dark"] > 4


@pytest.mark.parametrize("name", ["bright", "dim", "dark"])
def test_colour_noise_follows_its_model(name):
    level = ILLUMINATION[name]
    flat = np.full((200, 200, 3), 0.45, np.float32)
    picture = level.expose(flat, np.random.default_rng(1))
    linear = (picture / 255.0) ** GAMMA
    np.testing.assert_allclose(linear.mean(), 0.45 * level.light * level.gain, rtol=0.03)
    np.testing.assert_allclose(linear.std(), level.noise(np.full(1, 0.45))[0], rtol=0.06)


def test_motion_blur_is_proportional_to_speed():
    """An edge that moves 1.2 m/s x 0.05 s at 2 m leaves a ramp of 4 px; static surfaces stay sharp."""
    speed = np.stack([np.full(41, 1.9), np.linspace(-0.6, -0.12, 41), np.full(41, 1.0)], -1)
    white = Material((0.9, 0.9, 0.9), "plain")
    board = body("board", "box", (0.01, 0.3, 0.3), moving(speed), white)
    raycaster = Raycaster(
        world(board, wall(6.0, Material((0.0, 0.0, 0.0), "plain")), num_steps=41, ambient=1.0, lights=())
    )
    shader = Shader(raycaster)
    sharp = shader.blurred(AHEAD, 20, 0.0, num_casts=3)[48, :, 1]
    soft = shader.blurred(AHEAD, 20, 5.0, num_casts=16)[48, :, 1]
    partial = [np.sum((row > 0.02 * row.max()) & (row < 0.98 * row.max())) for row in (sharp, soft)]
    assert partial[0] == 0
    expected = 140 * 0.06 / 1.89
    assert abs(partial[1] / 2 - expected) <= 1
    np.testing.assert_allclose(soft.sum(), sharp.sum(), rtol=0.02)
    assert raycaster.step == 20


# --- textures --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("texture", ["noise", "checker", "stripes", "speckle", "photo"])
def test_textures_move_with_their_body(texture):
    """A board moved sideways by seven pixels, and one upside down, look the same there."""
    if texture == "photo" and textures.photograph("hopper") is None:
        pytest.skip("matplotlib's sample pictures are not installed")
    scale = 0.5 if texture == "photo" else 9.0
    material = Material((0.5, 0.4, 0.3), texture, scale=scale, contrast=0.5, photo="hopper", seed=4)
    shift = 7 * 1.99 / 140
    poses = moving(
        [[2, 0, 1], [2, -shift, 1], [2, 0, 1]], [turned(0), turned(0), turned(180, (1, 0, 0))]
    )  # +x away, so -y is right
    raycaster = Raycaster(world(body("board", "box", (0.01, 0.45, 0.35), poses, material), num_steps=3))
    shader = Shader(raycaster)
    looks = []
    for step in range(3):
        raycaster.pose(step)
        looks.append(shader.surface(raycaster.cast(AHEAD)).albedo[30:66, 40:80])
    assert looks[0].std() > 0.05
    np.testing.assert_allclose(looks[1][:, 7:], looks[0][:, :-7], atol=0.02)
    assert np.mean(np.abs(looks[1] - looks[0])) > 0.02
    np.testing.assert_allclose(looks[2][::-1, ::-1][:, :-8], looks[0][:, 8:], atol=0.02)


def test_each_face_of_a_turned_box_has_its_own_picture():
    """A pattern laid on by the wrong axis would be stretched into lines."""
    checker = Material((0.5, 0.5, 0.5), "checker", scale=9.0, contrast=0.8)
    raycaster = Raycaster(
        world(
            body("a", "box", (0.4, 0.4, 0.4), moving([[2, 0, 1]] * 2, [turned(90), turned(90, (0, 1, 0))]), checker),
            num_steps=2,
        )
    )
    for step in range(2):
        raycaster.pose(step)
        albedo = Shader(raycaster).surface(raycaster.cast(AHEAD)).albedo[30:66, 46:82, 0]
        assert np.median(np.std(albedo, axis=1)) > 0.2
        assert np.median(np.std(albedo, axis=0)) > 0.2


def test_seeds_and_contrast_change_a_texture():
    def look(**kwargs):
        raycaster = Raycaster(world(wall(3.0, Material((0.5, 0.5, 0.5), **kwargs))))
        return Shader(raycaster).surface(raycaster.cast(AHEAD)).albedo

    np.testing.assert_array_equal(look(seed=1), look(seed=1))
    assert np.mean(np.abs(look(seed=1) - look(seed=2))) > 0.02
    np.testing.assert_allclose(look(contrast=0.0), 0.5, atol=1e-6)
    # Cells far smaller than a pixel come out grey, not as flicker.
    assert look(texture="checker", scale=400.0, contrast=0.8).std() < 1e-3


def test_missing_photographs_give_a_warning(monkeypatch):
    monkeypatch.setitem(textures.PHOTOGRAPHS, "absent", ("no_such_package", "a.jpg"))
    material = Material((0.5, 0.5, 0.5), "photo", photo="absent", contrast=0.5)
    raycaster = Raycaster(world(wall(3.0, material)))
    with pytest.warns(UserWarning, match="no_such_package"):
        shader = Shader(raycaster)
    assert shader.surface(raycaster.cast(AHEAD)).albedo.std() > 0.02
    with pytest.raises(ValueError, match="hopper"):
        textures.photograph("nobody")


# --- depth sensors ---------------------------------------------------------------------------------------------------


def flat_depth(sensor, distance_m, reflectance=0.5, shine=0.0, seed=0):
    hits = Raycaster(world(wall(distance_m))).cast(AHEAD)
    shape = hits.depth_m.shape
    depth = sensor.measure(
        hits, np.full(shape, reflectance, np.float32), np.full(shape, shine, np.float32), np.random.default_rng(seed)
    )
    return depth[30:66, 40:88] / 1000.0


@pytest.mark.parametrize("distance_m", [1.0, 2.5, 3.5])
@pytest.mark.parametrize("name", ["kinect_v2", "xtion"])
def test_depth_noise_follows_its_model(name, distance_m):
    sensor = SENSORS[name]
    depth = flat_depth(sensor, distance_m)
    found = depth[depth > 0]
    assert len(found) > 0.98 * depth.size
    # Frontal, so the angle of incidence is under 20 degrees and adds little.
    extra = (np.full(1, 0.5),) if name == "kinect_v2" else ()
    law = sensor.noise_m(np.full(1, distance_m), np.full(1, np.cos(np.radians(8))), *extra)[0]
    np.testing.assert_allclose(np.std(found), law, rtol=0.12)
    assert abs(np.median(found) - distance_m) < 0.5 * law + 0.5 * distance_m**2 / 348 + 0.001


def test_noise_models_have_their_published_values():
    """Fankhauser et al. at 4 m, and at 2 m and 60 degrees; Nguyen et al. at 3 m."""
    half = np.full(1, 0.5)
    np.testing.assert_allclose(KinectV2().noise_m(np.full(1, 4.0), np.ones(1), half), 4.3e-3, rtol=1e-3)
    slanted = 1.5 - 1.0 + 1.2 + 0.1 * 2**1.5 * 4
    np.testing.assert_allclose(KinectV2().noise_m(np.full(1, 2.0), half, half), slanted * 1e-3, rtol=1e-3)
    np.testing.assert_allclose(Xtion().noise_m(np.full(1, 3.0), np.ones(1)), 14.04e-3, rtol=1e-3)


@pytest.mark.parametrize("name", ["kinect_v2", "xtion"])
def test_a_slope_is_no_edge(name):
    raycaster = Raycaster(world(body("floor", "box", (20, 20, 0.5), (0, 0, -0.5))))
    hits = raycaster.cast(look_at(CAMERA, [0.0, 0.0, 0.8], [3.0, 0.0, 0.0]))
    shape, sensor = hits.depth_m.shape, SENSORS[name]
    bright = np.full(shape, 0.5, np.float32)
    depth = sensor.measure(hits, bright, np.zeros(shape, np.float32), np.random.default_rng(0)) / 1000.0
    extra = (bright,) if name == "kinect_v2" else ()
    sigma = sensor.noise_m(hits.depth_m, hits.facing(), *extra)
    some = (depth > 0) & (hits.depth_m > 1) & (hits.depth_m < 3.2)
    assert some.sum() > 3000
    assert np.mean(np.abs(depth - hits.depth_m)[some] < 4.5 * sigma[some] + 0.001) > 0.999


def test_xtion_quantises_disparity_and_kinect_does_not():
    depth = flat_depth(Xtion(), 3.0)
    levels = np.unique(depth[depth > 0])
    steps = 8 * 580 * 0.075
    np.testing.assert_allclose(levels, steps / np.rint(steps / levels), atol=6e-4)
    np.testing.assert_allclose(np.diff(levels).min(), 3.0**2 / steps, rtol=0.1)
    fine = flat_depth(KinectV2(), 3.0)
    assert len(np.unique(fine)) > len(levels)


def test_dark_far_shiny_and_near_surfaces_have_no_depth():
    for sensor in (KinectV2(), Xtion()):
        missing = {
            case: np.mean(flat_depth(sensor, *case) == 0)
            for case in ((3.0, 0.5), (5.0, 0.06), (9.5, 0.9), (0.4, 0.5), (1.5, 0.06))
        }
        assert missing[3.0, 0.5] < 0.01
        assert missing[1.5, 0.06] < 0.02
        for case in ((5.0, 0.06), (9.5, 0.9), (0.4, 0.5)):
            assert missing[case] > 0.8
        assert np.mean(flat_depth(sensor, 2.0, 0.5, 0.9) == 0) > 0.5
    kinect = KinectV2(dropout=0.0)
    darker, lighter = (np.std(flat_depth(kinect, 2.0, reflectance)) for reflectance in (0.3, 0.9))
    assert darker > 1.2 * lighter


@pytest.mark.parametrize("name", ["kinect_v2", "xtion"])
def test_grazing_surfaces_have_no_depth(name):
    """A floor from 1 m up, and from 0.15 m up: hardly any return at the same distance."""
    shares = []
    for height in (1.5, 0.12):
        raycaster = Raycaster(world(body("floor", "box", (20, 20, 0.5), (0, 0, -0.5))))
        hits = raycaster.cast(look_at(CAMERA, [0.0, 0.0, height], [3.0, 0.0, 0.0]))
        shape = hits.depth_m.shape
        depth = SENSORS[name].measure(
            hits, np.full(shape, 0.5, np.float32), np.zeros(shape, np.float32), np.random.default_rng(0)
        )
        near = (hits.depth_m > 1.5) & (hits.depth_m < 3.5)
        shares.append(np.mean(depth[near] == 0))
    assert shares[0] < 0.05
    assert shares[1] > 0.8


def scene_with_an_edge(sensor, seed=0):
    raycaster = Raycaster(world(wall(3.0), body("board", "box", (0.01, 0.3, 2), (1.51, 0, 1))))
    hits = raycaster.cast(look_at(xtion_intrinsics(320), [0.0, 0.0, 1.0], [1.0, 0.0, 1.0]))
    shape = hits.depth_m.shape
    depth = sensor.measure(
        hits, np.full(shape, 0.5, np.float32), np.zeros(shape, np.float32), np.random.default_rng(seed)
    )
    return hits, depth


def test_xtion_has_a_shadow_as_wide_as_its_disparity():
    hits, depth = scene_with_an_edge(Xtion(dropout=0.0, edge_px=0.0))
    near = hits.depth_m[120] < 2
    left, right = np.flatnonzero(near)[[0, -1]]
    width = 267 * 0.075 * (1 / 1.5 - 1 / 3.0)
    assert abs(np.sum(depth[120, left - 30 : left] == 0) - width) <= 1
    assert np.all(depth[:, right + 2 : right + 30] > 0)


def test_kinect_has_flying_pixels_at_edges_only():
    hits, depth = scene_with_an_edge(KinectV2())
    flying = (depth > 1600) & (depth < 2850)
    columns = np.flatnonzero(flying.any(axis=0))
    near = np.flatnonzero(hits.depth_m[120] < 2)[[0, -1]]
    assert np.sum(flying) > 100
    assert np.all(np.min(np.abs(columns[:, None] - near), axis=1) <= 1)


def test_frame_times():
    rng = np.random.default_rng(0)
    times = frame_times(4000, 30.0, rng, jitter_s=0.004, drop_probability=0.1)
    assert times[0] == 0
    assert np.all(np.diff(times) > 0)
    np.testing.assert_allclose(np.mean(np.diff(times)), 1 / 30 / 0.9, rtol=0.02)
    even = frame_times(4000, 30.0, rng, jitter_s=0.002)
    np.testing.assert_allclose(np.std(even - np.arange(4000) / 30), 0.002, rtol=0.05)
    for bad in ({"num_frames": 0}, {"rate_hz": 0.0}, {"drop_probability": 1.0}, {"jitter_s": -1.0}):
        with pytest.raises(ValueError, match=r"needed|expected"):
            frame_times(**{"num_frames": 5, "rate_hz": 30.0, "rng": rng} | bad)


# --- flow ------------------------------------------------------------------------------------------------------------


def test_flow_of_a_body_that_moves_and_turns():
    """Points of a ball and of a box, found by hand, carried by the known motion and projected."""
    turn, shift = turned(20, (1, -1, 2)), np.array([0.1, 0.15, -0.08])
    for kind, size in (("sphere", (0.4, 0, 0)), ("box", (0.3, 0.3, 0.3))):
        centre = np.array([2.0, 0.0, 1.0])
        raycaster = Raycaster(
            world(
                body("a", kind, size, moving([centre, centre + shift], [turned(0), turn])),
                wall(4.0),
                num_steps=2,
            )
        )
        before = raycaster.cast(AHEAD)
        raycaster.pose(1)
        truth = flow_between(before, raycaster.cast(AHEAD))
        on = before.depth_m < 3
        points = AHEAD.position_m + rays(AHEAD) * before.depth_m[..., None] - centre
        w, axis = turn[0], turn[1:]
        spun = points + 2 * np.cross(axis, np.cross(axis, points) + w * points)
        column, row = np.meshgrid(np.arange(128), np.arange(96))
        expected = project(AHEAD, spun + centre + shift) - np.stack([column, row], -1)
        np.testing.assert_allclose(truth.forward_px[on], expected[on], atol=1e-4)
        assert np.abs(truth.forward_px[on]).max() > 5
        assert np.all(truth.forward_px[~on] == 0)


def test_flow_of_a_moved_camera():
    raycaster = Raycaster(office())
    before = raycaster.cast(AHEAD)
    other = look_at(CAMERA, [0.1, 0.05, 1.05], [1.1, 0.0, 1.0])
    truth = flow_between(before, raycaster.cast(other))
    column, row = np.meshgrid(np.arange(128), np.arange(96))
    hit = before.geom >= 0
    expected = project(other, before.world_m[hit]) - np.stack([column, row], -1)[hit]
    np.testing.assert_allclose(truth.forward_px[hit], expected, atol=1e-4)
    assert np.mean(truth.forward_occluded) < 0.2


@pytest.fixture(scope="module")
def pair():
    raycaster = Raycaster(office())
    raycaster.pose(10)
    before = raycaster.cast(AHEAD)
    raycaster.pose(15)
    after = raycaster.cast(AHEAD)
    return raycaster, before, after, flow_between(before, after)


def interior(hits, target, flow):
    """Pixels whose target lies among four pixels of one geom, the top left one, and the parts within it."""
    row, column = np.indices(hits.geom.shape)
    x, y = column + flow[..., 0], row + flow[..., 1]
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    height, width = hits.geom.shape
    fits = (left >= 0) & (left < width - 1) & (top >= 0) & (top < height - 1)
    left, top = np.clip(left, 0, width - 2), np.clip(top, 0, height - 2)
    for right, down in ((0, 0), (0, 1), (1, 0), (1, 1)):
        fits &= target.geom[top + down, left + right] == hits.geom
    return fits, left, top, (x - left)[..., None], (y - top)[..., None]


def sample(values, left, top, x, y):
    upper = values[top, left] * (1 - x) + values[top, left + 1] * x
    lower = values[top + 1, left] * (1 - x) + values[top + 1, left + 1] * x
    return upper * (1 - y) + lower * y


def test_forward_and_backward_flow_agree_where_visible(pair):
    _, before, after, truth = pair
    fits, *place = interior(before, after, truth.forward_px)
    fits &= ~truth.forward_occluded
    there = sample(truth.backward_px, *place)
    error = np.linalg.norm(truth.forward_px + there, axis=-1)[fits]
    moved = np.linalg.norm(truth.forward_px, axis=-1)[fits] > 1
    assert moved.sum() > 800
    assert np.quantile(error[moved], 0.95) < 0.1
    assert np.median(error[moved]) < 0.01


def test_warping_by_the_flow_reconstructs_the_first_picture(pair):
    raycaster, before, after, truth = pair
    shader = Shader(raycaster)
    one, two = shader.surface(before).albedo, shader.surface(after).albedo
    fits, *place = interior(before, after, truth.forward_px)
    moving_pixels = fits & ~truth.forward_occluded & before.moving
    warped = np.abs(sample(two, *place) - one)[moving_pixels].mean()
    unwarped = np.abs(two - one)[moving_pixels].mean()
    assert moving_pixels.sum() > 800
    assert warped < 0.015
    assert unwarped > 4 * warped


@pytest.mark.parametrize("forward", [True, False])
def test_occlusion_agrees_with_rays_to_the_moved_points(pair, forward):
    raycaster, before, after, truth = pair
    if not forward:
        raycaster.pose(10)
        before, after = after, before
    else:
        raycaster.pose(15)
    occluded = truth.forward_occluded if forward else truth.backward_occluded
    turn = after.geom_rotation[before.geom]
    world_m = np.einsum("hwij,hwj->hwi", turn, before.local_m) + after.geom_position_m[before.geom]
    ray = (world_m - AHEAD.position_m).reshape(-1, 3)
    away = np.linalg.norm(ray, axis=1)
    _, distance, _ = raycaster._shoot(AHEAD.position_m, ray / away[:, None], None)
    hidden = (distance < away - 1e-4).reshape(occluded.shape)
    assert hidden.sum() > 100
    # Only pixels on a rim may differ.
    assert np.mean(hidden != occluded) < 0.01
    assert np.sum(hidden & occluded) > 0.85 * hidden.sum()


def test_surfaces_that_turn_away_are_occluded():
    """A ball that spins in place: points that move to the far side are hidden, though the ball still covers the pixel."""
    raycaster = Raycaster(
        world(body("ball", "sphere", (0.5, 0, 0), moving([[2, 0, 1]] * 2, [turned(0), turned(50)])), num_steps=2)
    )
    before = raycaster.cast(AHEAD)
    raycaster.pose(1)
    truth = flow_between(before, raycaster.cast(AHEAD))
    on = before.geom >= 0
    place = np.array([2.0, 0.0, 1.0])
    c, s = np.cos(np.radians(50)), np.sin(np.radians(50))
    spun = (before.world_m - place) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    away = np.sum((spun + place - AHEAD.position_m) * spun, axis=-1) >= 0
    assert np.sum(on & away) > 300
    assert np.mean(truth.forward_occluded[on] == away[on]) > 0.98


def test_flow_needs_casts_of_one_world(pair):
    _, before, _, _ = pair
    other = Raycaster(world(wall(3.0))).cast(AHEAD)
    with pytest.raises(ValueError, match="one world"):
        flow_between(before, other)


def test_same_seed_same_pictures():
    def frame(seed):
        rng = np.random.default_rng(seed)
        raycaster = Raycaster(office())
        raycaster.pose(7)
        hits = raycaster.cast(AHEAD)
        shader = Shader(raycaster)
        surface = shader.surface(hits)
        colour = ILLUMINATION["dim"].expose(shader.radiance(hits, surface), rng)
        return colour, *(sensor.measure(hits, surface.reflectance, surface.shine, rng) for sensor in SENSORS.values())

    for one, same, other in zip(frame(0), frame(0), frame(1), strict=True):
        np.testing.assert_array_equal(one, same)
        assert np.any(one != other)
