"""Choice of the device, and the origin of results: device, processor, versions and commit."""

from __future__ import annotations

import contextlib
import os
import platform
import subprocess
from functools import cache
from pathlib import Path
from typing import Any, Literal

from psotrack.errors import SettingsError
from psotrack.pipeline import environment

Device = Literal["cpu", "gpu"]

_PACKAGE = Path(__file__).parents[1]


def use_device(device: Device) -> None:
    """Make JAX compute on a device. Call it before JAX uses any device.

    Raises:
        SettingsError: JAX does not find the device, or already uses another device.
    """
    import jax

    jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[device])
    remedy = "a GPU needs NVIDIA's driver and `pip install 'psotrack[cuda]'`" if device == "gpu" else ""
    try:
        found = jax.default_backend()
    except (RuntimeError, AssertionError) as error:
        # JAX raises AssertionError if it is installed without support for the device.
        why = str(error).partition("\n")[0] or "no device that JAX can use"
        raise SettingsError("--device", expected=f"a {device}", found=why, remedy=remedy) from error
    if found != device:
        raise SettingsError(
            "--device", expected=f"a {device}", found=f"{found} in use already", remedy=remedy
        )


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


def provenance() -> dict[str, Any]:
    """Versions, device and commit, as nested tables for JSON."""
    this = environment()
    device = this["device"] | {"processor": _processor(), "processors": processors()}
    return {"versions": this["versions"], "device": device, "commit": commit()}


@cache
def commit(package: Path = _PACKAGE) -> str:
    """Commit of the package, with "-dirty" after changes; "" if the package is not in a git checkout of its own."""
    try:
        # An installed package may be inside the checkout of another project, whose commit says nothing.
        _git(package, "ls-files", "--error-unmatch", "__init__.py")
        return _git(package, "describe", "--always", "--dirty", "--exclude=*", "--abbrev=12")
    except (OSError, subprocess.CalledProcessError):
        return ""


def _git(folder: Path, *words: str) -> str:
    return subprocess.run(
        ["git", "--no-optional-locks", *words], cwd=folder, capture_output=True, text=True, check=True
    ).stdout.strip()


@cache
def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()
