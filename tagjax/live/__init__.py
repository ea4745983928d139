"""A running stream: its results frame by frame, events, a web page, and sensors that are recorded meanwhile."""
