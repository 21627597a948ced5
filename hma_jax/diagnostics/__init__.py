"""Diagnostics of models: the coordinate check of muP, and the matrix products that a program computes."""
