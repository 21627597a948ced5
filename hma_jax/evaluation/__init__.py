"""Evaluation: what a model is asked to predict, every window's numbers, their means and errors."""
