from ._folder_content import videos_in
from ._marker_corners import (
    MarkerRow,
    read_marker_centres,
    read_marker_corners,
    read_marker_rows,
    split_label,
    write_marker_corners,
)
from ._masks import MASKS, MaskWriter, join_archives
from ._onboard import (
    ONBOARD_CALIBRATION,
    onboard_pose_file,
    read_onboard,
    read_onboard_calibration,
    write_onboard_calibration,
)
from ._poses import (
    mocap_markers_file,
    pose_file,
    read_poses,
    unit_quaternion,
    write_mocap_markers,
    write_poses,
)
from .dpjait import CALIBRATION, DETECTIONS, MARKER_CORNERS, detection_files, read_sequence
from .drafting import Draft, DraftOptions, Matching, draft_recording, match_files
from .opening import find_marker_corners, is_recording, open_recording

__all__ = [
    "CALIBRATION",
    "DETECTIONS",
    "MARKER_CORNERS",
    "MASKS",
    "ONBOARD_CALIBRATION",
    "Draft",
    "DraftOptions",
    "MarkerRow",
    "MaskWriter",
    "Matching",
    "detection_files",
    "draft_recording",
    "find_marker_corners",
    "is_recording",
    "join_archives",
    "match_files",
    "mocap_markers_file",
    "onboard_pose_file",
    "open_recording",
    "pose_file",
    "read_marker_centres",
    "read_marker_corners",
    "read_marker_rows",
    "read_onboard",
    "read_onboard_calibration",
    "read_poses",
    "read_sequence",
    "split_label",
    "unit_quaternion",
    "videos_in",
    "write_marker_corners",
    "write_mocap_markers",
    "write_onboard_calibration",
    "write_poses",
]
