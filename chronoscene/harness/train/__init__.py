"""One run in its own process: training loop, checkpoints, test views, scores."""
