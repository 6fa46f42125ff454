from .births import (
    SPEED_SHARE,
    TRUSTED_VIEWPOINTS,
    WINDOW_FRAMES,
    Births,
    KnownDrones,
    Measurement,
    TrackCandidate,
    state_at,
)
from .common_sightings import CommonSightings, count_common
from .cut_off import find_cut_off, find_outside
from .initial_state import (
    InitialState,
    StartSource,
    first_drones,
    given_state,
    known_motion,
    room_bounds,
    start_source,
    state_at_first_frame,
)
from .moving_volume import FlightVolume, MovingPoints, flight_volume, moving_blobs, moving_detections
from .reidentification import (
    NEW,
    STAYED_SPANS,
    LostTracks,
    find_false_tracks,
    find_lost_tracks,
    reidentify,
)
from .residual import FrameBlobs, unexplained

__all__ = [
    "NEW",
    "SPEED_SHARE",
    "STAYED_SPANS",
    "TRUSTED_VIEWPOINTS",
    "WINDOW_FRAMES",
    "Births",
    "CommonSightings",
    "FlightVolume",
    "FrameBlobs",
    "InitialState",
    "KnownDrones",
    "LostTracks",
    "Measurement",
    "MovingPoints",
    "StartSource",
    "TrackCandidate",
    "count_common",
    "find_cut_off",
    "find_false_tracks",
    "find_lost_tracks",
    "find_outside",
    "first_drones",
    "flight_volume",
    "given_state",
    "known_motion",
    "moving_blobs",
    "moving_detections",
    "reidentify",
    "room_bounds",
    "start_source",
    "state_at",
    "state_at_first_frame",
    "unexplained",
]
