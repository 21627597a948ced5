"""The model: embed -> stems -> trunk -> heads."""

from hma_jax.model.hma import HMA, declare_model

__all__ = ["HMA", "declare_model"]
