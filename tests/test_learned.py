"""Learned parameters as files: the same tracer comes back, and what does not fit is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from tagjax.core.json_text import json_checksum
from tagjax.core.settings import ConfigError
from tagjax.tagattention import TagAttention, learned
from tagjax.tagattention.learned import load_parameters, packaged_parameters, read_learned, save_parameters
from tagjax.tagattention.tracer_settings import learned_tracer, make_tracer, settled, tracer_clips
from tagjax.tracing.clips import ClipSettings

CONF = str((Path(__file__).parents[1] / "conf").resolve())
SETTINGS: dict[str, Any] = {"_target_": "tagjax.tagattention.TagAttention", "whole": None}
CLIPS: dict[str, Any] = {
    "stride": 2,
    "window": 3,
    "flow": "dis",
    "estimator": "robust",
    "antennas": None,
    "max_reads": 16,
}


def _stirred(seed: int = 0, tracer: TagAttention | None = None) -> TagAttention:
    rng = np.random.default_rng(seed)
    stir = lambda leaf: leaf + jnp.asarray(rng.normal() * 0.2, leaf.dtype) if eqx.is_inexact_array(leaf) else leaf  # noqa: E731
    return jax.tree.map(stir, TagAttention(whole=None) if tracer is None else tracer)


def test_what_is_written_is_what_is_read(tmp_path: Path) -> None:
    stirred = _stirred()
    save_parameters(tmp_path / "weights.json", stirred, SETTINGS, CLIPS, {"seed": 3})
    back = make_tracer(SETTINGS, str(tmp_path / "weights.json"))
    assert isinstance(back, TagAttention)
    assert jax.tree.structure(back) == jax.tree.structure(stirred)
    assert back.physical() == pytest.approx(stirred.physical(), rel=1e-5)
    fresh = TagAttention(whole=None)
    assert any(float(a) != float(b) for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(fresh), strict=True))


def test_default_is_what_was_learned_from_these_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learned, "PACKAGED", tmp_path)
    save_parameters(tmp_path / "one.json", _stirred(1), SETTINGS, CLIPS)
    save_parameters(tmp_path / "two.json", _stirred(2), {**SETTINGS, "dwell": {"memory_s": 2.0}}, CLIPS)
    assert packaged_parameters() == ("one", "two")
    tracer = TagAttention(whole=None)
    for name, settings in (("one", SETTINGS), ("two", {**SETTINGS, "dwell": {"memory_s": 2.0}})):
        chosen, named = (load_parameters(tracer, source, settings) for source in ("default", name))
        assert chosen.physical() == named.physical()
    with pytest.raises(ValueError, match=r"no packaged parameters were learned from these settings.*one, two"):
        load_parameters(tracer, "default", {**SETTINGS, "detection": {"threshold": 0.3}})


def test_settings_that_learned_parameters_replace_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "one.json"
    save_parameters(path, _stirred(1), SETTINGS, CLIPS)
    tracer = TagAttention(whole=None)
    with pytest.raises(ValueError, match=r"found tracer\.dwell\.memory_s=2\.0; expected 4\.0"):
        load_parameters(tracer, path, {**SETTINGS, "dwell": {"memory_s": 2.0}})
    other = {**SETTINGS, "detection": {"threshold": 0.3}, "hidden": None}  # which are not learned
    with pytest.raises(
        ValueError, match=r"found tracer\.hidden=null, .*; expected tracer\.hidden=not null, .*Set the expected values"
    ):
        load_parameters(tracer, path, other)


def _changed(path: Path, **changes: Any) -> Path:
    content = json.loads(path.read_text())
    content.update(changes)
    del content["sha256"]
    other = path.with_name("changed.json")
    other.write_text(json.dumps({**content, "sha256": json_checksum(content)}))
    return other


def test_what_did_not_move_in_learning_may_be_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "one.json"
    tracer = TagAttention(whole=None)
    learned_ones = {**tracer.physical(), "dwell.memory_s": 3.0}
    save_parameters(path, tracer.with_physical(learned_ones), SETTINGS, CLIPS)
    asked = make_tracer({**SETTINGS, "hidden": {"margin_nats": 5.0}}, str(path))
    assert isinstance(asked, TagAttention)
    assert asked.physical() == pytest.approx({**learned_ones, "hidden.margin_nats": 5.0}, rel=1e-5)


def test_files_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    tracer = TagAttention(whole=None)
    path = tmp_path / "weights.json"
    save_parameters(path, tracer, SETTINGS, CLIPS)
    good = tracer.physical()

    def load(**changes: Any) -> None:
        load_parameters(tracer, _changed(path, **changes), SETTINGS)

    with pytest.raises(ValueError, match="no learned parameters"):
        load(format="another")
    with pytest.raises(ValueError, match="version 7; this release reads 4"):
        load(version=7)
    with pytest.raises(ValueError, match=r"dwell\.memory_s: not a number"):
        load(parameters={**good, "dwell.memory_s": None})
    with pytest.raises(ValueError, match=r"parameters\.dwell\.memory_s: not finite in float32"):
        load(parameters={**good, "dwell.memory_s": float("nan")})
    less = {name: value for name, value in good.items() if name != "dwell.memory_s"}
    with pytest.raises(ValueError, match=r"dwell\.memory_s.*dwell\.gamma|dwell\.gamma.*dwell\.memory_s"):
        load(parameters={**less, "dwell.gamma": 1.0})
    with pytest.raises(ValueError, match=r"reader\.outlier: value is 1\.5; expected a fraction"):
        load(parameters={**good, "reader.outlier": 1.5})
    with pytest.raises(ValueError, match=r"dwell\.memory_s: value is -1\.0; expected a positive"):
        load(parameters={**good, "dwell.memory_s": -1.0})
    path.write_text(path.read_text()[:40])
    with pytest.raises(ValueError, match="no learned parameters"):
        load_parameters(tracer, path, SETTINGS)
    with pytest.raises(ValueError, match="No learned parameters at 'nowhere'"):
        load_parameters(tracer, "nowhere", SETTINGS)


def test_a_tracer_without_learned_parameters_is_refused() -> None:
    with pytest.raises(ValueError, match="learned parameters are of TagAttention"):
        make_tracer({"_target_": "tagjax.tagattention.literal.TagAttentionLiteral"}, "default")


def _tracer_settings(name: str) -> dict[str, Any]:
    with initialize_config_dir(CONF, version_base="1.3"):
        composed = OmegaConf.to_container(compose("train", [f"tracer={name}"]).tracer, resolve=True)
    assert isinstance(composed, dict)
    return {str(key): value for key, value in composed.items()}


def test_packaged_parameters_need_no_further_setting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They bring their tracer and the clips that it was trained with."""
    monkeypatch.setattr(learned, "PACKAGED", tmp_path)
    settings = {name: value for name, value in _tracer_settings("tagattention").items() if name != "clips"}
    stirred = _stirred(tracer=TagAttention())
    save_parameters(tmp_path / "one.json", stirred, settings, CLIPS)
    for weights in ("default", "one"):
        tracer, clips = learned_tracer(weights)
        named, same_clips = learned_tracer(weights, settings)
        made = make_tracer(settings, weights)
        for one in (tracer, named, made):
            assert isinstance(one, TagAttention)
            assert one.physical() == stirred.physical()
        assert clips == same_clips == ClipSettings(stride=2, window=3)
    assert ClipSettings().stride is None  # without weights: as the camera has it


def test_the_packaged_parameters_are_of_the_tracer_as_it_is() -> None:
    assert packaged_parameters() == ("default",)
    tracer, clips = learned_tracer("default")
    assert isinstance(tracer, TagAttention)
    assert clips == ClipSettings()
    learned, untrained = tracer.physical(), TagAttention().physical()
    assert learned.keys() == untrained.keys()
    changed = {name for name in learned if learned[name] != pytest.approx(untrained[name], rel=1e-3)}
    of_reads = {name for name in learned if name.startswith("reader.")}  # learned from the reads alone
    assert changed == of_reads | {"body.moving_m_s"}
    assert all(np.isfinite(value) for value in learned.values())


def test_without_packaged_parameters_the_name_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tagjax.tagattention.learned.PACKAGED", tmp_path)
    with pytest.raises(ValueError, match=r"weights=default: no packaged parameters .* \(packaged are: none\)"):
        learned_tracer("default")


def test_clip_settings_come_back_without_the_sizes_of_buffers(tmp_path: Path) -> None:
    save_parameters(tmp_path / "weights.json", _stirred(), SETTINGS, CLIPS)
    assert learned_tracer(str(tmp_path / "weights.json"))[1] == ClipSettings(stride=2, window=3)
    kept = read_learned(tmp_path / "weights.json").clips
    assert kept == {name: value for name, value in CLIPS.items() if name != "max_reads"}


def test_weights_learned_at_the_resolution_of_the_camera_are_used_so(tmp_path: Path) -> None:
    save_parameters(tmp_path / "weights.json", _stirred(), SETTINGS, {**CLIPS, "stride": None})
    assert read_learned(tmp_path / "weights.json").clips["stride"] is None
    assert learned_tracer(str(tmp_path / "weights.json"))[1] == ClipSettings(window=3)


@pytest.mark.parametrize(("width", "stride"), [(512, 2), (640, 2), (256, 1), (1280, 5)])
def test_stored_scores_have_one_key_for_a_stride_given_or_automatic(width: int, stride: int) -> None:
    automatic = {"_target_": "x", "clips": {"estimator": "published", "stride": None}}
    given = {"_target_": "x", "clips": {"estimator": "published", "stride": stride}}
    assert settled(automatic, width) == settled(given, width) == given
    assert settled({"_target_": "x"}, width) == {"_target_": "x"}


def test_a_flow_beside_the_weights_moves_with_them(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    first.mkdir()
    (first / "flow.npz").write_bytes(b"")
    save_parameters(first / "weights.json", _stirred(), SETTINGS, {**CLIPS, "flow": str(first / "flow.npz")})
    first.rename(second)
    assert learned_tracer(str(second / "weights.json"))[1].flow == str(second / "flow.npz")


def test_a_tracer_configuration_brings_its_clips() -> None:
    settings = _tracer_settings("tagattention")
    assert tracer_clips(settings) == ClipSettings()
    assert tracer_clips(_tracer_settings("tagattention_published")) == ClipSettings(
        window_s=0.133, estimator="published", antennas="busiest"
    )
    assert isinstance(make_tracer(settings), TagAttention)
    with pytest.raises(ConfigError, match=r"tracer\.clips: unknown key 'strid'"):
        tracer_clips({**settings, "clips": {"strid": 2}})
