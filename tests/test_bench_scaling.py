"""The benchmark of scaling, in small: it measures, fits, draws and writes its table and record."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "experiments" / "benchmarks" / "scaling.py"


def benchmark(*words: object) -> subprocess.CompletedProcess[str]:
    # Scripts find the package of this checkout first, as the tests do.
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, str(SCRIPT), *map(str, words)]
    return subprocess.run(
        command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": paths}, check=False
    )


@pytest.mark.slow
def test_in_small_it_measures_fits_draws_and_writes(tmp_path: Path) -> None:
    words = ("--small", "--axes", "cameras", "--repeats", 1)
    done = benchmark(*words, "--picture", tmp_path / "scaling.png", "--results", tmp_path)
    assert done.returncode == 0, done.stderr
    rows = pd.read_csv(tmp_path / "scaling.csv")
    assert rows["cameras"].tolist() == rows["value"].tolist() == [2, 3, 4]
    assert (rows[["front_end_ms", "track_ms", "finish_ms", "meeting_ms", "compile_s", "memory_gb"]] > 0).all(
        axis=None
    )
    # Images of 320 pixels, in which a pixel is 26 mm where the drones are, and both drones are there in all frames.
    assert (rows["mean_error_mm"] < 52).all()
    assert (rows["missed_rate"] == 0).all()
    record = json.loads((tmp_path / "scaling.json").read_text())
    fits = record["figures"]["exponents"]["cameras"]
    # The fit goes through the middle of the points: the exponents are those of the table.
    slope, _ = np.polyfit(np.log(rows["value"]), np.log(rows["front_end_ms"]), 1)
    assert fits["front end"]["exponent"] == pytest.approx(slope, rel=1e-4)
    assert all(fit["standard_error"] >= 0 for fit in fits.values())
    assert "front end  cameras ^" in done.stdout
    assert (tmp_path / "scaling.png").stat().st_size > 10_000


def test_the_help_has_examples() -> None:
    done = benchmark("--help")
    assert done.returncode == 0
    assert "python experiments/benchmarks/scaling.py --axes cameras drones" in done.stdout
