"""The simulated reader: radio channel, inventory rounds, clocks and noise."""
