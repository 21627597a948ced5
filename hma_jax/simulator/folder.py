"""A simulator on disk: a run, its tokenizer, the commands of its robots, and starts of episodes.

    RUN/checkpoints   the model (`hma_jax.training.runs`)
    RUN/tokenizer     or RUN/../tokenizer, where a study has it
    RUN/robots.json   ranges and names of the robots' commands, as recorded
    RUN/starts.npz    beginnings of recorded episodes
    RUN/decode.json   how its frames are best filled

The last three may be absent.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hma_jax.config import ConfigError, DecodeConfig, SamplerConfig, require
from hma_jax.config.json import completed, from_dict, to_dict
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.runtime.files import write_file
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.starts import FILE as STARTS
from hma_jax.simulator.starts import Start, load_starts
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.tokenizers.io import load_tokenizer
from hma_jax.training.runs import Run

ROBOTS = "robots.json"
TOKENIZER = "tokenizer"
DECODE = "decode.json"

DEFAULT_DECODE = DecodeConfig(sampler=SamplerConfig("dpm++", 12, temperature=0.0))
"""How frames are decoded without a decode.json: greedily. Latents are decoded greedily too, with fewer evaluations of
the denoiser than in evaluation."""


def find_tokenizer(directory: Path, run: Run, given: Path | None) -> Tokenizer:
    """The tokenizer whose tokens the run was trained on; of a link to a run, that beside the run before that beside the
    link. Raises ConfigError if there is none, or a different one."""
    homes = [directory.resolve().parent] * directory.is_symlink() + [directory.absolute().parent]
    places = [Path(given)] if given else [directory / TOKENIZER, *(home / TOKENIZER for home in homes)]
    found = [place for place in places if place.is_dir()]
    require(
        bool(found),
        f"no tokenizer at {' or '.join(map(str, places))}; copy the tokenizer that {directory} was trained with "
        "there, or give its directory with --tokenizer if the command has that option",
    )
    tokenizer, wanted = load_tokenizer(found[0]), run.provenance.get("tokenizer")
    require(
        wanted in (None, tokenizer.identity),
        f"{directory} was trained on tokens of tokenizer {wanted}, but {found[0]} is {tokenizer.identity}; copy the "
        "right one there, or give its directory with --tokenizer if the command has that option",
    )
    return tokenizer


def find_robots(directory: Path, table: EmbodimentTable) -> tuple[Robot, ...]:
    """The robots of the table that have actions, as robots.json describes them, or otherwise from their statistics."""
    described = {robot.name: robot for robot in load_robots(directory / ROBOTS)}
    return tuple(described.get(e.name) or Robot.of(e) for e in table.entries if e.action_dim)


def find_starts(directory: Path) -> tuple[Start, ...]:
    """The starts in starts.npz; none without that file."""
    path = directory / STARTS
    return load_starts(path) if path.exists() else ()


def find_decode(directory: Path) -> DecodeConfig:
    """The settings in decode.json. Fields that it leaves out are as in DEFAULT_DECODE or, for fields that may be newer
    than the file (`hma_jax.config.base.later`), have the value from before; a `temperature` alone is also that of the
    sampler. Raises ConfigError for a damaged file."""
    path = directory / DECODE
    stated = completed(_read(path), DEFAULT_DECODE) if path.exists() else {}
    usual = to_dict(DEFAULT_DECODE)
    if isinstance(stated, dict) and "temperature" in stated:
        usual["sampler"]["temperature"] = stated["temperature"]
    return from_dict(DecodeConfig, _completed(usual, stated), str(path))


def _completed(usual: Any, stated: Any) -> Any:
    """`stated`, with missing fields taken from `usual`."""
    if not (isinstance(usual, dict) and isinstance(stated, dict)):
        return stated
    return usual | {name: _completed(usual.get(name), value) for name, value in stated.items()}


def change_decode(decode: DecodeConfig, temperature: float | None = None, **fields: Any) -> DecodeConfig:
    """`decode` with other `fields`; None keeps a field. `temperature` applies to whatever a model samples, token ids or
    latents."""
    given = {name: value for name, value in fields.items() if value is not None}
    if temperature is not None:
        sampler = replace(given.get("sampler", decode.sampler), temperature=temperature)
        given |= {"temperature": temperature, "sampler": sampler}
    return replace(decode, **given)


def load_robots(path: Path) -> tuple[Robot, ...]:
    """The robots in a file; empty if there is none. Raises ConfigError for a damaged file."""
    if not path.exists():
        return ()
    rows = _read(path)
    require(isinstance(rows, list), f"{path} is not a list of robots; make it again")
    return tuple(from_dict(Robot, row, f"{path}: robot {i}") for i, row in enumerate(rows))


def save_robots(robots: Sequence[Robot], path: Path) -> None:
    _write(path, [to_dict(robot) for robot in robots])


def save_decode(decode: DecodeConfig, path: Path) -> None:
    _write(path, to_dict(decode))


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read ({error}); make it again") from error


def _write(path: Path, content: Any) -> None:
    write_file(path, json.dumps(content, indent=1) + "\n")
