"""Importers of RGB-D recordings of any camera, one file a format; frames are streamed, never held all at once.

A format is a function that opens a path as an `RgbdSource` (source.py): its cameras, and its colour and depth pictures in
the order in which they are stored. The rest is the same for all formats: pictures are paired by time (pairing.py), lens
distortion is undone and depth is registered to colour (views.py), and frames go to the store one by one (streaming.py).
"""
