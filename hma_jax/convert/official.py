"""Checkpoints of the official PyTorch release (STMaskGIT and STMAR), as a `Run` and back.

A directory holds config.json and model.safetensors, or a torch file instead of the latter. Reading is strict: missing
or additional tensors and tensors of another shape are refused, where the release would leave random weights. Fields
that we do not use are kept in the run's provenance, so that a run that was imported and not trained since is exported
with the same fields and, byte for byte, the same tensors. In every other run, muP's multipliers are folded into the
weights where the release would use different ones (`multipliers`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hma_jax.config import ConfigError, ModelConfig, TrainConfig, require
from hma_jax.config.json import stable_hash
from hma_jax.convert.atomic import atomic_directory
from hma_jax.convert.multipliers import folded, query_ratio, readout_ratio
from hma_jax.convert.official_config import (
    BASE_WIDTH,
    CONTINUOUS_DEFAULTS,
    DISCRETE_DEFAULTS,
    is_continuous,
    read_masking,
    read_model,
    read_table,
    write_config,
)
from hma_jax.convert.release_limits import ATTENTION_SCALE, loads_in_release, released_form, require_official
from hma_jax.convert.run_directory import require_run
from hma_jax.convert.table import flat, from_official, nested, official_parts, to_official
from hma_jax.convert.tensors import Stored, check_tensors, read_finite, read_safetensors, write_safetensors
from hma_jax.convert.torch_file import read_torch
from hma_jax.model.embodiments import DEAD_STD, EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.model.params import Params
from hma_jax.training.runs import Run

CONFIG, WEIGHTS = "config.json", "model.safetensors"
TORCH_WEIGHTS = ("pytorch_model.bin", "model.bin")
INDEX = "{}.index.json"  # instead of weights that are in several files, which it names
WRAPPERS = ("module.", "_orig_mod.")
"""Prefixes that torch's data parallelism and torch.compile add to every name."""

ACTIONS_IN = ("stem/into/kernel", "action_head/robots/into/kernel")
"""Parameters [E, U, ...] that multiply actions, clean or noised."""

TRAINABLE = (2, 512)
"""Factors and entries of each that the release's loss assumes (reference section 1.8)."""

CLIP = 10.0
"""The range +-CLIP in which the release keeps predicted clean values while sampling; its configuration has no field for
it."""


def official_shapes(model: ModelConfig, table: EmbodimentTable) -> dict[str, tuple[int, ...]]:
    """Name -> shape of every tensor of an official checkpoint, statistics included."""
    parts = official_parts(model, table, declare_model(model, table).leaves())
    shapes = {part.name: part.shape for own in parts.values() for part in own}
    for entry in table.entries:
        shapes |= dict.fromkeys(_statistics(entry.name), (entry.action_dim,))
    return shapes


def _statistics(robot: str) -> tuple[str, str]:
    return f"action_preprocessor.{robot}.mean", f"action_preprocessor.{robot}.std"


# --- Reading -----------------------------------------------------------------------------------


def read_official(directory: Path) -> Run:
    """A run at step 0. Raises ConfigError, which names the file and the field or tensors that do not fit."""
    directory = Path(directory)
    config, tensors = read_config(directory), _read_weights(directory)
    where = str(directory / CONFIG)
    require(
        is_continuous(config) == any(name.startswith("diffloss.") for name in tensors),
        f"{directory}: {CONFIG} describes the {_variant(config)} variant, but the tensors are those of the other "
        "variant",
    )
    with _naming_file(where):
        model, masking = read_model(config, where), read_masking(config)
        require(
            config.get("use_actions", True) is not False,
            "use_actions is false: the release trains such a model without actions, which leaves its parameters for "
            "actions untrained, so it cannot be imported",
        )
        require(
            model.concat or masking.predicts_frames,
            f"jointly_predict_states is false, so that the model predicts actions alone, and with action_network "
            f"{config.get('action_network', 'mlp')!r} from image tokens; here actions are predicted from action tokens only "
            "(concat)",
        )
    blocks = model.layers + (model.diffusion.depth if model.diffusion else 0)
    require(
        blocks <= len(tensors),  # before anything is built for each layer
        f"{where}: it describes {blocks} layers, but there are only {len(tensors)} tensors",
    )
    names = config["action_domains"]
    missing = [name for robot in names for name in _statistics(robot) if name not in tensors]
    require(not missing, f"{directory}: missing tensors {', '.join(missing[:10])}")
    statistics = {
        robot: tuple(read_finite(tensors, name, str(directory)) for name in _statistics(robot)) for robot in names
    }
    with _naming_file(where):
        table = read_table(config, statistics, where)
        shapes = official_shapes(model, table)
    check_tensors(shapes, tensors, str(directory))
    leaves = declare_model(model, table).leaves()
    params = from_official(tensors, official_parts(model, table, leaves), leaves, str(directory))
    provenance = {
        "official": {
            "variant": _variant(config),
            "config": config,
            "table": stable_hash(table),
            "weights": _hash_of(params),
            "halves": {n: t.dtype.name for n, t in tensors.items() if t.dtype.name != "float32"},
        }
    }
    return Run(model, TrainConfig(masking=masking), table, params, 0, provenance)


def import_remarks(run: Run) -> list[str]:
    """What a user must know about a run that `read_official` made and that was not trained since: where it computes
    differently from the release, or may compute differently from the trained model."""
    remarks = []
    if run.model.conditioning == "cross_attention":
        remarks.append("cross-attention is computed as the paper describes it; the release computes it differently")
    if run.train.masking.predicts_actions and not run.model.concat:
        remarks.append(
            "the actions that it predicts are ignored: without concat in action_network the release reads them from image "
            "tokens, here they are read from action tokens only; its frames are not affected"
        )
    elif run.train.masking.predicts_actions:
        remarks.append(
            "the actions that it predicts are wrong, here as in the release, which trains action heads on raw actions "
            "and un-normalises what they give (docs/reference.md, section 9.1); its frames are not affected. To "
            "predict actions, train it further here (hma train --from): here targets are normalised"
        )
    steps = run.provenance["official"]["config"].get("num_sampling_steps", "100")
    if run.model.diffusion and str(steps) != "100":
        remarks.append(
            f"num_sampling_steps is {steps!r}: settings decide with how many steps frames are sampled here. For as many as "
            f"in the release: --set eval.decode.sampler.kind=ddpm --set eval.decode.sampler.steps={steps}"
        )
    constant = [
        f"{e.name} ({', '.join(str(i) for i, std in enumerate(e.std) if 0 < std <= DEAD_STD)})"
        for e in run.table.entries
        if any(0 < std <= DEAD_STD for std in e.std)
    ]
    if constant:
        remarks.append(
            f"action values, counted from 0, whose stored deviation is at most {DEAD_STD:g} are 0 here: {', '.join(constant)}. "
            "The release divides the rounding errors of such a constant by a deviation of their size, so its model was "
            "trained with another number there, perhaps 1 or -1, and may make somewhat different frames here"
        )
    if run.model.diffusion and run.model.mup.enabled and run.model.width != BASE_WIDTH:
        remarks.append(
            f"use_mup is true and the width is {run.model.width}: the release can neither train nor load such a "
            f"continuous model, since its muP supports width {BASE_WIDTH} only, so nothing says how the program that "
            "trained it scales the condition of the diffusion heads. It is multiplied by 1 here; if frames come out "
            f"wrong, it may have to be {BASE_WIDTH / run.model.width:g} ({BASE_WIDTH} / width)"
        )
    return remarks


@contextmanager
def _naming_file(where: str) -> Iterator[None]:
    """Adds the name of the file to errors of our configurations, which do not know it."""
    try:
        yield
    except OverflowError as error:
        raise ConfigError(f"{where}: it contains a number that is too large ({error})") from error
    except ConfigError as error:
        raise ConfigError(str(error) if where in str(error) else f"{where}: {error}") from error


def read_config(directory: Path) -> dict[str, Any]:
    """The contents of config.json. Raises ConfigError if there is no readable one."""
    path = Path(directory) / CONFIG
    try:
        config = json.loads(path.read_text())
    except OSError as error:
        raise ConfigError(f"no {path} ({error.strerror}); {_advice(path.parent)}") from error
    except ValueError as error:
        raise ConfigError(f"{path} is not JSON: {error}") from error
    require(isinstance(config, dict), f"{path}: expected named fields, got {type(config).__name__}")
    return config


def _advice(directory: Path) -> str:
    """Advice on what to give instead of a directory without config.json."""
    snapshots = directory / "snapshots"
    if snapshots.is_dir():
        return f"give the directory of a version in {snapshots}, where the Hugging Face hub keeps the files"
    advice = f"give a directory with {CONFIG} and {WEIGHTS}"
    if not directory.exists() and not directory.is_absolute() and len(directory.parts) == 2:
        advice += f"; of a model on the Hugging Face hub: hf download {directory} --local-dir {directory.name}"
    return advice


def _read_weights(directory: Path) -> dict[str, Stored]:
    names = (WEIGHTS, *TORCH_WEIGHTS)
    found = [directory / name for name in (*names, *map(INDEX.format, names)) if (directory / name).is_file()]
    require(bool(found), f"{directory} has neither {WEIGHTS} nor {' nor '.join(TORCH_WEIGHTS)}")
    tensors = _read_shards(found[0]) if found[0].suffix == ".json" else _read_file(found[0])
    while prefix := next((p for p in WRAPPERS if tensors and all(name.startswith(p) for name in tensors)), ""):
        tensors = {name.removeprefix(prefix): tensor for name, tensor in tensors.items()}
    return tensors


def _read_file(path: Path) -> dict[str, Stored]:
    return read_safetensors(path) if path.suffix == ".safetensors" else read_torch(path)


def _read_shards(index: Path) -> dict[str, Stored]:
    """The tensors of all files that an index names. Raises ConfigError where one is missing."""
    try:
        files = sorted({str(name) for name in json.loads(index.read_text())["weight_map"].values()})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{index} is not a readable index of weight files ({error}); download it again") from error
    missing = [name for name in files if not (index.parent / name).is_file()]
    require(not missing, f"{index.parent}: missing {', '.join(missing[:10])}, which {index.name} names; download them")
    return {name: tensor for file in files for name, tensor in _read_file(index.parent / file).items()}


def _variant(config: dict[str, Any]) -> str:
    return "continuous" if is_continuous(config) else "discrete"


# --- Writing -----------------------------------------------------------------------------------


def write_official(run: Run, directory: Path) -> list[str]:
    """Writes config.json and model.safetensors; returns remarks for the user.

    Raises ConfigError if `directory` exists or the release could not compute the model, and as `require_run`.
    """
    require_run(run)
    config = official_config(run)
    tensors, remarks = official_tensors(run)
    if not loads_in_release(config):
        remarks.append(
            "the checkpoint is written unchanged; the release cannot load it, since its muP supports continuous "
            "models of width 256 only. After further training here, it is written with muP folded into the weights, "
            "which the release loads"
        )
    with atomic_directory(directory) as temporary:
        (temporary / CONFIG).write_text(json.dumps(config, indent=2, sort_keys=True))
        write_safetensors(temporary / WEIGHTS, tensors)
    return remarks


def official_config(run: Run) -> dict[str, Any]:
    """The original config.json if it still describes the run, otherwise an updated one.

    Raises ConfigError if the release could not compute the model.
    """
    form = _exportable(run)
    source = _imported(run)
    original = source.get("config", {})
    fields = write_config(form, run.table, run.train.masking)
    if original and source["table"] == stable_hash(run.table):
        if _same(read_model(original, CONFIG), form) and read_masking(original) == run.train.masking:
            return original
        kept = ("action_domains", "d_actions", "action_stats")
        fields = {name: value for name, value in fields.items() if name not in kept}
    return {**(CONTINUOUS_DEFAULTS if form.diffusion else DISCRETE_DEFAULTS), **original, **fields}


def official_tensors(run: Run) -> tuple[dict[str, np.ndarray], list[str]]:
    """(name -> array, remarks for the user). Raises ConfigError as `official_config` does."""
    form, remarks = _exportable(run), []
    declared = declare_model(form, run.table)
    leaves = declared.leaves()
    arrays = folded(flat(run.params), leaves, run.model, form)
    if not run.model.action_heads:
        heads = nested({path: spec for path, spec in leaves.items() if path not in arrays})
        arrays |= flat(replace(declared, specs=heads).init(0))
        remarks.append("the release's models have action heads, this model has none: they are written untrained")
    if not _unchanged_since_import(run):
        arrays |= _without_constant_actions(arrays, run.table)
        if not form.diffusion and (form.factors, form.factor_vocab) != TRAINABLE:
            remarks.append(
                f"tokens have {form.factors} factors of {form.factor_vocab} entries: the release generates frames with this "
                f"model, but cannot train it or compute its loss, which assumes {TRAINABLE[0]} factors of {TRAINABLE[1]}"
            )
    remarks += _remarks(run.model, form)
    tensors = to_official(nested(arrays), official_parts(form, run.table, leaves))
    for entry in run.table.entries:
        for name, values in zip(_statistics(entry.name), (entry.centre, entry.unit), strict=True):
            tensors[name] = np.asarray(values, np.float32)
    halves = run.provenance.get("official", {}).get("halves", {})
    return {name: _narrow(x, halves.get(name)) for name, x in tensors.items()}, remarks


def _imported(run: Run) -> dict[str, Any]:
    """What `read_official` recorded about the checkpoint from which the run was made or trained further; {} if there is
    none."""
    provenance = run.provenance
    while provenance and "official" not in provenance:
        provenance = provenance.get("origin", {}).get("provenance", {})
    return provenance.get("official", {})


def _exportable(run: Run) -> ModelConfig:
    """The configuration that is written: the imported one if the run came from the release and was not trained since,
    otherwise `released_form`. Raises ConfigError if the release could not compute it."""
    if _unchanged_since_import(run):
        return run.model
    require_official(run.model, run.table, run.train.masking.setting)
    return released_form(run.model)


def _unchanged_since_import(run: Run) -> bool:
    """Whether the run was imported from the release and neither trained nor edited since."""
    source = run.provenance.get("official")
    if not source or run.step or source["table"] != stable_hash(run.table):
        return False
    if read_model(source["config"], CONFIG) != run.model:
        return False
    return source["weights"] == _hash_of(run.params)


def _hash_of(params: Params) -> str:
    digest = hashlib.sha256()
    for path, array in sorted(flat(params).items()):
        digest.update(path.encode())
        digest.update(np.ascontiguousarray(array, "<f4"))
    return digest.hexdigest()[:16]


def _without_constant_actions(arrays: dict[str, np.ndarray], table: EmbodimentTable) -> dict[str, np.ndarray]:
    """The parameters that multiply actions, with zeros for action values that do not vary. This model normalises such
    values to 0, while the release divides their rounding noise by about 0 (`ActionUnits.normalise`)."""
    alive_EU = table.alive()
    return {path: np.where(alive_EU[..., None], arrays[path], 0) for path in ACTIONS_IN if path in arrays}


def _same(original: ModelConfig, form: ModelConfig) -> bool:
    """Whether multipliers and everything else are equal; without muP the base width has no meaning."""
    switches = original.mup.enabled == form.mup.enabled
    return original == form or (switches and released_form(original) == released_form(form))


def _remarks(model: ModelConfig, form: ModelConfig) -> list[str]:
    remarks = []
    reads, queries = readout_ratio(model, form), query_ratio(model, form)
    what = "what conditions the diffusion heads is" if model.diffusion else "read-outs are"
    if model.mup.enabled and not form.mup.enabled:
        why = (
            f"attention scales of {ATTENTION_SCALE} / head width only"
            if model.mup.attention_scale != ATTENTION_SCALE or "attention" in model.mup.without
            else "continuous models of width 256 only"
        )
        remarks.append(
            f"muP is folded into the weights and switched off in {CONFIG}, because the release supports it for {why}: "
            f"queries are multiplied by {queries:g}, {what} multiplied by {reads:g}. The model computes the same, but "
            "further training uses the learning rates of a model without muP"
        )
    elif reads != 1:
        remarks.append(
            f"{what} multiplied by {reads:g}, because the release divides their inputs by width / "
            f"{form.mup.base_width} and this model by width / {model.mup.base_width}"
        )
    if model.diffusion and model.diffusion.clip != CLIP:
        remarks.append(
            f"while sampling the release keeps predicted clean values in +-{CLIP:g}, this model in "
            f"+-{model.diffusion.clip:g}"
        )
    return remarks


def _narrow(tensor: np.ndarray, dtype: str | None) -> np.ndarray:
    """The tensor in the type in which it was imported, unless that loses precision."""
    if dtype is None:
        return tensor
    narrow = tensor.astype(dtype)
    return narrow if np.array_equal(narrow.astype(tensor.dtype), tensor, equal_nan=True) else tensor
