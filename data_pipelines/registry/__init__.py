"""The dataset registry: which camera and which action fields of a dataset are used, at what rate.

`spec` is the record type, `angles` what it may say about angles. The entries are data: `own` (the real samples and the
user's own), `openx` (Open X-Embodiment) and `beyond_openx` (the rest of the paper's mixture); those of the embedded
suite and of the simulators are derived from their own tables. `toml_file` reads entries that are kept outside this
project. `table` finds an entry by name, `mixtures` names lists of them. Reads no dataset.
"""

from data_pipelines.registry.mixtures import MIXTURES, get_mixture
from data_pipelines.registry.spec import FRAME_RATE, DatasetSpec
from data_pipelines.registry.table import all_specs, find_reader, find_spec, get_spec, known_groups, register

__all__ = [
    "FRAME_RATE", "MIXTURES", "DatasetSpec", "all_specs", "find_reader", "find_spec", "get_mixture", "get_spec",
    "known_groups", "register",
]  # fmt: skip
