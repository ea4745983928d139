"""The systems that came before TagAttention, each whole: from raw recordings to its own paper's tables."""
