"""Videos with what was found drawn into them: boxes, names, trails, ellipses and time; a mosaic with a map from above.

In: a `TrackedFlight` with a recording that has videos. Out: MP4 files, in H.264 where OpenCV can encode it on this
machine, else in MPEG-4. Finished videos are not made again. Other rooms may use every name in `__init__.pyi`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
