"""The identification that no tracer can exceed by reads: each tag's true distance against those of the other tags."""

from .run import CeilingConfig as CeilingConfig
from .run import run_ceiling as run_ceiling
from .table import console_table as console_table
