"""Seeded choices, below all that make them: order, splits and subsets, the mixture of datasets."""
