"""Tagview's own experiments: identification of trains, separated traces, equal phases, tracking error (VI.B-D)."""

from .detector import train_tagview as train_tagview
from .run import TagviewExperiment as TagviewExperiment
from .run import run_tagview as run_tagview
from .tables import report_markdown as report_markdown
