"""The embodiments of datasets before there are any data: what the registry alone says of them."""

from __future__ import annotations

import functools

from data_pipelines.registry import DatasetSpec, get_spec
from hma_jax.model.embodiments import Embodiment, EmbodimentTable


@functools.cache
def declared_table(names: tuple[str, ...], rate: float | None) -> EmbodimentTable:
    """Embodiments with the right action sizes and no statistics.

    Raises ConfigError for a name that the registry does not know.
    """

    def entry(spec: DatasetSpec) -> Embodiment:
        dim = spec.action_dim
        return Embodiment(spec.name, dim, spec.stride_at(rate), mean=(0.0,) * dim, std=(1.0,) * dim)

    return EmbodimentTable(tuple(entry(get_spec(name)) for name in names))
