"""The case of tables: schedules, counts, weights and what initial parameters look like."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from data_pipelines.registry import DatasetSpec
from data_pipelines.sampling.mixture import mixture_weights
from data_pipelines.sources.rlds.images import fit_image
from hma_jax.config import DiffusionConfig, ModelConfig, OptimizerConfig
from hma_jax.convert.table import official_parts
from hma_jax.generation.decoding import cosine_schedule, masked_counts
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.frames import compose, factorise, patchify, unpatchify
from hma_jax.model.heads import timestep_embedding
from hma_jax.model.hma import declare_model
from hma_jax.objective.process import Process, make_process, respace
from hma_jax.training.optimizer import make_schedule
from tests.golden.case import Case, Finding


def check_tables(case: Case) -> None:
    """Every JSON file of the folder; one that is not known is a failure."""
    for path in sorted(case.folder.glob("*.json")):
        content = json.loads(path.read_text())
        if path.stem in TABLES:
            TABLES[path.stem](case, path.stem, content)
        else:
            case.add(Finding(path.name, False, note="unknown table"))


def _close(case: Case, label: str, got: Any, want: Any, rtol: float = 1e-12) -> None:
    case.compare(label, np.asarray(got, np.float64), np.asarray(want, np.float64), 1e-15, rtol)


def _exact(case: Case, label: str, wrong: list[str], count: int) -> None:
    case.add(Finding(label, not wrong, note="; ".join(wrong[:5]) if wrong else f"{count} exact"))


# --- Diffusion ---------------------------------------------------------------------------------


def _check_process(case: Case, label: str, process: Process, want: dict[str, Any]) -> None:
    rows = want.get("index", slice(None))
    ours = {
        "betas": process.betas,
        "alphas_cumprod": process.alphas_cumprod,
        "alphas_cumprod_prev": process.alphas_cumprod_prev,
        "posterior_mean_coef1": process.posterior_x0,
        "posterior_mean_coef2": process.posterior_xt,
        "sqrt_recip_alphas_cumprod": process.clean_from_xt,
        "sqrt_recipm1_alphas_cumprod": process.clean_from_eps,
        "posterior_log_variance_clipped": process.posterior_log_variance_clipped,
        "posterior_variance": process.betas * (1 - process.alphas_cumprod_prev) / (1 - process.alphas_cumprod),
        "timestep_map": process.timestep_map,
    }
    for name in want:
        if name in ours:
            rtol = 1e-9 if name.startswith("posterior_log") else 1e-12
            _close(case, f"{label}.{name}", ours[name][rows], want[name], rtol)
        elif name != "index":
            case.add(Finding(f"{label}.{name}", False, note="unknown table"))


def _diffusion(case: Case, label: str, want: dict[str, Any]) -> None:
    steps = 1000 if "index" in want else len(next(iter(want.values())))  # copies may be thinned
    _check_process(case, label, make_process(steps), want)


def _respaced(case: Case, label: str, want: dict[str, Any]) -> None:
    for count, process in want.items():
        _check_process(case, f"{label}.{count}", respace(make_process(1000), int(count)), process)


def _indices(case: Case, label: str, want: dict[str, Any]) -> None:
    wrong = [n for n in want if respace(make_process(1000), int(n)).timestep_map.tolist() != want[n]]
    _exact(case, label, wrong, len(want))


def _embedding(case: Case, label: str, want: dict[str, Any]) -> None:
    got = jax.jit(timestep_embedding, static_argnums=1)(np.array(want["timesteps"]), want["dim"])
    case.compare(label, got, np.asarray(want["embedding"], np.float32), 1e-4)


# --- Tokens and decoding -----------------------------------------------------------------------


_factorise = jax.jit(factorise, static_argnums=(1, 2))
_compose, _patches = (jax.jit(function, static_argnums=1) for function in (compose, patchify))
_cells = jax.jit(unpatchify, static_argnums=(1, 2))


def _factorisation(case: Case, label: str, want: list[dict[str, Any]]) -> None:
    wrong = []
    for one in want:
        size = one["factor_size"]
        digits = _factorise(np.array(one["ids"]), one["num_factors"], size)
        if digits.tolist() != one["factors"] or _compose(digits, size).tolist() != one["ids"]:
            wrong.append(f"{one['num_factors']} factors of {size}")
    _exact(case, label, wrong, len(want))


def _patchify(case: Case, label: str, want: dict[str, Any]) -> None:
    shape, new = want["input_shape"], want["output_shape"]
    x, patch = np.arange(np.prod(shape)).reshape(shape), shape[2] // new[2]
    tokens = np.asarray(_patches(x, patch))
    good = tokens.ravel().tolist() == want["output"] and (np.asarray(_cells(tokens, patch, new[3])) == x).all()
    _exact(case, label, [] if good else ["the order differs"], 1)


def _mask_counts(case: Case, label: str, want: dict[str, Any]) -> None:
    wrong, count = [], 0
    for size, runs in want["discrete"].items():
        config = ModelConfig(tokens=int(size))
        for steps, masked in runs.items():
            count += 1
            if masked_counts(config, int(steps))[:-1] != masked:
                wrong.append(f"discrete, {size} tokens, {steps} steps")
    for size, runs in want["continuous"].items():
        config = ModelConfig(tokens=int(size), diffusion=DiffusionConfig())
        for steps, sampled in runs.items():
            count += 1
            if [int(size) - keep for keep in masked_counts(config, int(steps))] != sampled:
                wrong.append(f"continuous, {size} tokens, {steps} steps")
    _exact(case, label, wrong, count)


def _cosine(case: Case, label: str, want: dict[str, Any]) -> None:
    """At any points, in any order."""
    _close(case, label, [cosine_schedule(u) for u in want["u"]], want["value"])


# --- Data and training -------------------------------------------------------------------------


def _weights(case: Case, label: str, want: list[dict[str, Any]]) -> None:
    got = [mixture_weights(one["sizes"], one["temperature"]) for one in want]
    _close(
        case,
        f"{label}.weights ({len(want)})",
        np.concatenate(got),
        np.concatenate([o["weights"] for o in want]),
    )
    note = "not followed: training counts steps, not epochs"
    case.add(Finding(f"{label}.batches_per_epoch", None, note=note))


def _rate(case: Case, label: str, want: dict[str, Any]) -> None:
    config = OptimizerConfig(learning_rate=1.0, warmup_steps=want["warmup_steps"])
    schedule = jax.jit(make_schedule(config, want["total_steps"]))
    for name in want.keys() - {"warmup_steps", "total_steps", "note", "index"}:
        if name == "constant_with_warmup":
            # Theirs counts warm-up steps from 0, so that its first update does nothing if there are any.
            idle = want["warmup_steps"] > 0
            got = [0.0 if idle and i == 0 else float(schedule(max(i - 1, 0))) for i in want["index"]]
            case.compare(f"{label}.{name}, one update later than ours", got, want[name], 1e-6)
            if idle:
                note = "not followed: the release's first update has a rate of 0, ours the first step of the warm-up"
                case.add(Finding(f"{label}.{name}", None, note=note))
        elif name == "custom_cosine":
            kind = OptimizerConfig(learning_rate=1.0, warmup_steps=want["warmup_steps"], schedule="cosine")
            cosine = jax.jit(make_schedule(kind, want["total_steps"]))
            got = [float(cosine(i)) for i in want["index"]]
            case.compare(f"{label}.{name}", got, want[name], 1e-6)
        else:
            case.add(Finding(f"{label}.{name}", False, note="unknown schedule"))


def _frequencies(case: Case, label: str, want: dict[str, Any]) -> None:
    """Whole multiples of 2 Hz have one stride in both."""
    even = {name: hz for name, hz in want["table"].items() if hz % 2 == 0 or hz == 1}
    wrong = [n for n, hz in even.items() if DatasetSpec(n, "i", (), (), hz).stride != want["stride"][n]]
    _exact(case, f"{label} (multiples of 2 Hz)", wrong, len(even))
    others = len(want["table"]) - len(even)
    case.add(Finding(label, None, note=f"{others} others not followed: the release floors, we round"))


def _resize(case: Case, label: str, want: dict[str, Any]) -> None:
    """Both end at the central square; the way there is not the same."""
    wrong = []
    for one in want["cases"]:
        size = one["output_hw"][0]
        got = fit_image(np.zeros((*one["input_hw"], 3), np.uint8), size).shape[:2]
        if list(got) != one["output_hw"]:
            wrong.append(f"{one['input_hw']}: {got}")
    _exact(case, f"{label}.output_hw", wrong, len(want["cases"]))
    note = "not followed: one antialiased step, and no wrong aspect ratio"
    case.add(Finding(f"{label}.resized_hw", None, note=note))


# --- Initial parameters ------------------------------------------------------------------------

OWN_INITIALISERS: dict[str, tuple[str, ...]] = {
    "discrete": (),
    "continuous": (
        "trunk/blocks/space",
        "trunk/blocks/time",
        "trunk/blocks/mlp",
        "embed/kernel",
        "frame_head/linear",
        "denoiser/into",
        "denoiser/blocks",
        "denoiser/modulation",
        "denoiser/out",
        "action_head/robots/condition",
        "action_head/robots/into",
        "action_head/robots/blocks",
    ),
}
"""DIFFERS: where our continuous variant is drawn otherwise than the release's, whose reset of all linear
layers to N(0, 0.02) depends on the order of its constructors (`model.initial`, `model.heads`)."""


def _initialisation(case: Case, label: str, want: dict[str, Any]) -> None:
    for variant in want.keys() - {"note"}:
        _check_initial(case, f"{label}.{variant}", variant, want[variant])


def _check_initial(case: Case, label: str, variant: str, want: dict[str, dict[str, Any]]) -> None:
    shape = {name: one["shape"] for name, one in want.items()}
    first = next(name for name in want if name.endswith("model.0.weight"))
    robot, chunk = first.split(".")[1], shape[first][1]
    _, frames, slots, width = shape["pos_embed_TSC"]
    layers = sum(name.endswith("norm1.weight") for name in want)
    settings: dict[str, Any] = {"width": width, "frames": frames, "layers": layers, "heads": 1}
    if variant == "continuous":
        channels = shape["mask_token"][-1]
        diffusion = DiffusionConfig(
            channels=channels,
            patch=math.isqrt(shape["token_embed.weight"][1] // channels),
            width=shape["diffloss.net.cond_embed.weight"][0],
            depth=sum(name.startswith("diffloss") and name.endswith("in_ln.weight") for name in want),
        )
        tokens = shape["diffusion_pos_embed_learned"][1] // frames
        settings |= {"diffusion": diffusion, "qkv_bias": True, "mlp_bias": False}
        cells = tokens * diffusion.cells
    else:
        tables = [one for name, one in shape.items() if "factored_embeds" in name]
        settings |= {"factors": len(tables), "factor_vocab": tables[0][0]}
        cells = tokens = 256  # of what the trainer builds
    model = ModelConfig(**settings, tokens=tokens, action_tokens=slots - cells)
    table = EmbodimentTable((Embodiment(robot, chunk, 1, (0.0,) * chunk, (1.0,) * chunk),))
    declared = declare_model(model, table)
    parts = official_parts(model, table, declared.leaves())
    own = {part.name: (path, part) for path, parts_ in parts.items() for part in parts_}
    arrays = {path: spec.init(np.random.default_rng(0), spec.shape) for path, spec in declared.leaves().items()}

    wrong, differ, followed = [f"{n}: not ours" for n in want if n not in own], 0, 0
    wrong += [f"{n}: not theirs" for n in own if n not in want]
    for name in want.keys() & own.keys():
        path, part = own[name]
        if list(part.shape) != want[name]["shape"]:
            wrong.append(f"{name}: shape {part.shape}")
        elif path.startswith(OWN_INITIALISERS[variant]) and not path.endswith(("bias", "gain")):
            differ += 1
        else:
            followed += 1
            wrong += _unlike(name, part.to_official(arrays[path]), want[name])
    _exact(case, label, wrong, followed)
    if differ:
        case.add(Finding(label, None, note=f"{differ} tensors not followed: initialisers of our own"))


def _unlike(name: str, array: np.ndarray, want: dict[str, Any]) -> list[str]:
    """Whether a draw has the recorded spread; the release's is a single draw too."""
    if "constant" in want:
        return [] if (array == want["constant"]).all() else [f"{name}: not {want['constant']:g}"]
    few = 4 / np.sqrt(array.size)  # of one standard deviation, four errors wide
    if abs(array.std() / want["std"] - 1) > max(0.02, few):
        return [f"{name}: std {array.std():.3g}, expected {want['std']:.3g}"]
    uniform = want["max_abs"] < 1.8 * want["std"]
    if uniform and abs(np.abs(array).max() / want["max_abs"] - 1) > 0.02:
        return [f"{name}: bound {np.abs(array).max():.3g}, expected {want['max_abs']:.3g}"]
    return []


TABLES: dict[str, Callable[[Case, str, Any], None]] = {
    "cosine_schedule": _cosine,
    "diffusion_1000": _diffusion,
    "diffusion_respaced": _respaced,
    "factorisation": _factorisation,
    "frequency_table": _frequencies,
    "initialisation": _initialisation,
    "learning_rate": _rate,
    "mask_counts": _mask_counts,
    "patchify": _patchify,
    "resize_geometry": _resize,
    "respaced_indices": _indices,
    "sampler_weights": _weights,
    "timestep_embedding": _embedding,
}
