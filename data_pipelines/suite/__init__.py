"""The embedded dataset suite: forty small simulated embodiments, written as RLDS.

`EMBODIMENTS` is the table, `generate_suite` makes the datasets. Bodies and controls define
robots, `tasks` and `world` what they do, `render` how it looks, `write` and `generate` what
ends up on disk. Imports neither JAX nor TensorFlow.
"""

from data_pipelines.suite.embodiments import EMBODIMENTS
from data_pipelines.suite.generate import generate_suite
from data_pipelines.suite.spec import EmbodimentSpec

__all__ = ["EMBODIMENTS", "EmbodimentSpec", "generate_suite"]
