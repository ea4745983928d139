"""Trials of faults: damaged and hostile inputs, each of which must end in a sound result or in one clear line."""
