"""A trained model as a simulator: pixels and a robot's raw actions in, pixels out.

`simulator` is the class that programs use, `programs` what it compiles, `robots` what may be asked of a robot,
`starts` recorded beginnings of episodes, `folder` where all of it lies on disk, `interface` what true simulators share
with it, `environment` Gymnasium's view of both. Decoding and the window are `hma_jax.generation`'s.
"""

from hma_jax.simulator.episode import Snapshot
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start

__all__ = ["Robot", "Simulator", "Snapshot", "Start"]
