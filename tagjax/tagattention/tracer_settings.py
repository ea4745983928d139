"""A tracer and its clips from settings as under conf/tracer, or from a file of learned parameters.

Beside `_target_` and the tracer's parameters such settings may hold `clips`: the clip settings that the tracer is meant
for (`stride`, `window`, ...). A file of learned parameters holds those it was trained with.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..core.build import build
from ..core.camera import working_stride
from ..core.settings import changed
from ..tracing.clips import ClipSettings
from ..tracing.tracer import AbstractTracer
from . import TagAttention
from ._differences import flat
from .learned import LearnableTracer, load_parameters, read_learned, without_clips
from .literal import TagAttentionLiteral
from .published import TagAttentionPublished

TRACERS: dict[str, type[AbstractTracer]] = {
    "tagjax.tagattention.TagAttention": TagAttention,
    "tagjax.tagattention.published.TagAttentionPublished": TagAttentionPublished,
    "tagjax.tagattention.literal.TagAttentionLiteral": TagAttentionLiteral,
}
"""The tracers that settings can name as `_target_`."""


def make_tracer(settings: Mapping[str, Any], weights: str | None = None) -> AbstractTracer:
    """The tracer that the settings describe, with the learned parameters `weights` if given (`load_parameters`).

    Raises `ConfigError` if the settings describe something else, `ValueError` for weights of a tracer that has none.
    """
    parameters = without_clips(settings)
    tracer: AbstractTracer = build(parameters, TRACERS, where="tracer")
    if weights is None:
        return tracer
    if not isinstance(tracer, LearnableTracer):
        raise ValueError(
            f"weights={weights}: found the tracer {settings['_target_']}; learned parameters are of TagAttention. Leave out "
            "weights=, or choose another tracer."
        )
    return load_parameters(tracer, weights, parameters)


def named_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The tracer's own settings by dotted name (`dwell.memory_s`), in the order of the names."""
    named = flat(without_clips(settings))
    return {name: named[name] for name in sorted(named) if name != "_target_"}


def with_values(settings: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """The settings with these values in place of their own, by dotted name."""
    result = dict(settings)
    for name, value in values.items():
        part, _, rest = name.partition(".")
        result[part] = with_values(result[part], {rest: value}) if rest else value
    return result


def tracer_clips(settings: Mapping[str, Any]) -> ClipSettings:
    """The clip settings of a tracer's configuration; the defaults for what it does not name."""
    return changed(ClipSettings(), settings.get("clips") or {}, where="tracer.clips")


def settled(settings: Mapping[str, Any], width: int) -> dict[str, Any]:
    """Settings whose `clips`, if any, have the stride for pictures of this width in place of an automatic one.

    Scores are stored under what determines them: a stride that follows from the width is the same as one that is given, and
    depth that is measured the same as before depth could be unknown.
    """
    clips = settings.get("clips")
    settings = {key: value for key, value in settings.items() if key != "unknown_depth" or value is not None}
    if not clips:
        return settings
    return {**settings, "clips": {**clips, "stride": working_stride(width, clips.get("stride"))}}


def baseline_clips(baselines: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """The clip settings that each baseline's configuration names; a baseline uses the main tracer's for the others."""
    return {name: settings.get("clips") or {} for name, settings in baselines.items()}


def learned_tracer(weights: str, settings: Mapping[str, Any] | None = None) -> tuple[AbstractTracer, ClipSettings]:
    """The tracer with learned parameters, and the clip settings that it was trained with.

    Without `settings` the tracer is the one that the file was learned from. Errors as of `make_tracer`.
    """
    if settings is None:
        settings = read_learned(weights).settings
    tracer = make_tracer(settings, weights)
    learned = read_learned(weights, settings)
    return tracer, changed(ClipSettings(), learned.clips, where=f"{learned.path}: clips")
