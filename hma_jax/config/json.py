"""Configs as JSON, both ways, with a stable hash and a readable difference.

It works on any frozen dataclass of scalars, tuples and other such dataclasses (see `config`): no field is known here by
name.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from typing import Any

from hma_jax.config.base import BEFORE, SCALARS, as_declared, as_scalar, hints_of, require

INFINITE = ("Infinity", "-Infinity")
"""Numbers that `to_plain_json` writes as strings."""


def to_dict(config: Any) -> Any:
    """Plain JSON types from a config (dataclasses, tuples and scalars, nested)."""
    return _plain(config)


def identity_of(config: Any) -> Any:
    """What names `config` and what it is compared by: `to_dict` without the later fields (`base.later`) that have the
    value which computes what was computed before. It is equal for equal results, whatever fields are added."""
    return _plain(config, names=True)


def _plain(config: Any, names: bool = False) -> Any:
    """`to_dict` or, with `names`, `identity_of`."""
    if config is None or isinstance(config, (str, int, float)):  # most of what there is
        return config
    if dataclasses.is_dataclass(config):
        values = {f.name: _plain(getattr(config, f.name), names) for f in dataclasses.fields(config)}
        for f in dataclasses.fields(config) if names else ():
            if BEFORE in f.metadata and values[f.name] == _plain(f.metadata[BEFORE], names):
                del values[f.name]
        return values
    if isinstance(config, (tuple, list)):
        return [_plain(v, names) for v in config]
    if isinstance(config, dict):
        return {k: _plain(v, names) for k, v in config.items()}
    return config


def completed(values: Any, like: Any) -> Any:
    """`values`, as any version wrote them for a config such as `like` or for a dict that holds some, with the missing
    later fields (`base.later`) added: they get the value from before. Comparable with `to_dict(like)`."""
    before = {}
    if dataclasses.is_dataclass(like):
        before = {f.name: to_dict(f.metadata[BEFORE]) for f in dataclasses.fields(like) if BEFORE in f.metadata}
        like = vars(like)
    if not (isinstance(like, dict) and isinstance(values, dict)):
        return values
    return before | {name: completed(value, like.get(name)) for name, value in values.items()}


def from_dict(cls: type, values: dict[str, Any], where: str = "") -> Any:
    """A `cls` from the output of `to_dict`, also of an earlier version's, or of `identity_of`. A missing later field
    (`base.later`) gets the value from before, any other missing field its default.

    Unknown keys, missing ones without a default, values of the wrong kind and unknown choices raise ConfigError, which
    names the field.
    """
    hints = hints_of(cls)
    known = {f.name: f for f in dataclasses.fields(cls)}
    where = where or cls.__name__
    require(isinstance(values, dict), f"{where}: expected named fields ({', '.join(known)}), got {values!r}")
    unknown = sorted(set(values) - set(known))
    require(not unknown, f"{where}: unknown field(s) {', '.join(unknown)}; known: {', '.join(known)}")
    missing = [
        n
        for n, f in known.items()
        if n not in values and f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
    ]
    require(not missing, f"{where}: missing field(s) {', '.join(missing)}")
    before = {n: f.metadata[BEFORE] for n, f in known.items() if BEFORE in f.metadata and n not in values}
    return cls(**before, **{n: as_declared(hints[n], v, f"{where}.{n}", _decode) for n, v in values.items()})


def _decode(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_dict(hint, value, where)
    if hint is float and value in INFINITE:
        return float(value)
    return as_scalar(hint, value, where) if hint in SCALARS else value


def leaves(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Every value in the output of `to_dict` that is not itself a nested config, by its dotted path."""
    found = {}
    for name, value in values.items():
        found |= leaves(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return found


def to_json(config: Any) -> str:
    return json.dumps(to_dict(config), indent=2, sort_keys=True)


def to_strict_json(values: Any) -> str:
    """JSON that any program can read: numbers that are not finite, which JSON does not have, are null."""
    return json.dumps(json.loads(json.dumps(values), parse_constant=lambda _: None), indent=1)


def to_plain_json(values: Any) -> str:
    """JSON that any program can read, and `from_dict` can read back: numbers that are not finite, which JSON does not
    have, are strings. `from_dict` reads "Infinity" and "-Infinity" as numbers."""
    return json.dumps(json.loads(json.dumps(values), parse_constant=str), indent=1)


def stable_hash(config: Any) -> str:
    """Hex digest of the canonical JSON, in which configs are represented by their `identity_of`: the same on every
    machine, with every Python version, and after fields were added."""
    # `identity_of` is not applied to the whole: most of what is hashed is JSON already, and copying it takes longer
    # than the rest.
    canonical = json.dumps(config, sort_keys=True, separators=(",", ":"), default=_of_dataclass)
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]


def _of_dataclass(config: Any) -> dict[str, Any]:
    if not dataclasses.is_dataclass(config):
        raise TypeError(f"Object of type {type(config).__name__} is not JSON serializable")
    return identity_of(config)


def diff(old: Any, new: Any, path: str = "") -> list[str]:
    """Readable lines 'field: old -> new' for every difference between two configs. List entries that have a name, as
    robots do, are matched by it."""
    a, b = to_dict(old), to_dict(new)
    if (old_named := _by_name(a)) and (new_named := _by_name(b)):
        lines = diff(old_named, new_named, path) if old_named.keys() == new_named.keys() else []
        return lines or ([] if a == b else [f"{path}: {list(old_named)} -> {list(new_named)}"])
    if isinstance(a, dict) and isinstance(b, dict):
        lines = []
        for key in sorted(set(a) | set(b)):
            lines += diff(a.get(key), b.get(key), f"{path}.{key}" if path else key)
        return lines
    return [] if a == b else [f"{path}: {a!r} -> {b!r}"]


def _by_name(value: Any) -> dict[str, Any]:
    """A list of objects with distinct names, as a dict by name; empty for anything else."""
    if not isinstance(value, list) or not all(
        isinstance(one, dict) and isinstance(one.get("name"), str) for one in value
    ):
        return {}
    named = {one["name"]: one for one in value}
    return named if len(named) == len(value) else {}
