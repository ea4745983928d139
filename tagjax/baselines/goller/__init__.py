"""Goller et al. (IEEE RFID 2014): antenna mixture, motion blobs, HMM association and an alarm at the exit.

`experiment` holds the paper's tables, `figures` its plots; both are imported by name.
"""

from .calibration import Calibration as Calibration
from .calibration import load_calibration as load_calibration
from .calibration import save_calibration as save_calibration
from .settings import GollerSettings as GollerSettings
from .tracer import GollerTracer as GollerTracer
