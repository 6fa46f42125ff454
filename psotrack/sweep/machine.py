"""The origin of results: device, processor, versions and commit."""

from __future__ import annotations

import platform
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

from psotrack.pipeline import environment
from psotrack.support import processors

_PACKAGE = Path(__file__).parents[1]


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
