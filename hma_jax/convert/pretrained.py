"""Tokenizers that others trained, read from the published files.

The MAGVIT2 tokenizer, 1X's or an Open-MAGVIT2 without adaptive normalisation, is a torch file of a training run
(`magvit2.ckpt`), or a safetensors file with its tensors. In a directory with a config.json beside the weights it may
have other sizes. The VAE of Stable Video Diffusion is a directory of the diffusers library. Reading is strict: missing
or additional tensors and tensors of another shape are refused by name, and no code in a file is run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from hma_jax.config import Dtype, ImageSize, Magvit2Config, require
from hma_jax.config.json import from_dict
from hma_jax.convert.official import CONFIG, read_config
from hma_jax.convert.table import nested
from hma_jax.convert.tensors import FLOATS, Stored, check_tensors, read_finite, read_safetensors
from hma_jax.convert.torch_file import read_torch
from hma_jax.model.params import Declared, Params, ParamSpec
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.tokenizers.pretrained import Magvit2Tokenizer, SvdVaeTokenizer

LOSS, AVERAGE, ADAPTIVE = "loss.", "model_ema.", "decoder.adaptive."
"""Prefixes of names of tensors in the file of a MAGVIT2 training: those of the discriminator, which a tokenizer does
not need; of the moving average of the weights, named as the weights without dots, which the release does not use; and
of the part that later Open-MAGVIT2 models have in their decoder."""

FILES = (
    "diffusion_pytorch_model.safetensors",
    "diffusion_pytorch_model.fp16.safetensors",
    "diffusion_pytorch_model.bin",
    "model.safetensors",
    "magvit2.safetensors",
    "magvit2.ckpt",
)
"""Names of weight files in a directory; the first that exists is read."""


@dataclass(frozen=True)
class Source:
    """How one kind of tokenizer is published."""

    tokenizer: type[Tokenizer]
    fields: Mapping[str, str]  # official field of config.json -> field of our configuration
    required: tuple[str, ...]  # official fields that every config.json of this kind has
    fixed: Mapping[str, tuple[Any, ...]]  # official field -> values that are supported
    shortcut: str  # official name of the 1x1 convolution beside a residual block

    def config(self, official: Mapping[str, Any], where: str, **given: Any) -> Any:
        """Our configuration. Raises ConfigError, which names the field that is missing or not supported."""
        missing = [name for name in self.required if official.get(name) is None]
        require(not missing, f"{where}: missing field(s) {', '.join(missing)}")
        for name, good in self.fixed.items():
            value = official.get(name, good[0])
            require(value in good, f"{where}: {name} is {value!r}, but only {good[0]!r} is supported")
        known = {field: official[name] for name, field in self.fields.items() if name in official}
        return from_dict(self.tokenizer.config_class, known | given, where)

    def official_name(self, path: str) -> str:
        """The official name of our parameter: 'decoder/conv_in/kernel' -> 'decoder.conv_in.weight'."""
        renamed = {"kernel": "weight", "gain": "weight", "shortcut": self.shortcut}
        return ".".join(renamed.get(part, part) for part in path.split("/"))


MAGVIT2 = Source(
    Magvit2Tokenizer,
    {
        "base_channels": "channels",
        "ch_mult": "multipliers",
        "num_res_blocks": "res_blocks",
        "z_channels": "bits",
        "norm_num_groups": "groups",  # no official field: 32 there
    },
    ("base_channels", "ch_mult", "num_res_blocks", "z_channels"),
    {"in_channels": (3,), "out_channels": (3,), "num_codebooks": (1,), "token_factorization": (False,)},
    "nin_shortcut",
)

SVD_VAE = Source(
    SvdVaeTokenizer,
    {
        "block_out_channels": "channels",
        "layers_per_block": "layers",
        "latent_channels": "latent_channels",
        "scaling_factor": "scale",
        "norm_num_groups": "groups",  # no official field: 32 there
    },
    ("block_out_channels", "layers_per_block", "latent_channels"),
    {"in_channels": (3,), "out_channels": (3,)},
    "conv_shortcut",
)


# --- Names and layouts ---------------------------------------------------------------------------


def official_shape(spec: ParamSpec) -> tuple[int, ...]:
    """The shape in PyTorch's layout: outputs, inputs, then the window."""
    # There a kernel over time is one over time and space, with a window of one pixel.
    window = (1, 1) if len(spec.shape) == 3 else ()
    return tuple(spec.shape[i] for i in _reversed(spec)) + window


def _reversed(spec: ParamSpec) -> tuple[int, ...]:
    """The permutation from our order of a kernel's axes, (window, inputs, outputs), to (outputs, inputs, window)."""
    last = len(spec.shape) - 1
    return (0,) if last == 0 else (last, last - 1, *range(last - 1))


def tokenizer_shapes(source: Source, declared: Declared) -> dict[str, tuple[int, ...]]:
    """Official name -> shape of every tensor that makes a network."""
    return {source.official_name(path): official_shape(spec) for path, spec in declared.leaves().items()}


def tokenizer_params(source: Source, declared: Declared, tensors: Mapping[str, Stored], where: str) -> Params:
    """Our parameters, float32. Raises ConfigError, which names tensors that are missing, not expected, of another
    shape, not floats or not finite."""
    check_tensors(tokenizer_shapes(source, declared), tensors, where, (*FLOATS, "float64"))

    def read(path: str, spec: ParamSpec) -> jnp.ndarray:
        values = read_finite(tensors, source.official_name(path), where).astype(np.float32)
        order = _reversed(spec)
        return jnp.asarray(values.reshape([spec.shape[i] for i in order]).transpose(np.argsort(order)))

    return nested({path: read(path, spec) for path, spec in declared.leaves().items()})


# --- Files -----------------------------------------------------------------------------------


def read_magvit2(
    path: Path,
    *,
    image_size: ImageSize = 256,
    compute_dtype: Dtype = "float32",
    weights: Literal["last", "ema"] = "last",
) -> Magvit2Tokenizer:
    """From `magvit2.ckpt`, a safetensors file, or a directory of either with config.json.

    `image_size` must be a multiple of 2^(levels - 1), which is 16 for the published tokenizer. `weights`: the last ones
    of the training, which the release uses, or their moving average. Raises ConfigError, which names what is wrong in
    the file.
    """
    path = Path(path)
    given: dict[str, Any] = {"image_size": image_size, "compute_dtype": compute_dtype}
    if path.is_dir():
        official = read_config(path)
        bits = official.get("z_channels")
        if isinstance(bits, int) and bits % Magvit2Config.factors:
            given["factors"] = 1
        config = MAGVIT2.config(official, str(path / CONFIG), **given)
    else:
        config = Magvit2Config(**given)
    tensors = read_tensors(path)
    kept = {name: t for name, t in tensors.items() if not name.startswith((LOSS, AVERAGE))}
    require(
        not any(name.startswith(ADAPTIVE) for name in kept),
        f"{path}: an Open-MAGVIT2 whose decoder has adaptive normalisation ({ADAPTIVE}*), which is not supported; "
        "supported is the one without, such as 1X's magvit2.ckpt",
    )
    if weights == "ema":
        averages = {name: AVERAGE + name.replace(".", "") for name in kept}
        lacking = [name for name, average in averages.items() if average not in tensors]
        require(
            not lacking,
            f"{path} has no averaged weights ({AVERAGE}*) for {len(lacking)} of {len(kept)} tensors; read the last ones",
        )
        kept = {name: tensors[average] for name, average in averages.items()}
    declared = Magvit2Tokenizer.declare(config)
    return Magvit2Tokenizer(config, tokenizer_params(MAGVIT2, declared, kept, str(path)))


def has_average(path: Path) -> bool:
    """Whether the file that `read_magvit2` reads also has the moving average of the weights."""
    return any(name.startswith(AVERAGE) for name in read_tensors(Path(path)))


def read_svd_vae(
    directory: Path, *, image_size: ImageSize = 256, patch: int = 2, compute_dtype: Dtype = "float32"
) -> SvdVaeTokenizer:
    """From a directory of the diffusers library, with config.json and diffusion_pytorch_model.safetensors.

    Raises ConfigError, which names what is wrong in the files.
    """
    directory = Path(directory)
    config = SVD_VAE.config(
        read_config(directory),
        str(directory / CONFIG),
        image_size=image_size,
        patch=patch,
        compute_dtype=compute_dtype,
    )
    declared = SvdVaeTokenizer.declare(config)
    params = tokenizer_params(SVD_VAE, declared, read_tensors(directory), str(directory))
    return SvdVaeTokenizer(config, params)


def read_tensors(path: Path) -> dict[str, Stored]:
    """name -> tensor, from a weight file or from the one in a directory. Raises ConfigError if there is none."""
    if path.is_dir():
        found = [path / name for name in FILES if (path / name).is_file()]
        require(bool(found), f"{path} has none of {', '.join(FILES)}")
        path = found[0]
    require(path.is_file(), f"no file or directory at {path}")
    if path.suffix == ".safetensors":
        return read_safetensors(path)
    return read_torch(path, within="state_dict")


def find_reader(path: Path) -> Callable[..., Tokenizer]:
    """`read_svd_vae` for a directory whose config.json describes that VAE, otherwise `read_magvit2`.

    Raises ConfigError for a directory with anything else.
    """
    path = Path(path)
    if not path.is_dir():
        return read_magvit2
    require(
        (path / CONFIG).is_file(),
        f"no {path / CONFIG}; of the MAGVIT2 tokenizer give the file itself, magvit2.ckpt, and of the VAE its directory, "
        f"with {CONFIG} and {FILES[0]}",
    )
    config = read_config(path)
    name = config.get("_class_name")
    if name == "AutoencoderKLTemporalDecoder":
        return read_svd_vae
    require(
        name is None and "ch_mult" in config,
        f"{path / CONFIG} describes {name or 'no tokenizer'}, which is not supported; supported are the "
        "AutoencoderKLTemporalDecoder of diffusers and the MAGVIT2 tokenizer (ch_mult, z_channels, ...)",
    )
    return read_magvit2
