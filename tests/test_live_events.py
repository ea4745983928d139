"""Events of a stream: detection and loss with hysteresis in time, alarms in a region, tags that leave through it."""

from __future__ import annotations

import dataclasses
import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tagjax.core.settings import ConfigError, from_mapping
from tagjax.live.events import EventRules, Sighting, next_events
from tagjax.live.regions import Region, floor_axes, floor_place, in_polygon, polygon_area

EXIT = Region(name="exit", floor_m=((-1.0, 0.0), (1.0, 0.0), (1.0, 2.0), (-1.0, 2.0)), inside_s=0.2, outside_s=0.5)
RULES = EventRules(detected_s=0.3, lost_s=1.0, regions=(EXIT,))
STEP_NS = 100_000_000
INSIDE, OUTSIDE = (0.0, 0.4, 1.0), (0.0, 0.4, 3.0)


def seen(place: tuple[float, ...] = OUTSIDE, confidence: float = 0.9) -> Sighting:
    return Sighting("detected", True, confidence, (10.0, 20.0, 30.0, 40.0), place)


def unseen(status: str = "not_found") -> Sighting:
    return Sighting(status)


def played(frames: list[Sighting | None], rules: EventRules = RULES, first_ns: int = 7 * 10**17):
    """Events with the number of their frame, ten frames a second; None: the tracer does not know the tag."""
    states, found = {}, []
    for number, sighting in enumerate(frames):
        sightings = {} if sighting is None else {"A": sighting}
        states, events = next_events(rules, states, first_ns + number * STEP_NS, sightings)
        found += [(number, event) for event in events]
    return found, states


def kinds(frames: list[Sighting | None], rules: EventRules = RULES) -> list[tuple[int, str]]:
    return [(number, event.kind) for number, event in played(frames, rules)[0]]


def test_a_tag_is_detected_after_a_while_and_lost_after_a_while():
    frames = [*[unseen()] * 2, *[seen()] * 6, *[unseen("occluded")] * 15]
    found, states = played(frames)
    assert [(number, event.kind) for number, event in found] == [(5, "detected"), (17, "lost")]
    detected, lost = found[0][1], found[1][1]
    first_ns = 7 * 10**17
    assert (detected.time_ns, detected.since_ns) == (first_ns + 5 * STEP_NS, first_ns + 2 * STEP_NS)
    assert (lost.time_ns, lost.since_ns) == (first_ns + 17 * STEP_NS, first_ns + 7 * STEP_NS)
    assert (lost.status, lost.confidence, lost.centre_m) == ("occluded", 0.9, OUTSIDE)  # the last detection's
    assert states == {}  # nothing is remembered


def test_what_flickers_raises_no_event():
    assert kinds([seen(), seen(), seen(), unseen()] * 10) == []  # never 0.3 s in a row
    assert kinds([*[seen()] * 4, *([unseen()] * 9 + [seen()]) * 5]) == [(3, "detected")]  # never 1 s without


def test_a_tag_that_the_tracer_forgets_is_lost():
    found, _ = played([*[seen()] * 4, *[None] * 12])
    assert [(number, event.kind, event.status) for number, event in found[1:]] == [(13, "lost", "not_read")]


def test_a_pause_of_the_camera_is_neither_a_detection_nor_a_loss():
    states, events = next_events(RULES, {}, 0, {"A": seen()})
    states, events = next_events(RULES, states, 2 * 10**9, {"A": seen()})  # two frames, two seconds apart
    assert events == []
    for number in range(1, 4):
        states, events = next_events(RULES, states, 2 * 10**9 + number * STEP_NS, {"A": seen()})
    assert [event.kind for event in events] == ["detected"]
    states, events = next_events(RULES, states, 9 * 10**9, {"A": seen()})
    assert events == []


def test_an_alarm_is_raised_once_a_visit():
    frames = [*[seen()] * 5, *[seen(INSIDE)] * 10, *[seen()] * 8, *[seen(INSIDE)] * 5]
    found, _ = played(frames)
    assert [(number, event.kind) for number, event in found] == [(3, "detected"), (7, "alarm"), (25, "alarm")]
    assert found[1][1].region == "exit"
    assert found[1][1].since_ns == 7 * 10**17 + 5 * STEP_NS


@pytest.mark.parametrize("between", [[seen()] * 3, [unseen()] * 8, [seen(confidence=0.2)] * 8, [seen(INSIDE, 0.2)] * 8])
def test_a_short_excursion_or_a_gap_raises_no_second_alarm(between):
    frames = [*[seen(INSIDE)] * 6, *between, *[seen(INSIDE)] * 6]
    assert [kind for _, kind in kinds(frames)].count("alarm") == 1


def test_no_alarm_without_confidence_or_for_a_short_visit():
    assert kinds([seen(INSIDE, 0.4)] * 20) == [(3, "detected")]
    assert kinds([*[seen()] * 5, seen(INSIDE), seen(INSIDE), *[seen()] * 5]) == [(3, "detected")]
    assert kinds([seen(INSIDE, math.nan)] * 20) == [(3, "detected")]


def test_an_alarm_waits_for_the_detection():
    assert kinds([seen(INSIDE)] * 6) == [(3, "detected"), (3, "alarm")]


def test_a_tag_leaves_through_the_region_where_it_was_last():
    gone = [unseen("not_read")] * 12
    found, _ = played([*[seen(INSIDE)] * 6, *gone])
    assert [(event.kind, event.region) for _, event in found[2:]] == [("lost", None), ("left", "exit")]
    assert kinds([*[seen(INSIDE)] * 6, seen(), *gone])[2:] == [(16, "lost")]
    put_down = [unseen("stationary")] * 12
    assert kinds([*[seen(INSIDE)] * 6, *put_down])[2:] == [(15, "lost")]


def test_a_region_of_the_picture_holds_the_centre_of_the_box():
    region = Region(name="door", picture_px=((0.0, 0.0), (25.0, 0.0), (25.0, 60.0), (0.0, 60.0)))
    assert region.holds((10.0, 20.0, 30.0, 40.0), None, RULES.up)
    assert not region.holds((10.0, 20.0, 50.0, 40.0), None, RULES.up)
    assert not region.holds(None, INSIDE, RULES.up)


def test_tags_do_not_disturb_each_other():
    rules = dataclasses.replace(RULES, regions=())
    states, events = {}, []
    for number in range(20):
        sightings = {"A": seen(), "B": seen() if number < 5 else unseen()}
        states, new = next_events(rules, states, number * STEP_NS, sightings)
        events += [(number, event.epc, event.kind) for event in new]
    assert events == [(3, "A", "detected"), (3, "B", "detected"), (14, "B", "lost")]
    assert set(states) == {"A"}


@given(
    st.lists(
        st.sampled_from([seen(), seen(INSIDE), seen(INSIDE, 0.1), unseen(), unseen("stationary"), None]), max_size=60
    )
)
def test_events_alternate_and_can_be_written(frames):
    found, _ = played(frames)
    both = [event.kind for _, event in found if event.kind in ("detected", "lost")]
    assert both == [("detected", "lost")[number % 2] for number in range(len(both))]
    present = False
    for _, event in found:
        assert event.since_ns <= event.time_ns
        assert json.loads(json.dumps(event.as_json()))["event"] == event.kind
        present = {"detected": True, "lost": False}.get(event.kind, present)
        assert present == (event.kind in ("detected", "alarm"))


def test_polygons():
    square = ((0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0))
    assert polygon_area(square) == 4.0
    assert polygon_area(square[::-1]) == -4.0
    assert in_polygon((1.0, 1.0), square)
    assert not in_polygon((3.0, 1.0), square)
    assert not in_polygon((-1.0, 1.0), square)
    assert not in_polygon((math.nan, 1.0), square)
    notched = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (2.0, 1.0), (0.0, 4.0))
    assert in_polygon((0.5, 2.0), notched)
    assert not in_polygon((2.0, 2.0), notched)
    beside = ((2.0, 0.0), (4.0, 0.0), (4.0, 2.0), (2.0, 2.0))
    assert in_polygon((2.0, 1.0), square) != in_polygon((2.0, 1.0), beside)


def test_the_floor_of_cameras_that_are_level_tilted_and_overhead():
    assert floor_axes((0.0, -1.0, 0.0)) == ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    right, forward = floor_axes((0.0, 0.0, -1.0))  # looks down: forward is the upper edge of the picture
    assert (right, forward) == ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0))
    tilt = math.radians(30)  # looks down by 30 degrees: a point on its axis, 2 m away, is 2 cos 30 m ahead
    up = (0.0, -math.cos(tilt), -math.sin(tilt))
    assert floor_place((0.5, 0.0, 2.0), up) == pytest.approx((0.5, 2.0 * math.cos(tilt)))
    assert floor_place((0.5, -math.cos(tilt), -math.sin(tilt)), up) == pytest.approx((0.5, 0.0))  # 1 m above the camera


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"regions": [{"name": "a"}]}, "neither of floor_m and picture_px"),
        ({"regions": [{"name": "a", "floor_m": [[0, 0], [1, 1], [2, 2]]}]}, "not on a line"),
        ({"regions": [{"name": "a", "floor_m": [[0, 0], [1, 1]]}]}, "at least three"),
        ({"regions": [{"name": "a", "floor_m": [[0, 0], [1, 0], [1, 1]], "picture_px": [[0, 0]]}]}, "both of"),
        ({"regions": [{"name": "", "floor_m": [[0, 0], [1, 0], [1, 1]]}]}, "name is empty"),
        ({"regions": [{"name": "a", "floor_m": [[0, 0], [1, 0], [1, 1]]}] * 2}, "different ones"),
        ({"regions": [{"name": "a", "floor_m": [[0, 0], [1, 0], [1, 1]], "min_confidence": 2}]}, "from 0 to 1"),
        ({"regions": [{"name": "a", "floor_m": [[0, 0], [1, 0], [1, 1]], "inside_s": -1}]}, "at least 0 s"),
        ({"lost_s": 0}, "more than 0 s"),
        ({"up": [0, 0, 0]}, "expected a direction"),
        ({"up": [1, 0, 0]}, "along the picture's rows"),
    ],
)
def test_rules_that_cannot_be_are_refused(wrong, text):
    with pytest.raises(ConfigError, match=text):
        from_mapping(EventRules, wrong)
