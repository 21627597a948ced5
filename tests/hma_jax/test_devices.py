"""Peaks of known devices, per type."""

import jax
import pytest

from hma_jax.runtime import devices
from hma_jax.runtime.devices import default_device, find_peak, peak_flops


@pytest.mark.parametrize(
    ("kind", "bfloat16", "float32"),
    [
        ("NVIDIA H100 80GB HBM3", 989.4e12, 494.7e12),
        ("NVIDIA H100 PCIe", 756e12, 378e12),
        ("NVIDIA H100 NVL", 835.5e12, 417.5e12),
        ("NVIDIA H200", 989.4e12, 494.7e12),
        ("NVIDIA H200 NVL", 835.5e12, 417.5e12),
        ("NVIDIA A100-SXM4-80GB", 312e12, 156e12),
        ("TPU v5 lite", 197e12, 197e12),
        ("TPU v5", 459e12, 459e12),
        ("TPU v5e", 197e12, 197e12),
        ("TPU v6e", 918e12, 918e12),
    ],
)
def test_a_device_is_measured_by_its_own_data_sheet(kind: str, bfloat16: float, float32: float):
    assert (find_peak(kind).bfloat16, find_peak(kind).float32) == (bfloat16, float32)


@pytest.mark.parametrize("kind", ["cpu", "NVIDIA H100 80GB HBM3 MIG 1g.10gb", "NVIDIA L4"])
def test_no_peak_is_made_up(kind: str):
    assert find_peak(kind) is None


def test_the_peak_is_that_of_the_type_that_is_used(monkeypatch):
    class Fake:
        device_kind = "NVIDIA H100 PCIe"

    monkeypatch.setattr(devices.jax, "devices", lambda: [Fake(), Fake()])
    monkeypatch.setattr(devices.jax, "device_count", lambda: 2)
    assert peak_flops("bfloat16") == 2 * 756e12
    assert peak_flops("float32") == 2 * 378e12  # TF32, JAX's default
    assert peak_flops("uint8") is None
    with jax.default_matmul_precision("highest"):
        assert peak_flops("float32") == 2 * 51e12


def test_the_default_device_is_this_process_s_own():
    assert default_device() == jax.local_devices()[0]
    with jax.default_device(jax.local_devices()[-1]):
        assert default_device() == jax.local_devices()[-1]
    with jax.default_device("cpu"):
        assert default_device().platform == "cpu"
