"""Which of several real tracks carries a tag: the association score of each method, by window length.

`scenes` reads the tracks, `association` scores virtual tags on them, `real_tags` the real tags recorded beside them.
"""

from .run import run_tracks as run_tracks
from .scenes import TracksConfig as TracksConfig
