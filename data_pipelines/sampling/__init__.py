"""All random choices of the data path, as functions of a seed: order, splits and subsets, the mixture of datasets."""
