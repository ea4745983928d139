"""Moving blobs and phases, without pixel fusion: what an engineer would build first, to tell what fusion adds.

Background subtraction in depth and colour; connected bodies in 3D, and their parts; a Kalman filter for each track; the
coherent likelihood of each tag's phases given each track's range; and the best assignment of tags to tracks. It has no paper.
"""

from .settings import BlobSettings as BlobSettings
from .tracer import BlobTracer as BlobTracer
