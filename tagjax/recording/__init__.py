"""Recordings: what a camera and a reader recorded, how it is stored, and importers from other formats."""

from ..core.camera import Intrinsics as Intrinsics
from ..core.errors import RecordingError as RecordingError
from ..core.errors import RecordingWarning as RecordingWarning
from .reads import TagReads as TagReads
from .recording import ClockAudit as ClockAudit
from .recording import ClockPiece as ClockPiece
from .recording import Recording as Recording
from .recording import SecondCamera as SecondCamera
from .recording import Truth as Truth
