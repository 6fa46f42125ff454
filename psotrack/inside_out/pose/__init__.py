"""The pose of a camera from the markers in one frame.

In: corners of markers in the image (pixels) and in the world (metres), the lens and `PoseSettings`. Out: a
`MarkerPose` with its covariance and the probability that another pose is the right one. Other rooms use
`estimate_pose` and these records, and nothing else of this room.

Imports go in this order: `records`; `equations` (linear equations of the corners); `fit` (the most likely pose near
an initial pose); `initial_poses` (poses by closed-form solvers); `estimating` (the complete estimation).
"""

from psotrack.inside_out.pose.estimating import estimate_pose
from psotrack.inside_out.pose.records import (
    CornerResiduals,
    ExpectedMotion,
    ExpectedPose,
    MarkerPose,
    PoseSettings,
    RollingShutter,
)
from psotrack.inside_out.pose.row_motion import row_times_s

__all__ = [
    "CornerResiduals",
    "ExpectedMotion",
    "ExpectedPose",
    "MarkerPose",
    "PoseSettings",
    "RollingShutter",
    "estimate_pose",
    "row_times_s",
]
