from .bundle import AdjustedRig, adjust
from .common_errors import CommonErrors
from .derivatives import centre_by_pose, reproject
from .extrinsics import Located, locate_camera
from .image_points import DroneViews, ImagePoints, find_drones_in_boxes, find_markers, read_image_points
from .intrinsics import Board, Lens, lens_of_board, lens_of_sensor, lens_of_view
from .pose_search import MIN_POINTS
from .residuals import GATE, UNLIKELY, inflation, spread_px
from .significance import Improved, find_wrong_cameras, improve

__all__ = [
    "GATE",
    "MIN_POINTS",
    "UNLIKELY",
    "AdjustedRig",
    "Board",
    "CommonErrors",
    "DroneViews",
    "ImagePoints",
    "Improved",
    "Lens",
    "Located",
    "adjust",
    "centre_by_pose",
    "find_drones_in_boxes",
    "find_markers",
    "find_wrong_cameras",
    "improve",
    "inflation",
    "lens_of_board",
    "lens_of_sensor",
    "lens_of_view",
    "locate_camera",
    "read_image_points",
    "reproject",
    "spread_px",
]
