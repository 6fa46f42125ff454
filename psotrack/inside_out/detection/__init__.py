"""Detection of ArUco markers in one image, with corners to a tenth of a pixel.

In: a grey image, the name of the markers' dictionary and, optionally, the lens. Out: `DetectedMarkers` (ids and
corners in pixels). Other rooms use `MarkerDetector` and `DetectedMarkers`; `refine_corners` also works alone, on
corners that are known to a few pixels.

`detector` reads the markers, `corners` refines their corners. `corners` uses `gamma` (the brightness encoding of the
image), `edge_transitions` (black to white across an edge) and `distortion` (pixels without and with the lens).
"""

from psotrack.inside_out.detection.corners import refine_corners
from psotrack.inside_out.detection.detector import DetectedMarkers, MarkerDetector

__all__ = ["DetectedMarkers", "MarkerDetector", "refine_corners"]
