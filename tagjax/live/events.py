"""Events of a stream from its results frame by frame: a state machine without clock, threads or files.

A tag is `detected` once it was so in every frame for `detected_s`, and `lost` after `lost_s` without a detection; what
flickers raises no event. It raises an `alarm` in a region (Goller et al., IV: the probability that a body in the exit region
carries the tag exceeds a threshold), once a visit. It has `left` through a region where it is lost and was in it last; a tag
that is lost because it stays in place has not.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal

from ..tracing.status import Status
from .regions import Region, Vector, floor_axes

Kind = Literal["detected", "lost", "alarm", "left"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EventRules:
    """When results become events. Raises `ValueError` for times that are not positive and two regions of one name."""

    detected_s: float = 0.5  # in every frame for so long
    lost_s: float = 2.0
    regions: tuple[Region, ...] = ()
    up: Vector = (0.0, -1.0, 0.0)  # the floor's normal in the camera frame; this one is of a level camera

    def __post_init__(self) -> None:
        if not (self.detected_s >= 0 and 0 < self.lost_s < math.inf):
            raise ValueError(
                f"detected_s is {self.detected_s} and lost_s is {self.lost_s}; expected at least 0 s and more than 0 s."
            )
        names = [region.name for region in self.regions]
        if len(set(names)) < len(names):
            raise ValueError(f"regions have the names {', '.join(names)}; expected different ones.")
        floor_axes(self.up)


@dataclasses.dataclass(frozen=True)
class Sighting:
    """The result for a tag at a frame; box and place are None where it is not detected."""

    status: str  # a word of `Status`
    detected: bool = False
    confidence: float = 0.0
    box_px: tuple[float, ...] | None = None  # x0 y0 x1 y1, of the whole picture
    centre_m: tuple[float, ...] | None = None  # camera frame


@dataclasses.dataclass(frozen=True)
class Event:
    """Something that happened to a tag."""

    kind: Kind
    epc: str
    time_ns: int  # of the frame at which it is known
    since_ns: int  # detected: of the first detection; alarm: of the entry; lost, left: of the last detection
    status: str  # at `time_ns`; of a lost tag the reason
    confidence: float  # here and below: of the last detection
    box_px: tuple[float, ...] | None = None
    centre_m: tuple[float, ...] | None = None
    region: str | None = None  # alarm, left

    def as_json(self) -> dict[str, Any]:
        """The event in JSON types."""
        content = {name: value for name, value in vars(self).items() if name not in ("kind", "region")}
        return {"event": self.kind, **content, **({} if self.region is None else {"region": self.region})}


@dataclasses.dataclass(frozen=True)
class Visit:
    """A tag and a region."""

    since_ns: int | None = None  # inside since then; None: it was outside when it was seen last
    last_ns: int = 0  # inside at that time, the last one
    alarmed: bool = False


@dataclasses.dataclass(frozen=True)
class TagState:
    """What is remembered of a tag."""

    present: bool = False  # the last event of both was `detected`, not `lost`
    begun_ns: int | None = None  # detected in every frame since then; while it is present, with gaps
    last_ns: int = 0  # of the last detection, and what it was
    last: Sighting = Sighting(Status.UNKNOWN.word)
    visits: tuple[Visit, ...] = ()  # one a region


States = Mapping[str, TagState]


def next_events(
    rules: EventRules, states: States, time_ns: int, sightings: Mapping[str, Sighting]
) -> tuple[dict[str, TagState], list[Event]]:
    """The states after a frame, and its events; times grow from frame to frame.

    A tag that is in no sighting counts as not read. Of tags that are neither present nor detected nothing is remembered.
    """
    after, events = {}, []
    for epc in [*sightings, *(epc for epc in states if epc not in sightings)]:
        sighting = sightings.get(epc, Sighting(Status.NOT_READ.word))
        state = states.get(epc, TagState(visits=(Visit(),) * len(rules.regions)))
        state, found = (_seen if sighting.detected else _unseen)(rules, state, epc, time_ns, sighting)
        events += found
        if state.present or state.begun_ns is not None:
            after[epc] = state
    return after, events


def _seen(
    rules: EventRules, state: TagState, epc: str, time_ns: int, sighting: Sighting
) -> tuple[TagState, list[Event]]:
    continued = state.begun_ns is not None and time_ns - state.last_ns < _ns(rules.lost_s)
    begun_ns = state.begun_ns if continued and state.begun_ns is not None else time_ns
    events, present = [], state.present
    if not present and time_ns - begun_ns >= _ns(rules.detected_s):
        present = True
        events.append(_event("detected", epc, time_ns, begun_ns, sighting, sighting.status))
    visits = []
    for region, visit in zip(rules.regions, state.visits, strict=True):
        if sighting.confidence >= region.min_confidence:
            visit = _visited(region, visit, time_ns, region.holds(sighting.box_px, sighting.centre_m, rules.up))
            since_ns = visit.since_ns
            if present and since_ns is not None and not visit.alarmed and time_ns - since_ns >= _ns(region.inside_s):
                events.append(_event("alarm", epc, time_ns, since_ns, sighting, sighting.status, region.name))
                visit = dataclasses.replace(visit, alarmed=True)
        visits.append(visit)
    return TagState(present, begun_ns, time_ns, sighting, tuple(visits)), events


def _visited(region: Region, visit: Visit, time_ns: int, inside: bool) -> Visit:
    """The visit after a detection inside or outside of the region. A gap in the detections inside does not end it."""
    over = time_ns - visit.last_ns >= _ns(region.outside_s)
    if not inside:
        return Visit(None, visit.last_ns, visit.alarmed and not over)
    if visit.since_ns is None:
        return Visit(time_ns, time_ns, visit.alarmed and not over)
    return dataclasses.replace(visit, last_ns=time_ns)


def _unseen(
    rules: EventRules, state: TagState, epc: str, time_ns: int, sighting: Sighting
) -> tuple[TagState, list[Event]]:
    if not state.present:
        return TagState(visits=(Visit(),) * len(rules.regions)), []
    if time_ns - state.last_ns < _ns(rules.lost_s):
        return state, []
    events = [_event("lost", epc, time_ns, state.last_ns, state.last, sighting.status)]
    if sighting.status != Status.STATIONARY.word:
        for region, visit in zip(rules.regions, state.visits, strict=True):
            if visit.since_ns is not None:
                events.append(_event("left", epc, time_ns, state.last_ns, state.last, sighting.status, region.name))
    return TagState(visits=(Visit(),) * len(rules.regions)), events


def _event(
    kind: Kind, epc: str, time_ns: int, since_ns: int, last: Sighting, status: str, region: str | None = None
) -> Event:
    return Event(kind, epc, time_ns, since_ns, status, last.confidence, last.box_px, last.centre_m, region)


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
