"""An estimate with its interval, as tables show it."""

from __future__ import annotations

from ..metrics.interval import Estimate


def estimate_text(estimate: Estimate, digits: int = 2) -> str:
    """`value [low, high]`; the value alone with one recording, and "-" for an undefined value."""
    if estimate.value is None:
        return "-"
    text = f"{estimate.value:.{digits}f}"
    if estimate.low is None or estimate.high is None:
        return text
    return f"{text} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"
