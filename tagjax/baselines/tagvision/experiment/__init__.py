"""TagVision's own experiments: parallel lines (Fig. 6), camera calibration (VI.B), objects that move over a table."""

from .run import TagVisionExperiment as TagVisionExperiment
from .run import run_tagvision as run_tagvision
from .tables import report_markdown as report_markdown
