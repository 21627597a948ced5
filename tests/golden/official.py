"""Reads reference cases: official tensors and settings as ours.

The cases beside this file hold numbers made by running the official PyTorch release (HMA,
Apache-2.0); each has a README.
"""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from hma_jax.config import ModelConfig, MupConfig
from hma_jax.embodiments import Embodiment, EmbodimentTable
from hma_jax.model import declare_model
from hma_jax.params import Declared

CASES = Path(__file__).parent


class Case:
    """One folder: settings, inputs, expected outputs and their tolerances."""

    def __init__(self, name: str):
        folder = CASES / name
        self.info = json.loads((folder / "case.json").read_text())
        self.settings = json.loads((folder / "config.json").read_text())
        self.inputs = dict(np.load(folder / "inputs.npz"))
        self.outputs = dict(np.load(folder / "outputs.npz"))
        weights = folder / "model.safetensors"
        self.tensors = read_safetensors(weights) if weights.exists() else {}

    def check(self, name: str, got: np.ndarray) -> None:
        """|got - want| <= atol + rtol |want| with the case's own tolerance; integers exactly."""
        want, got = self.outputs[name], np.asarray(got)
        assert got.shape == want.shape, f"{name}: shape {got.shape}, want {want.shape}"
        if want.dtype.kind in "iub":
            np.testing.assert_array_equal(got, want, err_msg=name)
        else:
            np.testing.assert_allclose(got, want, **self.info["tolerance"][name], err_msg=name)

    def model_config(self) -> ModelConfig:
        s = self.settings
        return ModelConfig(
            width=s["d_model"],
            layers=s["num_layers"],
            heads=s["num_heads"],
            frames=s["T"],
            tokens=s["S"],
            action_tokens=s["action_token_size"],
            factors=s["num_factored_vocabs"],
            factor_vocab=s["factored_vocab_size"],
            mlp_ratio=s["mlp_ratio"],
            qkv_bias=s.get("qkv_bias", False),
            proj_bias=s["proj_bias"],
            mlp_bias=s["mlp_bias"],
            qk_norm=s["qk_norm"],
            mup=MupConfig(enabled=s["use_mup"]),
        )

    def table(self) -> EmbodimentTable:
        s = self.settings
        entries = []
        for name, chunk, (mean, std) in zip(
            s["action_domains"], s["d_actions"], s["action_stats"], strict=True
        ):
            entries.append(Embodiment(name, len(mean), chunk // len(mean), tuple(mean), tuple(std)))
        return EmbodimentTable(tuple(entries))

    def load(self) -> tuple[ModelConfig, EmbodimentTable, Declared, dict]:
        """(config, table, declarations, parameters)."""
        config, table = self.model_config(), self.table()
        declared = declare_model(config, table)
        flat = to_our_layout(self.tensors, config, table)
        params: dict = {}
        for path, array in flat.items():
            *parents, leaf = path.split("/")
            node = params
            for parent in parents:
                node = node.setdefault(parent, {})
            node[leaf] = jnp.asarray(array)
        assert set(flat) == set(declared.leaves())
        for path, spec in declared.leaves().items():
            assert flat[path].shape == spec.shape, f"{path}: {flat[path].shape}, want {spec.shape}"
        return config, table, declared, params

    def pad(self, actions: np.ndarray, table: EmbodimentTable) -> np.ndarray:
        return np.pad(actions, ((0, 0), (0, 0), (0, table.action_width - actions.shape[-1])))


def read_safetensors(path: Path) -> dict[str, np.ndarray]:
    """float32 tensors of a safetensors file: a length, a JSON header, then raw arrays."""
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    header.pop("__metadata__", None)
    tensors = {}
    for name, entry in header.items():
        assert entry["dtype"] == "F32", f"{name} is {entry['dtype']}"
        begin, end = (8 + size + offset for offset in entry["data_offsets"])
        tensors[name] = np.frombuffer(data[begin:end], np.float32).reshape(entry["shape"])
    return tensors


def to_our_layout(
    tensors: dict[str, np.ndarray], config: ModelConfig, table: EmbodimentTable
) -> dict[str, np.ndarray]:
    """'our/path' -> array from official names; torch kernels are (out, in)."""
    d, h, i = config.width, config.heads, config.head_width
    out: dict[str, np.ndarray] = {
        "embed/tables": np.stack(
            [tensors[f"token_embed.factored_embeds.{q}.weight"] for q in range(config.factors)]
        ),
        "embed/mask": tensors["token_embed.mask_token_embed"][0],
        "positions": tensors["pos_embed_TSC"][0],
        "readout/kernel": tensors["out_x_proj.weight"].T,
        "readout/bias": tensors["out_x_proj.bias"],
    }

    def per_robot(pattern: str) -> np.ndarray:
        return np.stack([tensors[pattern.format(name)] for name in table.names])

    first = [tensors[f"action_mlp.{name}.model.0.weight"].T for name in table.names]
    out["stem/into/kernel"] = np.stack(
        [np.pad(kernel, ((0, table.action_width - len(kernel)), (0, 0))) for kernel in first]
    )
    out["stem/into/bias"] = per_robot("action_mlp.{}.model.0.bias")
    out["stem/gain"] = per_robot("action_mlp.{}.model.1.weight")
    out["stem/bias"] = per_robot("action_mlp.{}.model.1.bias")
    out["stem/out/kernel"] = per_robot("action_mlp.{}.model.3.weight").swapaxes(1, 2)
    out["stem/out/bias"] = per_robot("action_mlp.{}.model.3.bias")

    def block(n: int) -> dict[str, np.ndarray]:
        layer = f"decoder.layers.{n}."
        b: dict[str, np.ndarray] = {}
        for ours, theirs in (("space", "spatial_attn"), ("time", "temporal_attn")):
            get = lambda name: tensors[f"{layer}{theirs}.{name}"]  # noqa: B023, E731
            b[f"{ours}/qkv"] = get("qkv.weight").T.reshape(d, 3, h, i)
            b[f"{ours}/out"] = get("proj.weight").T.reshape(h, i, d)
            b[f"{ours}/out_bias"] = get("proj.bias")
            if config.qk_norm:
                b[f"{ours}/norm/gain"], b[f"{ours}/norm/bias"] = get("norm.weight"), get("norm.bias")
        if not config.qk_norm:
            for ours, theirs in (("norm_space", "norm1"), ("norm_mlp", "norm2")):
                b[f"{ours}/gain"] = tensors[f"{layer}{theirs}.weight"]
                b[f"{ours}/bias"] = tensors[f"{layer}{theirs}.bias"]
        for ours, theirs in (("mlp_in", "mlp.fc1"), ("mlp_out", "mlp.fc2")):
            b[f"{ours}/kernel"] = tensors[f"{layer}{theirs}.weight"].T
            b[f"{ours}/bias"] = tensors[f"{layer}{theirs}.bias"]
        for ours, theirs in (
            ("out", "linear_out"),
            ("hidden", "adaLN_modulation.0"),
            ("shift_scale", "adaLN_modulation.2"),
        ):
            name = layer + "action_projectors.{}." + theirs
            b[f"modulation/{ours}/kernel"] = per_robot(name + ".weight").swapaxes(1, 2)
            b[f"modulation/{ours}/bias"] = per_robot(name + ".bias")
        return b

    blocks = [block(n) for n in range(config.layers)]
    for path in blocks[0]:
        out[f"trunk/blocks/{path}"] = np.stack([b[path] for b in blocks])
    return out
