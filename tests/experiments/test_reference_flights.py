"""Three small flights hold the version of tracking: their results are the stored ones, and a change is said."""

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import environment_without_jax_settings

ROOT = Path(__file__).parents[2]
PROGRAM = ROOT / "experiments" / "reference_flights.py"


@pytest.mark.slow
def test_the_results_have_not_changed():
    """The program has JAX's own settings, as its numbers were made, and its own compiled programs."""
    environment = environment_without_jax_settings()
    environment.pop("XLA_FLAGS", None)
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), environment.get("PYTHONPATH", "")])
    command = [sys.executable, PROGRAM, "--compiled", ROOT / ".compiled" / "reference-flights"]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr


def test_a_change_is_noticed_and_the_remedy_said(tmp_path, monkeypatch):
    """A number that is 0.3 % off, and numbers of another version."""
    # The program appends folders to the path of imports.
    monkeypatch.setattr(sys, "path", [str(PROGRAM.parent), *sys.path])
    program, numbers = importlib.import_module(PROGRAM.stem), tmp_path / "numbers.json"
    found = {"tracks": 2, "error (mm)": 1.5}
    monkeypatch.setattr(program, "FLIGHTS", {"short": lambda _: found})

    def run(*words):
        monkeypatch.setattr(sys, "argv", [PROGRAM.name, "--numbers", str(numbers), *words])
        program.main()

    run("--write")
    run()
    stored = json.loads(numbers.read_text())
    found["error (mm)"] *= 1.003
    remedy = "if meant, raise the version in results.toml, run `make reference-flights` and `make results`"
    line = "short: error (mm): expected 1.5, found 1.5045"
    with pytest.raises(
        SystemExit, match=f"^{re.escape(line)}\nreference flights: results changed; {remedy}$"
    ):
        run()
    numbers.write_text(json.dumps(stored | {"version": 0}))
    version = f"version of tracking: expected 0, found {stored['version']}"
    with pytest.raises(SystemExit, match=f"{version}\n.* results changed; run `make reference-flights`$"):
        run()
