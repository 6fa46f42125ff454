from .equations import Equations
from .estimating import estimate_pose
from .noise import estimate_noise
from .records import CameraPose, CornerNoise, MarkerPose, PoseSettings
from .rows import PosesAt, RollingShutter, at_middle_row, row_times_s, shift_of_rows, spline_through

__all__ = [
    "CameraPose",
    "CornerNoise",
    "Equations",
    "MarkerPose",
    "PoseSettings",
    "PosesAt",
    "RollingShutter",
    "at_middle_row",
    "estimate_noise",
    "estimate_pose",
    "row_times_s",
    "shift_of_rows",
    "spline_through",
]
