"""Headline figures: how they are written, made again, and checked.

    python experiments/_results.py list               # the figures, when each was made, and the command that makes it
    python experiments/_results.py make [NAME ...]    # makes figures again (`make results`)

`results.toml` declares every figure and its command. An experiment writes its figure with `Run.save`: rows as
results/NAME.csv, and results/NAME.json, the record, with commit, machine, date, version of tracking, and figures that
are no rows. The pages in docs/ read these files when they are built. `history` has dated figures that nobody makes
again.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

ROOT = Path(__file__).resolve().parents[1]
REGISTRY = Path(__file__).with_name("results.toml")
#: Folder of the rows and records.
FOLDER = Path(__file__).parent / "results"
#: Packages whose versions a record states, where they are installed.
PACKAGES = ("psotrack", "jax", "numpy", "scipy", "pandas", "opencv-python-headless", "stonesoup")


@dataclass(frozen=True)
class Figure:
    """One figure of the registry.

    Attributes:
        name: name of the figure; its record is results/`name`.json.
        says: what it shows, one line.
        command: the command that makes it, from the repository's root.
        minutes: time that the command takes on two cores, roughly.
    """

    name: str
    says: str
    command: str
    minutes: float

    @property
    def record(self) -> Path:
        """The committed record."""
        return FOLDER / f"{self.name}.json"

    @property
    def variables(self) -> list[str]:
        """Names of the environment variables in the command, such as PSOTRACK_REAL_DATA."""
        return re.findall(r"\$([A-Z_]+)", self.command)

    @property
    def unset(self) -> list[str]:
        """Variables of the command that have no value: the figure cannot be made here."""
        return [name for name in self.variables if not os.environ.get(name)]


@cache
def registry() -> dict[str, Figure]:
    """All declared figures by name, in the order of the file."""
    declared = tomllib.loads(REGISTRY.read_text(encoding="utf-8"))["figures"]
    return {name: Figure(name, **entry) for name, entry in declared.items()}


def tracking_version() -> int:
    """The version of tracking, which is raised by hand when results may change."""
    return int(tomllib.loads(REGISTRY.read_text(encoding="utf-8"))["version"])


class Run:
    """One run of an experiment; create it before the work begins, because the commit is read then.

    Args:
        name: name of the figure, or of a study that no page shows.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.facts = {
            "figure": name,
            "command": " ".join(["python", *_portable(sys.argv)]),
            "tracking": tracking_version(),
            "commit": _git("rev-parse", "HEAD") or None,
            "dirty": _changed_files(),
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
        }

    def save(
        self, folder: Path, *, rows: pd.DataFrame | None = None, figures: Mapping[str, Any] | None = None
    ) -> None:
        """Write rows to `folder`/NAME.csv, and the record to `folder`/NAME.json.

        Args:
            folder: folder of the files; made if it is missing.
            rows: rows of the figure.
            figures: figures that are no rows, fit for JSON.
        """
        folder.mkdir(parents=True, exist_ok=True)
        if rows is not None:
            rows.to_csv(folder / f"{self.name}.csv", index=False, float_format="%.6g")
        record = self.facts | {"machine": machine(), "versions": versions(), "figures": dict(figures or {})}
        path = folder / f"{self.name}.json"
        temporary = path.with_suffix(".json.part")
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        temporary.replace(path)


def machine() -> dict[str, Any]:
    """Processor, number of usable processors, system, and the device that JAX computes on, if JAX is loaded."""
    jax = sys.modules.get("jax")
    device = jax.devices()[0] if jax is not None else None
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "processor": _processor(),
        "processors": usable,
        "system": f"{platform.system()} {platform.machine()}",
        "device": None if device is None else f"{device.platform} ({device.device_kind})",
        "load_average": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
    }


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that are installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def outdated() -> list[str]:
    """One line for each figure that is not of today's version of tracking, unless it cannot be made here."""
    today, lines = tracking_version(), []
    for figure in registry().values():
        if not figure.record.exists():
            found = "no record"
        else:
            record = json.loads(figure.record.read_text(encoding="utf-8"))
            if record["tracking"] == today or figure.unset:
                continue
            found = f"version {record['tracking']} ({record['date'][:10]})"
        lines.append(
            f"figure {figure.name}: expected version {today} of tracking, found {found}; "
            f"run `make results ONLY={figure.name}`, about {figure.minutes:g} minutes"
        )
    return lines


def make(names: Sequence[str]) -> int:
    """Make these figures again, one after the other; the exit code is 1 if a command failed."""
    failed = []
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    for figure in _chosen(names):
        print(f"{figure.name}: about {figure.minutes:g} minutes on two cores", flush=True)
        if figure.unset:
            expected = f"expected a value of {', '.join(figure.unset)} in the environment"
            print(f"{figure.name}: {expected}, found none: the stored figure stays", file=sys.stderr)
            if names:
                failed.append(figure.name)
            continue
        print(f"$ {figure.command}", flush=True)
        words = [os.path.expandvars(word) for word in shlex.split(figure.command)]
        words[0] = sys.executable
        if subprocess.run(words, cwd=ROOT, env=environment, check=False).returncode:
            failed.append(figure.name)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return int(bool(failed))


def _chosen(names: Sequence[str]) -> list[Figure]:
    unknown = set(names) - set(registry())
    if unknown:
        sys.exit(
            f"results: expected names of results.toml ({', '.join(registry())}), found {', '.join(sorted(unknown))}"
        )
    return [figure for name, figure in registry().items() if not names or name in names]


def _portable(words: Sequence[str]) -> list[str]:
    """Words of a command, quoted, without paths of this machine.

    Paths below the repository's root are relative to the root, and a word that begins with the value of an environment
    variable of a declared command begins with the variable's name.
    """
    names = {name for figure in registry().values() for name in figure.variables}
    values = {os.environ[name]: f"${name}" for name in names if os.environ.get(name)}
    quoted = []
    for word in words:
        value = next((value for value in values if word == value or word.startswith(f"{value}/")), None)
        if value is None:
            quoted.append(shlex.quote(word.removeprefix(f"{ROOT}/")))
        else:
            quoted.append(values[value] + shlex.quote(word[len(value) :]).removesuffix("''"))
    return quoted


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


def _changed_files() -> list[str]:
    """Files with local changes, without the figures: `make results` writes one after the other."""
    figures_left_out = f":!{FOLDER.relative_to(ROOT)}"
    status = _git("status", "--porcelain", "--untracked-files=no", "--", ".", figures_left_out)
    return [line[3:] for line in status.splitlines()]


def _git(*words: str) -> str:
    """Output of a Git command; empty where the command fails or Git is missing."""
    try:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.rstrip("\n")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("action", choices=["list", "make"])
    parser.add_argument("names", nargs="*", metavar="NAME", help="figures [default: all of results.toml]")
    options = parser.parse_args()
    if options.action == "make":
        sys.exit(make(options.names))
    for figure in _chosen(options.names):
        made = "never"
        if figure.record.exists():
            record = json.loads(figure.record.read_text(encoding="utf-8"))
            made = f"{record['date'][:10]}, commit {record['commit'][:7]}, version {record['tracking']} of tracking"
        print(
            f"{figure.name:14} {figure.minutes:4g} min  {figure.says}; made {made}\n{'':24}{figure.command}"
        )


if __name__ == "__main__":
    main()
