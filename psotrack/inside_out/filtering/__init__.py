"""Estimates of a camera's motion from the poses of single frames: a causal filter, and a smoother for recordings.

In: a `CameraPath` whose poses each come from one frame, or one `FramePose` after the other. Out: the same frames with
filtered or smoothed poses, velocities, covariances and status. Other rooms use `filter_path`, `smooth`,
`PoseFilterParams`, and, frame by frame, `step`.

Imports go in this order: `motion` (a Kalman filter), `pose_filter` (which poses belong to the motion), `smoothing`
(paths of recordings, and how wildly the camera moves).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
