from .camera_boxes import Footage
from .formats import FORMATS, export_tracks, read_tracks

__all__ = ["FORMATS", "Footage", "export_tracks", "read_tracks"]
