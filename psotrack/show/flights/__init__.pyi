from .appearance import Ellipsoids, colour_rgb, ellipsoids_90, status_rgb, statuses
from .events import Event, EventKind, find_events, intervals
from .flight import (
    USUAL_SIZE_M,
    FlightTracks,
    TrackedFlight,
    find_recording,
    first_instants,
    flight_of,
    read_flight,
    read_tracks_file,
    rows_at,
    split_sequence,
)
from .image_views import ImageViews, ellipse_outlines_px, view_in_images
from .quality import QUANTITIES, Quantity, camera_quality, drone_quality, quantities
from .run_record import (
    LearnedDrone,
    MeetingRecord,
    RunRecord,
    read_run_record,
    recording_beside,
    write_tracked,
)
from .run_summary import RunSummary, run_summary

__all__ = [
    "QUANTITIES",
    "USUAL_SIZE_M",
    "Ellipsoids",
    "Event",
    "EventKind",
    "FlightTracks",
    "ImageViews",
    "LearnedDrone",
    "MeetingRecord",
    "Quantity",
    "RunRecord",
    "RunSummary",
    "TrackedFlight",
    "camera_quality",
    "colour_rgb",
    "drone_quality",
    "ellipse_outlines_px",
    "ellipsoids_90",
    "find_events",
    "find_recording",
    "first_instants",
    "flight_of",
    "intervals",
    "quantities",
    "read_flight",
    "read_run_record",
    "read_tracks_file",
    "recording_beside",
    "rows_at",
    "run_summary",
    "split_sequence",
    "status_rgb",
    "statuses",
    "view_in_images",
    "write_tracked",
]
