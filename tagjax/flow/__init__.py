"""Optical flow: networks, losses, estimates, weights, and flows by name. `opencv` and `registry` import cv2."""

from typing import TYPE_CHECKING, Any

from .estimates import FlowEstimate, estimate, flow_along
from .weights import load_network, packaged_weights, save_weights

if TYPE_CHECKING:
    from .registry import make_flow

__all__ = ["FlowEstimate", "estimate", "flow_along", "load_network", "make_flow", "packaged_weights", "save_weights"]


def __getattr__(name: str) -> Any:
    if name == "make_flow":
        from .registry import make_flow

        return make_flow
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
