"""Scores of boxes, masks, identities, tracks and optical flow."""
