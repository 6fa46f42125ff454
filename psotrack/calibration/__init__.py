"""Calibration: what lenses the cameras have, where they stand, and a rig that agrees with what its cameras see.

`intrinsics` from a data sheet or a ChArUco board; `extrinsics` from points of known places, which `marks` reads or
finds; `bundle` moves all cameras and points together, `alike` knows what errors in common do to its covariance, and
`significance` which cameras are off; `rig_files` are a rig's files.
"""

from psotrack.calibration.alike import Alike
from psotrack.calibration.bundle import Adjusted, adjust
from psotrack.calibration.derivatives import centre_by_pose, reproject
from psotrack.calibration.extrinsics import Located, locate_camera
from psotrack.calibration.intrinsics import Board, Lens, lens_of_board, lens_of_sensor, lens_of_view
from psotrack.calibration.marks import DroneViews, Marks, find_markers, in_boxes, read_marks
from psotrack.calibration.pose_search import MIN_POINTS
from psotrack.calibration.residuals import GATE, UNLIKELY, inflation, spread_px
from psotrack.calibration.rig_files import read_lenses, read_rig, write_rig
from psotrack.calibration.significance import Improved, improve, off_cameras

__all__ = [
    "GATE",
    "MIN_POINTS",
    "UNLIKELY",
    "Adjusted",
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
    "read_lenses",
    "read_marks",
    "read_rig",
    "reproject",
    "spread_px",
    "write_rig",
]
