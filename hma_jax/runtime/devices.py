"""Devices: which one a process uses by default, and the peak speed of known ones."""

from __future__ import annotations

from dataclasses import dataclass

import jax

FULL_PRECISION = ("highest", "float32")
"""Values of `jax_default_matmul_precision` under which products of float32 are computed wholly in float32."""


@dataclass(frozen=True)
class Peak:
    """FLOP/s of matrix products, by the type of the factors.

    `float32` is for JAX's default precision: TF32 on tensor cores, one pass in bfloat16 on a TPU. `full_float32` is for
    `jax_default_matmul_precision` "highest": the ordinary cores of a GPU, six passes on a TPU.
    """

    bfloat16: float
    float32: float
    full_float32: float


def _tpu(bfloat16: float) -> Peak:
    return Peak(bfloat16, bfloat16, bfloat16 / 6)


_HOPPER_SXM = Peak(989.4e12, 494.7e12, 66.9e12)
_HOPPER_NVL = Peak(835.5e12, 417.5e12, 60e12)
_HOPPER_PCIE = Peak(756e12, 378e12, 51e12)

PEAKS = {
    "NVIDIA H100 80GB HBM3": _HOPPER_SXM,
    "NVIDIA H100 PCIe": _HOPPER_PCIE,
    "NVIDIA H100 NVL": _HOPPER_NVL,
    "NVIDIA H200": _HOPPER_SXM,
    "NVIDIA H200 NVL": _HOPPER_NVL,
    "NVIDIA A100": Peak(312e12, 156e12, 19.5e12),
    "TPU v4": _tpu(275e12),
    "TPU v5 lite": _tpu(197e12),
    "TPU v5e": _tpu(197e12),
    "TPU v5": _tpu(459e12),  # JAX's name for a v5p
    "TPU v5p": _tpu(459e12),
    "TPU v6 lite": _tpu(918e12),
    "TPU v6e": _tpu(918e12),
}
"""From the makers' data sheets, without sparsity, by the beginning of JAX's device kind; the longest that matches
counts."""


def find_peak(kind: str) -> Peak | None:
    """Peak of one device; None where it is not known: for CPUs, slices of a GPU (MIG), and variants that are not in the
    table."""
    fitting = [prefix for prefix in PEAKS if kind.startswith(prefix) and "MIG" not in kind]
    return PEAKS[max(fitting, key=len)] if fitting else None


def peak_flops(dtype: str) -> float | None:
    """Peak FLOP/s of all this program's devices together, for products of `dtype`; None where it is not known."""
    peak = find_peak(jax.devices()[0].device_kind)
    if peak is None or dtype not in ("bfloat16", "float32"):
        return None
    if dtype == "float32" and jax.config.jax_default_matmul_precision in FULL_PRECISION:
        return peak.full_float32 * jax.device_count()
    return getattr(peak, dtype) * jax.device_count()


def default_device() -> jax.Device:
    """Where this process puts arrays unless told otherwise; never another process's device."""
    chosen = jax.config.jax_default_device
    return chosen if isinstance(chosen, jax.Device) else jax.local_devices(backend=chosen)[0]
