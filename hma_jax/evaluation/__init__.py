"""Evaluation: what a model is asked to predict, the numbers of every window, and their means with errors."""
