"""What every configuration is checked with."""

from __future__ import annotations


class ConfigError(ValueError):
    """A configuration that cannot work; the message names the field and what to change."""


def require(condition: bool, message: str) -> None:
    """Raises ConfigError(message) unless `condition` holds."""
    if not condition:
        raise ConfigError(message)
