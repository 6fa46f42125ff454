"""A drone before two thermal cameras, with false alarms: a flight of christofhapp/batflight3D_publication.

The authors publish raw detections of both cameras, the pixels of the drone and its GPS track, but no poses. The poses
are estimated here from the pixels and the track; the epipolar geometry comes from the pixels alone, because GPS errs by
metres.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from formula_flights import Flight
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from psotrack.geometry import make_camera, make_rig
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import Detections, write_detections
from psotrack.trajectories import Trajectories

REPOSITORY = Path("christofhapp/batflight3D_publication")
IMAGE_SIZE_WH = (640, 480)
K = np.array([[1176.0, 0, 320], [0, 1176.0, 240], [0, 0, 1]])
#: Standard deviations of the GPS positions' projections and of the drone's pixels, pixels.
GPS_PX, PIXEL_PX = 5.0, 1.0


def read_flight(data: Path, name: str, first: int, num_frames: int) -> Flight:
    """Read a part of a flight.

    Args:
        data: folder of the repositories, as OWNER/NAME.
        name: name of the flight.
        first: first frame.
        num_frames: number of frames.
    """
    folder = data / REPOSITORY / "data" / name
    points = pd.read_csv(folder / "DRONE_SIM_PTS.csv").drop_duplicates("nr")
    times = pd.to_datetime(pd.read_csv(folder / "imagelist.csv").datetime, format="mixed")
    fps = 1 / times.diff().dt.total_seconds().median()
    place_m = _east_north_up(points[["lat", "lon", "height"]].to_numpy(float))
    pixels = [points[["x1", "y1"]].to_numpy(float), points[["x2", "y2"]].to_numpy(float)]
    poses = _poses(place_m, pixels)
    rig = make_rig(
        {
            f"cam{number + 1}": make_camera(
                R=Rotation.from_rotvec(pose[:3]).as_matrix(), t_m=pose[3:], K=K, image_size_wh=IMAGE_SIZE_WH
            )
            for number, pose in enumerate(poses)
        }
    )
    detections = {name: _read_points(folder / f"IM_PTS_{name}.csv", first, num_frames) for name in rig.names}
    frame = np.arange(num_frames)
    truth_m = np.full((num_frames, 1, 3), np.nan)
    row = points.nr.to_numpy() - first
    inside = (row >= 0) & (row < num_frames)
    truth_m[row[inside], 0] = place_m[inside]
    return Flight(rig, detections, Trajectories(frame, frame / fps, ("drone",), truth_m), float(fps))


def write_recording(flight: Flight, folder: Path) -> None:
    """Write rig and detections of a flight, and a `recording.toml` that names them."""
    folder.mkdir(parents=True, exist_ok=True)
    write_rig(folder / "rig.toml", flight.rig, force=True)
    lines = ["version = 1", 'calibration = "rig.toml"']
    for index, name in enumerate(flight.rig.names):
        write_detections(folder / f"{name}.csv", flight.detections[name])
        width, height = flight.rig.cameras.image_size_wh[index].astype(int).tolist()
        lines += [f"[cameras.{name}]", f'detections = "{name}.csv"', f"size = [{width}, {height}]"]
        lines.append(f"fps = {flight.fps!r}")
    (folder / "recording.toml").write_text("\n".join(lines) + "\n")


def _east_north_up(degrees: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
    """Metres east, north and up from the first point; the flights are short enough for a plane."""
    latitude = np.deg2rad(degrees[0, 0])
    north = 111_132.95 - 559.85 * np.cos(2 * latitude) + 1.17 * np.cos(4 * latitude)
    east = 111_412.88 * np.cos(latitude) - 93.5 * np.cos(3 * latitude)
    off = degrees - degrees[0] * (1, 1, 0)
    return off[:, [1, 0, 2]] * (east, north, 1.0)


def _poses(
    place_m: Float[np.ndarray, "points 3"], pixels: list[Float[np.ndarray, "points 2"]]
) -> Float[np.ndarray, "2 6"]:
    """Rotation vectors and translations of both cameras."""
    first = []
    for pixel in pixels:
        found, rvec, tvec, _ = cv2.solvePnPRansac(
            place_m, pixel, K, None, reprojectionError=15.0, iterationsCount=2000, flags=cv2.SOLVEPNP_SQPNP
        )
        assert found
        first.append(np.concatenate([rvec.ravel(), tvec.ravel()]))
    some = slice(None, None, max(1, len(place_m) // 1000))
    rays = [(pixel[some] - K[:2, 2]) / K[0, 0] for pixel in pixels]

    def errors(poses: np.ndarray) -> np.ndarray:
        R = [Rotation.from_rotvec(pose[:3]).as_matrix() for pose in poses.reshape(2, 6)]
        t = [pose[3:] for pose in poses.reshape(2, 6)]
        off = []
        for number in range(2):
            seen = place_m[some] @ R[number].T + t[number]
            off.append((seen[:, :2] / seen[:, 2:] - rays[number]).ravel() * K[0, 0] / GPS_PX)
        turn = R[1] @ R[0].T
        shift = t[1] - turn @ t[0]
        line = np.cross(shift, _homogeneous(rays[0]) @ turn.T)
        distance = (line * _homogeneous(rays[1])).sum(axis=1) / np.linalg.norm(line[:, :2], axis=1)
        return np.concatenate([*off, distance * K[0, 0] / PIXEL_PX])

    return least_squares(errors, np.concatenate(first), loss="soft_l1", x_scale="jac").x.reshape(2, 6)


def _homogeneous(x: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 3"]:
    return np.column_stack([x, np.ones(len(x))])


def _read_points(path: Path, first: int, num_frames: int) -> Detections:
    """Detections of some frames, as boxes of the stated area."""
    rows = pd.read_csv(path)
    rows = rows[(rows.nr >= first) & (rows.nr < first + num_frames)].sort_values("nr", kind="stable")
    middle = rows[["x", "y"]].to_numpy(float) + 0.5
    half = np.sqrt(np.maximum(rows.area.to_numpy(float), 1.0))[:, None] / 2
    boxes = np.concatenate([middle - half, middle + half], axis=1)
    return Detections(rows.nr.to_numpy(int) - first, boxes, np.ones(len(rows)))
