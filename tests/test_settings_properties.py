"""Properties of settings read from plain values: what is written is read back; anything else gives `ConfigError` alone."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tagjax.core.settings import ConfigError, changed, from_mapping
from tagjax.metrics.recordings import ScoreSettings
from tagjax.training.config import TrainConfig
from tagjax.training.loop import LoopSettings
from tagjax.training.objective import ObjectiveSettings

FLOATS = st.floats(allow_nan=False, allow_infinity=False)
WORDS = st.text(max_size=8)


@dataclasses.dataclass(frozen=True)
class Inner:
    """Nested settings."""

    size: int = 3
    scale: float = 1.0
    mode: Literal["one", "two"] = "one"


@dataclasses.dataclass(frozen=True)
class Outer:
    """One field of each kind that the package's settings have."""

    name: str
    flag: bool = False
    limit: float | None = None
    either: int | str = 0
    values: tuple[float, ...] = ()
    span: tuple[int, int] | None = None
    words: Mapping[str, float] = dataclasses.field(default_factory=dict)
    inner: Inner = dataclasses.field(default_factory=Inner)
    optional: Inner | None = None

    def __post_init__(self) -> None:
        if self.name == "refused":
            raise ValueError("name is 'refused'; expected another.")


INNER = st.fixed_dictionaries(
    {}, optional={"size": st.integers(), "scale": FLOATS, "mode": st.sampled_from(["one", "two"])}
)
OUTER = st.fixed_dictionaries(
    {"name": WORDS.filter(lambda name: name != "refused")},
    optional={
        "flag": st.booleans(),
        "limit": st.none() | FLOATS,
        "either": st.integers() | WORDS,
        "values": st.lists(FLOATS, max_size=4),
        "span": st.none() | st.lists(st.integers(), min_size=2, max_size=2),
        "words": st.dictionaries(WORDS, FLOATS, max_size=3),
        "inner": INNER,
        "optional": st.none() | INNER,
    },
)
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inside: st.lists(inside, max_size=3) | st.dictionaries(st.text(max_size=8), inside, max_size=3),
    max_leaves=6,
)
MISTYPED: dict[str, st.SearchStrategy[Any]] = {
    "name": st.none() | st.booleans() | st.integers() | FLOATS | st.lists(WORDS),
    "flag": st.none() | st.integers(2) | FLOATS | st.just("on") | st.lists(st.booleans()),
    "limit": st.booleans() | WORDS | st.lists(FLOATS),
    "either": st.none() | st.booleans() | st.lists(st.integers()),
    "values": st.none() | FLOATS | WORDS | st.lists(WORDS, min_size=1),
    "span": st.integers() | WORDS | st.lists(st.integers(), min_size=3),
    "words": st.none() | st.integers() | st.lists(FLOATS, min_size=1),
    "inner": st.none() | st.integers() | st.fixed_dictionaries({"size": FLOATS.filter(lambda x: x != int(x)) | WORDS}),
    "optional": st.booleans() | WORDS | st.fixed_dictionaries({"mode": st.just("three")}),
}


def _listed(value: Any) -> Any:
    """The value as YAML holds it: lists in place of tuples."""
    if isinstance(value, Mapping):
        return {name: _listed(one) for name, one in value.items()}
    return [_listed(one) for one in value] if isinstance(value, tuple | list) else value


@given(OUTER)
def test_what_is_given_is_held_and_survives_the_round_trip(values):
    made = from_mapping(Outer, values)
    held = _listed(dataclasses.asdict(made))
    for name, value in values.items():
        if name in ("inner", "optional") and value is not None:
            assert {key: held[name][key] for key in value} == value
        else:
            assert held[name] == value
    assert isinstance(made.values, tuple)
    assert from_mapping(Outer, held) == made


@given(OUTER, WORDS)
def test_a_key_that_no_field_has_is_refused_by_name(values, key):
    known = {field.name for field in dataclasses.fields(Outer)}
    if key in known:
        return
    with pytest.raises(ConfigError) as error:
        from_mapping(Outer, {**values, key: 1})
    assert repr(key) in str(error.value)


@pytest.mark.parametrize("name", MISTYPED)
@given(st.data())
def test_a_value_of_another_type_is_refused_by_name(name, data):
    values = {**data.draw(OUTER), name: data.draw(MISTYPED[name])}
    with pytest.raises(ConfigError) as error:
        from_mapping(Outer, values)
    assert name in str(error.value)


def test_every_field_has_values_that_are_refused():
    assert set(MISTYPED) == {field.name for field in dataclasses.fields(Outer)}


@given(st.dictionaries(st.sampled_from([field.name for field in dataclasses.fields(Outer)]) | WORDS, ANYTHING))
def test_anything_gives_settings_or_a_config_error(values):
    with contextlib.suppress(ConfigError):  # any other error fails the test
        assert isinstance(from_mapping(Outer, values), Outer)


@pytest.mark.parametrize("schema", [TrainConfig, ObjectiveSettings, LoopSettings, ScoreSettings])
@given(st.data())
def test_anything_in_a_field_of_real_settings_gives_settings_or_a_config_error(schema, data):
    least = {"tracer": {"_target_": "a"}, "optimizer": {"_target_": "b"}} if schema is TrainConfig else {}
    field = data.draw(st.sampled_from([field.name for field in dataclasses.fields(schema)]))
    with contextlib.suppress(ConfigError):
        assert isinstance(from_mapping(schema, {**least, field: data.draw(ANYTHING)}), schema)


@given(OUTER, INNER)
def test_changed_replaces_what_is_given_and_nothing_else(values, other):
    made = from_mapping(Outer, values)
    assert changed(made, {}, where="settings") == made
    again = changed(made.inner, {**other, "size": None}, where="settings.inner")
    kept = {name: value for name, value in other.items() if name != "size"}
    assert dataclasses.asdict(again) == {**dataclasses.asdict(made.inner), **kept}


def test_what_the_settings_themselves_refuse_is_a_config_error():
    with pytest.raises(ConfigError, match="name is 'refused'"):
        from_mapping(Outer, {"name": "refused"})
