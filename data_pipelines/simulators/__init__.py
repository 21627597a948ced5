"""The simulator suite: models of real robots from public simulators, written as RLDS (extra `sim`).

`EMBODIMENTS` is the table, `generate_sim` makes the datasets, `replay` runs an episode again under
other actions. Simulators run in processes of their own (`worker`), behind one interface
(`episode.Simulator`, `backends`); `behaviour` and `experts` say what robots do.
"""

from data_pipelines.simulators.embodiments import EMBODIMENTS, select
from data_pipelines.simulators.generate import generate_sim
from data_pipelines.simulators.replay import read_start, replay
from data_pipelines.simulators.spec import SimSpec

__all__ = ["EMBODIMENTS", "SimSpec", "generate_sim", "read_start", "replay", "select"]
