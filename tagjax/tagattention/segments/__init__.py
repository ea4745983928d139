"""The tracer whose state lives on persistent segments, shared by all tags."""
