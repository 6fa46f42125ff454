"""Inside-out: the position of a drone from markers of known positions in its own camera's video (the paper's method 3).

In: an on-board video, a map of the markers and the lens. Out: a `CameraPath` with position, orientation, covariance
and status in every frame; also maps of markers, made from videos or measured corners, and the fusion of paths with
tracks of static cameras. Other rooms use the names that this room exports, and nothing else.

From a frame to a path: `frames` (reading), `pose` (of one frame), `filtering` (over time), `localising` (the complete
localisation). `mapping` builds and checks maps, `fusing` joins paths and tracks; `psotrack.evaluation` compares paths
with references. Imports go in this order: camera_path, lens_files, marker_map, frames, pose, filtering,
rolling_shutter, mapping, localising, fusing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
