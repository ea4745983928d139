"""Persistent segments that follow the flow: the pixel side of the tracer on segments, shared by all tags."""

from .background import Background as Background
from .labels import Segmenter as Segmenter
from .step import SegmentFrame as SegmentFrame
from .step import SegmentTracker as SegmentTracker
from .step import SegmentTrackerState as SegmentTrackerState
