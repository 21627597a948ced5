"""Training: state, optimiser, sharded step, checkpoints and the one loop around them."""
