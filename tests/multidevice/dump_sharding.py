"""How the parameters of every preset lie on two meshes of eight devices, with forty robots.

`python -m tests.multidevice.dump_sharding` writes the files under `sharding/` anew.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

from experiments.bench.models import MODELS
from experiments.presets import PRESETS
from hma_jax.config import MeshConfig, ModelConfig
from hma_jax.model.hma import declare_model
from hma_jax.runtime.audit import describe_sharding, plan_sharding
from tests.multidevice.forty_robots import make_table

FOLDER = Path(__file__).with_name("sharding")
MESHES = ((1, 8, 1), (2, 2, 2))


def models() -> dict[str, ModelConfig]:
    """Of the presets, and the large ones of `hma plan`."""
    large = {name: MODELS[name] for name in ("xl", "xl-continuous")}
    return {name: preset.model for name, preset in PRESETS.items()} | large


def fake_mesh(data: int, fsdp: int, tensor: int) -> SimpleNamespace:
    """Of devices that need not be there."""
    return SimpleNamespace(shape={"data": data, "fsdp": fsdp, "tensor": tensor})


def dump(model: ModelConfig) -> str:
    declared, parts = declare_model(model, make_table(40)), []
    for sizes in MESHES:
        decisions = plan_sharding(declared, fake_mesh(*sizes), MeshConfig())
        parts.append(f"data {sizes[0]} x fsdp {sizes[1]} x tensor {sizes[2]}\n{describe_sharding(decisions)}\n")
    return "\n".join(parts)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, model in models().items():
        (FOLDER / f"{name}.txt").write_text(dump(model))
