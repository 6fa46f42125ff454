from .boxes import Boxes, Extents, extents, project_boxes
from .camera_names import camera_key, chosen_camera, files_by_camera
from .cameras import (
    NEAR_M,
    Camera,
    CameraRig,
    camera,
    distort,
    look_at,
    project,
    stack,
    to_camera,
    to_pixels,
    undistort,
)
from .dpjait_calibration import LENGTHS, read_calibration, read_names, write_calibration
from .reprojection import project_with_jacobian, reconstruct
from .rig_files import read_lenses, read_rig, write_rig
from .rotations import cross_matrices, rotation_matrices
from .triangulation import (
    MAX_CONDITION,
    candidates,
    match_views,
    projection_equations,
    triangulate,
    triangulate_paths,
    viewpoints,
)

__all__ = [
    "LENGTHS",
    "MAX_CONDITION",
    "NEAR_M",
    "Boxes",
    "Camera",
    "CameraRig",
    "Extents",
    "camera",
    "camera_key",
    "candidates",
    "chosen_camera",
    "cross_matrices",
    "distort",
    "extents",
    "files_by_camera",
    "look_at",
    "match_views",
    "project",
    "project_boxes",
    "project_with_jacobian",
    "projection_equations",
    "read_calibration",
    "read_lenses",
    "read_names",
    "read_rig",
    "reconstruct",
    "rotation_matrices",
    "stack",
    "to_camera",
    "to_pixels",
    "triangulate",
    "triangulate_paths",
    "undistort",
    "viewpoints",
    "write_calibration",
    "write_rig",
]
