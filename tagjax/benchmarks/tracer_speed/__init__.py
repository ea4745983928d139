"""How fast the tracer runs live, against the aims set for it and against its NumPy twin."""

from .figures import TracerSpeedSettings as TracerSpeedSettings
from .figures import tracer_figures as tracer_figures
from .memory import MemorySettings as MemorySettings
from .memory import memory_figures as memory_figures
