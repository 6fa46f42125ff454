"""Calibration: lenses and poses of cameras, and a rig that agrees with what its cameras see.

In: a data sheet or a video of a ChArUco board (`intrinsics`), points of known position (`marks`, `extrinsics`), or
detections of drones (`bundle`). Out: lenses and rigs with covariances. `bundle` adjusts all cameras and points
together, `alike` adds errors that all cameras share to the covariance, and `significance` says which cameras are
wrong for certain. The files of rigs are read and written in `psotrack.geometry`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
