"""ArUco markers and AprilTags in one image, with corners to a tenth of a pixel, for boards and every camera.

In: a grey image, the name of the markers' dictionary and, optionally, the lens. Out: `DetectedMarkers` (ids, corners
in pixels and their accuracy). Other rooms may use every name in `__init__.pyi`; `refine_corners` also works alone, on
corners that are known to a few pixels.

`detector` finds markers by OpenCV's detector and keeps those that look like their `patterns`. `corners` refines their
corners: `gamma` is the brightness encoding of the image, `edges` measures where black turns into white across an edge,
and fits the edges.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
