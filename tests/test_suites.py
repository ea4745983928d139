"""Suites: every file under conf/suite is one, splits are apart, and runs resume and repeat exactly."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tagjax.core.settings import ConfigError, from_mapping
from tagjax.recording import RecordingError
from tagjax.recording.store import open_recording
from tagjax.sim.contact_sheet import save_sheet
from tagjax.sim.radio.planar import PlanarSettings, open_planar, planar_trials
from tagjax.sim.record import simulate_recording
from tagjax.sim.rendering.raycast import Raycaster
from tagjax.sim.rendering.sensors import kinect_v2_intrinsics
from tagjax.sim.rendering.viewpoint import look_at
from tagjax.sim.rendering.visibility import intervals, sampled_steps, visible_fraction
from tagjax.sim.stories import STORIES
from tagjax.sim.stories.shop import EXIT_X_M
from tagjax.sim.suites import MANIFEST, PLANAR, SPLITS, Counts, Suite, Variant, item_scenario, make_suite, prepare
from tagjax.sim.world.bodies import STEP_S, tag_dipole, tag_path
from tagjax.sim.world.objects import bounds

FILES = sorted((Path(__file__).parents[1] / "conf" / "suite").glob("*.yaml"))

SAME_WORLDS = {
    "multi_4_clear": "multi_4",
    "hopping_china": "single_static",
    "hopping_etsi": "single_static",
    "hopping_fixed": "single_static",
    "no_flips": "single_static",
}
"""Suites with the worlds and pictures of another one, so that scores are compared recording by recording."""

MIN_TEST_TAGS = 12
"""Fewest tags in a test split, over its recordings: one tag more or less identified is then at most 8 %."""


def _suite(path: Path) -> Suite:
    return from_mapping(Suite, yaml.safe_load(path.read_text()))


def _tiny(**changed) -> Suite:
    variants = (Variant("one", {"num_objects": 1}), Variant("two", {"num_objects": 2}))
    suite = Suite("tiny", "a test", "none", "tabletop", 5, variants=variants).smoke()
    return dataclasses.replace(suite, **{"duration_s": 0.8, **changed})


def _digest(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_file_is_a_suite(path):
    suite = _suite(path)
    assert suite.name == path.stem
    assert suite.about
    assert suite.story == PLANAR or suite.story in STORIES
    assert suite.items()
    for variant in suite.variants:
        dataclasses.replace(suite.capture, **variant.capture)


def test_the_documentation_lists_every_suite_with_its_counts():
    page = (FILES[0].parents[2] / "docs" / "benchmark.md").read_text()
    for path in FILES:
        suite = _suite(path)
        counts = [len(suite.variants) * count for count in dataclasses.astuple(suite.counts)]
        assert (
            f"| `{suite.name}` | {suite.about} | {len(suite.variants)} | {counts[0]} / {counts[1]} / {counts[2]} |"
            in page
        )
        if suite.name not in SAME_WORLDS:
            assert (FILES[0].parents[2] / "docs" / "benchmark" / f"{suite.name}.jpg").exists()


def test_no_two_recordings_share_a_seed():
    seeds = [item.seed for path in FILES if path.stem not in SAME_WORLDS for item in _suite(path).items()]
    assert len(set(seeds)) == len(seeds)
    assert {item.split for path in FILES for item in _suite(path).items()} == set(SPLITS)


def _named(name: str) -> Suite:
    return _suite(FILES[0].parent / f"{name}.yaml")


@pytest.mark.parametrize(("name", "base"), SAME_WORLDS.items())
def test_suites_of_the_same_worlds_have_the_same_seeds_in_the_same_splits(name, base):
    """No world of one split of either suite is in another split of the other: nothing is learned on a test world."""
    one, other = _named(name), _named(base)
    keys = [
        [(item.variant.name, item.split, item.number, item.seed) for item in suite.items()] for suite in (one, other)
    ]
    assert keys[0] == keys[1]
    assert (one.story, one.duration_s, one.capture) == (other.story, other.duration_s, other.capture)
    if name != "multi_4_clear":
        assert one.settings == other.settings
        assert one.variants == other.variants


@pytest.mark.parametrize(("name", "base"), SAME_WORLDS.items())
def test_worlds_are_the_same_recording_by_recording(name, base):
    """Bodies, poses, lights, camera, antennas; of `multi_4_clear` all but the tags, of the others all but the reader."""
    for item, original in zip(_named(name).items(), _named(base).items(), strict=True):
        if item.number > 0 or item.split == "validation":
            continue  # the seeds are the same
        one, other = item_scenario(item), item_scenario(original)
        for body, twin in zip(one.world.bodies, other.world.bodies, strict=True):
            assert (body.name, body.shapes, body.label, body.role) == (twin.name, twin.shapes, twin.label, twin.role)
            np.testing.assert_array_equal(body.poses.position_m, twin.poses.position_m)
            np.testing.assert_array_equal(body.poses.quaternion, twin.poses.quaternion)
        assert one.world.lights == other.world.lights
        assert one.panels == other.panels
        assert (one.camera_position_m, one.camera_look_at_m) == (other.camera_position_m, other.camera_look_at_m)
        assert one.antennas_m == other.antennas_m
        same_tags = one.world.tags == other.world.tags
        assert same_tags == (name != "multi_4_clear"), item.name
        assert (one.inventory == other.inventory) == (name == "multi_4_clear"), item.name


@pytest.mark.parametrize("variant", ["box", "toy"])
def test_recordings_of_other_readers_have_the_same_pictures_and_other_reads(variant):
    channels = {}
    pictures = []
    for name in ("single_static", "hopping_china", "hopping_etsi", "hopping_fixed", "no_flips"):
        suite = _named(name)
        item = next(item for item in suite.items() if (item.variant.name, item.split) == (variant, "train"))
        capture = dataclasses.replace(suite.capture, width=48, frame_rate_hz=2.0)
        recording = simulate_recording(item_scenario(item), capture, seed=item.seed, name=item.name)
        assert recording.truth is not None
        assert recording.truth.tag_position_m is not None
        pictures.append(
            (recording.colour, recording.depth, recording.time_ns, *recording.truth.tag_position_m.values())
        )
        reads = recording.reads
        assert set(np.unique(reads.carrier_hz)) <= set(reads.hop_table_hz)
        channels[name] = (len(reads.hop_table_hz), min(reads.hop_table_hz), max(reads.hop_table_hz))
        assert reads.pi_flips == (name != "no_flips")
        if name in ("hopping_etsi", "hopping_fixed"):
            assert len(np.unique(reads.carrier_hz)) <= (3 if name == "hopping_etsi" else 1)
        else:
            assert len(np.unique(reads.carrier_hz)) > 10
    for other in pictures[1:]:
        for one, same in zip(pictures[0], other, strict=True):
            np.testing.assert_array_equal(one, same)
    assert channels == {
        "single_static": (50, 902.75e6, 927.25e6),
        "hopping_china": (16, 920.625e6, 924.375e6),
        "hopping_etsi": (4, 865.7e6, 867.5e6),
        "hopping_fixed": (1, 920.625e6, 920.625e6),
        "no_flips": (50, 902.75e6, 927.25e6),
    }


def _view(scenario, suite: Suite):
    return look_at(suite.capture.intrinsics(), scenario.camera_position_m, scenario.camera_look_at_m)


def _bodies(scenario) -> dict[str, list[int]]:
    """Numbers of each person's limbs."""
    found: dict[str, list[int]] = {}
    for number, body in enumerate(scenario.world.bodies):
        if body.role == "person":
            found.setdefault(body.name, []).append(number)
    return found


def _speed(path_m: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(path_m, axis=0), axis=1) / STEP_S


@pytest.mark.ci
def test_every_train_has_the_number_of_traces_of_its_variant():
    """All items: intervals in which any point of the train is within the picture and not occluded by any body."""
    suite = _named("separated_traces")
    assert {variant.settings["num_traces"] for variant in suite.variants} == {2, 3, 4}
    for item in suite.items():
        scenario = item_scenario(item)
        looks = sampled_steps(scenario.world, 0.2)
        for tag in scenario.world.tags:
            seen = visible_fraction(scenario.world, (tag.body,), _view(scenario, suite), looks) > 0
            shown, hidden = intervals(seen), intervals(~seen)
            assert len(shown) == item.variant.settings["num_traces"], item.name
            assert seen[0]
            assert seen[-1]
            assert np.diff(shown).min() >= 2, item.name
            assert np.diff(hidden).min() >= 1, item.name


@pytest.mark.parametrize("variant", ["two", "four"])
def test_the_masks_appear_and_disappear_as_often(variant):
    suite = _named("separated_traces")
    item = next(item for item in suite.items() if item.split == "test" and item.variant.name == variant)
    scenario = item_scenario(item)
    capture = dataclasses.replace(suite.capture, width=96, frame_rate_hz=8.0)
    truth = simulate_recording(scenario, capture, seed=item.seed, name=item.name).truth
    assert truth is not None
    for label in (1, 2):
        shown = np.any(np.asarray(truth.labels) == label, axis=(1, 2))
        assert len(intervals(shown)) == item.variant.settings["num_traces"]
        np.testing.assert_array_equal(shown, truth.visible[label])


@pytest.mark.ci
def test_every_person_enters_and_leaves():
    """All items: no limb and no object is visible at either end; each person is visible in between."""
    suite = _named("enter_leave")
    for item in suite.items():
        scenario = item_scenario(item)
        world, view, looks = scenario.world, _view(scenario, suite), sampled_steps(scenario.world, 0.3)
        people = _bodies(scenario)
        assert len(people) == len(world.tags) == suite.settings["num_people"]
        for limbs, tag in zip(people.values(), world.tags, strict=True):
            seen = visible_fraction(world, (*limbs, tag.body), view, looks) > 0
            assert not seen[:2].any(), item.name
            assert not seen[-2:].any(), item.name
            assert seen.sum() * 0.3 > 3.0, item.name
            # Behind the wall at both ends, well before it between, through the opening each time.
            hips = world.bodies[limbs[0]].poses.position_m
            wall = next(body for body in world.bodies if body.name == "lintel")
            wall_m, opening_m = wall.poses.position_m[0], wall.shapes[0].size_m[1]
            ahead = hips[:, 0] < wall_m[0]
            assert not ahead[0]
            assert not ahead[-1]
            assert hips[:, 0].min() < wall_m[0] - 1.0
            crossings = np.flatnonzero(np.diff(ahead.astype(int)))
            assert len(crossings) == 2, item.name
            assert np.abs(hips[crossings, 1] - wall_m[1]).max() < opening_m - 0.2
        apart = [np.linalg.norm(world.bodies[a[0]].poses.position_m - world.bodies[b[0]].poses.position_m, axis=1)
                 for a, b in itertools.combinations(people.values(), 2)]  # fmt: skip
        assert min(gap.min() for gap in apart) > 0.5


def test_a_recording_of_a_door_starts_and_ends_empty():
    suite = _named("enter_leave")
    item = next(item for item in suite.items() if item.split == "test")
    scenario = item_scenario(item)
    raycaster = Raycaster(scenario.world)
    view = look_at(kinect_v2_intrinsics(96), scenario.camera_position_m, scenario.camera_look_at_m)
    roles = np.array([scenario.world.bodies[body].role for body in raycaster.geom_body])

    def shown(step: float) -> int:
        raycaster.pose(step)
        return int(np.sum(np.isin(roles[np.maximum(raycaster.cast(view).geom, 0)], ("person", "object"))))

    last = scenario.world.num_steps - 1
    assert [shown(0), shown(25), shown(last - 25), shown(last)] == [0, 0, 0, 0]
    assert shown(last // 2) > 50


def _shop_items(name: str, all_items: bool) -> list:
    items = _named(name).items()
    chosen = items if all_items else [item for item in items if item.split == "test" and item.number == 0]
    assert chosen, name
    return chosen


@pytest.mark.parametrize("all_items", [False, pytest.param(True, marks=pytest.mark.ci)])
def test_the_shop_agrees_with_the_paper(all_items):
    """The same shop always; level dipoles; static tags on a box near the exit; carried tags leave, or never come near it."""
    furniture: dict[str, set] = {}
    stayed = carried = 0
    for item in _shop_items("shop_exit", all_items):
        asked = {"num_static_tags": 0, "num_bystanders": 0, **item.suite.settings, **item.variant.settings}
        scenario = item_scenario(item)
        world, (exit_antenna, *_) = scenario.world, scenario.antennas_m
        assert exit_antenna[:2] == (EXIT_X_M, 0.0)
        assert len(scenario.antennas_m) == 3
        furniture.setdefault("shop", set()).add(
            tuple(np.round([body.poses.position_m[0] for body in world.bodies if body.role != "object" and not body.label
                            and body.role != "person" and body.name != "grey box"], 6).ravel())
        )  # fmt: skip
        assert all(tag.dipole[2] == 0 for tag in world.tags), item.name
        people = [world.bodies[limbs[0]].poses.position_m[:, :2] for limbs in _bodies(scenario).values()]
        assert len(people) == asked["num_people"] + asked["num_bystanders"]
        paths = [tag_path(world, tag) for tag in world.tags]
        still = [path[0] for path in paths if np.ptp(path, axis=0).max() < 0.01]
        moving = [path for path in paths if np.ptp(path, axis=0).max() >= 0.01]
        assert len(still) == asked["num_static_tags"]
        assert len(moving) == asked["num_people"] * asked["tags_each"]
        for place in still:
            assert 0.0 < place[0] - EXIT_X_M < asked["static_within_m"] + 0.3, item.name
            assert place[2] < 1.3
        for path in moving:
            stayed += path[:, 0].min() > EXIT_X_M + 0.3
            carried += 1
            # People who leave do so before the recording ends, and walks on for half a metre.
            assert path[:, 0].min() > EXIT_X_M + 0.3 or path[-1, 0] < EXIT_X_M - 0.5, item.name
        for path in people[asked["num_people"] :]:
            # A bystander comes near the exit's line and never beyond it.
            assert EXIT_X_M < path[:, 0].min() < EXIT_X_M + 1.9, item.name
            assert np.ptp(path[:, 0]) > 0.9
        for one, other in itertools.combinations(people, 2):
            assert np.linalg.norm(one - other, axis=1).min() > 0.6, item.name
        for box in (body for body in world.bodies if body.name == "grey box"):
            aside = np.abs(np.stack(people) - box.poses.position_m[0, :2]) - box.shapes[0].size_m[:2]
            assert np.max(aside, axis=-1).min() > 0.25, item.name
    assert len(furniture["shop"]) == 1
    assert not all_items or 0.1 < stayed / carried < 0.35


@pytest.mark.ci
def test_the_exits_antenna_reads_the_static_tags_all_the_time():
    """First recordings: at least one read by the exit's antenna in every second, of every tag on the box."""
    num_checked = 0
    for item in _shop_items("shop_exit", all_items=False):
        scenario = item_scenario(item)
        still = {tag.epc for tag in scenario.world.tags if np.ptp(tag_path(scenario.world, tag), axis=0).max() < 0.01}
        if not still:
            continue
        capture = dataclasses.replace(item.suite.capture, width=32, frame_rate_hz=2.0)
        reads = simulate_recording(scenario, capture, seed=item.seed, name=item.name).reads
        for epc in still:
            mine = (reads.epc == epc) & (reads.antenna == 1)
            second = np.unique(np.floor(reads.time_ns[mine] * 1e-9 - reads.time_ns[0] * 1e-9))
            assert len(second) > 0.8 * item.suite.duration_s, (item.name, epc)
            num_checked += 1
    assert num_checked > 0


@pytest.mark.parametrize("all_items", [False, pytest.param(True, marks=pytest.mark.ci)])
def test_an_object_is_handed_over_and_put_onto_a_box(all_items):
    """The first person holds it until they meet, then the second one, then it is stationary; both people leave."""
    for item in _shop_items("shop_handover", all_items):
        scenario = item_scenario(item)
        world = scenario.world
        (tag,) = world.tags
        assert tag.dipole[2] == 0
        path = tag_path(world, tag)
        one, other = (world.bodies[limbs[0]].poses.position_m for limbs in _bodies(scenario).values())
        near = [np.linalg.norm(path[:, :2] - person[:, :2], axis=1) for person in (one, other)]
        meet = int(0.25 * item.suite.duration_s / STEP_S)
        assert near[0][: meet - 20].max() < 0.6, item.name
        rest = int(np.argmax(np.all(np.abs(path - path[-1]) < 1e-6, axis=1)))
        assert near[1][meet + 20 : rest].max() < 0.85, item.name
        # Neither stands about with it: less than a second without a step, from when it is first moved on.
        start = int(np.argmax(np.linalg.norm(path - path[0], axis=1) > 0.05))
        carrier = np.where(np.arange(world.num_steps)[:, None] < meet, one, other)[start:rest, :2]
        pause = np.linalg.norm(np.diff(carrier, axis=0), axis=1) / STEP_S < 0.1
        pause[meet - start - 1 : meet - start + 1] = True  # from one person to the other is no step
        assert pause.mean() < 0.45, item.name
        assert _speed(path).max() < 3.0, item.name
        assert path[0, 0] < EXIT_X_M + 0.8 < EXIT_X_M + 2.1 < path[meet, 0] + 0.6 < EXIT_X_M + 4.2 < path[-1, 0] + 0.2
        assert rest * STEP_S < item.suite.duration_s - 6.0
        assert one[-1, 0] < EXIT_X_M - 0.8 > other[-1, 0]
        assert np.linalg.norm(one - other, axis=1).min() > 0.6, item.name


def test_the_grid_has_a_level_dipole_in_two_directions():
    scenario = item_scenario(_shop_items("shop_grid", all_items=False)[0])
    (tag,) = scenario.world.tags
    path, axis = tag_path(scenario.world, tag), tag_dipole(scenario.world, tag)
    np.testing.assert_allclose(axis[:, 2], 0, atol=1e-9)
    rests = np.all(np.abs(np.diff(path, axis=0)) < 1e-9, axis=1)
    places = np.unique(np.round(path[1:][rests][:, :2], 2), axis=0)
    assert len(places) == len(np.unique(places[:, 0])) * len(np.unique(places[:, 1])) > 40
    suite = _named("shop_grid")
    for place in places:
        here = np.flatnonzero(rests & np.all(np.abs(path[1:, :2] - place) < 0.01, axis=1))
        # The last one is kept to the end.
        here = here[: round(suite.settings["pause_s"] / STEP_S) - 1]
        along = np.abs(axis[1:][here, 0])
        assert 0.4 < along.mean() < 0.6
        np.testing.assert_allclose(along * (1 - along), 0, atol=1e-9)


@pytest.mark.parametrize(("name", "variant"), [("planar_tracks", "three"), ("shop_exit", "sp_mt_4")])
def test_objects_do_not_pass_through_each_other(name, variant):
    """All items: the bounding boxes of two objects, rotated about the vertical, never overlap."""
    items = [item for item in _named(name).items() if item.variant.name == variant]
    assert items
    for item in items:
        scenario = item_scenario(item)
        objects = [scenario.world.bodies[tag.body] for tag in scenario.world.tags]
        for one, other in itertools.combinations(objects, 2):
            (low, high), (bottom, top) = bounds(one.shapes), bounds(other.shapes)
            between = one.poses.position_m - other.poses.position_m
            across = (
                np.linalg.norm(between[:, :2], axis=1) - 0.5 * (high - low)[:2].min() - 0.5 * (top - bottom)[:2].min()
            )
            above = np.abs(between[:, 2]) - 0.5 * (high - low)[2] - 0.5 * (top - bottom)[2]
            assert np.maximum(across, above).min() > 0, (item.name, one.name, other.name)


@pytest.mark.ci
def test_people_walk_at_the_speed_of_the_suite():
    """All items: the given speed is reached and kept on the straight parts; the labelled object is the person, with a badge."""
    for item in (suite := _named("speed")).items():
        scenario = item_scenario(item)
        asked = item.variant.settings["speed_m_s"]
        limbs = [scenario.world.bodies[i] for i in next(iter(_bodies(scenario).values()))]
        assert {limb.label for limb in limbs} == {1}, item.name
        walker = _speed(limbs[0].poses.position_m[:, :2])
        (tag,) = scenario.world.tags
        assert scenario.world.bodies[tag.body] in limbs, item.name
        badge = tag_path(scenario.world, tag)
        assert walker.max() == pytest.approx(asked, rel=0.02), item.name
        assert np.mean(walker > 0.95 * asked) > 0.15, item.name
        assert np.percentile(walker, 75) > 0.75 * asked, item.name
        # Both ways: towards the sensor and away.
        rate = np.diff(np.linalg.norm(badge - np.array(scenario.camera_position_m), axis=1)) / STEP_S
        assert rate.min() < -0.7 * asked, item.name
        assert rate.max() > 0.6 * asked or suite.duration_s * asked < 3.5, item.name


def test_hands_wave_at_the_speed_of_the_suite():
    """All items: stationary for 2 s, then exactly the given peak speed within the acceleration bound."""
    suite = _named("velocity_threshold")
    assert sorted(variant.settings["speed_m_s"] for variant in suite.variants) == [0.5, 2.5]
    for item in suite.items():
        scenario = item_scenario(item)
        path = scenario.world.bodies[scenario.world.tags[0].body].poses.position_m
        asked, speed = item.variant.settings["speed_m_s"], _speed(path)
        assert speed[: round(1.9 / STEP_S)].max() < 0.05, item.name
        assert speed.max() == pytest.approx(asked, rel=0.03), item.name
        push = np.linalg.norm(np.diff(path, n=2, axis=0), axis=1).max() / STEP_S**2
        assert push < 1.1 * max(12.0, 5.5 * asked**2), item.name


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_suite_has_a_scenario_for_each_item_and_enough_tags_to_test(path):
    """The number of tags follows from a variant's settings, so the first recording of each, shortened, is enough."""
    suite = _suite(path)
    num_tests = suite.counts.test
    if suite.story == PLANAR:  # one tag in each recording
        assert num_tests >= MIN_TEST_TAGS
        return
    shorter_s = min(suite.duration_s, max(5.0, suite.smoke_s))
    suite = dataclasses.replace(suite, duration_s=shorter_s, counts=Counts(0, 0, 1))
    num_tags = 0
    for item in suite.items():
        world = item_scenario(item).world
        world.check()
        num_tags += num_tests * len(world.tags)
    assert num_tags >= MIN_TEST_TAGS, f"{num_tags} tags; raise counts.test of {path.name}"


@pytest.mark.parametrize("number", [0, 7, 19])
def test_trains_of_equal_phase_differ_by_half_a_wavelength_in_range(number):
    suite = _named("half_wavelength")
    item = next(item for item in suite.items() if item.split == "test" and item.number == number)
    capture = dataclasses.replace(suite.capture, width=32, frame_rate_hz=3.0)
    truth = simulate_recording(item_scenario(item), capture, seed=item.seed, name=item.name).truth
    assert truth is not None
    one, other = (np.asarray(range_m) for range_m in truth.tag_range_m.values())
    # Half a wavelength of the band's middle, 915 MHz, is 164 mm.
    assert np.abs(np.abs(one - other) - 0.164).max() < 0.01
    assert np.ptp(one) > 0.05


def test_a_preview_shows_the_worlds_of_the_suite():
    suite = _named("velocity_threshold")
    preview = suite.preview()
    first = [item for item in suite.items() if item.split == "test" and item.number == 0]
    assert [(item.name, item.seed) for item in preview.items()] == [(item.name, item.seed) for item in first]
    recording = simulate_recording(
        item_scenario(preview.items()[0]), dataclasses.replace(preview.capture, width=32), seed=1, name="x"
    )
    assert recording.num_frames == 6
    training = dataclasses.replace(_named("corpus"), counts=Counts(1, 0, 0))
    assert [item.split for item in training.preview().items()] == ["train"] * 10


def test_readers_and_stories_differ_by_variant():
    suite = _tiny(
        duration_s=2.0,
        reader={"region": "china", "flip_probability": 0.0},
        variants=(
            Variant("one", {"num_objects": 1}),
            Variant("two", {"num_objects": 2}, reader={"flip_probability": 0.12}),
            Variant("hand", {"stationary_s": 0.2}, story="handheld"),
        ),
    )
    one, two, hand = (item_scenario(item) for item in suite.items())
    assert [scenario.inventory.flip_probability for scenario in (one, two, hand)] == [0.0, 0.12, 0.0]
    assert {scenario.inventory.region for scenario in (one, two, hand)} == {"china"}
    assert not any(body.role == "person" for body in two.world.bodies)
    assert any(body.role == "person" for body in hand.world.bodies)


def test_a_killed_run_resumes_and_repeats_exactly(tmp_path):
    suite = _tiny()
    made = make_suite(suite, tmp_path / "a")
    assert [one.name for one in made] == ["tiny-one-test-0", "tiny-two-test-0"]
    whole = _digest(tmp_path / "a")
    # What a kill leaves: one recording finished, a half-written one beside it.
    first, second = (item.path(tmp_path / "b") for item in suite.items())
    prepare(suite, tmp_path / "b")
    (second.parent / f".{second.name}.0123.partial").mkdir(parents=True)
    first.parent.mkdir(exist_ok=True)
    (tmp_path / "a" / first.relative_to(tmp_path / "b")).rename(first)
    stamp = first.stat().st_mtime_ns
    assert [one.name for one in make_suite(suite, tmp_path / "b")] == ["tiny-two-test-0"]
    assert first.stat().st_mtime_ns == stamp
    assert _digest(tmp_path / "b") == whole
    assert make_suite(suite, tmp_path / "b") == []
    sheet = cv2.imread(str(save_sheet(suite, tmp_path / "b")))
    assert sheet is not None
    assert sheet.shape[1] > 6 * 190
    assert sheet.std() > 10
    recording = open_recording(second)
    assert recording.name == "tiny-two-test-0"
    assert recording.truth is not None
    assert len(recording.truth.tag_to_label) == 2


@pytest.mark.ci
def test_workers_change_nothing(tmp_path):
    make_suite(_tiny(), tmp_path / "one")
    make_suite(_tiny(), tmp_path / "two", workers=2)
    assert _digest(tmp_path / "one") == _digest(tmp_path / "two")


@pytest.mark.ci
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_suite_in_small(path, tmp_path):
    suite = _suite(path).smoke()
    assert len(make_suite(suite, tmp_path)) == len(suite.variants)
    for item in suite.items():
        if suite.story == PLANAR:
            open_planar(item.path(tmp_path))
        else:
            open_recording(item.path(tmp_path)).check()


def test_a_folder_with_other_contents_is_left_unchanged(tmp_path):
    home = tmp_path / "tiny"
    home.mkdir()
    (home / "thesis.txt").write_text("precious")
    with pytest.raises(RecordingError, match=r"has no readable suite\.json"):
        make_suite(_tiny(), tmp_path)
    assert [path.name for path in home.iterdir()] == ["thesis.txt"]
    (home / "thesis.txt").unlink()
    home.rmdir()
    prepare(_tiny(), tmp_path)
    with pytest.raises(RecordingError, match=r"other settings \(seed\)"):
        prepare(dataclasses.replace(_tiny(), seed=6), tmp_path)
    assert json.loads((home / MANIFEST).read_text())["seed"] == 5


def test_counts_of_a_suite_may_grow(tmp_path):
    few, more = (dataclasses.replace(_tiny(), counts=Counts(0, 0, number)) for number in (1, 3))
    for item in prepare(few, tmp_path):
        item.path(tmp_path).mkdir(parents=True)
    todo = prepare(more, tmp_path)
    assert {item.number for item in todo} == {1, 2}
    assert {(item.name, item.seed) for item in few.items()} < {(item.name, item.seed) for item in more.items()}
    assert json.loads((tmp_path / "tiny" / MANIFEST).read_text())["counts"]["test"] == 3
    assert prepare(few, tmp_path) == []


def test_impossible_suites_are_refused():
    given = {"name": "x", "about": "x", "paper": "x", "story": "juggle", "seed": 1}
    with pytest.raises(ConfigError, match="story is 'juggle'"):
        from_mapping(Suite, given)
    with pytest.raises(ConfigError, match="duration_s is 0"):
        from_mapping(Suite, {**given, "story": "handheld", "duration_s": 0.0})
    with pytest.raises(ConfigError, match="smoke_s 0"):
        from_mapping(Suite, {**given, "story": "handheld", "smoke_s": 0.0})
    with pytest.raises(ConfigError, match="unknown reader setting volume; expected settings among clock_drift_ppm"):
        from_mapping(Suite, {**given, "story": "handheld", "reader": {"volume": 3}})
    with pytest.raises(ConfigError, match="story is 'juggle'"):
        from_mapping(Suite, {**given, "story": "handheld", "variants": [{"name": "a", "story": "juggle"}]})
    with pytest.raises(ConfigError, match="unknown key 'durations'"):
        from_mapping(Suite, {**given, "durations": 3})
    full = Suite("x", "x", "x", "tabletop", 1, settings={"num_objects": 40}, counts=Counts(0, 0, 1))
    with pytest.raises(ValueError, match=r"x-all-test-0 .*draws failed.*do not fit"):
        item_scenario(full.items()[0])


def test_planar_trials_follow_the_geometry(tmp_path):
    """Without noise the phase is that of the true line, and of no other line: TagVision's Fig. 6."""
    trials = planar_trials(PlanarSettings(noise_rad=0.0, num_rounds=3), seed=1)
    assert trials.line_m[trials.true_line] == 0
    np.testing.assert_allclose(np.diff(trials.line_m), 0.006)
    assert (trials.line_m[0], trials.line_m[-1]) == pytest.approx((-0.3, 0.3))
    distance_m = np.hypot(trials.line_m[:, None, None] - 1.018, trials.sample_m)
    phasor = np.exp(1j * (trials.phase_rad - 4 * np.pi * trials.carrier_hz * distance_m / 299792458.0))
    np.testing.assert_allclose(np.angle(phasor[trials.true_line]), 0, atol=1e-9)
    largest_rad = np.abs(np.angle(phasor)).max(axis=(1, 2))
    assert np.all(np.delete(largest_rad, trials.true_line) > 0.19)
    suite = Suite("planar", "a test", "none", PLANAR, 2, counts=Counts(0, 0, 1), settings={"num_rounds": 2})
    make_suite(suite, tmp_path)
    stored = open_planar(suite.items()[0].path(tmp_path))
    np.testing.assert_array_equal(
        stored.phase_rad, planar_trials(PlanarSettings(num_rounds=2), seed=suite.items()[0].seed).phase_rad
    )
    with pytest.raises(RecordingError, match="no readable planar trials"):
        open_planar(tmp_path / "nothing")
    with pytest.raises(ValueError, match="at least 1, 2 and 1"):
        PlanarSettings(num_samples=1)
