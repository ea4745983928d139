"""The flow networks by the name that settings give as `_target_`. To add one, add its class here."""

from __future__ import annotations

from .flownet import FlowNetC, FlowNetS
from .network import AbstractFlowNetwork
from .pyramid import PyramidFlow
from .raft import RAFTSmall

NETWORKS: dict[str, type[AbstractFlowNetwork]] = {
    f"{network.__module__}.{network.__name__}": network for network in (FlowNetC, FlowNetS, PyramidFlow, RAFTSmall)
}
