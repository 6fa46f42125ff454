"""Estimates of a camera's motion from the poses of single frames: a causal filter, and a smoother for recordings.

In: a `CameraPath` whose poses each come from one frame, or one `PoseRow` per frame. Out: the same frames with
filtered or smoothed poses, velocities, covariances and status. Other rooms use `filter_path`, `smooth`,
`PoseFilterParams`, and, frame by frame, `pose_filter.step`.

Imports go in this order: `records`, `manifold` (orientations), `motion` (a Kalman filter), `multiple_models` (several
of them together), `path_rows` (frames of a path), `pose_filter`, `smoothing`.
"""

from psotrack.inside_out.filtering.pose_filter import PoseFilterParams, filter_path
from psotrack.inside_out.filtering.smoothing import smooth

__all__ = ["PoseFilterParams", "filter_path", "smooth"]
