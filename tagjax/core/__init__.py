"""Numerics, compilation, constrained parameters, camera geometry and files: what every other package builds on."""
