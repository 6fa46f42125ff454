"""Compile cache on disk: JAX compiles each program once per machine instead of once per process."""

from __future__ import annotations

import logging
import re
import warnings
from pathlib import Path
from typing import Any

import jax

logger = logging.getLogger(__name__)

#: Shortest compile time of a program that is stored, seconds. Reading a smaller program back takes as long.
WORTH_KEEPING_S = 0.3
_UNREADABLE_ENTRY = re.compile(r"persistent compilation cache entry for '([\w.]+)'")


def keep_compiled(folder: Path | str) -> None:
    """Let JAX store compiled programs in a folder, and load programs that other processes stored there.

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
        unreadable = _UNREADABLE_ENTRY.search(str(message))
        if unreadable is None:
            show(message, *where, **more)
            return
        logger.info("%s: %s", folder, message)
        # JAX never replaces an entry, so an entry that a full disk cut short would fail in every later run.
        for entry in folder.glob(f"{unreadable[1]}-*-cache"):
            entry.unlink(missing_ok=True)

    warnings.showwarning = show_or_repair
