"""Detection of ArUco markers in one image, with corners to a tenth of a pixel.

In: a grey image, the name of the markers' dictionary and, optionally, the lens. Out: `DetectedMarkers` (ids, corners
in pixels and their accuracy). Other rooms use `MarkerDetector` and `DetectedMarkers`; `refine_corners` also works
alone, on corners that are known to a few pixels.

`search` finds the markers: `brightness` makes the images that are searched, `quads` finds quadrangles, `codes` reads
them. `corners` refines their corners: `gamma` is the brightness encoding of the image, `edge_transitions` finds black
to white across an edge, `edge_lines` fits lines to the edges, `distortion` converts pixels with and without the lens.
`marker_table` searches images and videos, and writes what it finds.
"""

from psotrack.inside_out.detection.corners import refine_corners
from psotrack.inside_out.detection.detector import DetectedMarkers, MarkerDetector
from psotrack.inside_out.detection.search import FirstPass

__all__ = ["DetectedMarkers", "FirstPass", "MarkerDetector", "refine_corners"]
