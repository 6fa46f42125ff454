"""One frame of a `CameraPath`, for those who make or read a path frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.inside_out.camera_path import CameraPath


@dataclass(frozen=True)
class PoseRow:
    """One frame. Attributes are those of `CameraPath`, without the axis of the frames; NaN for what is not known."""

    frame: int
    time_s: float
    position_m: Float[np.ndarray, "3"]
    orientation_wxyz: Float[np.ndarray, "4"]
    covariance: Float[np.ndarray, "6 6"]
    num_markers: int
    reprojection_px: float
    ambiguity: float
    status: int
    flags: int
    velocity_m_s: Float[np.ndarray, "3"]

    @property
    def has_pose(self) -> bool:
        """Whether there is a pose."""
        return bool(np.isfinite(self.position_m).all())


def rows_of(path: CameraPath) -> list[PoseRow]:
    """The frames of a path, one by one; velocities are NaN where the path has none."""
    velocity_m_s = np.full((path.num_frames, 3), np.nan) if path.velocity_m_s is None else path.velocity_m_s
    return [
        PoseRow(
            frame=int(path.frame[k]),
            time_s=float(path.time_s[k]),
            position_m=path.position_m[k],
            orientation_wxyz=path.orientation_wxyz[k],
            covariance=path.covariance[k],
            num_markers=int(path.num_markers[k]),
            reprojection_px=float(path.reprojection_px[k]),
            ambiguity=float(path.ambiguity[k]),
            status=int(path.status[k]),
            flags=int(path.flags[k]),
            velocity_m_s=velocity_m_s[k],
        )
        for k in range(path.num_frames)
    ]


def path_of(rows: Sequence[PoseRow]) -> CameraPath:
    """The path of these frames, which increase; velocities are left out where no frame has one."""
    velocity_m_s = _stacked([row.velocity_m_s for row in rows], (3,))
    return CameraPath(
        frame=np.array([row.frame for row in rows], int),
        time_s=np.array([row.time_s for row in rows], float),
        position_m=_stacked([row.position_m for row in rows], (3,)),
        orientation_wxyz=_stacked([row.orientation_wxyz for row in rows], (4,)),
        covariance=_stacked([row.covariance for row in rows], (6, 6)),
        num_markers=np.array([row.num_markers for row in rows], int),
        reprojection_px=np.array([row.reprojection_px for row in rows], float),
        ambiguity=np.array([row.ambiguity for row in rows], float),
        status=np.array([row.status for row in rows], int),
        flags=np.array([row.flags for row in rows], int),
        velocity_m_s=velocity_m_s if np.isfinite(velocity_m_s).any() else None,
    )


def _stacked(values: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    return np.array(values, float).reshape(-1, *shape)
