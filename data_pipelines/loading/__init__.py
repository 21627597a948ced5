"""Batches for training: windows of a token store, or frames for a tokenizer."""
