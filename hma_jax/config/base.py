"""Checks that every configuration uses."""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal

BEFORE = "before"
"""The key of a field's metadata under which `later` keeps its value."""


class ConfigError(ValueError):
    """A configuration that cannot work; the message names the field and what to change."""


def later(default: Any, *, before: Any = dataclasses.MISSING) -> Any:
    """A field that was added after things were named by its configuration: finished trials, trained tokenizers, token
    stores. `before` is the value that computes what was computed without the field, if that is not its default. A field
    that has this value is part of no name (`json.identity_of`); read from a file without the field, it has it."""
    return dataclasses.field(default=default, metadata={BEFORE: default if before is dataclasses.MISSING else before})


def require(condition: bool, message: str) -> None:
    """Raises ConfigError(message) unless `condition` holds."""
    if not condition:
        raise ConfigError(message)


def require_shapes(what: str, found: Mapping[str, Any], wanted: Mapping[str, tuple[int, ...]]) -> None:
    """Raises ConfigError, which begins with `what`, unless the arrays in `found` have the shapes `wanted`; None has
    none, and what is not an array is named by its type."""
    shapes = {
        name: None if array is None else getattr(array, "shape", type(array).__name__) for name, array in found.items()
    }
    wrong = [f"{name} {shape}, got {shapes[name]}" for name, shape in wanted.items() if shapes[name] != shape]
    require(not wrong, f"{what} {'; '.join(wrong)}")


def require_seed(seed: int, where: str) -> None:
    """Raises ConfigError, which begins with `where`, unless `seed` is in [0, 2^32): JAX uses 32 bits of a seed, so that
    2^32 would be the same as 0, and numpy takes no negative one."""
    require(0 <= seed < 2**32, f"{where} must lie in [0, 2^32), got {seed}")


def require_choice(value: Any, choices: tuple[Any, ...], where: str) -> None:
    """Raises ConfigError, which begins with `where`, unless `value` is one of `choices`."""
    known = ", ".join(map(str, choices))
    require(value in choices, f"{where}: {value!r} is not allowed; choose one of {known}")


def check_fields(config: Any, infinite_allowed: tuple[str, ...] = ()) -> None:
    """Raises ConfigError for a field of a dataclass that is not among the choices of its type (a Literal, one or None,
    or a tuple of such), and for a number that is not finite. Fields in `infinite_allowed` may be infinite: no limit.

    A list is replaced by a tuple: configurations are hashed, as keys of compiled programs."""
    where = type(config).__name__
    for name, value in list(vars(config).items()):
        if isinstance(value, list):
            object.__setattr__(config, name, tuple(value))
    for name, choices, several in _choices(type(config)):
        value = getattr(config, name)
        for one in value if several else (value,):
            require_choice(one, choices, f"{where}.{name}")
    for name, value in vars(config).items():
        finite = (
            not isinstance(value, float) or math.isfinite(value) or (name in infinite_allowed and value == math.inf)
        )
        require(finite, f"{where}.{name} must be finite, got {value}")


@functools.cache
def _choices(cls: type) -> tuple[tuple[str, tuple[Any, ...], bool], ...]:
    """(field, its choices, whether it is a tuple of them) of every field with choices."""
    found = []
    for name, hint in typing.get_type_hints(cls).items():
        several = typing.get_origin(hint) is tuple
        choices = _of_literals(typing.get_args(hint)[0] if several else hint)
        if choices:
            found.append((name, choices, several))
    return tuple(found)


def _of_literals(hint: Any) -> tuple[Any, ...]:
    """The values of a Literal, or of `Literal | None`; empty for other types."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        options = [option for option in typing.get_args(hint) if option is not type(None)]
        choices = _of_literals(options[0]) if len(options) == 1 else ()
        return (*choices, None) if choices else ()
    return typing.get_args(hint) if typing.get_origin(hint) is Literal else ()
