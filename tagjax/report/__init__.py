"""Pictures: overlays and curves."""
