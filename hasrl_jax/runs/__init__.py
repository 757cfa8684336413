"""The directory of a run: configuration, checkpoints, metrics."""
