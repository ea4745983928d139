"""Damaged and hostile files of weights and checkpoints: one line says what is wrong, and nothing is silently different."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import safetensors.numpy
import synthetic_clips as synthetic

from tagjax.baselines.goller import calibration as goller
from tagjax.baselines.tagvision import plane as tagvision
from tagjax.benchmarks.faults import weights as weight_faults
from tagjax.core.array_file import ArrayFile
from tagjax.core.json_text import json_checksum, not_float32, parse_json
from tagjax.core.parameters import check_positive
from tagjax.core.stream import StreamIterator
from tagjax.tagattention import TagAttention
from tagjax.tagattention.learned import load_parameters, read_learned, renew_checksum, save_parameters
from tagjax.training.checkpoint import CheckpointError, Checkpoints
from tagjax.training.loop import resume_state
from tagjax.training.state import TrainState

SETTINGS: dict[str, Any] = {"_target_": "tagjax.tagattention.TagAttention", "whole": None}
NESTED = "[" * 100_000


@pytest.fixture
def parameters(tmp_path: Path) -> Path:
    path = tmp_path / "weights.json"
    save_parameters(path, TagAttention(whole=None), SETTINGS, {"stride": 2})
    return path


def _one_line(error: pytest.ExceptionInfo[ValueError]) -> None:
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (NESTED, "more than 32 levels"),
        ("[" * 40 + "]" * 40, "more than 32 levels"),
        ('{"a": 1, "b": {"c": 1, "c": 2}}', "the key 'c' twice"),
        ('{"a": 1' + "0" * 5000 + "}", "4300"),
        ('{"a": 1', "Expecting"),
        ("", "Expecting value"),
    ],
)
def test_json_that_cannot_be_used_is_a_value_error(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        parse_json(text)
    _one_line(error)


def test_numbers_are_those_of_float32() -> None:
    content = {"a": [1, 1e39, -(10**400)], "b": {"c": float("nan"), "d": 3.4e38, "e": True, "f": "1e99"}}
    assert not_float32(content) == ["a[1]", "a[2]", "b.c"]
    for value in (1e39, 1e-39, float("inf")):
        with pytest.raises(ValueError, match="as float32 has"):
            check_positive(alpha=value)


@pytest.mark.parametrize("value", ["1e39", "-1e39", "1" + "0" * 400, "NaN", "Infinity", "1e400"])
@pytest.mark.parametrize("name", ["alpha", "beta"])
def test_parameters_that_are_not_finite_in_float32_are_refused(parameters: Path, name: str, value: str) -> None:
    content = json.loads(parameters.read_text())
    content["parameters"][name] = json.loads(value)
    del content["sha256"]
    parameters.write_text(json.dumps({**content, "sha256": json_checksum(content)}))  # a hostile file has a checksum
    with pytest.raises(ValueError, match=rf"weights\.json: parameters\.{name}: not finite in float32") as error:
        load_parameters(TagAttention(whole=None), parameters, SETTINGS)
    _one_line(error)


@pytest.mark.parametrize("where", ["settings", "clips", "about"])
def test_a_changed_number_is_detected_by_the_checksum(parameters: Path, where: str) -> None:
    content = json.loads(parameters.read_text())
    content[where]["stride"] = 3
    parameters.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="does not have the checksum of the file") as error:
        read_learned(parameters)
    _one_line(error)
    renew_checksum(parameters)
    assert dict(getattr(read_learned(parameters), where, {"stride": 3}))["stride"] == 3


def test_a_file_of_parameters_may_be_formatted_otherwise(parameters: Path) -> None:
    content = json.loads(parameters.read_text())
    parameters.write_text(json.dumps(dict(reversed(content.items())), indent=4))
    assert read_learned(parameters).clips == {"stride": 2}


@pytest.mark.parametrize(
    "content",
    [NESTED.encode(), b'{"format": 1, "format": 2}', b"\xff\xfe", b"", b"[]", b"null", b" " * 2_000_000, b"\0" * 100],
    ids=["nested", "repeated", "no_utf8", "empty", "list", "null", "huge", "nul"],
)
def test_a_file_of_something_else_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "weights.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"weights\.json: .*no learned parameters") as error:
        read_learned(path)
    _one_line(error)


@pytest.mark.parametrize(
    "change",
    [
        {"parameters": {"beta": "0.5"}},
        {"parameters": {"beta": [1]}},
        {"parameters": []},
        {"clips": None},
        {"default": "yes"},
        {"version": [3]},
    ],
    ids=str,
)
def test_values_of_another_type_are_refused_in_one_line(parameters: Path, change: dict[str, Any]) -> None:
    content = {**json.loads(parameters.read_text()), **change}
    del content["sha256"]
    parameters.write_text(json.dumps({**content, "sha256": json_checksum(content)}))
    with pytest.raises(ValueError, match=r"weights\.json: ") as error:
        read_learned(parameters)
    _one_line(error)


FILE = ArrayFile("test-arrays", 1, "arrays of a test", "python -m nothing")


def _written(path: Path, text: str, value: float = 1.0) -> Path:
    arrays = {"a": np.full(3, value, np.float32)}
    path.write_bytes(safetensors.numpy.save(arrays, {"tagjax": text}))
    return path


def test_metadata_of_arrays_are_checked(tmp_path: Path) -> None:
    path, like = tmp_path / "a.safetensors", {"a": jnp.zeros(3)}
    FILE.write(path, like, {"stride": 2})
    np.testing.assert_array_equal(FILE.read(path, like)["a"], 0)
    metadata = FILE.metadata(path)
    for text, message in (
        (NESTED, "more than 32 levels"),
        ('{"format": "test-arrays", "format": "test-arrays"}', "twice"),
        (json.dumps({**metadata, "stride": 3}), "do not have the checksum"),
        (json.dumps({**metadata, "version": [1]}), r"version \[1\]"),
        ("3", "no arrays of a test"),
    ):
        with pytest.raises(ValueError, match=message) as error:
            FILE.read(_written(path, text, 0.0), like)
        _one_line(error)


def test_arrays_are_finite_in_the_dtype_of_the_network(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    FILE.write(path, {"a": jnp.full(3, 1e6)}, {})
    with pytest.raises(ValueError, match="a is not finite as float16"):
        FILE.read(path, {"a": jax.ShapeDtypeStruct((3,), jnp.float16)})


@pytest.fixture(scope="module")
def state() -> TrainState:
    return TrainState.create(synthetic.SmallTracer(), optax.adam(0.1), seed=0)


def _described(folder: Path, state: TrainState, change: Callable[[dict[str, Any]], Any], *, checksum: bool) -> None:
    """Replace the description of a new checkpoint by what `change` makes of it."""
    with Checkpoints(folder) as checkpoints:
        checkpoints.save(state, {"samples": 3})
    (path,) = (folder / "0" / "about").glob("metadata")
    about = json.loads(path.read_text())
    about.pop("sha256")
    content = change(about)
    if checksum:
        content["sha256"] = json_checksum(content)
    path.write_text(content if isinstance(content, str) else json.dumps(content))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    ("change", "checksum", "message"),
    [
        (lambda about: NESTED, False, "RecursionError"),
        (lambda about: {**about, "data": {"samples": 4}}, False, "does not have its checksum"),
        (lambda about: {**about, "step": 1}, True, "is of step 1; expected 0"),
        (lambda about: {**about, "step": "0"}, True, "is of step '0'; expected 0"),
        (lambda about: {**about, "step": 0.0}, True, "is of step 0.0; expected 0"),
        (lambda about: {**about, "arrays": [1]}, True, "lacks arrays"),
        (lambda about: {**about, "arrays": {".step": 3}}, True, "lacks arrays"),
        (lambda about: {name: value for name, value in about.items() if name != "arrays"}, True, "lacks arrays"),
        (lambda about: {name: value for name, value in about.items() if name != "data"}, True, "lacks arrays"),
        (lambda about: {**about, "format": [0] * 1000}, True, "has format"),
    ],
)
def test_a_damaged_description_of_a_checkpoint_is_refused(
    tmp_path: Path, state: TrainState, change: Callable[[dict[str, Any]], Any], checksum: bool, message: str
) -> None:
    _described(tmp_path, state, change, checksum=checksum)
    with Checkpoints(tmp_path) as checkpoints, pytest.raises(CheckpointError, match=message) as error:
        checkpoints.restore(state)
    _one_line(error)


@pytest.mark.parametrize("data", [{"samples": -1}, {"samples": True}, {"samples": 10**300}, {"samples": "3"}, [], None])
def test_a_position_in_the_data_that_is_none_is_refused(tmp_path: Path, state: TrainState, data: Any) -> None:
    with Checkpoints(tmp_path) as checkpoints:
        checkpoints.save(state, data)
        samples = StreamIterator.__new__(StreamIterator)  # which refuses a position before it opens anything
        with pytest.raises(CheckpointError, match="The position in the data is") as error:
            resume_state(state, samples, checkpoints, allowed=True)
    _one_line(error)


@pytest.mark.parametrize("load", [tagvision.load_calibration, goller.load_calibration])
def test_a_calibration_of_nested_json_is_refused(tmp_path: Path, load: Callable[[Path], Any]) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(NESTED)
    with pytest.raises(ValueError, match="more than 32 levels") as error:
        load(path)
    _one_line(error)


def test_damaged_weights_are_never_silently_different(tmp_path: Path) -> None:
    outcomes = weight_faults.trial(120, 0, tmp_path)
    assert [one.kind for one in outcomes] == ["weights, JSON", "weights, safetensors"]
    assert sum(one.tried for one in outcomes) == 120
    assert [one.examples for one in outcomes] == [(), ()]
    assert all(one.failed == 0 for one in outcomes)


@pytest.mark.ci
def test_thousands_of_damaged_weights_are_never_silently_different(tmp_path: Path) -> None:
    assert [one.examples for one in weight_faults.trial(4000, 1, tmp_path)] == [(), ()]
