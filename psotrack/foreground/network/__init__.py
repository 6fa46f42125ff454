"""The network that finds drones in one frame: its layers, what it finds, and its file.

In: a reduced frame, and the learned background of its camera. Out: for each pixel the probability that the pixel shows
a drone, and boxes. Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
