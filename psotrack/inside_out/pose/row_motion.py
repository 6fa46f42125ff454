"""Motion of a camera while the rows of one frame are exposed one after the other: the rolling shutter.

The pose of a frame is that of its reference row, the middle row of the image. A row that is exposed s seconds later is
seen from p + v s, in the orientation R exp(w s), with the velocity v along the world's axes and the turn rate w about
the camera's axes. Both are taken as constant during a frame, and the covariance counts how they change (Hedborg,
Forssén, Felsberg & Ringaby, Rolling shutter bundle adjustment, CVPR 2012; Albl, Kukelova, Larsson & Pajdla, Rolling
shutter camera absolute pose, IEEE Transactions on Pattern Analysis and Machine Intelligence 42(6), 2020). One frame
shows both only through the product with the line time, and shows them badly where few markers are seen. The motion
between frames is therefore their prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.geometry import Camera, cross_matrices

#: Squared angle of a turn, rad², below which its series is used.
_SMALL_RAD2 = 1e-12


@dataclass(frozen=True)
class RowMotion:
    """Times of the rows in which corners are seen, and the motion that is expected.

    Attributes:
        time_s: (markers, 4), when the row of each corner was exposed, after the reference row, seconds.
        expected: (6,), expected velocity along the world's axes (m/s) and turn rate about the camera's axes (rad/s).
        information: (6, 6), inverse of the covariance of the expected motion.
        acceleration_std: (6,), standard deviations of the acceleration (m/s²) and of the angular acceleration (rad/s²).
    """

    time_s: Float[np.ndarray, "markers 4"]
    expected: Float[np.ndarray, "6"]
    information: Float[np.ndarray, "6 6"]
    acceleration_std: Float[np.ndarray, "6"]


@dataclass(frozen=True)
class UnsureRows:
    """Uncertainty of the times of rows.

    Attributes:
        error_s: (markers, 4), change of each corner's time by one standard deviation of the line time, seconds.
        expected: (6,), expected motion, as in `RowMotion`, by which a wrong time changes a corner's pixel.
        covariance: (6, 6), covariance of the expected motion.
    """

    error_s: Float[np.ndarray, "markers 4"]
    expected: Float[np.ndarray, "6"]
    covariance: Float[np.ndarray, "6 6"]


@dataclass(frozen=True)
class MovedRows:
    """Changes of the pose from the reference row to other rows.

    Attributes:
        time_s: (rows,), seconds after the reference row.
        moved_m: (rows, 3), change of the position, world, metres.
        R_reference_row: (rows, 3, 3), from the camera's axes at a row to those at the reference row.
        J: (rows, 3, 3), right Jacobians of the turns.
    """

    time_s: Float[np.ndarray, "rows"]
    moved_m: Float[np.ndarray, "rows 3"]
    R_reference_row: Float[np.ndarray, "rows 3 3"]
    J: Float[np.ndarray, "rows 3 3"]


def row_times_s(
    corners_px: Float[np.ndarray, "*corners 2"], lens: Camera, line_time_s: float
) -> Float[np.ndarray, "*corners"]:
    """When the rows of corners were exposed, after the middle row of the image, seconds."""
    return line_time_s * (corners_px[..., 1] - (float(lens.image_size_wh[1]) - 1) / 2)


def at_rows(time_s: Float[np.ndarray, "rows"], motion: Float[np.ndarray, "6"]) -> MovedRows:
    """The pose of a camera at rows, relative to its pose at the reference row.

    Args:
        time_s: (rows,), when the rows were exposed, after the reference row, seconds.
        motion: (6,), velocity along the world's axes (m/s) and turn rate about the camera's axes (rad/s).
    """
    turn = time_s[:, None] * motion[3:]
    angle2 = np.maximum((turn * turn).sum(axis=1), _SMALL_RAD2)[:, None, None]
    angle = np.sqrt(angle2)
    first, second = np.sin(angle) / angle, (1 - np.cos(angle)) / angle2
    third = np.where(angle2 > 1e-6, (angle - np.sin(angle)) / (angle2 * angle), 1 / 6)
    crossed = cross_matrices(turn)
    square = crossed @ crossed
    return MovedRows(
        time_s,
        time_s[:, None] * motion[:3],
        np.eye(3) + first * crossed + second * square,
        np.eye(3) - second * crossed + third * square,
    )


def slopes_by_motion(
    by_shift: Float[np.ndarray, "rows 2 3"],
    by_turn: Float[np.ndarray, "rows 2 3"],
    R_world_cam: Float[np.ndarray, "3 3"],
    moved: MovedRows,
) -> tuple[Float[np.ndarray, "rows 2 6"], Float[np.ndarray, "rows 2 6"]]:
    """Derivatives of pixels by the pose at the reference row and by the motion.

    Args:
        by_shift: (rows, 2, 3), derivatives by a shift of the point in the axes of the camera at the row.
        by_turn: (rows, 2, 3), derivatives by a small turn of the camera at the row.
        R_world_cam: (3, 3), camera to world, at the reference row.
        moved: the poses at the rows.

    Returns:
        (rows, 2, 6) twice: by position (world) and turn (camera) at the reference row, and by velocity and turn rate.
    """
    to_row = moved.R_reference_row.swapaxes(1, 2)
    by_position = -by_shift @ to_row @ R_world_cam.T
    by_pose = np.concatenate([by_position, by_turn @ to_row], axis=-1)
    time_s = moved.time_s[:, None, None]
    by_motion = np.concatenate([time_s * by_position, time_s * by_turn @ moved.J], axis=-1)
    return by_pose, by_motion
