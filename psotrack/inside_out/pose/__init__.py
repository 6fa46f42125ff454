"""The pose of a camera from the markers in one frame.

In: corners of markers in the image (pixels) and in the world (metres), the lens and `PoseSettings`. Out: a
`MarkerPose` with its covariance and the probability that another pose is the right one. Other rooms use
`estimate_pose`, `estimate_noise`, `at_middle_row` and these records, and nothing else of this room.

Imports go in this order: `records`; `equations` (linear equations of the corners); `fit` (the most likely pose near
an initial pose); `initial_poses` (poses by closed-form solvers); `estimating` (the complete estimation); `noise` (the
variances of a recording); `rows` (the rolling shutter).
"""

from psotrack.inside_out.pose.equations import Equations
from psotrack.inside_out.pose.estimating import estimate_pose
from psotrack.inside_out.pose.noise import estimate_noise
from psotrack.inside_out.pose.records import CornerNoise, ExpectedPose, MarkerPose, PoseSettings
from psotrack.inside_out.pose.rows import (
    PosesAt,
    RollingShutter,
    at_middle_row,
    row_times_s,
    shift_of_rows,
    spline_through,
)

__all__ = [
    "CornerNoise",
    "Equations",
    "ExpectedPose",
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
