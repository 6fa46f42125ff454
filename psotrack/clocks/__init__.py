"""Clocks: how late is one camera, one recording or one reference, compared with another.

In: detections of several cameras, or two sets of positions over time. Out: offsets in seconds or frames, with standard
errors.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
