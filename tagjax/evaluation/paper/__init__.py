"""The papers' figures from suites: a table of figures, their recordings and functions, and a run that draws them."""

from .run import Drawn as Drawn
from .run import run_paper as run_paper
from .settings import PaperConfig as PaperConfig
from .table import suites as suites
