"""The embedded dataset suite: fifty small simulated robots, ten families of five, written as RLDS.

`EMBODIMENTS` is every robot, `TRAINED` the forty that studies train on, `UNSEEN` the ten that they
do not; `generate_suite` makes the datasets, `Environment` steps a robot. `families` holds the
tables; bodies and controls define robots, `tasks` and `behaviour` what they try to do, `world` what results; `rollout`
runs whole episodes, `render` draws them, `write` and `generate` put them on disk. Imports neither JAX nor TensorFlow.
"""

from data_pipelines.suite.embodiments import EMBODIMENTS, TRAINED, UNSEEN
from data_pipelines.suite.environment import Environment
from data_pipelines.suite.generate import generate_suite
from data_pipelines.suite.spec import EmbodimentSpec

__all__ = ["EMBODIMENTS", "UNSEEN", "TRAINED", "EmbodimentSpec", "Environment", "generate_suite"]
