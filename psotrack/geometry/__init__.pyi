from .boxes import Boxes, Extents, make_extents, project_boxes
from .camera_names import camera_key, chosen_camera, files_by_camera
from .cameras import (
    NEAR_M,
    Camera,
    Rig,
    distort,
    look_at,
    make_camera,
    make_rig,
    project,
    to_camera,
    to_pixels,
    undistort,
)
from .dpjait_calibration import METRES_PER_UNIT, read_calibration, read_camera_names, write_calibration
from .reprojection import project_with_jacobian, reconstruct
from .rig_files import read_lenses, read_rig, write_rig
from .rotations import cross_matrices, rotation_matrices
from .triangulation import (
    MAX_CONDITION,
    match_views,
    projection_equations,
    triangulate,
    triangulate_candidates,
    triangulate_paths,
    viewpoints,
)

__all__ = [
    "MAX_CONDITION",
    "METRES_PER_UNIT",
    "NEAR_M",
    "Boxes",
    "Camera",
    "Extents",
    "Rig",
    "camera_key",
    "chosen_camera",
    "cross_matrices",
    "distort",
    "files_by_camera",
    "look_at",
    "make_camera",
    "make_extents",
    "make_rig",
    "match_views",
    "project",
    "project_boxes",
    "project_with_jacobian",
    "projection_equations",
    "read_calibration",
    "read_camera_names",
    "read_lenses",
    "read_rig",
    "reconstruct",
    "rotation_matrices",
    "to_camera",
    "to_pixels",
    "triangulate",
    "triangulate_candidates",
    "triangulate_paths",
    "undistort",
    "viewpoints",
    "write_calibration",
    "write_rig",
]
