"""`hma bench`: how fast it is, here; the measuring is in `experiments.bench`."""
