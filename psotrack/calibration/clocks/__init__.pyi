from .camera_clocks import camera_offsets
from .reference_clock import ReferenceOffset, own_reference, reference_for, reference_offset
from .track_clocks import (
    MAX_OFFSET_FRAMES,
    CameraClocks,
    LostFrames,
    clocks_of_tracks,
    estimate_clocks,
    fit_clocks,
    places_of_tracks,
)

__all__ = [
    "MAX_OFFSET_FRAMES",
    "CameraClocks",
    "LostFrames",
    "ReferenceOffset",
    "camera_offsets",
    "clocks_of_tracks",
    "estimate_clocks",
    "fit_clocks",
    "own_reference",
    "places_of_tracks",
    "reference_for",
    "reference_offset",
]
