"""The rolling shutter: rows of one frame are exposed one after the other while the camera moves.

The pose of a frame is that of its middle row. The pixels of a corner in another row are moved to where the camera would
have seen the corner when the middle row was exposed: by the difference of its projections by the poses at both times.
Those poses are known from the frames around it (spline-based correction: Hedborg, Forssén, Felsberg & Ringaby, Rolling
shutter bundle adjustment, CVPR 2012).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from psotrack.geometry import NEAR_M, Camera, to_pixels

#: Positions, (times, 3), and rotations from camera to world, (times, 3, 3), at times in seconds.
PosesAt = Callable[
    [Float[np.ndarray, "times"]], tuple[Float[np.ndarray, "times 3"], Float[np.ndarray, "times 3 3"]]
]


@dataclass(frozen=True)
class RollingShutter:
    """Rolling shutter of a camera: its rows are exposed one after the other.

    Attributes:
        line_time_s: time from the exposure of one row to that of the next row, seconds; negative if the rows are
            exposed from the last row to the first.
        std_s: standard deviation of the line time, seconds.
    """

    line_time_s: float
    std_s: float = 0.0


def spline_through(time_s: Sequence[float], poses: Sequence[tuple[np.ndarray, np.ndarray]]) -> PosesAt:
    """Cubic splines through poses, positions and rotations from camera to world, at two times or more, seconds."""
    position_m = CubicSpline(time_s, [position for position, _ in poses])
    turns = RotationSpline(time_s, Rotation.from_matrix([R for _, R in poses]))
    return lambda times: (position_m(times), turns(times).as_matrix())


def row_times_s(
    corners_px: Float[np.ndarray, "*corners 2"], lens: Camera, line_time_s: float
) -> Float[np.ndarray, "*corners"]:
    """When the rows of corners were exposed, after the middle row of the image, seconds."""
    return line_time_s * (corners_px[..., 1] - (float(lens.image_size_wh[1]) - 1) / 2)


def at_middle_row(
    corners_px: Float[np.ndarray, "markers 4 2"],
    corners_m: Float[np.ndarray, "markers 4 3"],
    lens: Camera,
    line_time_s: float,
    time_s: float,
    poses_at: PosesAt,
) -> Float[np.ndarray, "markers 4 2"]:
    """(markers, 4, 2), pixels of corners as the middle row's pose shows them, of a frame at `time_s`."""
    return corners_px - shift_of_rows(corners_px, corners_m, lens, (0.0, line_time_s), time_s, poses_at)


def shift_of_rows(
    corners_px: Float[np.ndarray, "markers 4 2"],
    corners_m: Float[np.ndarray, "markers 4 3"],
    lens: Camera,
    line_times_s: tuple[float, float],
    time_s: float,
    poses_at: PosesAt,
) -> Float[np.ndarray, "markers 4 2"]:
    """(markers, 4, 2), change of the pixels from the first line time to the second; 0 behind the camera."""
    first, second = (
        _seen_at(time_s + row_times_s(corners_px, lens, line_time_s), corners_m, lens, poses_at)
        for line_time_s in line_times_s
    )
    return np.nan_to_num(second - first)


def _seen_at(
    time_s: Float[np.ndarray, "markers 4"],
    corners_m: Float[np.ndarray, "markers 4 3"],
    lens: Camera,
    poses_at: PosesAt,
) -> Float[np.ndarray, "markers 4 2"]:
    """Pixels of corners, each at its own time; NaN behind the camera."""
    position_m, R = poses_at(time_s.ravel())
    x_cam = np.einsum("nji,nj->ni", R, corners_m.reshape(-1, 3) - position_m)
    x_cam[x_cam[:, 2] <= NEAR_M] = np.nan
    return np.asarray(to_pixels(lens, x_cam)).reshape(*time_s.shape, 2)
