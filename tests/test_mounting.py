"""Mounting of tags: clear of hands and of the object itself, on the front, vertical; nothing else of the object changes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tagjax.sim.stories import build_scenario
from tagjax.sim.world.mounting import front_m, mounted
from tagjax.sim.world.objects import OBJECT_KINDS, make_object
from tagjax.sim.world.sightline import chord_m


@pytest.mark.parametrize("kind", OBJECT_KINDS)
def test_a_clear_tag_is_vertical_on_the_front_and_free_ahead(kind):
    rng = np.random.default_rng(3)
    for _ in range(12):
        drawn = make_object(kind, rng)
        clear = mounted(drawn, "clear")
        assert clear.dipole == (0.0, 0.0, 1.0)
        assert dataclasses.replace(clear, tag_m=drawn.tag_m, dipole=drawn.dipole) == drawn
        x, y, z = clear.tag_m
        assert -0.001 < x - front_m(drawn, y, z) < 0.01
        tag = np.array([clear.tag_m])
        for away in ([1.5, 0.0, 0.0], [1.5, 0.3, 0.0], [1.5, -0.3, 0.3]):
            assert max(chord_m(shape, tag, tag + away)[0] for shape in drawn.shapes) < 1e-3
        assert mounted(drawn, "as_drawn") is drawn


def test_tags_on_the_front_stay_and_others_move_there():
    rng = np.random.default_rng(5)
    for kind in ("bottle", "box", "notebook", "bag"):
        drawn = make_object(kind, rng)
        assert mounted(drawn, "clear").tag_m == drawn.tag_m
    toys = [make_object("toy", rng) for _ in range(20)]
    bears = [toy for toy in toys if toy.tag_m[0] < -0.05]
    cars = [toy for toy in toys if toy.tag_m[2] > 0.05]
    assert len(bears) + len(cars) == 20
    assert min(len(bears), len(cars)) > 3
    for bear in bears:
        assert mounted(bear, "clear").tag_m[0] > 0
        assert mounted(bear, "clear").tag_m[2] == bear.tag_m[2]
    for car in cars:
        assert mounted(car, "clear").tag_m == pytest.approx((car.half_size_m[0] + 0.002, 0.0, 0.0), abs=0.001)


def test_the_mounting_changes_only_the_tags_of_a_world():
    """The same draws: bodies, poses, camera and reader are equal."""

    def built(mounting: str):
        return build_scenario(
            "handheld", np.random.default_rng(4), 2.0, {"kinds": ["toy", "box"], "mounting": mounting}
        )

    drawn, clear = built("as_drawn"), built("clear")
    assert [body.shapes for body in drawn.world.bodies] == [body.shapes for body in clear.world.bodies]
    for one, other in zip(drawn.world.bodies, clear.world.bodies, strict=True):
        np.testing.assert_array_equal(one.poses.position_m, other.poses.position_m)
        np.testing.assert_array_equal(one.poses.quaternion, other.poses.quaternion)
    assert drawn.inventory == clear.inventory
    assert drawn.camera_position_m == clear.camera_position_m
    assert drawn.world.tags[0] != clear.world.tags[0]


def test_an_unknown_mounting_is_refused():
    with pytest.raises(ValueError, match="mounting is 'hidden'; expected one of as_drawn, clear"):
        build_scenario("handheld", np.random.default_rng(4), 2.0, {"mounting": "hidden"})
