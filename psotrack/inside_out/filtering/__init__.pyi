from .motion import Agility, MotionEstimate
from .pose_filter import (
    Estimated,
    FilterRun,
    PoseFilterParams,
    expected,
    filled,
    orientations,
    path_of,
    poses_of,
    step,
)
from .smoothing import choose_agility, filter_path, smooth, smoothed_motions

__all__ = [
    "Agility",
    "Estimated",
    "FilterRun",
    "MotionEstimate",
    "PoseFilterParams",
    "choose_agility",
    "expected",
    "filled",
    "filter_path",
    "orientations",
    "path_of",
    "poses_of",
    "smooth",
    "smoothed_motions",
    "step",
]
