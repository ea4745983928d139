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
SETTINGS: dict[str, Any] = {"_target_": "tagjax.tagattention.TagAttention", "cell": 4}
CLIPS: dict[str, Any] = {
    "stride": 2,
    "window": 3,
    "flow": "dis",
    "estimator": "robust",
    "antennas": None,
    "max_reads": 16,
}


def _stirred(seed: int = 0) -> TagAttention:
    rng = np.random.default_rng(seed)
    stir = lambda leaf: leaf + jnp.asarray(rng.normal() * 0.2, leaf.dtype) if eqx.is_inexact_array(leaf) else leaf  # noqa: E731
    return jax.tree.map(stir, TagAttention(cell=4))


def test_what_is_written_is_what_is_read(tmp_path: Path) -> None:
    stirred = _stirred()
    save_parameters(tmp_path / "weights.json", stirred, SETTINGS, CLIPS, {"seed": 3})
    back = make_tracer(SETTINGS, str(tmp_path / "weights.json"))
    assert isinstance(back, TagAttention)
    assert jax.tree.structure(back) == jax.tree.structure(stirred)
    assert back.physical() == pytest.approx(stirred.physical(), rel=1e-5)
    fresh = TagAttention(cell=4)
    assert any(float(a) != float(b) for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(fresh), strict=True))


def test_default_is_what_was_learned_from_these_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learned, "PACKAGED", tmp_path)
    save_parameters(tmp_path / "one.json", _stirred(1), SETTINGS, CLIPS)
    save_parameters(tmp_path / "two.json", _stirred(2), {**SETTINGS, "beta": 0.5}, CLIPS)
    assert packaged_parameters() == ("one", "two")
    tracer = TagAttention(cell=4)
    for name, settings in (("one", SETTINGS), ("two", {**SETTINGS, "beta": 0.5})):
        chosen, named = (load_parameters(tracer, source, settings) for source in ("default", name))
        assert chosen.physical() == named.physical()
    with pytest.raises(ValueError, match=r"no packaged parameters were learned from these settings.*one, two"):
        load_parameters(tracer, "default", {**SETTINGS, "cell": 9})


def test_settings_that_learned_parameters_replace_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "one.json"
    save_parameters(path, _stirred(1), SETTINGS, CLIPS)
    tracer = TagAttention(cell=4)
    with pytest.raises(ValueError, match=r"found tracer\.beta=0\.5; expected 0\.8"):
        load_parameters(tracer, path, {**SETTINGS, "beta": 0.5})
    other = {**SETTINGS, "cell": 9, "max_speed_m_s": 2.0}  # which are not learned
    with pytest.raises(
        ValueError, match=r"found tracer\.cell=9, .*; expected tracer\.cell=4, .*Set the expected values"
    ):
        load_parameters(tracer, path, other)
    load_parameters(tracer, _changed(path, version=3), other)  # whose files held none of them


def _changed(path: Path, **changes: Any) -> Path:
    content = json.loads(path.read_text())
    content.update(changes)
    del content["sha256"]
    other = path.with_name("changed.json")
    other.write_text(json.dumps({**content, "sha256": json_checksum(content)}))
    return other


@pytest.mark.parametrize("weights", ["default", "tagattention"])
def test_what_did_not_move_in_learning_may_be_asked_for(weights: str) -> None:
    """`tracer.rest_doubt=0.2` with packaged parameters, as docs/learning.md advises."""
    with initialize_config_dir(CONF, version_base="1.3"):
        plain, doubting = (
            OmegaConf.to_container(compose("train", ["tracer=tagattention", *more]).tracer, resolve=True)
            for more in ([], ["tracer.rest_doubt=0.2"])
        )
    without, with_doubt = (make_tracer(one, weights) for one in (plain, doubting))
    assert isinstance(without, TagAttention)
    assert isinstance(with_doubt, TagAttention)
    result = with_doubt.physical()
    assert result.pop("rest_doubt") == pytest.approx(0.2)
    assert result == {name: value for name, value in without.physical().items() if name != "rest_doubt"}
    with pytest.raises(ValueError, match=r"things_in_hand\.json: found tracer\.rest_doubt=0\.2; expected 0\.0"):
        make_tracer(doubting, "things_in_hand")  # which learned it


def test_files_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    tracer = TagAttention(cell=4)
    path = tmp_path / "weights.json"
    save_parameters(path, tracer, SETTINGS, CLIPS)
    good = tracer.physical()

    def load(**changes: Any) -> None:
        load_parameters(tracer, _changed(path, **changes), SETTINGS)

    with pytest.raises(ValueError, match="no learned parameters"):
        load(format="another")
    with pytest.raises(ValueError, match="version 7; this release reads 3"):
        load(version=7)
    with pytest.raises(ValueError, match="beta: not a number"):
        load(parameters={**good, "beta": None})
    with pytest.raises(ValueError, match=r"parameters\.alpha: not finite in float32"):
        load(parameters={**good, "alpha": float("nan")})
    with pytest.raises(ValueError, match=r"missing \['beta'\], unknown \['gamma'\]"):
        load(parameters={**{name: value for name, value in good.items() if name != "beta"}, "gamma": 1.0})
    with pytest.raises(ValueError, match=r"beta is 1\.5; expected a fraction from 0 to 1"):
        load(parameters={**good, "beta": 1.5})
    with pytest.raises(ValueError, match="positive value"):
        load(parameters={**good, "alpha": -1.0})
    path.write_text(path.read_text()[:40])
    with pytest.raises(ValueError, match="no learned parameters"):
        load_parameters(tracer, path, SETTINGS)
    with pytest.raises(ValueError, match="No learned parameters at 'nowhere'"):
        load_parameters(tracer, "nowhere", SETTINGS)


def test_a_tracer_without_learned_parameters_is_refused() -> None:
    with pytest.raises(ValueError, match="learned parameters are of TagAttention"):
        make_tracer({"_target_": "tagjax.tagattention.literal.TagAttentionLiteral"}, "default")


def test_packaged_parameters_are_of_the_tracer_as_it_is_configured() -> None:
    with initialize_config_dir(CONF, version_base="1.3"):
        composed = OmegaConf.to_container(compose("train", ["tracer=tagattention"]), resolve=True)
    assert isinstance(composed, dict)
    assert packaged_parameters() == ("tagattention", "things_in_hand")
    untrained, default, people, things = (
        make_tracer(composed["tracer"], weights) for weights in (None, "default", *packaged_parameters())
    )
    assert all(isinstance(one, TagAttention) for one in (untrained, default, people, things))
    found = [one.physical() for one in (untrained, default, things) if isinstance(one, TagAttention)]
    assert found[0] != found[1] != found[2] != found[0]
    assert isinstance(people, TagAttention)
    assert people.physical() == found[1]


def _tracer_settings(name: str) -> dict[str, Any]:
    with initialize_config_dir(CONF, version_base="1.3"):
        composed = OmegaConf.to_container(compose("train", [f"tracer={name}"]).tracer, resolve=True)
    assert isinstance(composed, dict)
    return {str(key): value for key, value in composed.items()}


@pytest.mark.parametrize("weights", ["default", "tagattention", "things_in_hand"])
def test_packaged_parameters_need_no_further_setting(weights: str) -> None:
    """They bring their tracer and the clips that it was trained with: every second pixel."""
    tracer, clips = learned_tracer(weights)
    settings = _tracer_settings("tagattention")
    named, same_clips = learned_tracer(weights, settings)
    assert isinstance(tracer, TagAttention)
    assert isinstance(named, TagAttention)
    made = make_tracer(settings, weights)
    assert isinstance(made, TagAttention)
    assert tracer.physical() == named.physical() == made.physical()
    assert clips == same_clips == ClipSettings(stride=2)
    assert ClipSettings().stride is None  # without weights: as the camera has it


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
    settings = _tracer_settings("tagattention_handheld")
    assert tracer_clips(settings) == ClipSettings()
    assert tracer_clips(_tracer_settings("tagattention")) == ClipSettings(stride=4)
    assert isinstance(make_tracer(settings), TagAttention)
    with pytest.raises(ConfigError, match=r"tracer\.clips: unknown key 'strid'"):
        tracer_clips({**settings, "clips": {"strid": 2}})
