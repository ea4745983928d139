"""Depth from two colour cameras: calibration, rectification, semi-global matching, and recordings made of it.

TagAttention, section V-F, option 2: a pair of calibrated RGB cameras in place of an RGB-D camera. The first camera is the
left one, seen from behind; the recording is in its view.
"""
