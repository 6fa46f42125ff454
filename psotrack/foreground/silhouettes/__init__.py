"""Silhouettes: the share of each reduced pixel that is foreground.

In: videos. Out: `Silhouettes`, arrays of coverage (0 to 255), which are computed once and stored; blobs in the
silhouettes; and summed-area tables of the silhouettes. Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
