"""The radio side: phase model, unwrapping, channel offsets, robust distance estimation, coherence."""
