"""Markers in an image: which they are, and where their corners are to a tenth of a pixel."""

from psotrack.inside_out.detection.corners import refined_corners
from psotrack.inside_out.detection.detector import MarkerDetector, SeenMarkers

__all__ = ["MarkerDetector", "SeenMarkers", "refined_corners"]
