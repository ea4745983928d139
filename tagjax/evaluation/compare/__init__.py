"""All four systems on the same recordings, in one table."""

from ._run import CompareConfig as CompareConfig
from ._run import console_table as console_table
from ._run import run_comparison as run_comparison
from ._systems import NAMES as NAMES
from ._systems import Systems as Systems
from ._systems import SystemSettings as SystemSettings
from ._table import Cell as Cell
from ._table import markdown as markdown
