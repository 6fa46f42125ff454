"""Cameras, rotations, boxes and triangulation.

In: camera parameters and points, or detections in pixels. Out: pixels, boxes, 3D points with covariances. The modules
use NumPy and JAX only. Calibration and triangulation compute in float64. Other rooms may use every name in
`__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
