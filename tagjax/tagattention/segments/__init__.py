"""The tracer on segments: persistent segments that follow the flow, evidence of the reads, and the body that carries a tag."""

from .background import Background as Background
from .body import Bodies as Bodies
from .body import CarryingBody as CarryingBody
from .dwell import DwellEvidence as DwellEvidence
from .labels import Segmenter as Segmenter
from .place_memory import PlaceMemory as PlaceMemory
from .place_memory import PlaceState as PlaceState
from .rigid import RigidMotion as RigidMotion
from .step import SegmentFrame as SegmentFrame
from .step import SegmentTracker as SegmentTracker
from .step import SegmentTrackerState as SegmentTrackerState
from .travel import Travel as Travel
from .travel import TravellingTogether as TravellingTogether
from .travel import TravelState as TravelState
