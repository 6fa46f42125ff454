"""2D detections: boxes that a neural network finds, markers, and training data for a network.

In: videos or images; for training data also a reference. Out: boxes per frame and camera, stored once per video; ArUco
dictionaries and boards; data sets in YOLO's layout.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
