"""Silhouettes: which share of each reduced pixel is foreground.

In: videos. Out: `Silhouettes`, arrays of coverage (0 to 255) that are computed once and stored, the blobs in them, and
summed-area tables of them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
