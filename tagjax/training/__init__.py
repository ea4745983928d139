"""Learning without labels: objective, step, loop, checkpoints, logging."""
