"""The origin of results: code, device, processor, versions and commit."""

from __future__ import annotations

import platform
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

from psotrack.pipeline import environment
from psotrack.support import digest_record, processors

_PACKAGE = Path(__file__).parents[1]
#: Rooms and modules that compute no part of a row, by the beginnings of their paths in the package.
COMPUTES_NO_ROW = (
    *("__main__", "api", "cli/", "demo", "inside_out/", "live/", "show/", "simulation/"),
    *(f"sweeps/{name}" for name in ("cluster", "grid_files", "grid_runs", "locks", "tables")),
)


@cache
def code_digest() -> str:
    """Digest of the source of everything that computes a row of results.

    A change of one of these files changes the key of every cell, so that its rows are computed again.
    """
    files = {path.relative_to(_PACKAGE).as_posix(): path for path in _PACKAGE.rglob("*.py")}
    kept = {name: path for name, path in files.items() if not name.startswith(COMPUTES_NO_ROW)}
    return digest_record({name: path.read_text(encoding="utf-8") for name, path in kept.items()})


def provenance() -> dict[str, Any]:
    """Versions, device, code and commit, as nested tables for JSON."""
    this = environment()
    device = this["device"] | {"processor": _processor(), "processors": processors()}
    return {"versions": this["versions"], "device": device, "code": code_digest(), "commit": commit()}


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
    command = ["git", "--no-optional-locks", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout.strip()


@cache
def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()
