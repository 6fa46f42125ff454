"""Scripts of `experiments/calibration`."""

import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from helpers import move_world, ring_rig
from scipy.spatial.transform import Rotation

from psotrack.geometry import Rig

FOLDER = Path(__file__).parents[1] / "experiments" / "calibration"


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


def test_common_motion_of_all_cameras_is_no_error_of_a_camera():
    """With `whole`, a common motion of all cameras is removed; the error of one displaced camera is kept."""
    errors = runpy.run_path(str(FOLDER / "adjusting.py"))["errors"]
    rig = ring_rig(5)
    as_a_whole = move_world(rig, Rotation.from_rotvec([1e-4, 2e-4, -1e-4]).as_matrix(), (1e-3, -2e-3, 1e-3))
    off_m, off_deg = errors(as_a_whole, rig, rig, whole=True)
    # The common motion is 2 mm and 0.014 degrees, and the linear alignment removes it.
    assert np.abs(off_m).max() < 1e-6
    assert np.abs(off_deg).max() < 1e-5
    off_m, off_deg = errors(as_a_whole, rig, rig, whole=False)
    assert np.linalg.norm(off_m, axis=1).min() > 1e-3
    T = rig.cameras.T_cam_world.copy()
    T[2, 0, 3] += 0.05
    displaced = Rig(rig.names, replace(rig.cameras, T_cam_world=T))
    off_m, _ = errors(rig, displaced, displaced, whole=False)
    np.testing.assert_allclose(np.linalg.norm(off_m, axis=1), [0, 0, 0.05, 0, 0], atol=1e-12)
    np.testing.assert_allclose(errors(rig, displaced, rig, whole=False)[0], 0, atol=1e-12)
