"""Compiles a simulator's programs before their first use."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

import numpy as np

from hma_jax.simulator.programs import padded
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start


def warm_up(
    simulator: Simulator, together: int | None = None, progress: Callable[[int, int, str], None] = lambda *_: None
) -> None:
    """Compiles the programs that reset, rewind and advance up to `together` episodes at once (default: any number), and
    restores the simulator's state. `warm_up_more` compiles those that advance more at once.

    Calls `progress(done, total, what)`, where `done` of `total` programs are compiled and `what` is the purpose of the
    next one."""
    each = [n for n in sizes(len(simulator)) if n <= (together or len(simulator))]
    done, total = count(), 3 * len(each)
    kept = simulator.snapshot()
    robot = next(iter(simulator.robots.values()))
    black = np.zeros((1, *simulator.images.shape[1:]), np.uint8)
    for n in each:
        progress(next(done), total, "beginning episodes")
        simulator.reset(Start(robot.name, black, np.zeros((0, robot.action_dim), np.float32)), episodes=range(n))
        progress(next(done), total, "rewinding")
        simulator.rewind(0, range(n))
    simulator.restore(kept)
    for n in each:
        progress(next(done), total, "making frames")
        simulator.compile(n)


def warm_up_more(
    simulator: Simulator,
    above: int,
    ended: Callable[[], bool] = lambda: False,
    reached: Callable[[int], None] = lambda _: None,
) -> None:
    """Compiles the programs that advance more than `above` episodes at once, up to all, until `ended()`. It may run in
    any thread. Calls `reached` with each number of episodes that is ready."""
    for together in sizes(len(simulator)):
        if above < together and not ended():
            simulator.compile(together)
            reached(together)


def sizes(episodes: int) -> list[int]:
    """For each of the programs that advance any number of `episodes` episodes, the most that it advances."""
    numbers = range(1, episodes + 1)
    return list({(len(padded(list(range(n)), episodes)), n == episodes): n for n in numbers}.values())
