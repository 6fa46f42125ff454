from .drawing import DrawnTracks, ImagePlaces, draw_drones, drawn_tracks, places_in
from .folder import OverlayOptions, WrittenOverlays, find_codec, save_picture, write_overlays

__all__ = [
    "DrawnTracks",
    "ImagePlaces",
    "OverlayOptions",
    "WrittenOverlays",
    "draw_drones",
    "drawn_tracks",
    "find_codec",
    "places_in",
    "save_picture",
    "write_overlays",
]
