from .camera_path import CameraPath, Flag, read_camera_path, write_camera_path
from .comparison.plots import save_flight
from .filtering.pose_filter import PoseFilterParams
from .filtering.smoothing import smooth
from .frames import Source, holds_images, open_source
from .fusing import Fused, FusedDrone, fuse
from .fusing.drone_fusion import DroneFusion, Errors
from .fusing.fused_table import write_fused
from .lens_files import chosen_lens, lens_of_matrix
from .localising import LocalisedVideo, LocaliseSettings, localise_video
from .mapping import BuiltMap, build_map, own_frame
from .mapping.check import Checkup, check_map
from .mapping.sightings import find_sightings
from .mapping.squares import Squares, read_measured, squares
from .marker_map import MarkerMap, read_marker_map
from .pose import PoseSettings

__all__ = [
    "BuiltMap",
    "CameraPath",
    "Checkup",
    "DroneFusion",
    "Errors",
    "Flag",
    "Fused",
    "FusedDrone",
    "LocaliseSettings",
    "LocalisedVideo",
    "MarkerMap",
    "PoseFilterParams",
    "PoseSettings",
    "Source",
    "Squares",
    "build_map",
    "check_map",
    "chosen_lens",
    "find_sightings",
    "fuse",
    "holds_images",
    "lens_of_matrix",
    "localise_video",
    "open_source",
    "own_frame",
    "read_camera_path",
    "read_marker_map",
    "read_measured",
    "save_flight",
    "smooth",
    "squares",
    "write_camera_path",
    "write_fused",
]
