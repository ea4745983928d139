"""Pairs of drawn pictures with exact optical flow, for pre-training flow networks. Needs no ray casting."""

from .pairs import FlowPair, flow_pair, flow_pairs
from .random_scenes import FlowPairSettings

__all__ = ["FlowPair", "FlowPairSettings", "flow_pair", "flow_pairs"]
