"""`hma plan` and its report. The compiling is in `bench.plan`."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, arg

from experiments.cli.bench.arguments import Model
from experiments.study_setup import UNSET, Preset, StudyArguments, make_setup
from experiments.terminal.progress import console, say, step, tidy_table
from experiments.terminal.words import counted, in_thousands
from hma_jax.config import ExecutionConfig, MeshConfig, ModelConfig, TrainConfig, require
from hma_jax.config.execution import Dtype, Remat

if TYPE_CHECKING:
    from experiments.bench.plan import Plan
    from hma_jax.model.embodiments import EmbodimentTable


@dataclass(frozen=True)
class PlanArguments(StudyArguments):
    """The study of the model: the one that `hma train` with the same arguments would train."""

    preset: Annotated[Preset | None, arg(help_behavior_hint="(default: a model of --model)")] = None
    """The study whose model, robots, batch and execution are planned."""


DEFAULTS = {"model": "base", "batch": 64, "robots": 1, "dtype": "bfloat16", "remat": "everything"}
"""Defaults of a model that is chosen by --model."""


def _default(name: str, metavar: str | None = None) -> object:
    return arg(metavar=metavar, help_behavior_hint=f"(default: {DEFAULTS[name]})")


@dataclass(frozen=True)
class Shape:
    """A model of `hma bench`, instead of a study's model."""

    model: Annotated[Model | None, _default("model")] = None
    """base is width 256 with 32 layers, xl width 1024."""
    batch: Annotated[int | None, _default("batch", "N")] = None
    """Windows per step, over all devices."""
    robots: Annotated[int | None, _default("robots", "N")] = None
    """Number of robots of the model."""
    dtype: Annotated[Dtype | None, _default("dtype")] = None
    """Number format of the computation; parameters and moments are float32."""
    remat: Annotated[Remat | None, _default("remat")] = None
    """What the backward pass recomputes to save memory: none, or everything (offload: inputs are in host memory).
    products: all but matrix products and attention; attention: all but attention and the MLP's first product."""


def plan(
    arguments: Annotated[OmitArgPrefixes[PlanArguments], arg(name="study")],
    shape: OmitArgPrefixes[Shape],
    topology: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ("local",),
    memory: Annotated[str | None, arg(metavar="SIZE"), UNSET] = None,
    brief: Annotated[FlagCreatePairsOff[bool], UNSET] = False,
) -> None:
    """Compile the real training step and print its memory, the sharding of every parameter, and its communication.

    Planning for a TPU topology needs no TPU, only its compiler: pip install -e '.[tpu]'.

    Args:
        arguments: The study whose model is planned.
        shape: A model of `hma bench`, if no --preset is given.
        topology: TPU topologies such as v5e:2x4, v4:2x2x4, or cloud names such as v4-32; `local`: this machine's
            devices.
        memory: Memory of one device, such as 80GiB, to compare with: needed if the compiler does not know it.
        brief: Leave out the sharding of every parameter and the list of collectives.
    """
    limit = read_memory(memory)
    if any(name != "local" for name in topology):  # read when JAX is imported
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
        os.environ.setdefault("TPU_SKIP_MDS_QUERY", "1")
        os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"  # programs for absent devices cannot be written
    from experiments.bench.collectives import count_kinds
    from experiments.bench.plan import find_devices, make_plan
    from experiments.dry_run.plan_table import flops_of
    from hma_jax.runtime.audit import size_of

    what, config, table, train, execution = _choose_model(arguments, shape)
    rows: list[tuple[str, Plan]] = []
    for name in topology:
        devices = find_devices(name)
        with step(f"compile {what} for {name} ({counted(len(devices), 'device')})"):
            rows.append((name, make_plan(config, table, train, execution, devices)))
    if not brief:
        for name, made in rows:
            _print_layouts(name, made)
            _print_sent(name, made, execution.accumulate)
    averaged = train.ema_decay > 0
    report = tidy_table(
        f"{what}: {in_thousands(rows[0][1].parameters)} parameters, batch {train.batch}, {execution.dtype}, "
        f"remat {execution.remat}; per device:",
        "topology", "mesh", "parameters", "moments", *["average"] * averaged, "activations", "peak", "per step",
        "verdict",
    )  # fmt: skip
    for name, made in rows:
        # The peak holds parameters, moments, the average, and whatever intermediate values live at the same time.
        sizes = (made.stored, made.moments, *[made.stored] * averaged, made.temporary, made.peak)
        shown = [size_of(x) if made.peak else "" for x in sizes]
        shape = " x ".join(map(str, made.mesh.values()))
        verdict = "" if name == "local" and limit is None else "fits"
        if made.refusal or limit is not None and made.peak > limit:
            verdict = "[red]does not fit[/]"
        report.add_row(name, shape, *shown, flops_of(made.flops_per_step / made.devices), verdict)
    console.print(report)
    for name, made in rows:
        if made.refusal:
            say(f"{name}: {made.refusal}")
        counts = ", ".join(f"{n} {kind}" for kind, n in count_kinds(made.collectives).items()) or "none"
        console.print(f"[dim]{name}: compiled in {made.compile_seconds:.0f} s; collectives: {counts}[/]")
    console.print("[dim]collectives are counted as in the program; the body of a loop counts once[/]")


def read_memory(size: str | None) -> float | None:
    """Number of bytes in '80GiB' or '80GB'. Raises ConfigError for anything that is not a size."""
    if size is None:
        return None
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?(GiB|GB)", size)
    require(match is not None, f"--memory {size}: write it as 80GiB or 80GB")
    return float(match[1]) * {"GiB": 2**30, "GB": 10**9}[match[2]]


def _choose_model(
    arguments: PlanArguments, shape: Shape
) -> tuple[str, ModelConfig, EmbodimentTable, TrainConfig, ExecutionConfig]:
    """The model in words, then the parts of its training step: for a study's reference trial, or for a fixed model."""
    if arguments.preset is None:
        from experiments.bench.models import make_shape

        others = replace(arguments, mesh=None) == PlanArguments()
        require(others, "these settings need a study; add --preset, or use --model, --batch and --robots")
        chosen = DEFAULTS | {name: value for name, value in vars(shape).items() if value is not None}
        config, table = make_shape(chosen["model"], chosen["robots"])
        execution = ExecutionConfig(chosen["dtype"], chosen["remat"], mesh=MeshConfig(*arguments.mesh or (1, -1, 1)))
        return chosen["model"], config, table, replace(TrainConfig(), batch=chosen["batch"]), execution
    from experiments.declared_table import declared_table
    from experiments.sweeps.sweep import reference_trial

    require(
        shape == Shape(),
        "--model, --batch, --robots, --dtype and --remat cannot be used with --preset; set model.*, train.batch, "
        "datasets, execution.dtype and execution.remat with --set",
    )
    study = make_setup(arguments).study
    trial = reference_trial(study, study.seeds[0])
    table = declared_table(trial.datasets, trial.rate)
    what = f"{study.name}, width {study.model.width}, {counted(table.size, 'robot')}"
    return what, trial.model, table, trial.train, study.execution


def _print_layouts(name: str, made: Plan) -> None:
    from hma_jax.runtime.audit import describe_sharding

    sizes = " x ".join(f"{axis} {size}" for axis, size in made.mesh.items())
    _print_lines(
        f"{name}: sharding of the parameters on a mesh of {sizes}, and what one device stores",
        describe_sharding(made.decisions),
    )


def _print_sent(name: str, made: Plan, accumulate: int) -> None:
    from hma_jax.runtime.audit import size_of

    lines = [
        f"{sent.count:4} {c.kind:18} {size_of(sent.bytes):>10} {how_often(c.loops, accumulate)}, "
        f"over {c.over or 'groups not told'}: {c.purpose}"
        for c, sent in made.collectives.items()
    ]
    if lines:
        whole = sum(sent.whole for sent in made.collectives.values())
        lines.append(f"in a step {size_of(whole)}: loops counted as often as they run")
    title = f"{name}: collectives, and what one device receives through those of a line, each time"
    _print_lines(title, "\n".join(lines) or "nothing")


def how_often(loops: int, accumulate: int) -> str:
    """How often a collective runs that is inside this many nested loops of a step with this many micro-batches. Loops
    within a layer cannot be distinguished."""
    inner = ["each layer", *["each micro-batch"] * (accumulate > 1)]
    return " of ".join(inner[-loops:]) if loops else "once"


def _print_lines(title: str, lines: str) -> None:
    console.print(f"[italic]{title}[/]")
    say(lines + "\n")
