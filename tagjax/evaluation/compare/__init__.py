"""All four systems on the same recordings, in one table."""

from .run import CompareConfig as CompareConfig
from .run import console_table as console_table
from .run import run_comparison as run_comparison
from .systems import NAMES as NAMES
from .systems import Systems as Systems
from .systems import SystemSettings as SystemSettings
from .table import Cell as Cell
from .table import markdown as markdown
