"""What limits a recording: measured values of its reads, clock and camera, each with a verdict and what to change."""

from .line import VERDICTS as VERDICTS
from .line import Line as Line
from .measure import Limits as Limits
from .measure import find_limits as find_limits
from .thresholds import Thresholds as Thresholds
