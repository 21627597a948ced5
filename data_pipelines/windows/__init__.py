"""Windows over the episodes of a token store: which exist, how they are sliced, which are held out for evaluation."""
