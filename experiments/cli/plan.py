"""`hma plan` and its report. The compiling is in `bench.plan`."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, arg

from experiments.cli.bench.arguments import Model
from experiments.progress import console, step, tidy_table
from hma_jax.config import ExecutionConfig, MeshConfig, TrainConfig
from hma_jax.config.execution import Dtype, Remat
from hma_jax.runtime.audit import describe_sharding, size_of

if TYPE_CHECKING:
    from experiments.bench.plan import Plan


def plan(
    model: Model = "base",
    topology: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ("local",),
    batch: int = 64,
    mesh: tuple[int, int, int] = (1, -1, 1),
    robots: int = 1,
    dtype: Dtype = "bfloat16",
    remat: Remat = "everything",
    brief: FlagCreatePairsOff[bool] = False,
) -> None:
    """Compile the real training step and say how it would run: does it fit, what lies where, what is sent?

    For a TPU topology no TPU is needed, but its compiler: pip install -e '.[tpu]'.

    Args:
        model: The models of `hma bench`: base is width 256 with 32 layers, xl width 1024.
        topology: TPU topologies such as v5e:2x4, v5e:8x8 or v5p:4x4x4; `local`: the devices here.
        batch: Windows per step, over all devices.
        mesh: Devices for data, fsdp and tensor parallelism; -1 takes those that are left.
        robots: Embodiments of the model.
        dtype: What is computed in; parameters and moments are float32.
        remat: What a block keeps for the backward pass; the rest is computed again.
        brief: Leave out the layout of every parameter and the list of what is sent.
    """
    if any(name != "local" for name in topology):  # read when JAX starts
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
        os.environ.setdefault("TPU_SKIP_MDS_QUERY", "1")
        os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"  # programs for absent devices cannot be written
    from experiments.bench.collectives import count_kinds
    from experiments.bench.models import make_shape
    from experiments.bench.plan import find_devices, make_plan

    config, table = make_shape(model, robots)
    execution = ExecutionConfig(dtype, remat, mesh=MeshConfig(*mesh))
    train = replace(TrainConfig(), batch=batch)
    rows: list[tuple[str, Plan]] = []
    for name in topology:
        devices = find_devices(name)
        with step(f"compile {model} for {name} ({len(devices)} devices)"):
            rows.append((name, make_plan(config, table, train, execution, devices)))
    if not brief:
        for name, made in rows:
            _print_layouts(name, made)
            _print_sent(name, made)
    report = tidy_table(
        f"{model}: {rows[0][1].parameters / 1e6:,.1f} M parameters, batch {batch}, {dtype}, remat {remat}; per device:",
        "topology", "mesh", "parameters", "moments", "activations", "peak", "TFLOP/step", "verdict",
    )  # fmt: skip
    for name, made in rows:
        # The peak holds parameters, moments and whatever lives at once of what is computed.
        sizes = (made.stored, 2 * made.stored, made.temporary, made.peak)
        shown = [size_of(x) if made.peak else "" for x in sizes]
        shape = " x ".join(map(str, made.mesh.values()))
        verdict = "[red]does not fit[/]" if made.refusal else "fits" if name != "local" else ""
        report.add_row(name, shape, *shown, f"{made.flops_per_step / 1e12:,.1f}", verdict)
    console.print(report)
    for name, made in rows:
        if made.refusal:
            console.print(f"{name}: {made.refusal}", markup=False, soft_wrap=True)
        counts = ", ".join(f"{n} {kind}" for kind, n in count_kinds(made.collectives).items()) or "none"
        console.print(f"[dim]{name}: compiled in {made.compile_seconds:.0f} s; collectives: {counts}[/]")
    console.print("[dim]collectives as they stand in the program, a loop's body once[/]")


def _print_layouts(name: str, made: Plan) -> None:
    sizes = " x ".join(f"{axis} {size}" for axis, size in made.mesh.items())
    _print_lines(f"{name}: parameters on a mesh of {sizes}, and what one device stores", describe_sharding(made.decisions))


def _print_sent(name: str, made: Plan) -> None:
    lines = [
        f"{sent.count:4} {c.kind:18} {size_of(sent.bytes):>10} {'each layer' if c.looped else 'once':10} "
        f"over {c.over or 'groups not told'}: {c.purpose}"
        for c, sent in made.collectives.items()
    ]
    _print_lines(f"{name}: what one device is sent in a step", "\n".join(lines) or "nothing")


def _print_lines(title: str, lines: str) -> None:
    console.print(f"[italic]{title}[/]")
    console.print(lines + "\n", markup=False, soft_wrap=True)
