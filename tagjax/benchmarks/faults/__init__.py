"""Trials of faults: bad input and interruptions, tried and failed by kind."""
