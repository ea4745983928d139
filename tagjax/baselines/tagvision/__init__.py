"""TagVision (Duan et al., INFOCOM 2017): blob tracks on a calibrated plane, matched to tags by their phases.

`experiment` holds the paper's tables, `figures` its plots; both are imported by name.
"""

from .plane import PlaneCamera as PlaneCamera
from .plane import load_calibration as load_calibration
from .plane import save_calibration as save_calibration
from .settings import TagVisionSettings as TagVisionSettings
from .tracer import TagVisionTracer as TagVisionTracer
