from .boxes import Boxes, Extents, boxes_at, make_extents, moved_extents, project_boxes
from .camera_names import camera_key, cameras_of, chosen_camera, chosen_cameras, files_by_camera
from .cameras import (
    NEAR_M,
    Camera,
    Rig,
    has_image,
    look_at,
    make_camera,
    make_rig,
    project,
    project_visible,
    scale_lens,
    to_camera,
    to_pixels,
    undistort,
)
from .image_fit import project_with_jacobian, to_pixels_with_jacobian
from .image_scale import sizes_m, sizes_px
from .lenses import (
    FISHEYE_COEFFICIENTS,
    PINHOLE_COEFFICIENTS,
    LensNumbers,
    distort,
    undistortion_stretch,
)
from .reprojection import reconstruct, triangulate
from .rotations import LENGTH_TOLERANCE, cross_matrices, rotation_matrices
from .shared_views import in_images, looking_depths_m, views_meet
from .triangulation import (
    MAX_CONDITION,
    projection_equations,
    triangulate_linearly,
    viewpoints,
)

__all__ = [
    "FISHEYE_COEFFICIENTS",
    "LENGTH_TOLERANCE",
    "MAX_CONDITION",
    "NEAR_M",
    "PINHOLE_COEFFICIENTS",
    "Boxes",
    "Camera",
    "Extents",
    "LensNumbers",
    "Rig",
    "boxes_at",
    "camera_key",
    "cameras_of",
    "chosen_camera",
    "chosen_cameras",
    "cross_matrices",
    "distort",
    "files_by_camera",
    "has_image",
    "in_images",
    "look_at",
    "looking_depths_m",
    "make_camera",
    "make_extents",
    "make_rig",
    "moved_extents",
    "project",
    "project_boxes",
    "project_visible",
    "project_with_jacobian",
    "projection_equations",
    "reconstruct",
    "rotation_matrices",
    "scale_lens",
    "sizes_m",
    "sizes_px",
    "to_camera",
    "to_pixels",
    "to_pixels_with_jacobian",
    "triangulate",
    "triangulate_linearly",
    "undistort",
    "undistortion_stretch",
    "viewpoints",
    "views_meet",
]
