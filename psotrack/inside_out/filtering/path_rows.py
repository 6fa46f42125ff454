"""One frame of a `CameraPath`, for code that makes or reads a path frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from psotrack.inside_out.camera_path import CameraPath, Flag
from psotrack.inside_out.filtering.records import MeasuredPose, PoseEstimate
from psotrack.inside_out.frame_motion import FrameMotion
from psotrack.trajectories import Status


@dataclass(frozen=True)
class PoseRow:
    """One frame of a path. Attributes are those of `CameraPath` without the frames' axis; unknown values are NaN."""

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
    chance: float = np.nan
    common: Float[np.ndarray, "6 errors"] = field(default_factory=lambda: np.zeros((6, 0)))
    motion: FrameMotion | None = None

    @property
    def has_pose(self) -> bool:
        """Whether there is a pose."""
        return bool(np.isfinite(self.position_m).all())

    def backwards(self) -> PoseRow:
        """The same frame in a time that runs backwards."""
        return replace(self, time_s=-self.time_s, motion=self.motion and self.motion.backwards())


def split_path(path: CameraPath) -> list[PoseRow]:
    """The frames of a path, one by one. Values that the path lacks are NaN; without `common`, there are 0 errors."""
    count = path.num_frames
    velocity_m_s = np.full((count, 3), np.nan) if path.velocity_m_s is None else path.velocity_m_s
    chance = np.full(count, np.nan) if path.chance is None else path.chance
    common = np.zeros((count, 6, 0)) if path.common is None else path.common
    motion = [None] * count if path.motion is None else path.motion
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
            chance=float(chance[k]),
            common=common[k],
            motion=motion[k],
        )
        for k in range(path.num_frames)
    ]


def join_rows(rows: Sequence[PoseRow]) -> CameraPath:
    """The path of these frames, in increasing order; optional values that no frame has are None."""
    velocity_m_s = _stack([row.velocity_m_s for row in rows], (3,))
    chance = np.array([row.chance for row in rows], float)
    common = np.array([row.common for row in rows], float)
    return CameraPath(
        frame=np.array([row.frame for row in rows], int),
        time_s=np.array([row.time_s for row in rows], float),
        position_m=_stack([row.position_m for row in rows], (3,)),
        orientation_wxyz=_stack([row.orientation_wxyz for row in rows], (4,)),
        covariance=_stack([row.covariance for row in rows], (6, 6)),
        num_markers=np.array([row.num_markers for row in rows], int),
        reprojection_px=np.array([row.reprojection_px for row in rows], float),
        ambiguity=np.array([row.ambiguity for row in rows], float),
        status=np.array([row.status for row in rows], int),
        flags=np.array([row.flags for row in rows], int),
        velocity_m_s=velocity_m_s if np.isfinite(velocity_m_s).any() else None,
        chance=chance if np.isfinite(chance).any() else None,
        common=common if common.size else None,
        motion=tuple(row.motion for row in rows) if any(row.motion for row in rows) else None,
    )


def measured_pose(row: PoseRow) -> MeasuredPose:
    """The pose of a frame that has one. An unknown ambiguity counts as 0, an unknown chance as 1."""
    motion = row.motion
    if motion is not None:
        of_pose, of_motion = motion.common[:6], motion.common[6:]
        motion = replace(
            motion,
            covariance=motion.covariance - of_pose @ of_pose.T,
            measured_covariance=motion.measured_covariance - of_motion @ of_motion.T,
        )
    return MeasuredPose(
        row.time_s,
        row.position_m,
        row.orientation_wxyz,
        row.covariance - row.common @ row.common.T,
        float(np.nan_to_num(row.ambiguity)),
        row.common,
        float(np.nan_to_num(row.chance, nan=1.0)),
        motion,
    )


def estimated_row(raw: PoseRow, estimate: PoseEstimate, ambiguity: float, *, used: bool) -> PoseRow:
    """A frame with its estimated pose; `used` says whether the frame's own pose was used for it."""
    flags = Flag(raw.flags)
    if raw.has_pose and not used:
        flags |= Flag.GATED
    if ambiguity < raw.ambiguity:
        flags &= ~Flag.AMBIGUOUS
    return replace(
        raw,
        position_m=estimate.position_m,
        orientation_wxyz=estimate.orientation_wxyz,
        covariance=estimate.covariance,
        ambiguity=ambiguity,
        status=int(Status.TRACKED if used else Status.COASTING),
        flags=int(flags),
        velocity_m_s=estimate.velocity_m_s,
        chance=np.nan,
        common=np.zeros((6, 0)),
        motion=None,
    )


def lost_row(raw: PoseRow, *, gated: bool = False) -> PoseRow:
    """A frame without an estimated pose."""
    return replace(
        raw,
        position_m=np.full(3, np.nan),
        orientation_wxyz=np.full(4, np.nan),
        covariance=np.full((6, 6), np.nan),
        ambiguity=np.nan,
        status=int(Status.LOST),
        flags=int(Flag(raw.flags) | Flag.GATED if gated else raw.flags),
        velocity_m_s=np.full(3, np.nan),
        chance=np.nan,
        common=np.zeros((6, 0)),
        motion=None,
    )


def _stack(values: list[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    return np.array(values, float).reshape(-1, *shape)
