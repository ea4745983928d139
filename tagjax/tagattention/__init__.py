"""TagAttention as a learnable tracer (Shi et al., ToN 2021)."""

from ._parameters import AbstractTagAttention as AbstractTagAttention
from ._parameters import paper_limit as paper_limit
from ._tracer import Belief as Belief
from ._tracer import Place as Place
from ._tracer import TagAttention as TagAttention
from ._tracer import TagAttentionState as TagAttentionState
