"""Result files of the experiments: how they are written, and made again.

    python experiments/_results.py list               # the results, when each was made, and the command that makes it
    python experiments/_results.py make [NAME ...]    # makes the results again (`make results`)

`results.toml` declares every result: its folder and its commands. An experiment writes its result with `Run.save`: rows
as NAME.csv, and NAME.json, the record, with commit, machine, date, versions, command, digests of the files, and figures
that are no rows. The pages in docs/ read these files when they are built. Records in `history` are of experiments that
exist no more.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Mapping, Sequence
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
#: Packages whose versions a record states, where they are installed.
PACKAGES = (
    "psotrack",
    "jax",
    "jaxlib",
    "numpy",
    "scipy",
    "pandas",
    "opencv-python-headless",
    "zarr",
    "ezc3d",
)
PACKAGES += ("stonesoup",)


@dataclass(frozen=True)
class Result:
    """One entry of the registry.

    Attributes:
        name: name of the entry; the record is `folder`/`name`.json.
        says: what the result shows, one line.
        folder: folder of the committed files, relative to the repository's root.
        commands: commands that make the result, in order, relative to the repository's root.
        minutes: time that the commands take on two cores, roughly, minutes.
    """

    name: str
    says: str
    folder: Path
    commands: tuple[str, ...]
    minutes: float

    @property
    def record(self) -> Path:
        """The committed record."""
        return ROOT / self.folder / f"{self.name}.json"


@cache
def registry() -> dict[str, Result]:
    """All declared results by name, in the order of the file."""
    declared = tomllib.loads(REGISTRY.read_text(encoding="utf-8"))
    return {
        name: Result(
            name,
            entry["says"],
            Path(entry["folder"]),
            tuple(entry["commands"]),
            entry["minutes"],
        )
        for name, entry in declared.items()
    }


class Run:
    """One run of an experiment; create it before the work begins, because the commit is read then.

    Args:
        name: name of the result in the registry.
    """

    def __init__(self, name: str) -> None:
        self._result = registry()[name]
        self._facts = {
            "result": name,
            "command": " ".join(["python", *_portable(sys.argv, self._result.commands)]),
            "commit": _git("rev-parse", "HEAD") or None,
            "dirty": [
                line[3:] for line in _git("status", "--porcelain", "--untracked-files=no").splitlines()
            ],
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
        }

    @property
    def name(self) -> str:
        """Name of the result."""
        return self._result.name

    @property
    def code_state(self) -> str:
        """Digest of commit and command: rows that were made in the same state need not be made again."""
        facts = json.dumps([self._facts[key] for key in ("commit", "dirty", "command")])
        return hashlib.sha256(facts.encode()).hexdigest()

    def copy(
        self,
        paths: Iterable[Path],
        folder: Path,
        *,
        figures: Mapping[str, Any] | None = None,
        files: Iterable[Path] = (),
    ) -> None:
        """Copy the files of a result into `folder`, and write the record beside them.

        Args:
            paths: files to copy.
            folder: folder of the result; made if it is missing.
            figures: figures that are no rows, fit for JSON.
            files: further files of the result, pictures for instance, which exist already and are not copied.
        """
        folder.mkdir(parents=True, exist_ok=True)
        copies = [Path(shutil.copy(path, folder)) for path in paths]
        self.save(folder, figures=figures, files=[*copies, *files])

    def save(
        self,
        folder: Path,
        *,
        rows: pd.DataFrame | None = None,
        figures: Mapping[str, Any] | None = None,
        files: Iterable[Path] = (),
        decimals: str = "%.6g",
    ) -> None:
        """Write rows to `folder`/NAME.csv, and the record to `folder`/NAME.json.

        Args:
            folder: folder of the result; made if it is missing.
            rows: rows of the result.
            figures: figures that are no rows, fit for JSON.
            files: further files of the result, pictures for instance, which exist already.
            decimals: format of floating-point numbers in the rows.
        """
        folder.mkdir(parents=True, exist_ok=True)
        written = [*files]
        if rows is not None:
            written.insert(0, folder / f"{self._result.name}.csv")
            rows.to_csv(written[0], index=False, float_format=decimals)
        record = self._facts | {
            "machine": machine(),
            "versions": versions(),
            "files": {_from(path, folder): digest(path) for path in written},
            "figures": dict(figures or {}),
        }
        path = folder / f"{self._result.name}.json"
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


def digest(path: Path) -> str:
    """SHA-256 of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def make(names: Sequence[str]) -> int:
    """Make these results again, one after the other; the exit code is 1 if a command failed."""
    failed = []
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    for result in _chosen(names):
        print(f"{result.name}: about {result.minutes:g} minutes on two cores", flush=True)
        missing = [name for name in _variables(result.commands) if not os.environ.get(name)]
        if missing:
            found = f"expected a value of {', '.join(missing)} in the environment, found none"
            print(f"{result.name}: {found}", file=sys.stderr)
            failed.append(result.name)
        for command in result.commands if not missing else ():
            print(f"$ {command}", flush=True)
            words = [os.path.expandvars(word) for word in shlex.split(command)]
            words[0] = sys.executable
            if subprocess.run(words, cwd=ROOT, env=environment, check=False).returncode:
                failed.append(result.name)
                break
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return int(bool(failed))


def _chosen(names: Sequence[str]) -> list[Result]:
    unknown = set(names) - set(registry())
    if unknown:
        sys.exit(
            f"results: expected names of results.toml ({', '.join(registry())}), found {', '.join(sorted(unknown))}"
        )
    return [result for name, result in registry().items() if not names or name in names]


def _portable(words: Sequence[str], commands: Iterable[str]) -> list[str]:
    """Words of a command, quoted, without paths of this machine.

    Paths below the repository's root are relative to the root, and a word that begins with the value of a variable of
    the declared commands begins with the variable's name.
    """
    values = {os.environ[name]: f"${name}" for name in _variables(commands) if os.environ.get(name)}
    quoted = []
    for word in words:
        value = next((value for value in values if word == value or word.startswith(f"{value}/")), None)
        if value is None:
            quoted.append(shlex.quote(word.removeprefix(f"{ROOT}/")))
        else:
            quoted.append(values[value] + shlex.quote(word[len(value) :]).removesuffix("''"))
    return quoted


def _variables(commands: Iterable[str]) -> list[str]:
    """Names of the environment variables in commands, such as $PSOTRACK_REAL_DATA."""
    return sorted({name for command in commands for name in re.findall(r"\$([A-Z_]+)", command)})


def _from(path: Path, folder: Path) -> str:
    """A path relative to a folder, with forward slashes."""
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


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
    parser.add_argument("names", nargs="*", metavar="NAME", help="results [default: all of results.toml]")
    options = parser.parse_args()
    if options.action == "make":
        sys.exit(make(options.names))
    for result in _chosen(options.names):
        made = "never"
        if result.record.exists():
            record = json.loads(result.record.read_text(encoding="utf-8"))
            made = f"{record['date'][:10]}, commit {record['commit'][:7]}"
        print(f"{result.name:20} {result.minutes:4g} min  {result.says}; made {made}")
        print("".join(f"{'':30}{command}\n" for command in result.commands), end="")


if __name__ == "__main__":
    main()
