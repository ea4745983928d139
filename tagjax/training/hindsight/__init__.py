"""Learning from hindsight: the tracer, online, learns to say what it says offline, when it knows all later reads.

No label enters. The two-pass smoother knows the reads and the motion of the whole recording; where it is sure, its masks are
what the online tracer should have said. Segments do not depend on what is learned, so they are computed once (`pieces`);
a step then traces whole recordings, without a pixel, in a second each (`objective`).
"""

from .files import PieceFiles
from .likelihood import FilmedFrames
from .objective import HindsightSettings
from .pieces import Piece, PieceFrames, segment_pieces
from .windows import PieceWindows, Window

__all__ = [
    "FilmedFrames",
    "HindsightSettings",
    "Piece",
    "PieceFiles",
    "PieceFrames",
    "PieceWindows",
    "Window",
    "segment_pieces",
]
