"""A trained model as a simulator: pixels and a robot's raw actions in, pixels out.

`simulator` has the class that programs use, `programs` what it compiles, `episode` the host's record of an episode,
`robots` the commands of a robot, `starts` recorded beginnings of episodes, `folder` all of it on disk, `warm_up` what
is compiled ahead, `interface` what true simulators share with it, `environment` Gymnasium environments of both.
Decoding and the window are `hma_jax.generation`'s.
"""

from hma_jax.simulator.episode import Snapshot
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start

__all__ = ["Robot", "Simulator", "Snapshot", "Start"]
