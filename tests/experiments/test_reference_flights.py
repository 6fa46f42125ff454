"""Three small flights hold the version of tracking: their results are the stored ones, and a change is said."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import environment_without_jax_settings

ROOT = Path(__file__).parents[2]
STORED = ROOT / "experiments" / "reference_flights.json"


def reference_flights(*words: object) -> subprocess.CompletedProcess[str]:
    """Run the program with JAX's own settings, as its numbers were made, and with its own compiled programs."""
    command = [sys.executable, ROOT / "experiments" / "reference_flights.py", *words]
    environment = environment_without_jax_settings()
    environment.pop("XLA_FLAGS", None)
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), environment.get("PYTHONPATH", "")])
    compiled = ("--compiled", ROOT / ".compiled" / "reference-flights")
    return subprocess.run(
        [*map(str, command), *map(str, compiled)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )


@pytest.mark.slow
def test_the_results_have_not_changed() -> None:
    done = reference_flights()
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_change_is_noticed_and_the_remedy_said(tmp_path: Path) -> None:
    """A number that is 0.3 % off, and numbers of another version."""
    stored, numbers = json.loads(STORED.read_text()), tmp_path / "numbers.json"
    before = stored["flights"]["inside out"]["filter: mean error (mm)"]
    stored["flights"]["inside out"]["filter: mean error (mm)"] *= 1.003
    numbers.write_text(json.dumps(stored))
    changed = reference_flights("--numbers", numbers, "--flights", "inside out")
    assert changed.returncode == 1
    one, last = changed.stderr.splitlines()
    assert one == f"inside out: filter: mean error (mm): expected {1.003 * before:g}, found {before:g}"
    assert last.startswith(
        "reference flights: results changed; if meant, raise the version in results.toml, "
    )
    assert last.endswith("run `make reference-flights` and `make results`")
    numbers.write_text(json.dumps({"version": 0, "flights": stored["flights"]}))
    other = reference_flights("--numbers", numbers, "--flights", "inside out")
    assert f"version of tracking: expected 0, found {stored['version']}" in other.stderr
    written = reference_flights("--numbers", numbers, "--flights", "inside out", "--write")
    assert (written.returncode, written.stderr) == (0, "")
    assert json.loads(numbers.read_text())["version"] == stored["version"]
    assert reference_flights("--numbers", numbers, "--flights", "inside out").returncode == 0
