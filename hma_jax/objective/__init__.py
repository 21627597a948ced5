"""What a model is trained for: masking, losses, and the mathematics of diffusion."""
