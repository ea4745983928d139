"""TagAttention as its paper describes it (Shi et al., 2021), in the reading that finds and keeps objects."""

from .tracer import TagAttentionPublished as TagAttentionPublished
