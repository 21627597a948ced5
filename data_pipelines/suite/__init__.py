"""The embedded dataset suite: forty small simulated embodiments, written as RLDS.

`EMBODIMENTS` is the table, `generate_suite` makes the datasets. Bodies and controls define
robots, `tasks` and `behaviour` what they want, `world` what comes of it; `rollout` runs whole
episodes, `render` draws them, `write` and `generate` put them on disk. Imports neither JAX nor
TensorFlow.
"""

from data_pipelines.suite.embodiments import EMBODIMENTS
from data_pipelines.suite.generate import generate_suite
from data_pipelines.suite.spec import EmbodimentSpec

__all__ = ["EMBODIMENTS", "EmbodimentSpec", "generate_suite"]
