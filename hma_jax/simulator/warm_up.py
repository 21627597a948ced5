"""Everything that a simulator will compile, before somebody waits for it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hma_jax.simulator.programs import padded
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start


def warm_up(simulator: Simulator, together: int | None = None) -> None:
    """Begins and rewinds black episodes, then all is as before; and compiles for as many as advance together. All of it
    for any number of episodes at once, or for up to `together` of them. More that advance: `warm_up_more`."""
    kept = simulator.snapshot()
    robot = next(iter(simulator.robots.values()))
    black = np.zeros((1, *simulator.images.shape[1:]), np.uint8)
    for size in sizes(len(simulator)):
        if size <= (together or len(simulator)):
            which = range(size)
            simulator.reset(Start(robot.name, black, np.zeros((0, robot.action_dim), np.float32)), episodes=which)
            simulator.rewind(0, which)
    simulator.restore(kept)
    warm_up_more(simulator, 0, together)


def warm_up_more(
    simulator: Simulator,
    above: int,
    most: int | None = None,
    ended: Callable[[], bool] = lambda: False,
    reached: Callable[[int], None] = lambda _: None,
) -> None:
    """Compiles for more than `above` episodes that advance together, up to `most` or all, unless it is `ended` before;
    from any thread. `reached` is told of each number up to which it is done."""
    for together in sizes(len(simulator)):
        if above < together <= (most or len(simulator)) and not ended():
            simulator.compile(together)
            reached(together)


def sizes(episodes: int) -> list[int]:
    """Of the programs that advance any of so many episodes."""
    return sorted({len(padded(list(range(together)), episodes)) for together in range(1, episodes + 1)})
