"""TagAttention as a learnable tracer (Shi et al., ToN 2021)."""

from ._stages import Belief as Belief
from ._stages import Place as Place
from ._stages import TagAttentionState as TagAttentionState
from ._tracer import TagAttention as TagAttention
from ._tracer import paper_limit as paper_limit
