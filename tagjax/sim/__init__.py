"""Simulation: a reader, virtual tags for real video, and rooms with walking people (needs the sim extra)."""
