from .board_corners import BoardFinder
from .board_page import save_board
from .board_recognition import describe_board, detect_board
from .boards import Board
from .bundle import Bundle, BundleProblem, BundleState, KnownLens, summed
from .extrinsics import Located, locate_camera
from .image_points import (
    ImagePoints,
    find_markers,
    read_image_points,
)
from .lens_models import LensModel, known_lenses, lens_of_view, parse_lens_model
from .pnp import Solver, ray_distances, solve_pnp, solve_pnp_ransac
from .residuals import GATE, inflation, spread_px
from .rig.adjustment import CalibratedRig, LensChoice, calibrate_rig, start_lenses
from .rig.by_board import calibrate_by_board
from .rig.by_points import calibrate_by_known_points, calibrate_by_moving_point
from .rig.findings import (
    RigCalibration,
    advise,
    coverage,
    figures_of,
    save_coverage,
    say_print,
    say_searched,
    worst_views,
)
from .rig.images import CameraImages, choose_instants, instants_of_numbers, open_images, open_recorded
from .rig.lenses import choose_lens_model
from .rig.moving_point import LOOSE, PointRig, PointViews, calibrate_by_point, covariance_of_centres
from .rig.point_files import (
    GivenWorld,
    distance_between,
    fit_world,
    read_point_views,
    read_world,
    stick_length,
    views_of_detections,
)
from .rig.settings import BoardSettings, LensSettings, PointSettings, RigSettings
from .rig.shifts import Shift, find_board_shifts, find_point_shifts
from .rig.views import BoardViews, FoundBoards, find_views
from .rig.world import Similarity, align, world_of_camera

__all__ = [
    "GATE",
    "LOOSE",
    "Board",
    "BoardFinder",
    "BoardSettings",
    "BoardViews",
    "Bundle",
    "BundleProblem",
    "BundleState",
    "CalibratedRig",
    "CameraImages",
    "FoundBoards",
    "GivenWorld",
    "ImagePoints",
    "KnownLens",
    "LensChoice",
    "LensModel",
    "LensSettings",
    "Located",
    "PointRig",
    "PointSettings",
    "PointViews",
    "RigCalibration",
    "RigSettings",
    "Shift",
    "Similarity",
    "Solver",
    "advise",
    "align",
    "calibrate_by_board",
    "calibrate_by_known_points",
    "calibrate_by_moving_point",
    "calibrate_by_point",
    "calibrate_rig",
    "choose_instants",
    "choose_lens_model",
    "covariance_of_centres",
    "coverage",
    "describe_board",
    "detect_board",
    "distance_between",
    "figures_of",
    "find_board_shifts",
    "find_markers",
    "find_point_shifts",
    "find_views",
    "fit_world",
    "inflation",
    "instants_of_numbers",
    "known_lenses",
    "lens_of_view",
    "locate_camera",
    "open_images",
    "open_recorded",
    "parse_lens_model",
    "ray_distances",
    "read_image_points",
    "read_point_views",
    "read_world",
    "save_board",
    "save_coverage",
    "say_print",
    "say_searched",
    "solve_pnp",
    "solve_pnp_ransac",
    "spread_px",
    "start_lenses",
    "stick_length",
    "summed",
    "views_of_detections",
    "world_of_camera",
    "worst_views",
]
