"""Optical flow: networks, losses, estimates, weights, and named flows. `opencv` and `named` import cv2."""
