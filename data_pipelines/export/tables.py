"""Tables in Parquet, as LeRobot stores them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hma_jax.config.json import to_strict_json
from hma_jax.runtime.files import write_file

if TYPE_CHECKING:
    import pyarrow as pa

INDEXED_BY_TASK = to_strict_json({
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": None},
        {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None},
    ],
    "pandas_version": "2.2.0",
})  # fmt: skip
"""LeRobot reads the tasks with pandas, which uses this column as the index."""


def arrow_type(values: np.ndarray) -> pa.DataType:
    """The type of a column [N, size]; LeRobot stores vectors of one value as numbers."""
    import pyarrow as pa

    number, size = pa.from_numpy_dtype(values.dtype), values.shape[1]
    return number if size == 1 else pa.list_(number, size)


def arrow(values: np.ndarray) -> pa.Array:
    import pyarrow as pa

    flat = pa.array(values.ravel())
    return flat if values.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def vectors(column: pa.ChunkedArray) -> np.ndarray:
    """[N, size]; the reverse of `arrow`."""
    from pyarrow import compute, types

    flat = compute.list_flatten(column) if types.is_fixed_size_list(column.type) else column
    return flat.to_numpy().reshape(len(column), -1)


def write_table(path: Path, table: pa.Table) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True, exist_ok=True)
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    write_file(path, sink.getvalue().to_pybytes())
