from .camera_path import CameraPath, Flag, read_camera_path, write_camera_path
from .filtering import PoseFilterParams, smooth
from .frames import FrameSource, markers_of, open_source, write_marker_table
from .fusing import FusedTracks, fuse, write_fused
from .lens_files import choose_lens, lens_from_matrix
from .localising import LocalisedVideo, LocaliseSettings, localise_video
from .mapping import (
    BuiltMap,
    MapCheck,
    build_map,
    check_map,
    corners_in_own_frame,
    find_sightings,
)
from .marker_map import (
    FittedSquares,
    MarkerCentres,
    MarkerMap,
    fit_squares,
    read_marker_map,
    read_marker_table,
    read_measured_corners,
)
from .pose import PoseSettings
from .rolling_shutter import LineTime, RollingShutter

__all__ = [
    "BuiltMap",
    "CameraPath",
    "FittedSquares",
    "Flag",
    "FrameSource",
    "FusedTracks",
    "LineTime",
    "LocaliseSettings",
    "LocalisedVideo",
    "MapCheck",
    "MarkerCentres",
    "MarkerMap",
    "PoseFilterParams",
    "PoseSettings",
    "RollingShutter",
    "build_map",
    "check_map",
    "choose_lens",
    "corners_in_own_frame",
    "find_sightings",
    "fit_squares",
    "fuse",
    "lens_from_matrix",
    "localise_video",
    "markers_of",
    "open_source",
    "read_camera_path",
    "read_marker_map",
    "read_marker_table",
    "read_measured_corners",
    "smooth",
    "write_camera_path",
    "write_fused",
    "write_marker_table",
]
