"""JAX: the devices on which it computes, and its compiled programs.

Compiled programs have the settings that they are written for, a cache on disk, and a bound on those in memory. The time
that JAX takes to compile is measured, because figures of speed count it apart from the work.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import jax

from psotrack.errors import SettingsError, install_command

Device = Literal["cpu", "gpu"]
_GPU_NEEDS = f"a GPU needs NVIDIA's driver and {install_command('cuda')}"


def use_device(device: Device) -> None:
    """Make JAX compute on a device. Call it before JAX uses any device.

    Raises:
        SettingsError: JAX does not find the device, or already uses another device.
    """
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
    if "XLA_FLAGS" not in os.environ:
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", count or processors())


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


logger = logging.getLogger(__name__)

#: Shortest compile time of a program that is stored, seconds. Reading a smaller program back takes as long.
WORTH_KEEPING_S = 0.3
#: Fraction of the memory maps that Linux allows a process, above which programs are dropped.
_MOST_MAPS = 0.5
_MAPS = Path("/proc/self/maps")
_MAP_LIMIT = Path("/proc/sys/vm/max_map_count")
#: JAX's warning about an entry of the cache that it cannot read or write.
_FAILED = re.compile(r"Error (reading|writing) persistent compilation cache entry for '([\w.]+)'")
#: Beginning of JAX's names of the events of tracing, lowering, compiling, and loading compiled programs.
_COMPILING = "/jax/core/compile/"


@contextlib.contextmanager
def as_written(*, float64: bool = False) -> Iterator[None]:
    """Within this block or function, and in this thread, JAX has the settings that the package is written for.

    Users choose others for programs of their own, by variables such as `JAX_ENABLE_X64`. The package's compiled
    programs state their types, use NaN and infinity for what is not known, and broadcast on purpose.

    Args:
        float64: whether the programs compute in float64, instead of float32.

    Raises:
        SettingsError: JAX does not find the devices that `JAX_PLATFORMS` asks for.
    """
    check_devices()
    with (
        jax.enable_x64(float64),
        jax.debug_nans(False),
        jax.debug_infs(False),
        jax.numpy_rank_promotion("allow"),
        jax.disable_jit(False),
    ):
        yield


def keep_compiled(folder: Path | str) -> None:
    """Let JAX store compiled programs in a folder, and load programs that other processes stored there.

    The folder's files are run, so nobody else may be allowed to write to it.

    For programs, not for libraries: the function changes JAX, and the display of warnings, for the whole process. It
    changes nothing if the user has already chosen a folder (`JAX_COMPILATION_CACHE_DIR`).

    Args:
        folder: created when the first program is stored. If the folder cannot be used, JAX compiles as without a
            cache, and the log says so.
    """
    folder = Path(folder)
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", WORTH_KEEPING_S)
    show = warnings.showwarning

    def show_or_repair(message: Warning | str, *where: Any, **more: Any) -> None:
        failed = _FAILED.search(str(message))
        if failed is None:
            show(message, *where, **more)
            return
        logger.info("%s: %s", folder, message)
        # JAX never replaces an entry, so an entry that a full disk cut short would fail in every later run.
        for entry in folder.glob(f"{failed[2]}-*-cache"):
            entry.unlink(missing_ok=True)
            if failed[1] == "reading":
                logger.warning("%s: damaged entry %s; the program is compiled again", folder, failed[2])

    warnings.showwarning = show_or_repair


def drop_programs_if_many(most_maps: int | None = None) -> bool:
    """Drop all compiled programs from memory, if the process has many memory maps.

    Each program keeps some dozens of maps, and Linux allows 65,530 per process: without this, a process that works on
    dozens of shapes ends with "Cannot allocate memory". Programs that are used again are read from the cache on disk
    (`keep_compiled`), or compiled again.

    Args:
        most_maps: largest number of maps for which nothing is dropped; None is half of what the system allows.

    Returns:
        Whether programs were dropped; never on systems without such a limit.
    """
    try:
        limit = _MOST_MAPS * int(_MAP_LIMIT.read_text()) if most_maps is None else most_maps
        maps = _MAPS.read_bytes().count(b"\n")
    except (OSError, ValueError):
        return False
    if maps <= limit:
        return False
    jax.clear_caches()
    # Programs are freed with the functions that refer to each other.
    gc.collect()
    logger.info("dropped compiled programs from memory, because the process had %d memory maps", maps)
    return True


@contextlib.contextmanager
def measured_compiling() -> Iterator[Callable[[], float]]:
    """Measure compiling in all threads; yields a function that returns the seconds so far.

    These are seconds of wall clock in which at least one thread compiled. Use it as in
    `with measured_compiling() as compile_s: ...; print(compile_s())`.
    """
    spans: list[tuple[float, float]] = []

    def note(event: str, start_time: float, end_time: float, **_: Any) -> None:
        if event.startswith(_COMPILING):
            spans.append((start_time, end_time))

    jax.monitoring.register_event_time_span_listener(note)
    try:
        yield lambda: _covered_s(spans)
    finally:
        jax.monitoring.unregister_event_time_span_listener(note)


def _covered_s(spans: list[tuple[float, float]]) -> float:
    """Length of the union of spans of time, seconds."""
    covered_s, until_s = 0.0, float("-inf")
    for start_s, end_s in sorted(spans):
        covered_s += max(0.0, end_s - max(start_s, until_s))
        until_s = max(until_s, end_s)
    return covered_s
