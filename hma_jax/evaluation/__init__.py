"""Evaluation: metric definitions and the protocol that applies them to a trained model."""
