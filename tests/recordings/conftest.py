"""A folder of sound recordings, which a test may change."""

import shutil

import cv2
import numpy as np
import pytest
from dpjait_folders import make_real, make_simulated, write_tum, write_video
from helpers import make_once

from psotrack.trajectories import Trajectories, write_trajectories


@pytest.fixture
def sound(tmp_path_factory, tmp_path):
    """A copy of a sequence of each half of the dataset, and of videos of any rig.

    The names of the sequences state other numbers of drones than they have.
    """

    def make(folder):
        make_simulated(folder / "S99_D9")
        make_real(folder / "R99_D9")
        any_rig = folder / "any"
        (any_rig / "pictures").mkdir(parents=True)
        for name in ("left", "right"):
            write_video(any_rig / f"{name}.avi", 6)
        (any_rig / "left.zip").write_bytes(b"PK")
        cv2.imwrite(str(any_rig / "ignore.png"), np.zeros((10, 10), np.uint8))
        time_s = np.arange(5.0)
        tracks = Trajectories(np.arange(5), time_s, ("drone",), np.ones((5, 1, 3)))
        write_trajectories(any_rig / "tracks.csv", tracks)
        write_tum(any_rig / "drone.tum", time_s, np.ones((5, 3)))
        for index in range(12):
            cv2.imwrite(str(any_rig / "pictures" / f"frame{index}.png"), np.zeros((48, 64), np.uint8))

    return shutil.copytree(make_once(tmp_path_factory, "sound_recordings", make), tmp_path / "in")
