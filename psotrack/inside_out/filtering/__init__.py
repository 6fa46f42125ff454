"""Estimates of a camera's motion from the poses of single frames: a causal filter, and a smoother for recordings.

In: a `CameraPath` whose poses each come from one frame, or one `FramePose` after the other. Out: the same frames with
filtered or smoothed poses, velocities, covariances and status. Other rooms use `filter_path`, `smooth`,
`PoseFilterParams`, and, frame by frame, `step`.

Imports go in this order: `motion` (a Kalman filter), `pose_filter` (which poses belong to the motion), `agility` (how
wildly the camera moves), `smoothing`.
"""

from psotrack.inside_out.filtering.agility import choose_agility
from psotrack.inside_out.filtering.motion import Agility, MotionEstimate
from psotrack.inside_out.filtering.pose_filter import (
    Estimated,
    FilterRun,
    FramePose,
    PoseFilterParams,
    expected,
    path_of,
    poses_of,
    step,
)
from psotrack.inside_out.filtering.smoothing import filter_path, smooth, smoothed_motions

__all__ = [
    "Agility",
    "Estimated",
    "FilterRun",
    "FramePose",
    "MotionEstimate",
    "PoseFilterParams",
    "choose_agility",
    "expected",
    "filter_path",
    "path_of",
    "poses_of",
    "smooth",
    "smoothed_motions",
    "step",
]
