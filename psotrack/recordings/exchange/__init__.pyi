from .camera_boxes import Footage
from .export import export_tracks
from .formats import FORMATS, read_tracks

__all__ = ["FORMATS", "Footage", "export_tracks", "read_tracks"]
