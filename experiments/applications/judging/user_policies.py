"""Policies of the user: `policies(robot)` of a Python file returns them by name. Their actions are checked.

The file may have a function `success` as well (`user_success`): it is run once for both."""

from __future__ import annotations

import inspect
import re
import sys
from pathlib import Path

import numpy as np

from experiments.applications.judging.ladder import OWN_HEAD, RANDOM
from experiments.applications.judging.user_success import PAGE, UserSuccess, success_of
from experiments.applications.policies.kinds import KINDS
from experiments.applications.policies.policy import Policy
from experiments.user_input.user_file import function_of, naming_line, run_file
from hma_jax.config import ConfigError, require
from hma_jax.simulator.interface import WholeNumbers
from hma_jax.simulator.robots import Robot

SIGNATURE = "policies(robot)"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
TAKEN = re.compile(rf"{RANDOM}|{OWN_HEAD}|({'|'.join(KINDS)})-\d+")
"""Names of policies that are made here, whichever of them a judgement has."""


class CheckedPolicy:
    """A user's policy: what it returns follows the protocol, or an error names it. It receives copies, and what it
    returns is copied, so it may write into both."""

    def __init__(self, policy: Policy, robot: Robot, where: str):
        """`where`: file and name, for messages. Raises ConfigError for an object that is not a policy."""
        for method, takes, shown in (
            ("reset", {"episodes": None, "seeds": [0]}, "reset(episodes=None, *, seeds=None)"),
            ("act", {"images": None}, "act(images)"),
        ):
            function = getattr(policy, method, None)
            require(callable(function), f"{where} is of type {type(policy).__name__} and has no {shown} ({PAGE})")
            try:
                signature = inspect.signature(function)
            except ValueError:  # functions written in C may have no signature
                continue
            try:
                signature.bind(*takes.values()) if method == "act" else signature.bind(**takes)
            except TypeError as error:
                raise ConfigError(f"{where}: its {method}{signature} cannot be called as {shown}: {error}") from error
        self.policy, self.robot, self.where = policy, robot, where
        self._shape: tuple[int, ...] | None = None  # of what it returned for an image

    def reset(self, episodes: WholeNumbers | None = None, *, seeds: WholeNumbers | None = None) -> None:
        self.policy.reset(episodes=episodes, seeds=seeds)

    def act(self, images: np.ndarray) -> np.ndarray:
        """Raises ConfigError for actions of another shape or type, and for actions that are not finite."""
        (count, robot), given = (len(images), self.robot), self.policy.act(images.copy())
        shape, chunks = (count, robot.action_dim), (count, robot.stride, robot.action_dim)
        wanted = (
            f"{self.where}: act(images) must return float32 {list(shape)}, an unnormalised action of {robot.name} for "
            f"each image, or {list(chunks)}, the whole chunk until the next image"
        )
        try:
            actions = np.asarray(given)
        except ValueError as error:  # lists of different lengths
            raise ConfigError(f"{wanted}; it returned something that is not an array ({error})") from error
        good = actions.shape in (shape, chunks) and np.issubdtype(actions.dtype, np.floating)
        require(good, f"{wanted}; it returned {actions.dtype} {list(actions.shape)}")
        require(
            self._shape in (None, actions.shape[1:]),
            f"{self.where}: act(images) must return always actions or always chunks; for an image it returned "
            f"{list(self._shape or ())} before, and now {list(actions.shape[1:])}",
        )
        self._shape = actions.shape[1:]
        actions = np.array(actions, np.float32)
        for b in np.flatnonzero(~np.isfinite(actions).reshape(count, -1).all(1))[:1]:
            raise ConfigError(
                f"{wanted}; the action that it returned for image {b} is not finite: {actions[b].tolist()}"
            )
        return actions


def load_user_policies(path: Path, robot: Robot) -> tuple[dict[str, CheckedPolicy], UserSuccess | None]:
    """What `policies(robot)` of the file returns, and its function for success, if it has one. The file can import
    modules beside it, as a program can.

    Raises ConfigError for objects other than policies, for names under which rollouts cannot be kept, and, with the
    line, for what the file raises.
    """
    folder = str(path.resolve().parent)
    if folder not in sys.path:
        sys.path.append(folder)  # after all others, so that it hides none
    with naming_line(path, PAGE):
        file = run_file(path, SIGNATURE, "policies of your own are", PAGE)
        policies = function_of(file, SIGNATURE, PAGE)(robot)
    where = f"{path}: {SIGNATURE}"
    require(
        isinstance(policies, dict), f"{where} must return a dict of policies by name, got {type(policies).__name__}"
    )
    require(bool(policies), f"{where} returned an empty dict")
    for name in policies:
        fits = isinstance(name, str) and NAME.fullmatch(name)
        require(
            bool(fits),
            f"{where}: {name!r} is used in file names; use at most 100 letters, digits, '.', '_' and '-', a letter or "
            "digit first",
        )
        require(not TAKEN.fullmatch(name), f"{where}: {name!r} is the name of a built-in policy; choose another")
    lower = [name.lower() for name in policies]
    twice = [name for name in policies if lower.count(name.lower()) > 1]
    require(
        not twice,
        f"{where}: {', '.join(twice)} differ only in upper and lower case, so their files could collide; rename one",
    )
    checked = {name: CheckedPolicy(policy, robot, f"{path}: policy {name!r}") for name, policy in policies.items()}
    return checked, success_of(file)


def try_out(
    policies: dict[str, CheckedPolicy], success: UserSuccess | None, batch: int, shape: tuple[int, int]
) -> None:
    """Shows black images to each: an error that would stop it later stops it before anything is made."""
    black = np.zeros((batch, *shape, 3), np.uint8)
    if success is not None:
        success.probabilities(black, black)
    for policy in policies.values():
        policy.reset(seeds=range(batch))
        policy.act(black)
