"""Compiled programs, kept on disk: the compiler's seconds are paid once per machine and program, not by every run."""

from __future__ import annotations

import logging
import re
import warnings
from pathlib import Path
from typing import Any

import jax

logger = logging.getLogger(__name__)

#: What compiles in less is compiled again: reading it back would take as long.
WORTH_KEEPING_S = 0.3
_TROUBLE = re.compile(r"persistent compilation cache entry for '([\w.]+)'")


def keep_compiled(folder: Path) -> None:
    """Have JAX keep what this process compiles from now on, and find what others compiled.

    For programs, not for libraries: it changes JAX and how warnings are shown for the whole process. Nothing changes
    where a user has already told JAX to keep it elsewhere (`JAX_COMPILATION_CACHE_DIR`).

    Args:
        folder: made when something is kept. Trouble with it costs the compiler's seconds, and a line in the log.
    """
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", WORTH_KEEPING_S)
    show = warnings.showwarning

    def tidied(message: Warning | str, *where: Any, **more: Any) -> None:
        trouble = _TROUBLE.search(str(message))
        if trouble is None:
            show(message, *where, **more)
            return
        logger.info("%s: %s", folder, message)
        # JAX never replaces an entry, and one that a full disk or a kill cut off would be in the way for ever.
        for entry in folder.glob(f"{trouble[1]}-*-cache"):
            entry.unlink(missing_ok=True)

    warnings.showwarning = tidied
