"""Scripts of `experiments/calibration`."""

import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from helpers import move_world, ring_rig
from scipy.spatial.transform import Rotation

from psotrack.geometry import Rig

FOLDER = Path(__file__).parents[1] / "experiments" / "calibration"


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


def test_common_motion_of_all_cameras_is_no_error_of_the_rigs_shape():
    """The common motion is removed; most of the error of one displaced camera is kept."""
    shape_errors = runpy.run_path(str(FOLDER / "adjusting.py"))["shape_errors"]
    rig = ring_rig(5)
    as_a_whole = move_world(rig, Rotation.from_rotvec([1e-4, 2e-4, -1e-4]).as_matrix(), (1e-3, -2e-3, 1e-3))
    # The common motion is 2 mm and 0.014 degrees, and the linear alignment removes it.
    assert np.abs(shape_errors(as_a_whole, rig, rig)).max() < 1e-6
    T = rig.cameras.T_cam_world.copy()
    T[2, 0, 3] += 0.05
    displaced = Rig(rig.names, replace(rig.cameras, T_cam_world=T))
    off_m = np.linalg.norm(shape_errors(rig, rig, displaced), axis=1)
    assert off_m.argmax() == 2
    assert 0.02 < off_m[2] < 0.05
    assert off_m[[0, 1, 3, 4]].max() < 0.02
    # The other cameras moved with the world, by the same common motion: only differences of shape count.
    moved = move_world(displaced, np.eye(3), (0.1, 0.2, -0.1))
    np.testing.assert_allclose(np.linalg.norm(shape_errors(rig, rig, moved), axis=1), off_m, atol=1e-6)


def test_places_are_compared_in_the_world():
    """A rig that is shifted as a whole puts every body off by the shift."""
    place_errors = runpy.run_path(str(FOLDER / "adjusting.py"))["place_errors"]
    rig, shift_m = ring_rig(4), np.array([0.01, -0.02, 0.03])
    place_m = np.random.default_rng(0).uniform((-1, -1, 0.8), (1, 1, 1.6), (20, 1, 3))
    off_m = place_errors(rig, move_world(rig, np.eye(3), shift_m), place_m)
    seen = np.isfinite(off_m).all(axis=-1)
    assert seen.sum() > 10
    expected = np.broadcast_to(shift_m, off_m[seen].shape)
    sign = np.sign(off_m[seen][0, 0] / shift_m[0])
    np.testing.assert_allclose(off_m[seen], sign * expected, atol=1e-9)
