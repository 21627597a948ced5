"""A trained model as a simulator: pixels and a robot's raw actions in, pixels out.

`simulator` has the class that programs use, `programs` its compiled programs, `episode` the host's record of an
episode, `robots` the commands of a robot, `starts` recorded beginnings of episodes, `folder` the files on disk,
`warm_up` compilation ahead of use, `interface` the interface that true simulators share, and `environment` Gymnasium
environments of both. Decoding and the window are in `hma_jax.generation`.
"""

from hma_jax.simulator.episode import Snapshot
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start

__all__ = ["Robot", "Simulator", "Snapshot", "Start"]
