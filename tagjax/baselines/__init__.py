"""The systems published before TagAttention, each from raw recordings to the tables of its own paper.

Each package has the same inside: `tracer` (the system), `detection`, `tracks` and `matching` (its method),
`calibration` or `training`, `experiment` (the paper's tables; needs recordings) and `figures` (needs matplotlib).
`host_trace` runs any of them over a recording; `AbstractHostTracer` is their common interface.
"""

from .host_tracer import AbstractHostTracer as AbstractHostTracer
from .host_tracer import Detection as Detection
from .host_tracer import HostCamera as HostCamera
from .host_tracer import HostFrame as HostFrame
from .host_tracer import host_frames as host_frames
from .host_tracer import host_trace as host_trace
from .host_tracer import trace_from_detections as trace_from_detections
