"""The commands behind the figures on calibration."""

import subprocess
import sys
from pathlib import Path

import pandas as pd

FOLDER = Path(__file__).parents[1] / "experiments" / "calibration"


def test_cameras_placed_by_twelve_points(tmp_path: Path) -> None:
    words = [sys.executable, FOLDER / "extrinsics.py", "--draws", "20", "--out", tmp_path]
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    table = pd.read_csv(tmp_path / "extrinsics.csv")
    # The wider the points are spread in depth the better; 20 draws tell a factor of two.
    assert table["median (mm)"].is_monotonic_increasing
    assert table["median (mm)"].between(2, 20).all()
    kept = pd.read_csv(FOLDER / "results" / "extrinsics.csv")
    assert list(kept.columns) == list(table.columns)
