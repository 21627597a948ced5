"""What recordings are like before they are replayed: how many of their actions a robot cannot execute, and whether all
say if they succeeded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_pipelines.errors import EpisodeError
from experiments.applications.generating.trajectories import Trajectories
from experiments.terminal.progress import Update
from hma_jax.config import require
from hma_jax.simulator.robots import Robot

MOST = 0.5
"""Actions of which a larger share of some value lies outside the robot's range are taken for those of other units."""


@dataclass(frozen=True)
class Survey:
    """What `survey` found in recordings, for one robot."""

    robot: Robot
    clipped: np.ndarray  # float [A]: the share of each action value that lies outside the range
    least: np.ndarray  # float32 [A]
    greatest: np.ndarray
    knows_success: bool  # whether all say if they succeeded

    def shares(self) -> dict[str, float]:
        """The share of each value that is clipped, by its name; without those of which nothing is."""
        named = zip(self.robot.dimensions, self.clipped.tolist(), strict=True)
        return {name: round(share, 6) for name, share in named if share}

    def describe(self) -> str:
        """What is clipped, for people; "" where nothing is."""
        if not self.shares():
            return ""
        shares = ", ".join(f"{100 * share:.2g} % of {name}" for name, share in self.shares().items())
        outside = self.robot.describe(self.clipped > 0, np.stack([self.least, self.greatest]))
        return f"recorded actions of {self.robot.name} will be clipped ({shares}): {outside}"

    def note(self) -> str:
        """The same as a question to the user; "" where nothing is."""
        said = self.describe()
        return said and f"note: {said}. Are these its raw units?"

    def require_raw_units(self) -> None:
        """Raises ConfigError where most of a value would be clipped."""
        require(
            bool((self.clipped <= MOST).all()),
            f"{self.describe()}. These are hardly its raw units: convert the recordings, or give another --robot; with "
            "--allow-clipping they are replayed nevertheless",
        )


def survey(recorded: Trajectories, count: int, robot: Robot, progress: Update = lambda *_: None) -> Survey:
    """Reads the actions of the first `count` recordings, not their frames. Values that the robot never changes do not
    count. Raises EpisodeError for a damaged one, where `recorded` does not leave it out."""
    low, high = np.asarray(robot.low, np.float32), np.asarray(robot.high, np.float32)
    outside, steps, known = np.zeros(len(low)), 0, True
    least, greatest = np.full(len(low), np.inf, np.float32), np.full(len(low), -np.inf, np.float32)
    for i in range(count):
        try:
            actions, success = recorded.actions(i), recorded.outline(i).success
        except EpisodeError as error:
            recorded.skip(i, error)
            continue
        outside += (((actions < low) | (actions > high)) & (low < high)).sum(0)
        least, greatest = np.minimum(least, actions.min(0)), np.maximum(greatest, actions.max(0))
        steps, known = steps + len(actions), known and success is not None
        progress(i + 1, count, "recordings")
    return Survey(robot, outside / max(steps, 1), least, greatest, known and steps > 0)
