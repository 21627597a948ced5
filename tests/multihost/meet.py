"""Processes that start without training; each prints what it learnt as one line of JSON."""

import json
import os
import sys

import jax
import numpy as np
from jax._src.xla_bridge import CUDA_VISIBLE_DEVICES
from jax.sharding import NamedSharding, PartitionSpec

from hma_jax.config import MeshConfig
from hma_jax.runtime.mesh import make_mesh
from hma_jax.runtime.processes import (
    AgreedMaximum,
    Processes,
    all_gather,
    broadcast_from_writer,
    end,
    is_writer,
    start,
    writer_first,
)
from hma_jax.runtime.rows import lay_out, own_rows


def main(path: str) -> None:
    start(Processes(detect="SLURM_JOB_ID" in os.environ, start_timeout=120).or_from(os.environ))
    me = jax.process_index()
    with writer_first("file"):
        if is_writer():
            with open(path, "w") as file:
                file.write("here")
        seen = open(path).read()
    agreement, agreed = AgreedMaximum(), []
    for step in range(4):
        agreed.append(agreement.result(lambda: -1))
        agreement.submit(lambda: me * step)
    whole = NamedSharding(make_mesh(MeshConfig()), PartitionSpec())
    laid = lay_out({"x": np.arange(3.0), "y": jax.numpy.ones(2)}, whole)
    report = {
        "seen": seen,
        "told": all_gather("name", f"p{me}"),
        "from_writer": broadcast_from_writer("chief", f"p{me}"),
        "agreed": agreed,
        "sum": float(jax.jit(lambda t: t["x"].sum() + t["y"].sum(), out_shardings=whole)(laid)),
        "gpus": CUDA_VISIBLE_DEVICES.value,
        "rows": {f"{m}": own_rows(MeshConfig(*m), 8).tolist() for m in ((-1, 1, 1), (1, 2, 1), (1, 1, 2))},
    }
    print(json.dumps(report), flush=True)
    end()


if __name__ == "__main__":
    main(*sys.argv[1:])
