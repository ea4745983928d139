"""Optical flow: named baselines. `tagjax.flow.opencv` imports cv2."""
