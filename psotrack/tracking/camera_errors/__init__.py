"""Errors of the cameras, learned from what they show of tracked drones, and covariances that hold for these errors.

In: tracks, and the place where each camera alone shows each drone. Out: noise and bias of each camera in
pixels, turns and clocks of the cameras, and covariances of the tracks that contain them. Other rooms may use every name
in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
