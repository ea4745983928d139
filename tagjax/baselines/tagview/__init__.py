"""Tagview (Duan et al., INFOCOM 2020): camera and antenna at the ceiling, phase linear in the translating factor.

`experiment` holds the paper's tables, `figures` its plots; both are imported by name.
"""

from .settings import TagviewSettings as TagviewSettings
from .tracer import TagviewTracer as TagviewTracer
from .weights import load_weights as load_weights
from .weights import save_weights as save_weights
