"""The motion of drones: a Kalman filter with white jerk and correlated measurement errors, and its smoother.

In: measured positions with covariances. Out: filtered (`kalman`) and smoothed (`smoothing`) states with covariances.
The functions of `kalman` are pure and run inside the tracker's compiled scan; other filters of the package use its
process noise of white jerk too. Other rooms may use every name in `__init__.pyi`, and the module `kalman`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
