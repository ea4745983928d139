"""Tracers: the interface, clips of recordings as device arrays, and the loop over a recording."""
