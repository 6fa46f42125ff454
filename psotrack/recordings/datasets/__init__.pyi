from ._reference import read_own_reference
from .drafting import Draft, DraftOptions, draft_recording
from .opening import find_marker_corners, is_recording, open_recording, reference_files, videos_in

__all__ = [
    "Draft",
    "DraftOptions",
    "draft_recording",
    "find_marker_corners",
    "is_recording",
    "open_recording",
    "read_own_reference",
    "reference_files",
    "videos_in",
]
