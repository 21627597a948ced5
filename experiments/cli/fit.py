"""`hma fit`: arguments and help, and the report. The compiling is in `fit`."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Annotated

from tyro.conf import arg

from experiments.cli.bench import Model
from experiments.progress import console, step, tidy_table
from hma_jax.config import ExecutionConfig, MeshConfig, TrainConfig
from hma_jax.config.execution import Dtype, Remat


def fit(
    model: Model = "base",
    topology: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ("local",),
    batch: int = 64,
    mesh: tuple[int, int, int] = (1, -1, 1),
    robots: int = 1,
    dtype: Dtype = "bfloat16",
    remat: Remat = "everything",
) -> None:
    """Compile the real training step and say what every device would hold: does it fit?

    For a TPU topology no TPU is needed, but its compiler: pip install -e '.[tpu]'.

    Args:
        model: The models of `hma bench`: base is width 256 with 32 layers, xl width 1024.
        topology: TPU topologies such as v5e:2x4, v5e:8x8 or v5p:4x4x4; `local`: the devices here.
        batch: Windows per step, over all devices.
        mesh: Devices for data, fsdp and tensor parallelism; -1 takes those that are left.
        robots: Embodiments of the model.
        dtype: What is computed in; parameters and moments are float32.
        remat: What a block keeps for the backward pass; the rest is computed again.
    """
    if any(name != "local" for name in topology):  # read when JAX starts
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
        os.environ.setdefault("TPU_SKIP_MDS_QUERY", "1")
        os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"  # programs for absent devices cannot be written
    from experiments.bench.fit import Fit, check_fit, find_devices
    from experiments.bench.models import make_shape

    config, table = make_shape(model, robots)
    execution = ExecutionConfig(dtype, remat, mesh=MeshConfig(*mesh))
    train = replace(TrainConfig(), batch=batch)
    rows: list[tuple[str, Fit]] = []
    for name in topology:
        devices = find_devices(name)
        with step(f"compile {model} for {name} ({len(devices)} devices)"):
            rows.append((name, check_fit(config, table, train, execution, devices)))
    parameters = rows[0][1].parameters
    report = tidy_table(
        f"{model}: {parameters / 1e6:,.1f} M parameters, batch {batch}, {dtype}, remat {remat}",
        "topology", "mesh", "arguments", "temporary", "peak", "TFLOP/step", "verdict",
    )  # fmt: skip
    for name, fit in rows:
        sizes = [f"{x / 2**30:,.2f} GiB" if fit.peak else "" for x in (fit.arguments, fit.temporary, fit.peak)]
        shape = " x ".join(map(str, fit.mesh))
        verdict = "[red]does not fit[/]" if fit.refusal else "fits" if name != "local" else ""
        report.add_row(name, shape, *sizes, f"{fit.flops_per_step / 1e12:,.1f}", verdict)
    console.print(report)
    for name, fit in rows:
        if fit.refusal:
            console.print(f"{name}: {fit.refusal}", markup=False, soft_wrap=True)
        counts = ", ".join(f"{n} {kind}" for kind, n in fit.collectives) or "none"
        console.print(f"[dim]{name}: compiled in {fit.compile_seconds:.0f} s; collectives: {counts}[/]")
    console.print("[dim]memory is per device; collectives as they stand in the program, a scan's body once[/]")
