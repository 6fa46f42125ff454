"""Choice of the devices on which JAX computes."""

from __future__ import annotations

import contextlib
import os
from typing import Literal

from psotrack.errors import SettingsError, install_command

Device = Literal["cpu", "gpu"]
_GPU_NEEDS = f"a GPU needs NVIDIA's driver and {install_command('cuda')}"


def use_device(device: Device) -> None:
    """Make JAX compute on a device. Call it before JAX uses any device.

    Raises:
        SettingsError: JAX does not find the device, or already uses another device.
    """
    import jax

    jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[device])
    remedy = _GPU_NEEDS if device == "gpu" else ""
    found = _backend("--device", f"a {device}", remedy)
    if found != device:
        raise SettingsError(
            "--device", expected=f"a {device}", found=f"{found} in use already", remedy=remedy
        )


def check_devices() -> None:
    """Raise `SettingsError` if JAX does not find the devices that the user chose for all of its programs."""
    _backend("JAX_PLATFORMS", "devices that JAX finds", f"{_GPU_NEEDS}; cpu is always there")


def _backend(where: str, expected: str, remedy: str) -> str:
    """Kind of the devices on which JAX computes."""
    import jax

    try:
        return jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        # JAX raises AssertionError if it is installed without support for the device.
        why = str(error).partition("\n")[0] or "no device that JAX can use"
        raise SettingsError(where, expected=expected, found=why, remedy=remedy) from error


def share_processors(count: int | None = None) -> None:
    """Make JAX treat processors as separate devices, which share the runs of a batch. Call it before JAX uses a device.

    Nothing changes if the user has set XLA_FLAGS, or if JAX already uses a device.

    Args:
        count: number of devices; None is one per processor that this process may use.
    """
    import jax

    if "XLA_FLAGS" not in os.environ:
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", count or processors())


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
