"""Conversion between the official config.json and our configuration. Facts: reference sections 1.1, 2 and 8.2."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hma_jax.config import MaskingConfig, ModelConfig, require
from hma_jax.config.json import from_dict
from hma_jax.model.embodiments import Embodiment, EmbodimentTable

BASE_WIDTH = 256
"""The width at which the release's muP multipliers are 1."""

CONTINUOUS_ONLY = {
    "Diffusion": True,
    "dim": 512,
    "vae_stride": 1,
    "patch_size": 1,
    "vae_embed_dim": 4,
    "mask_ratio_min": 0.7,
    "attn_dropout": 0.1,
    "proj_dropout": 0.1,
    "buffer_size": 64,
    "diffloss_d": 4,
    "diffloss_w": 1024,
    "num_sampling_steps": "100",
    "diffusion_batch_mul": 1,
    "grad_checkpointing": False,
    "predict_unmask": False,
    "maskgit_steps": 16,
}

DISCRETE_DEFAULTS: dict[str, Any] = {
    "T": 12,
    "S": 256,
    "image_vocab_size": 262144,
    "use_mup": False,
    "dataloader_apply_mask": True,
    "dataloader_apply_corruption": True,
    "dataloader_mask_ratio_min": 0.2,
    "drop_action_ratio": 0.0,
    "arch": "STTransformerDecoder",
    "random_dummy_action": True,
    "num_factored_vocabs": 1,
    "factored_vocab_size": None,
    "max_corrupt_rate": 0.2,
    "non_mlm_ratio": 0.2,
    "num_prompt_frames": 4,
    "init_actions": False,
    "d_action": 28,
    "use_actions": True,
    "action_domains": None,
    "d_actions": None,
    "action_stats": None,
    "action_network": "mlp",
    "shared_action_mlps": True,
    "action_contrastive_loss": False,
    "jointly_predict_actions": False,
    "jointly_predict_states": True,
    "action_token_size": 64,
    "label_drop_prob": 0.5,
    "action_loss_weight": 0.5,
    "qkv_bias": False,
    "proj_bias": True,
    "attn_drop": 0.0,
    "qk_norm": True,
    "mlp_ratio": 4.0,
    "mlp_drop": 0.0,
    "mlp_bias": True,
}
"""The release's default for each absent field, including fields that have no effect."""

CONTINUOUS_DEFAULTS = DISCRETE_DEFAULTS | {
    "dataloader_apply_corruption": False,
    "dataloader_mask_ratio_min": 0.1,
    "action_loss_weight": 1.0,
    **CONTINUOUS_ONLY,
}

MODEL_FIELDS = {
    "d_model": "width",
    "num_layers": "layers",
    "num_heads": "heads",
    "T": "frames",
    "action_token_size": "action_tokens",
    "mlp_ratio": "mlp_ratio",
    "qkv_bias": "qkv_bias",
    "proj_bias": "proj_bias",
    "mlp_bias": "mlp_bias",
    "qk_norm": "qk_norm",
}
"""Official field -> the field of ModelConfig with the same meaning."""

DIFFUSION_FIELDS = {
    "vae_embed_dim": "channels",
    "patch_size": "patch",
    "diffloss_w": "width",
    "diffloss_d": "depth",
    "diffusion_batch_mul": "repeats",
}

MASKING_FIELDS = {
    "action_loss_weight": "action_loss_weight",
    "non_mlm_ratio": "non_mlm_ratio",
    "num_prompt_frames": "prompt_frames",
    "max_corrupt_rate": "max_corrupt_rate",
}

NETWORKS = {
    "mlp": "add",
    "modulate": "modulate",
    "concat": "concat",
    "concat+modulate": "concat+modulate",
    "cross_attention": "cross_attention",
}
"""action_network -> ModelConfig.conditioning."""

REQUIRED = ("d_model", "num_layers", "num_heads", "action_domains", "d_actions")


def is_continuous(config: Mapping[str, Any]) -> bool:
    return any(config.get(name) not in (None, False) for name in ("Diffusion", "diffloss_w", "vae_embed_dim"))


def _with_defaults(config: Mapping[str, Any]) -> dict[str, Any]:
    """`config` with the release's defaults for absent fields."""
    return {**(CONTINUOUS_DEFAULTS if is_continuous(config) else DISCRETE_DEFAULTS), **config}


def _complete(config: Mapping[str, Any], where: str) -> dict[str, Any]:
    """`_with_defaults`. Raises ConfigError for absent fields without a usable default, and for invalid counts and
    lists."""
    missing = [name for name in REQUIRED if config.get(name) is None]
    no_robots = set(missing) == {"action_domains", "d_actions"}
    why = ": a model without robots, which the release trains without actions, cannot be imported" if no_robots else ""
    require(not missing, f"{where}: missing field(s), or null: {', '.join(missing)}{why}")
    full = _with_defaults(config)
    for name in ("S", "d_model", *(["patch_size"] if is_continuous(config) else [])):
        require(_is_count(full[name]), f"{where}: {name} must be a positive integer, got {full[name]!r}")
    for name, good in (("action_domains", lambda x: isinstance(x, str)), ("d_actions", _is_count)):
        listed = isinstance(full[name], list) and all(map(good, full[name]))
        require(listed, f"{where}: {name} must list one value per robot, got {full[name]!r}")
    return full


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 1


def read_model(config: Mapping[str, Any], where: str) -> ModelConfig:
    """Our configuration of the model. Raises ConfigError, which names a field that is missing, of the wrong kind or not
    supported."""
    full = _complete(config, where)
    network = full["action_network"]
    require(
        isinstance(network, str) and network in NETWORKS,
        f"{where}: action_network {network!r} is not supported; supported are {', '.join(NETWORKS)}",
    )
    fields = {field: full[official] for official, field in MODEL_FIELDS.items()}
    fields["conditioning"] = NETWORKS[network]
    base = full["d_model"] if is_continuous(config) else BASE_WIDTH
    fields["mup"] = {"enabled": full["use_mup"], "base_width": base}
    size = full["S"]
    if is_continuous(config):
        fields["diffusion"] = {field: full[official] for official, field in DIFFUSION_FIELDS.items()}
        cells = full["patch_size"] ** 2
        require(size % cells == 0, f"{where}: S {size} latent cells cannot be divided into patches of {cells}")
        fields["tokens"] = size // cells
    else:
        fields["tokens"] = size
        fields["factors"] = full["num_factored_vocabs"]
        # As in the release, which ignores the stored factored_vocab_size.
        fields["factor_vocab"] = _root(full["image_vocab_size"], fields["factors"], where)
    return from_dict(ModelConfig, fields, where)


def _root(vocab: int | None, factors: int, where: str) -> int:
    require(
        _is_count(vocab) and _is_count(factors),
        f"{where}: image_vocab_size {vocab!r} and num_factored_vocabs {factors!r} must be numbers",
    )
    root = round(vocab ** (1 / factors))
    require(
        root**factors == vocab,
        f"{where}: image_vocab_size {vocab} cannot be split into {factors} equal factors (num_factored_vocabs)",
    )
    return root


def read_masking(config: Mapping[str, Any]) -> MaskingConfig:
    """How the release would continue training, except for the hidden actions of the continuous variant
    (`masking.hide_actions`). Raises ConfigError where it would train nothing."""
    full = _with_defaults(config)
    fields = {field: full[official] for official, field in MASKING_FIELDS.items()}
    states, actions = (bool(full[f"jointly_predict_{what}"]) for what in ("states", "actions"))
    require(
        states or actions,
        "jointly_predict_states and jointly_predict_actions are both false, so the model predicts nothing; one must be "
        "true",
    )
    fields["setting"] = ("full" if states else "policy") if actions else "forward"
    if is_continuous(config):
        fields |= {"mask_angle_min": full["dataloader_mask_ratio_min"], "mask_unit": "cell"}
    else:
        fields["clean_rate_min"] = full["dataloader_mask_ratio_min"]
        if not full["dataloader_apply_corruption"]:
            fields["max_corrupt_rate"] = 0.0
    return from_dict(MaskingConfig, fields)


def read_table(
    config: Mapping[str, Any], statistics: Mapping[str, tuple[np.ndarray, np.ndarray]], where: str
) -> EmbodimentTable:
    """Robots in the order of action_domains; `statistics` holds each robot's (mean, std), the buffers."""
    full = _complete(config, where)
    names, chunks = full["action_domains"], full["d_actions"]
    require(
        len(names) == len(chunks) >= 1,
        f"{where}: {len(names)} action_domains but {len(chunks)} d_actions; each domain needs one",
    )
    entries = []
    for name, chunk in zip(names, chunks, strict=True):
        mean, std = (np.asarray(x, np.float32) for x in statistics[name])
        dim = mean.size
        require(
            dim > 0 and chunk % dim == 0,
            f"{where}: d_actions {chunk} of {name} is not a multiple of its {dim} action dimensions, the length of "
            f"action_preprocessor.{name}.mean",
        )
        entries.append(Embodiment(name, dim, chunk // dim, tuple(mean.tolist()), tuple(std.tolist())))
    return EmbodimentTable(tuple(entries))


def write_config(model: ModelConfig, table: EmbodimentTable, masking: MaskingConfig) -> dict[str, Any]:
    """The fields of an official config.json that follow from a model the release can hold (`release_limits`)."""
    config = {official: getattr(model, field) for official, field in MODEL_FIELDS.items()}
    config |= {official: getattr(masking, field) for official, field in MASKING_FIELDS.items()}
    config |= {
        "S": model.tokens * (model.diffusion.cells if model.diffusion else 1),
        "use_mup": model.mup.enabled,
        "action_network": next(k for k, v in NETWORKS.items() if v == model.conditioning),
        "jointly_predict_actions": masking.predicts_actions,
        "jointly_predict_states": masking.predicts_frames,
        "init_actions": True,
        "action_domains": list(table.names),
        "d_actions": table.chunks.tolist(),
        "action_stats": [[list(e.centre), list(e.unit)] for e in table.entries],
    }
    if model.diffusion:
        config |= {official: getattr(model.diffusion, field) for official, field in DIFFUSION_FIELDS.items()}
        config |= {"image_vocab_size": None, "factored_vocab_size": 64}  # the release's placeholders
        config["dataloader_mask_ratio_min"] = masking.mask_angle_min
    else:
        config |= {"image_vocab_size": model.vocab_size, "factored_vocab_size": model.factor_vocab}
        config["num_factored_vocabs"] = model.factors
        config["dataloader_apply_corruption"] = masking.max_corrupt_rate > 0
        config["dataloader_mask_ratio_min"] = masking.clean_rate_min
    return config
