"""Scores of boxes, masks, identities and optical flow."""
