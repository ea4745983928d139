"""Moving blobs and phases, without pixel fusion: what an engineer would build first, to tell what fusion adds.

Background subtraction in depth and colour, connected parts in 3D, a Kalman filter for each track, the coherence of each tag's
phases with each track's range, and the best assignment of tags to tracks. It has no paper.
"""

from .settings import BlobSettings as BlobSettings
from .tracer import BlobTracer as BlobTracer
