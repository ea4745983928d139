"""Timing of the stages against named peers."""
