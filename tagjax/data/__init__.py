"""Recordings on disk, clips, and importers."""
