from .corners import RefinedCorners, refine_corners
from .detector import DetectedMarkers, MarkerDetector
from .patterns import marker_dictionary

__all__ = ["DetectedMarkers", "MarkerDetector", "RefinedCorners", "marker_dictionary", "refine_corners"]
