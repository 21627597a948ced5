"""How a model would train: the real training step, compiled for devices that need not be there.

For a TPU topology XLA compiles ahead of time on any machine (extra `tpu`), and says what every
device would hold and send. The same report comes from the devices at hand.
"""

from __future__ import annotations

import importlib.util
import math
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from experiments.bench.collectives import Collective, Sent, find_collectives
from hma_jax.config import ConfigError, ExecutionConfig, MeshConfig, ModelConfig, TrainConfig, require
from hma_jax.kernels.attention import backend_of
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.flops import train_flops_per_step
from hma_jax.model.hma import declare_model
from hma_jax.model.params import Declared
from hma_jax.runtime.audit import Decision, audit_sharding, plan_sharding
from hma_jax.runtime.mesh import check_mesh, make_mesh
from hma_jax.runtime.sharding import batch_sharding
from hma_jax.training.state import TrainState, state_shapes
from hma_jax.training.step import make_train_step

LOCAL = "local"

CORES_PER_CHIP = {"v2": 2, "v3": 2, "v4": 2, "v5p": 2, "v5e": 1, "v5litepod": 1, "v6e": 1}
"""What one chip adds to the number in a cloud's TPU name: 2 if it counts cores (v4-32), else 1 (v5litepod-8)."""


@dataclass(frozen=True)
class Plan:
    """How a model is laid out on a mesh, and what one device holds while it trains, in bytes. If there are no memory
    figures, the model does not fit."""

    decisions: tuple[Decision, ...]
    devices: int
    mesh: Mapping[str, int]
    compile_seconds: float
    flops_per_step: float  # FLOPs of the model, by formula, all devices together
    moments: int = 0  # both, for what is trained
    arguments: int = 0  # parameters, moments and this device's rows
    temporary: int = 0
    peak: int = 0
    collectives: Mapping[Collective, Sent] = field(default_factory=dict)
    refusal: str = ""  # the compiler's words when it does not fit

    @property
    def parameters(self) -> int:
        return sum(d.spec.size for d in self.decisions)

    @property
    def stored(self) -> int:
        """Bytes of the parameters, in float32."""
        return 4 * sum(d.device_size for d in self.decisions)


def find_devices(topology: str) -> list[Any]:
    """The devices of a TPU topology such as v5e:2x4 or, by the cloud's name, v5e-8; or those at hand (`local`).

    Raises ConfigError for a topology that the compiler does not know or without the extra.
    """
    if topology == LOCAL:
        return jax.devices()
    require(
        re.match(r"v\d|tpu", topology) is not None,
        f"no TPU called {re.split('[:-]', topology)[0]}; GPUs cannot be planned without one: run "
        "`hma plan --topology local` there",
    )
    require(
        importlib.util.find_spec("libtpu") is not None,
        f"--topology {topology}: the TPU compiler is not installed: pip install -e '.[tpu]'",
    )
    from jax.experimental import topologies

    name = chips_of(topology)
    cores = {"chip_config_name": "megacore"} if name.startswith("v4:") else {}  # a device is a chip, not a core
    try:
        return list(topologies.get_topology_desc(platform="tpu", topology_name=name, **cores).devices)
    except (RuntimeError, ValueError, NotImplementedError) as error:
        called = topology if name == topology else f"{topology} ({name})"
        raise ConfigError(
            f"the TPU compiler knows no topology {called}; give one such as v4:2x2x4, v5e:2x4, v5p:4x4x4 or v6e:8x8, "
            f"or v4-32, v5e-8 as clouds call them ({str(error).splitlines()[0]})"
        ) from error


def chips_of(topology: str) -> str:
    """The topology of a cloud's name: v4:2x2x4 of v4-32, v5e:2x4 of v5e-8, as close to a square or a cube as powers of
    two allow. Other names are returned as they are. Raises ConfigError for a number of chips that is not 4, 8,
    16, ..."""
    match = re.fullmatch(r"(v\d\w*)-(\d+)", topology)
    if match is None or match[1] not in CORES_PER_CHIP:
        return topology
    kind, count = match[1].replace("litepod", "e"), int(match[2])
    chips, rest = divmod(count, CORES_PER_CHIP[match[1]])
    doubled, axes = chips.bit_length() - 1, 3 if kind in ("v4", "v5p") else 2
    whole = not rest and chips == 1 << doubled and doubled >= 2
    unit = "cores, two for each chip" if CORES_PER_CHIP[match[1]] == 2 else "chips"
    require(
        whole,
        f"--topology {topology}: the number counts {unit}, and must come to 4, 8, 16, ... chips; for other slices "
        f"give how the chips lie, such as {kind}:{'x'.join(['2', '2', '4'][-axes:])}",
    )
    sizes = [2 ** ((doubled + axis) // axes) for axis in range(axes)]
    return f"{kind}:{'x'.join(map(str, [2, 2, 1] if (axes, doubled) == (3, 2) else sizes))}"


def make_plan(
    model: ModelConfig, table: EmbodimentTable, train: TrainConfig, execution: ExecutionConfig, devices: list[Any]
) -> Plan:
    """Compiles the training step for `devices`.

    Raises ConfigError if the mesh does not suit them or the model, or leaves large parameters whole.
    """
    if execution.attention == "auto":  # for those devices, not this machine's
        execution = replace(execution, attention=backend_of(devices[0].platform))
    declared = declare_model(model, table, execution)
    mesh_config = execution.mesh
    mesh = make_mesh(mesh_config, devices)
    check_mesh(mesh, model, train.batch, execution.accumulate)
    decisions = plan_sharding(declared, mesh, mesh_config)
    audit_sharding(decisions, mesh)
    state, batch = abstract_inputs(declared, table, model, train, mesh_config, mesh)
    facts = dict(
        decisions=tuple(decisions),
        devices=len(devices),
        mesh=dict(mesh.shape),
        flops_per_step=train_flops_per_step(model, table, train),
        moments=sum(
            x.dtype.itemsize * math.prod(x.sharding.shard_shape(x.shape))
            for x in jax.tree.leaves((state.opt_state.first, state.opt_state.second))
        ),
    )
    began = time.perf_counter()
    with jax.set_mesh(mesh):
        shardings = jax.tree.map(lambda x: x.sharding, state)
        step = jax.jit(
            make_train_step(declared, table, model, train, execution.accumulate),
            donate_argnums=0,
            out_shardings=(shardings, None),
        )
        lowered = step.trace(state, batch).lower(lowering_platforms=(devices[0].platform,))
        try:
            compiled = lowered.compile()
        except jax.errors.JaxRuntimeError as error:
            if "exceed" not in str(error) and "RESOURCE_EXHAUSTED" not in str(error):
                raise
            return Plan(**facts, compile_seconds=time.perf_counter() - began, refusal=_refusal(str(error)))
    memory = compiled.memory_analysis()
    arguments, temporary = int(memory.argument_size_in_bytes), int(memory.temp_size_in_bytes)
    # For CPU, XLA's peak leaves out temporary memory, which there and on GPU is one block beside the arguments.
    counted = devices[0].platform == "tpu"
    return Plan(
        **facts,
        compile_seconds=time.perf_counter() - began,
        arguments=arguments,
        temporary=temporary,
        peak=int(memory.peak_memory_in_bytes) if counted else arguments + temporary,
        collectives=find_collectives(compiled.as_text(), mesh.shape),
    )


def abstract_inputs(
    declared: Declared,
    table: EmbodimentTable,
    model: ModelConfig,
    train: TrainConfig,
    mesh_config: MeshConfig,
    mesh: Mesh,
) -> tuple[TrainState, dict[str, jax.ShapeDtypeStruct]]:
    """State and batch of the training step: shapes, types and shardings, no arrays."""
    state = state_shapes(declared, table, mesh, mesh_config, average=train.ema_decay > 0, only=train.only)
    shape = (train.batch, model.frames, model.tokens)
    tokens = (shape, jnp.int32)
    if model.diffusion:
        tokens = ((*shape, model.diffusion.token_channels), jnp.float32)
    rows = {
        "tokens": tokens,
        "actions": ((*shape[:2], table.action_width), jnp.float32),
        "embodiment": (shape[:1], jnp.int32),
    }
    sharding = batch_sharding(mesh)
    return state, {name: jax.ShapeDtypeStruct(*of, sharding=sharding) for name, of in rows.items()}


def _refusal(message: str) -> str:
    lines = [line.strip() for line in message.splitlines() if line.strip()]
    relevant = [line for line in lines if "exceed" in line or "Ran out" in line]
    return (relevant or lines)[0]
