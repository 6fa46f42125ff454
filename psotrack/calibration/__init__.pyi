from .alike import Alike
from .bundle import AdjustedRig, adjust
from .derivatives import centre_by_pose, reproject
from .extrinsics import Located, locate_camera
from .intrinsics import Board, Lens, lens_of_board, lens_of_sensor, lens_of_view
from .marks import DroneViews, Marks, find_markers, in_boxes, read_marks
from .pose_search import MIN_POINTS
from .residuals import GATE, UNLIKELY, inflation, spread_px
from .significance import Improved, improve, off_cameras

__all__ = [
    "GATE",
    "MIN_POINTS",
    "UNLIKELY",
    "AdjustedRig",
    "Alike",
    "Board",
    "DroneViews",
    "Improved",
    "Lens",
    "Located",
    "Marks",
    "adjust",
    "centre_by_pose",
    "find_markers",
    "improve",
    "in_boxes",
    "inflation",
    "lens_of_board",
    "lens_of_sensor",
    "lens_of_view",
    "locate_camera",
    "off_cameras",
    "read_marks",
    "reproject",
    "spread_px",
]
