"""Projection lines: drones from detections of several cameras, triangulated and tracked (the paper's second method).

In: detections of all cameras and the rig. Out: tracks with the same motion model, status and covariances as those of
the swarm. Other rooms may use every name in `__init__.pyi`.

In every frame the motion model says where drones are expected; `crossings` matches the detections of all cameras with
these positions and with each other, and triangulates them. A position that no track explains and that lasts for
several frames starts a track, or continues a lost one.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
