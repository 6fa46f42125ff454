"""Scripts of `experiments/calibration`."""

import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

FOLDER = Path(__file__).parents[2] / "experiments" / "calibration"


@pytest.mark.slow
def test_cameras_placed_by_twelve_points(tmp_path: Path) -> None:
    words = [sys.executable, FOLDER / "extrinsics.py", "--draws", "20", "--out", tmp_path]
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    table = pd.read_csv(tmp_path / "extrinsics.csv")
    # Errors are smaller if the points are spread wider in depth; 20 draws show a factor of two.
    assert table["median (mm)"].is_monotonic_increasing
    assert table["median (mm)"].between(2, 20).all()
    kept = pd.read_csv(FOLDER / "results" / "extrinsics.csv")
    assert list(kept.columns) == list(table.columns)
