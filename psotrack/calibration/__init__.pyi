from .board_recognition import BoardFinder, describe_board, detect_board
from .boards import Board, save_board
from .bundle import GATE, Bundle, BundleProblem, BundleState, KnownLens, spread_px, summed
from .extrinsics import Located, Solver, locate_camera, ray_distances, solve_pnp, solve_pnp_ransac
from .image_points import (
    ImagePoints,
    find_markers,
    read_image_points,
)
from .lens_models import LensModel, known_lenses, lens_of_view, parse_lens_model
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
from .rig.views import (
    BoardViews,
    CameraImages,
    FoundBoards,
    choose_instants,
    find_views,
    instants_of_numbers,
    open_images,
    open_recorded,
)
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
