from .candidate_search import CandidateSearch, DroneSearch, FoundCandidates, SeenFrame
from .common_sightings import CommonSightings, count_common
from .cut_off import find_cut_off, find_outside
from .initial_state import (
    StartSource,
    complete_initial_state,
    find_initial_state,
    known_motion,
    room_bounds,
    start_source,
)
from .initialisation import FLOOR_CLEARANCE_M, InitialState
from .moving_volume import FlightVolume, MovingPoints, flight_volume, moving_blobs, moving_detections
from .new_tracks import FollowedCandidate, KnownDrones, Sighted, TrackCandidate, find_candidates
from .reidentification import (
    NEW,
    SPEED_SHARE,
    LostTracks,
    PlannedStarts,
    find_false_tracks,
    find_lost_tracks,
    plan_starts,
    reidentify,
)

__all__ = [
    "FLOOR_CLEARANCE_M",
    "NEW",
    "SPEED_SHARE",
    "CandidateSearch",
    "CommonSightings",
    "DroneSearch",
    "FlightVolume",
    "FollowedCandidate",
    "FoundCandidates",
    "InitialState",
    "KnownDrones",
    "LostTracks",
    "MovingPoints",
    "PlannedStarts",
    "SeenFrame",
    "Sighted",
    "StartSource",
    "TrackCandidate",
    "complete_initial_state",
    "count_common",
    "find_candidates",
    "find_cut_off",
    "find_false_tracks",
    "find_initial_state",
    "find_lost_tracks",
    "find_outside",
    "flight_volume",
    "known_motion",
    "moving_blobs",
    "moving_detections",
    "plan_starts",
    "reidentify",
    "room_bounds",
    "start_source",
]
