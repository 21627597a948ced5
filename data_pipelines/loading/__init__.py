"""From episodes to batches: splits, windows, mixture, order, and the frozen evaluation windows."""
