"""Windows over the episodes of a token store: which there are, how they are cut, which are held out for evaluation."""
