"""The systems that came before TagAttention, each whole: from raw recordings to its own paper's tables.

`host_trace` runs one over a recording, frame by frame; `AbstractHostTracer` is what each of them is.
"""

from ._interface import AbstractHostTracer as AbstractHostTracer
from ._interface import Claim as Claim
from ._interface import HostCamera as HostCamera
from ._interface import HostFrame as HostFrame
from ._interface import claims_to_trace as claims_to_trace
from ._interface import host_frames as host_frames
from ._interface import host_trace as host_trace
