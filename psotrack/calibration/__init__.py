"""Calibration: lenses and poses of cameras, and rigs from boards or points.

In: points of known position (`extrinsics`), a board that is moved before one or all cameras, or a moving point (`rig`).
Out: lenses and rigs with covariances. Other rooms may use every name in `__init__.pyi`. The files of rigs are read and
written in `psotrack.geometry`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
