from .colours import colour_rgb, status_colours, status_rgb, statuses
from .ellipsoids import Ellipsoids, ellipsoids_90
from .events import Event, EventKind, find_events
from .flight import (
    USUAL_SIZE_M,
    FlightTracks,
    TrackedFlight,
    first_instants,
    read_flight,
    read_tracks_file,
)
from .image_views import ImageEllipses, boxes_in_images, ellipse_outlines_px, ellipses_in_images, shown_frames
from .quality import camera_quality, drone_quality
from .run_record import LearnedDrone, MeetingRecord, RunRecord, read_run_record

__all__ = [
    "USUAL_SIZE_M",
    "Ellipsoids",
    "Event",
    "EventKind",
    "FlightTracks",
    "ImageEllipses",
    "LearnedDrone",
    "MeetingRecord",
    "RunRecord",
    "TrackedFlight",
    "boxes_in_images",
    "camera_quality",
    "colour_rgb",
    "drone_quality",
    "ellipse_outlines_px",
    "ellipses_in_images",
    "ellipsoids_90",
    "find_events",
    "first_instants",
    "read_flight",
    "read_run_record",
    "read_tracks_file",
    "shown_frames",
    "status_colours",
    "status_rgb",
    "statuses",
]
