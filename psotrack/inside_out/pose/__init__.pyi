from .equations import CameraPose, CornerNoise, Equations, MarkerPose, PoseSettings, estimate_noise
from .estimating import estimate_pose

__all__ = [
    "CameraPose",
    "CornerNoise",
    "Equations",
    "MarkerPose",
    "PoseSettings",
    "estimate_noise",
    "estimate_pose",
]
