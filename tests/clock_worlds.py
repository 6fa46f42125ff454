"""Drones whose motion is known at any time, as a reference and as tracks with another clock, and files of both."""

import numpy as np
from helpers import make_unnamed_rig

from psotrack.geometry import look_at, make_camera
from psotrack.geometry.rig_files import write_calibration
from psotrack.recordings import VideoWriter
from psotrack.recordings.datasets import CALIBRATION
from psotrack.recordings.mocap import Markers, write_c3d
from psotrack.trajectories import Trajectories, write_trajectories

FPS = 25.0
#: Seconds by which the .c3d file of `make_late_videos` begins before its videos.
LATE_S = 0.4321


def random_motion(number=0, speed_m_s=1.0):
    """A function of times (...,) that returns positions (..., 3); the motion never repeats and has about this speed."""
    rng = np.random.default_rng(number)
    rate, phase = rng.uniform(0.4, 1.6, (4, 3)), rng.uniform(0, 2 * np.pi, (4, 3))
    size_m = speed_m_s / np.sqrt(6) / rate

    def position_m(time_s):
        angle = rate * np.asarray(time_s)[..., None, None] + phase
        return (size_m * np.sin(angle)).sum(axis=-2) + np.array([3.0 * number, 0, 1.5])

    return position_m


def simulate_estimate(*paths, seconds=12.0, start_s=3.0, offset_s=0.0, noise_m=0.0, fps=FPS, seed=0):
    """Tracks of drones whose true positions are `path(t)` by the reference's clock.

    The reference's clock is `offset_s` ahead of the clock of the tracks.
    """
    time_s = start_s - offset_s + np.arange(int(seconds * fps)) / fps
    position_m = np.stack([path(time_s + offset_s) for path in paths], axis=1)
    position_m = position_m + np.random.default_rng(seed).normal(0, noise_m, position_m.shape)
    return Trajectories(np.arange(len(time_s)), time_s, tuple(map(str, range(len(paths)))), position_m)


def simulate_reference(*paths, rate_hz=100.0, seconds=18.0):
    """Times and true positions (times, drones, 3)."""
    time_s = np.arange(int(seconds * rate_hz)) / rate_hz
    return time_s, np.stack([path(time_s) for path in paths], axis=1)


def make_late_videos(root):
    """A real sequence with black videos, a .c3d file of 100 Hz that begins earlier, and `tracks.csv`."""
    folder = root / "Real_Data" / "R12_D2"
    folder.mkdir(parents=True)
    R, t_m = look_at((0.0, -6.0, 2.0), (0.0, 0.0, 1.5))
    K = np.diag([1100.0, 1100.0, 1.0])
    one = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(64, 48), dist=(0.0, 0.0, 0.0, 0.0))
    write_calibration(folder / CALIBRATION, make_unnamed_rig(one), "mm")
    with VideoWriter(folder / "0.avi", FPS, (64, 48)) as writer:
        for _ in range(150):
            writer.write(np.zeros((48, 64, 3), np.uint8))
    paths = random_motion(0), random_motion(1)
    time_s, position_m = simulate_reference(*paths, seconds=8)
    cross_m = np.array([[0.1, 0, 0], [0, 0.13, 0], [-0.16, 0, 0], [0, -0.19, 0]])
    cross_m -= cross_m.mean(axis=0)
    labels = tuple(f"Dron{drone}:Dron{drone}{marker}" for drone in (1, 2) for marker in (1, 2, 3, 4))
    markers_m = (position_m[:, :, None] + cross_m).reshape(len(time_s), 8, 3)
    write_c3d(folder / "R12_D2.c3d", Markers(labels, markers_m, 100.0))
    estimate = simulate_estimate(*paths, seconds=6, start_s=LATE_S, offset_s=LATE_S, noise_m=0.01)
    write_trajectories(root / "tracks.csv", estimate)
    return root
