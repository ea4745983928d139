"""Goller et al.'s own experiments: alarms at a shop's exit (Tables I and II), hand-over (Fig. 7), sensor ablation."""

from .run import GollerExperiment as GollerExperiment
from .run import run_goller as run_goller
