"""Checks that every configuration uses."""

from __future__ import annotations

import dataclasses
import functools
import math
import sys
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal

BEFORE = "before"
"""The key of a field's metadata under which `later` keeps its value."""

SCALARS = (bool, int, float, str)
"""Types of single values. Besides configs and tuples, only values of these types are checked."""

UNIONS = (typing.Union, types.UnionType)


class ConfigError(ValueError):
    """A configuration that cannot work; the message names the field and what to change."""


def later(default: Any, *, before: Any = dataclasses.MISSING) -> Any:
    """A field that was added after things had been named by its configuration: finished trials, trained tokenizers,
    token stores. `before` is the value that computes what was computed without the field, if that is not its default. A
    field with this value is part of no name (`json.identity_of`), and a configuration read from a file without the
    field gets this value."""
    return dataclasses.field(default=default, metadata={BEFORE: default if before is dataclasses.MISSING else before})


def require(condition: bool, message: str) -> None:
    """Raises ConfigError(message) unless `condition` holds."""
    if not condition:
        raise ConfigError(message)


def require_shapes(what: str, found: Mapping[str, Any], wanted: Mapping[str, tuple[int, ...]]) -> None:
    """Raises ConfigError, which begins with `what`, unless the arrays in `found` have the shapes `wanted`. None has no
    shape; anything else that is not an array is named by its type."""
    shapes = {
        name: None if array is None else getattr(array, "shape", type(array).__name__) for name, array in found.items()
    }
    wrong = [f"{name} {shape}, got {shapes[name]}" for name, shape in wanted.items() if shapes[name] != shape]
    require(not wrong, f"{what} {'; '.join(wrong)}")


def require_seed(seed: int, where: str) -> None:
    """Raises ConfigError, which begins with `where`, unless `seed` is in [0, 2^32): JAX uses 32 bits of a seed, so that
    2^32 would be the same as 0, and NumPy accepts no negative seed."""
    require(0 <= seed < 2**32, f"{where} must lie in [0, 2^32), got {seed}")


def require_choice(value: Any, choices: tuple[Any, ...], where: str) -> None:
    """Raises ConfigError, which begins with `where`, unless `value` is one of `choices`."""
    known = ", ".join(map(str, choices))
    require(value in choices, f"{where}: {value!r} is not allowed; choose one of {known}")


def check_fields(config: Any, infinite_allowed: tuple[str, ...] = ()) -> None:
    """Raises ConfigError for a field of a dataclass whose value is not of its declared type (`as_declared`), and for a
    number that is not finite. Fields in `infinite_allowed` may be infinite: no limit.

    A list is replaced by a tuple, because configurations are hashed, as keys of compiled programs. A NumPy number is
    replaced by a Python number, which JSON can hold."""
    where = type(config).__name__
    for name, hint in hints_of(type(config)).items():
        value = getattr(config, name)
        if type(value) is not hint:  # usually it is
            value = as_declared(hint, value, f"{where}.{name}", _as_made)
            object.__setattr__(config, name, value)
        finite = (
            not isinstance(value, float) or math.isfinite(value) or (name in infinite_allowed and value == math.inf)
        )
        require(finite, f"{where}.{name} must be finite, got {value}")


@functools.cache  # cached by class: thousands of configs are made and read
def hints_of(cls: type) -> dict[str, Any]:
    """The types of a dataclass's fields, by their names."""
    hints = typing.get_type_hints(cls)
    return {f.name: hints[f.name] for f in dataclasses.fields(cls)}


def as_declared(hint: Any, value: Any, where: str, plain: Callable[[Any, Any, str], Any]) -> Any:
    """`value` for a field of type `hint`: one of the choices of a Literal, a tuple (also made from a list), or, for a
    union, the member that `value` looks like. For other types it is what `plain(hint, value, where)` returns. Raises
    ConfigError, which begins with `where`."""
    if choices := _choices(hint):
        require_choice(value, choices, where)
        return value
    origin = typing.get_origin(hint)
    if origin in UNIONS:
        if value is None and type(None) in typing.get_args(hint):
            return None
        options = [option for option in typing.get_args(hint) if option is not type(None)]
        return as_declared(_member(options, value, where), value, where, plain)
    if origin is tuple:
        require(isinstance(value, (list, tuple)), f"{where}: expected a list, got {value!r}")
        args = typing.get_args(hint)
        if len(args) == 2 and args[1] is Ellipsis:
            args = (args[0],) * len(value)
        require(len(value) == len(args), f"{where}: expected {len(args)} values, got {value!r}")
        return tuple(as_declared(a, v, where, plain) for a, v in zip(args, value, strict=True))
    return plain(hint, value, where)


def as_scalar(hint: type, value: Any, where: str) -> Any:
    """`value` for a field of one of the types `SCALARS`. A NumPy number becomes a Python number. 1000.0 becomes 1000
    where `hint` is int, and 1 becomes 1.0 where `hint` is float: equal configurations have one name. Raises
    ConfigError, which begins with `where`, for everything else: a bool is not a number, and a number is not a bool."""
    given = value
    if getattr(value, "shape", None) == ():
        value = value.item()  # a NumPy number, or an array of one number
    if hint is int and isinstance(value, float) and value.is_integer():
        value = int(value)
    kinds = (int, float) if hint is float else hint
    fits = isinstance(value, kinds) and (hint is bool or not isinstance(value, bool))
    require(fits, f"{where}: expected {hint.__name__}, got {given!r}")
    if isinstance(value, int):
        most = sys.float_info.max if hint is float else sys.maxsize
        require(abs(value) <= most, f"{where}: the number is too large for {hint.__name__}")
    return float(value) if hint is float else value


def _as_made(hint: Any, value: Any, where: str) -> Any:
    if hint in SCALARS:
        return as_scalar(hint, value, where)
    fits = not dataclasses.is_dataclass(hint) or isinstance(value, hint)
    require(fits, f"{where}: expected {getattr(hint, '__name__', hint)}, got {value!r}")
    return value


def _member(options: list[Any], value: Any, where: str) -> Any:
    """The member of a union that `value` is meant for: the tuple if it is a list, its own class, or, among configs, the
    one with the same `kind`; otherwise the first member."""
    if len(options) == 1:  # it may be one that `isinstance` refuses, such as Any
        return options[0]
    for option in options:
        kinds = (list, tuple) if typing.get_origin(option) is tuple else option
        if isinstance(kinds, (type, tuple)) and isinstance(value, kinds):
            return option
    if not isinstance(value, dict) or "kind" not in value:
        return options[0]
    kinds = {option.kind: option for option in options if hasattr(option, "kind")}
    require(value["kind"] in kinds, f"{where}: unknown kind {value['kind']!r}; known: {', '.join(kinds)}")
    return kinds[value["kind"]]


@functools.cache
def _choices(hint: Any) -> tuple[Any, ...]:
    """The values of a Literal, or of `Literal | None`; empty for other types."""
    if typing.get_origin(hint) in UNIONS:
        options = [option for option in typing.get_args(hint) if option is not type(None)]
        choices = _choices(options[0]) if len(options) == 1 else ()
        return (*choices, None) if choices else ()
    return typing.get_args(hint) if typing.get_origin(hint) is Literal else ()
