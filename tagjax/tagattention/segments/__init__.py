"""The tracer on segments: persistent segments that follow the flow, evidence of the reads, and the body that carries a tag."""

from .association import SegmentTrace as SegmentTrace
from .background import Background as Background
from .body import Bodies as Bodies
from .body import CarryingBody as CarryingBody
from .competition import Competition as Competition
from .detection import Detection as Detection
from .dwell import DwellEvidence as DwellEvidence
from .free_path import FreePath as FreePath
from .labels import Segmenter as Segmenter
from .rigid import RigidMotion as RigidMotion
from .step import SegmentFrame as SegmentFrame
from .step import SegmentTracker as SegmentTracker
from .step import SegmentTrackerState as SegmentTrackerState
from .tracer import TagAttention as TagAttention
from .tracer import TagAttentionState as TagAttentionState
from .travel import Pooling as Pooling
from .travel import TravellingTogether as TravellingTogether
from .travel import TravelState as TravelState
from .whole import WholeBody as WholeBody
