"""Clocks: offsets between the clocks of cameras, and between the clocks of a recording and its reference.

In: detections of several cameras, or two sets of positions over time. Out: offsets in frames or seconds, with standard
deviations that hold for errors that are correlated in time. Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
