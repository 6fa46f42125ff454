"""The small worlds of the tests: each is made once per test run, by the first worker that asks for it.

The files of a small flight: videos of three cameras that film two drones, rig, reference, tracks and a record.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers import ring_rig

from psotrack.geometry import project
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import VideoWriter
from psotrack.trajectories import Status, Trajectories, write_trajectories

RATE_HZ, NUM_FRAMES, IMAGE_SIZE_WH = 25.0, 14, (320, 240)
CAMERAS = ("c0", "c1", "c2")
#: Frames in which drone 1 is predicted, and from which on drone 0 is lost.
COASTING, LOST_FROM = slice(4, 6), 11
#: Names of the reference's drones.
REFERENCE = ("dron1", "dron2")


def make_tracks(error_m: float = 0.0) -> Trajectories:
    """Two drones that fly side by side, with covariances of 2 to 6 cm."""
    time_s = np.arange(NUM_FRAMES) / RATE_HZ
    position_m = np.zeros((NUM_FRAMES, 2, 3))
    position_m[..., 0] = [-0.6, 0.6]
    position_m[..., 1] = (time_s - time_s.mean())[:, None]
    position_m[..., 2] = 1.2 + error_m
    status = np.full((NUM_FRAMES, 2), int(Status.TRACKED))
    status[COASTING, 1] = Status.COASTING
    status[LOST_FROM:, 0] = Status.LOST
    return Trajectories(
        frame=np.arange(NUM_FRAMES),
        time_s=time_s,
        drones=("0", "1"),
        position_m=position_m,
        velocity_m_s=np.broadcast_to([0.0, 1.0, 0.0], position_m.shape).copy(),
        fitness=np.full((NUM_FRAMES, 2), 0.6),
        num_cameras=np.full((NUM_FRAMES, 2), 3),
        status=status,
        covariance_m2=np.broadcast_to(np.diag([4e-4, 16e-4, 36e-4]), (NUM_FRAMES, 2, 3, 3)).copy(),
    )


def make_sequence(folder: Path, repeat: int = 1) -> Path:
    """A recording.toml with videos of grey noise in which the drones are dark squares.

    Args:
        folder: folder of the files.
        repeat: how often the videos show the flight.
    """
    rig, truth = ring_rig(len(CAMERAS), image_size_wh=IMAGE_SIZE_WH), make_tracks()
    folder.mkdir(parents=True, exist_ok=True)
    write_rig(folder / "rig.toml", rig)
    random = np.random.default_rng(0)
    width, height = IMAGE_SIZE_WH
    for index, name in enumerate(rig.names):
        pixels, _ = project(rig.cameras[index], truth.position_m)
        with VideoWriter(folder / f"{name}.avi", RATE_HZ, IMAGE_SIZE_WH) as writer:
            for frame in [*range(NUM_FRAMES)] * repeat:
                image = random.integers(110, 140, (height, width, 3), np.uint8)
                for column, row in np.rint(pixels[frame]).astype(int):
                    image[max(row - 4, 0) : row + 5, max(column - 8, 0) : column + 9] = 20
                writer.write(image)
    reference = replace(
        truth, velocity_m_s=None, fitness=None, num_cameras=None, status=None, covariance_m2=None
    )
    for drone, name in enumerate(REFERENCE):
        own = replace(reference, drones=(name,), position_m=reference.position_m[:, [drone]])
        write_trajectories(folder / f"{name}.csv", own)
    cameras = "".join(f'[cameras.{name}]\nvideo = "{name}.avi"\n' for name in rig.names)
    files = ", ".join(f'"{name}.csv"' for name in REFERENCE)
    (folder / "recording.toml").write_text(
        f'version = 1\ncalibration = "rig.toml"\n{cameras}[reference]\nfiles = [{files}]\n', encoding="utf-8"
    )
    return folder


def make_tracks_file(path: Path, error_m: float = 0.01) -> Path:
    """A file of tracks that are off by `error_m` in height, and a record of the run beside it."""
    write_trajectories(path, make_tracks(error_m))
    drones = [{"drone": drone, "size_m": [0.3, 0.3, 0.15]} for drone in range(2)]
    path.with_suffix(".json").write_text(json.dumps({"rate_hz": RATE_HZ, "drones": drones}), encoding="utf-8")
    return path


def make_two_flights(folder: Path) -> None:
    """Fill a folder with the sequences `flight` and `second`, and `tracks.csv` of the first."""
    make_sequence(folder / "flight")
    make_sequence(folder / "second")
    make_tracks_file(folder / "tracks.csv")
