"""Overrides of single settings of a study, as --set gives them: 'path=value'.

Owns how a value is parsed, and the suggestions for an unknown path. A path that ends in `help` prints `settings_help`.
"""

from __future__ import annotations

import difflib
import json
import types
import typing
from collections.abc import Collection, Mapping, Sequence
from dataclasses import is_dataclass
from typing import Any, Literal

from experiments.study import Study
from experiments.user_input.settings_help import describe_settings, show_settings
from hma_jax.config import ConfigError, ModelConfig, require
from hma_jax.config.json import from_dict, leaves, to_dict

ABBREVIATED = {"lr": "learning_rate", "batch_size": "batch", "num_steps": "steps"}
"""Names of other projects for the same."""

OF_A_TRIAL = "train.seed"
"""What a trial takes from the study's `seeds`: `Study` refuses any other value."""


def override(study: Study, settings: Sequence[str], model: ModelConfig | None = None) -> Study:
    """`study` (with `model` in place of its own, if given), with fields changed by 'path=value' strings such as
    'model.frames=4'.

    Values are JSON; lists may be written '4,8,16'. Raises ConfigError for an unknown path
    (with the closest known one) or a value of the wrong kind. 'help' and 'model.help' show the settings, as changed by
    the strings before, and end the program as --help does.
    """
    values = to_dict(study) | ({} if model is None else {"model": to_dict(model)})
    before = leaves(values)
    for setting in settings:
        path, separator, text = setting.partition("=")
        if not separator and path.split(".")[-1] == "help":
            _show(values, path.removesuffix("help").removesuffix("."))
            raise SystemExit(0)
        advice = "write it as path=value, such as model.frames=4; --set help lists all settings"
        require(bool(separator), f"--set {setting}: {advice}")
        _assign(values, before, path.strip(), text.strip())
    return from_dict(Study, values)


def _show(values: dict[str, Any], group: str) -> None:
    """Prints all settings, or those of a group. Raises ConfigError if there is no such group."""
    found = [
        one
        for one in describe_settings(from_dict(Study, values))
        if one.path != OF_A_TRIAL and (not group or one.path == group or one.path.startswith(f"{group}."))
    ]
    if not found:
        raise ConfigError(f"--set {group}.help: {_instead(values, group, leaves(values))}")
    show_settings(found, f"Settings of preset {values['name']}; --set PATH=VALUE changes one")


def _assign(values: dict[str, Any], before: Mapping[str, Any], path: str, text: str) -> None:
    """Puts the parsed `text` at `path`, in place. Its type is that of the value `before` any override: an earlier
    override of the same path may have left a whole number in place of a fraction."""
    known = leaves(values)
    if path not in known:
        raise ConfigError(f"--set {path}: {_instead(values, path, known)}")
    node = values
    *parents, last = path.split(".")
    for parent in parents:
        node = node[parent]
    node[last] = _parse(path, text, before.get(path, node[last]))


def _instead(values: dict[str, Any], path: str, known: Collection[str]) -> str:
    """The message for an unknown setting: a name that was probably meant, or the names of its group."""
    node, at, rest = values, [], path.split(".")
    while rest and isinstance(node, dict) and rest[0] in node:
        node = node[rest[0]]
        at.append(rest.pop(0))
    group = ".".join(at)
    if not isinstance(node, dict):  # the path continues below a value
        if node is None and group == "model.diffusion":
            return f"{group} is null in this study, whose tokens are ids; use a preset that ends in -continuous"
        return f"no such setting; {group} is a value, {json.dumps(node)}"
    names = [f"{name}.*" if isinstance(value, dict) else name for name, value in node.items()]
    inside = f"{group or 'a study'} has {', '.join(names)}"
    if not rest:
        return f"this is a group of settings, set one of them; {inside}"
    meant = _meant(node, group, rest, known)
    return f"no such setting; did you mean {' or '.join(meant[:4])}?" if meant else f"no such setting; {inside}"


def _meant(node: dict[str, Any], group: str, rest: Sequence[str], known: Collection[str]) -> list[str]:
    """Settings that the rest of a path below `group` probably means, by the first rule that finds any."""
    last = ABBREVIATED.get(rest[-1], rest[-1])
    known = [k for k in known if k != OF_A_TRIAL]
    last_parts = {k.split(".")[-1] for k in known}

    def in_group(cutoff: float) -> list[str]:
        near = difflib.get_close_matches(last, node, n=3, cutoff=cutoff) if len(rest) == 1 else []
        return [k for k in (f"{group}.{n}" if group else n for n in near) if k in known]

    def by_leaf(leaf: str) -> list[str]:
        found = [k for k in known if k.split(".")[-1] == leaf]
        return [k for k in found if group and k.startswith(f"{group}.")] or found

    whole = ".".join([group, *rest]).strip(".")
    return (
        [k for k in known if k.endswith("." + ".".join(rest)) and len(rest) > 1]  # the end of a path
        or (difflib.get_close_matches(whole, known, n=1, cutoff=0.9) if len(rest) > 1 else [])
        or list(dict.fromkeys(in_group(0.85) + by_leaf(last)))  # a typing error, or the right name in the wrong place
        or (in_group(0.6) if group else [])
        or difflib.get_close_matches(whole, known, n=3, cutoff=0.8)
        or [k for leaf in difflib.get_close_matches(last, last_parts, n=1, cutoff=0.8) for k in by_leaf(leaf)]
    )


def _of_names(config: type, path: str) -> bool:
    """Whether the setting at `path` of a `config` is a list of names, which may be empty."""
    name, _, rest = path.partition(".")
    hint = typing.get_type_hints(config).get(name)
    kinds = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
    if rest:
        return any(is_dataclass(kind) and _of_names(kind, rest) for kind in kinds)
    elements = [typing.get_args(kind)[0] for kind in kinds if typing.get_origin(kind) is tuple]
    return any(element is str or typing.get_origin(element) is Literal for element in elements)


def _parse(path: str, text: str, old: Any) -> Any:
    """A value of the same type as `old`, from command-line text."""
    if isinstance(old, str):
        return text
    if isinstance(old, list) and not text.startswith("["):
        items = [t.strip() for t in text.split(",") if t.strip()]
        return items if _of_names(Study, path) else [_json(path, t, "numbers separated by commas") for t in items]
    value = _json(
        path, text, "a number, true, false, null or list" if old is None else f"a value like {json.dumps(old)}"
    )
    if old is not None and value is not None:
        number = isinstance(old, (int, float)) and not isinstance(old, bool)
        fits = isinstance(value, (int, float)) if number else isinstance(value, type(old))
        if isinstance(old, int) and isinstance(value, float) or isinstance(value, bool) and number:
            fits = False
            whole = number and isinstance(value, float) and value.is_integer()
            require(not whole, f"--set {path}={text}: expected a whole number, written {value:.0f}")
        require(fits, f"--set {path}={text}: expected a value like {json.dumps(old)}")
    return value


def _json(path: str, text: str, expected: str) -> Any:
    """The value of JSON `text`. `expected`: what is allowed there, for the message."""
    try:
        return json.loads(text.lower() if text in ("True", "False", "None") else text)
    except json.JSONDecodeError:
        if text == "None":
            return None
        raise ConfigError(f"--set {path}={text}: expected {expected}") from None
