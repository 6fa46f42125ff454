"""2D detection of drones by a neural network, and training data for such a network.

In: videos, and for training data also a reference. Out: boxes per frame and camera, stored once per video; data sets in
YOLO's layout. Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
