"""Robot data in, batches out: RLDS shards, token store, windows, mixtures, loaders, suites."""
