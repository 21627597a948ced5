"""What is learnt: masking, losses, and the mathematics of diffusion."""
