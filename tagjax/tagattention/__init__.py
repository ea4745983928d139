"""TagAttention as a learnable tracer (Shi et al., ToN 2021)."""

from .segments import TagAttention as TagAttention
from .segments import TagAttentionState as TagAttentionState
