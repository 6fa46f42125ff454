"""Calibration: lenses and poses of cameras, and adjustment of a rig to the pixels that its cameras measure.

In: a data sheet or a video of a ChArUco board (`intrinsics`), points of known position (`image_points`, `extrinsics`),
or detections of drones (`bundle`). Out: lenses and rigs with covariances. `bundle` adjusts all cameras and points
together, `common_errors` adds errors that many points share to the covariance, and `significance` finds the cameras
that are certainly wrong. Other rooms may use every name in `__init__.pyi`. The files of rigs are read and written in
`psotrack.geometry`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
