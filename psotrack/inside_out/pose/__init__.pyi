from .equations import Equations
from .estimating import estimate_pose
from .noise import estimate_noise
from .records import CameraPose, CornerNoise, MarkerPose, PoseSettings

__all__ = [
    "CameraPose",
    "CornerNoise",
    "Equations",
    "MarkerPose",
    "PoseSettings",
    "estimate_noise",
    "estimate_pose",
]
