"""The tracer on segments in NumPy and OpenCV: what the JAX tracer is timed against, and checked by.

It is written as NumPy is best used: loops over what there is (pixels in front of the background, segments that exist, reads
that came), state changed in place. Settings and constants are those of the `TagAttention` that it is made from, so that the
two can differ in their arithmetic only.
"""

from .tracer import NumpyTrace as NumpyTrace
from .tracer import NumpyTracer as NumpyTracer
