"""Inside-out: the position of a drone from markers of known position that its own camera sees (the paper's method 3).

In: an on-board video, a map of the markers and the lens. Out: a `CameraPath` with position, orientation, covariance
and status in every frame; also the map itself, made from a video, and the fusion of such a path with outside-in
tracks.

From a frame to a path: `frames`, `detection` (markers), `pose` (of one frame), `filtering` (over time), `localising`
(all of it). `mapping` makes and checks maps, `comparison` judges paths, `fusing` joins paths and tracks. Imports go
in this order: camera_path, lens_files, marker_map, frames, detection, pose, filtering, localising, mapping,
comparison, fusing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
