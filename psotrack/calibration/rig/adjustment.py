"""Lenses and places of all cameras, and the board's place at each instant, in one adjustment.

First each camera's lens alone, then the cameras' places through the views that they share (`start`), then all
together: with a robust loss to find the places, and with squared residuals without outliers.

**Slips.** The corners of a view agree with each other far better than with the corners of other cameras, if the board
moves and the cameras are not exactly synchronous. So each view has its own slip, a turn and a shift of the board, from
a normal distribution whose width is estimated from the views (D. J. C. MacKay, Bayesian interpolation, 1992, equation
4.6); a view that slips more than others has a wider one, so that slips follow Student's distribution. Where cameras are
synchronous the width shrinks to nothing.

**Covariance.** All corners that are seen at one instant share errors: the board is not flat, it moves while the
shutters are open, the clocks differ. Least squares takes them for independent. The sandwich of P. J. Huber (1967), with
the instants as groups (Liang & Zeger 1986), does not; with few groups it is too small, because each group pulls the
estimate towards itself. The correction is that of Bell & McCaffrey (2002), CR3, which is the jackknife over the
instants: each group's residuals are those of an estimate without the group.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import log

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.calibration.boards import Board
from psotrack.calibration.bundle import (
    GATE,
    LEAST_NOISE_PX,
    Bundle,
    BundleState,
    centre_by_pose,
    median_by_camera,
    solve_robustly,
    summed,
)
from psotrack.calibration.lens_models import LensModel
from psotrack.calibration.rig.start import (
    LEAST_VIEWS,
    MOST_FITS,
    Chain,
    LensViews,
    choose_lens_model,
    find_lens,
    join_cameras,
)
from psotrack.calibration.rig.views import BoardViews
from psotrack.calibration.rig.world import Similarity
from psotrack.errors import InputError
from psotrack.geometry import Camera, Rig, make_rig
from psotrack.support import Advance, Report, no_progress

_logger = logging.getLogger(__name__)
#: Largest number of adjustments, and relative change of the slips' widths that ends them.
_MOST_ROUNDS, _SETTLED = 15, 0.02
#: Smallest number of views of a camera whose lens is unknown, and of one whose lens is known.
_LEAST_VIEWS, _LEAST_VIEWS_KNOWN = 5, 1
#: What a single camera's views must determine: largest standard deviation of the focal length, as a fraction of it, and
#: largest focal length, in image widths (a field of view of 3 degrees); smallest angle between the planes of the board
#: in the two views that differ most, degrees.
_MAX_FOCAL_ERROR, _MAX_FOCAL_WIDTHS, _MIN_TILT_DEG = 0.02, 20.0, 10.0
#: Degrees of freedom of Student's distribution: small, because a board moves now fast and now hardly.
_FREEDOM = 3.0
#: Unknowns of a slip: three of the turn, three of the shift.
_SLIP_UNKNOWNS = 6
#: Widths at the start and smallest widths: a turn, and a shift as a fraction of the board's size.
_FIRST_SLIP, _LEAST_SLIP = 0.01, 1e-5
#: Largest factor of a width in one step.
_LARGEST_STEP = 4.0
#: Largest condition number of the information, in units of its diagonal.
_MAX_CONDITION = 1e13
#: Smallest share of an unknown's information that the other instants must have for an instant to be left out.
_LEAST_LEFT = 0.02


@dataclass(frozen=True)
class CalibratedRig:
    """Result of a calibration by a board.

    Attributes:
        board: the board.
        rig: the cameras; the world is the first camera, or the board at the chosen instant.
        views: the views, with the corners of a board that looks alike after a turn put into one order.
        T_world_board: (instants, 4, 4), board to world, metres.
        residual_px: (cameras, instants, corners), distances from the projections, pixels; NaN where not seen.
        own_residual_px: the same where each view has the board at a pose of its own, its slip.
        used: (cameras, instants, corners), False for outliers and for what is not seen.
        lens_models: for each camera, the model of its lens.
        lens_std: for each camera, standard deviations of fx, fy, cx, cy and of the distortion; 0 where it was known.
        centre_covariance_m2: (cameras, 3, 3), covariances of the camera centres, world, m².
        shared: (cameras, cameras), number of instants that two cameras share.
    """

    board: Board
    rig: Rig
    views: BoardViews
    T_world_board: Float[np.ndarray, "instants 4 4"]
    residual_px: Float[np.ndarray, "cameras instants corners"]
    own_residual_px: Float[np.ndarray, "cameras instants corners"]
    used: Bool[np.ndarray, "cameras instants corners"]
    lens_models: tuple[LensModel, ...]
    lens_std: tuple[np.ndarray, ...]
    centre_covariance_m2: Float[np.ndarray, "cameras 3 3"]
    shared: Int[np.ndarray, "cameras cameras"]

    @property
    def view_px(self) -> Float[np.ndarray, "cameras instants"]:
        """(cameras, instants), median distance of a view's corners, pixels; NaN of a camera that does not see it."""
        seen = ~np.isnan(self.residual_px).all(axis=-1)
        medians = np.full(seen.shape, np.nan)
        medians[seen] = np.nanmedian(self.residual_px[seen], axis=-1)
        return medians


@dataclass(frozen=True)
class LensChoice:
    """What is known and what is wanted of the lenses.

    Attributes:
        model: model of the lenses that are not known; None to choose it for each camera by views left out.
        known: lenses by camera name, which are kept.
        start: lenses of all cameras by name from which the adjustment starts (see `start_lenses`); None to find them.
    """

    model: LensModel | None = field(default_factory=LensModel)
    known: Mapping[str, tuple[LensModel, np.ndarray]] | None = None
    start: Mapping[str, tuple[LensModel, np.ndarray]] | None = None


def calibrate_rig(
    board: Board,
    views: BoardViews,
    lenses: LensChoice = LensChoice(),
    *,
    floor: int | None = None,
    report: Report = no_progress,
) -> CalibratedRig:
    """Calibrate lenses and places of all cameras from views of a board.

    Args:
        board: the board.
        views: pixels of the board's corners.
        lenses: what is known of the lenses.
        floor: number of the instant at which the board is the world: its corner is the origin, z points out of its
            front. None: the world is the first camera.
        report: display of the progress.

    Raises:
        InputError: a camera sees too little of the board, no views join the cameras, the views do not determine the
            rig, or the board is not seen at the instant `floor`.
    """
    fixed = None if floor is None else _instant(views, floor)
    start = lenses.start or start_lenses(board, views, lenses, report)
    models, vectors = zip(*(start[name] for name in views.names), strict=True)
    chain = join_cameras(board, views, models, vectors)
    # The corners of every view in the order of the board.
    seen_px = np.where(views.seen[..., None, None], views.corners_px, np.nan)
    ordered = np.full(views.corners_px.shape, np.nan)
    np.put_along_axis(ordered, board.labellings[chain.labelling][..., None], seen_px, axis=2)
    views = replace(views, corners_px=ordered)
    with report("adjustment", _MOST_ROUNDS + 1) as advance:
        bundle = _adjust(board, views, chain, (models, vectors), lenses, fixed, advance)
    found = _result(board, views, chain, models, bundle)
    if len(views.names) == 1 and not lenses.known:
        _check_lens(found)
    return found


def _check_views(board: Board, views: BoardViews, lenses: LensChoice) -> None:
    for name, count in zip(views.names, views.seen.sum(axis=1).tolist(), strict=True):
        least = _LEAST_VIEWS_KNOWN if name in (lenses.known or {}) else _LEAST_VIEWS
        if count < least:
            raise InputError(
                f"camera {name}",
                expected=f"at least {least} views of {board.least_corners} corners of the board",
                found=f"{count}",
                remedy="film the board nearer, or pass the camera's lens with --lenses",
            )


def start_lenses(
    board: Board, views: BoardViews, lenses: LensChoice, report: Report = no_progress
) -> dict[str, tuple[LensModel, np.ndarray]]:
    """Models and first vectors of the lenses, by camera name, from the views of each camera alone.

    Arguments: see `calibrate_rig`.

    Raises:
        InputError: a camera sees too little of the board, or no lens fits its views.
    """
    _check_views(board, views, lenses)
    known = lenses.known or {}
    start = {}
    steps = (0 if lenses.model else MOST_FITS) + 1
    with report("lenses", steps * sum(name not in known for name in views.names)) as advance:
        for camera, name in enumerate(views.names):
            if name in known:
                start[name] = known[name]
            else:
                start[name] = _first_lens(board, views, camera, lenses.model, advance)
                advance(1)
    return start


def _check_lens(found: CalibratedRig) -> None:
    """Check that the views of a single camera determine its lens, which no other camera helps to."""
    camera, width = found.rig.cameras[0], found.views.image_size_wh[0, 0]
    focal_px, std_px = camera.K[0, 0], found.lens_std[0][0]
    # Boards that are all parallel to the image fit every focal length, and its stated deviation is then meaningless.
    normals = found.T_world_board[found.used[0].any(axis=1), :3, 2]
    tilt_deg = np.rad2deg(np.arccos(np.clip((normals @ normals.T).min(), -1, 1)))
    # The estimated tilts are meaningless too if the fit diverged to a very large focal length.
    diverged = focal_px > _MAX_FOCAL_WIDTHS * width
    if diverged or tilt_deg < _MIN_TILT_DEG or not std_px < _MAX_FOCAL_ERROR * focal_px:
        raise InputError(
            f"camera {found.rig.names[0]}",
            expected=f"views that determine the focal length to {_MAX_FOCAL_ERROR:.0%}",
            found=f"boards whose tilts differ by at most {tilt_deg:.0f} degrees, error {std_px / focal_px:.1%}",
            remedy="tilt the board, and move it into all corners of the image",
        )


def _first_lens(
    board: Board, views: BoardViews, camera: int, model: LensModel | None, advance: Advance
) -> tuple[LensModel, Float[np.ndarray, " unknowns"]]:
    """Model and first vector of a camera's lens from its own views; None for a model that the views choose."""
    width, height = views.image_size_wh[camera].tolist()
    own = LensViews(board, views.corners_px[camera][views.seen[camera]], (width, height))
    if model is None:
        if len(own) < LEAST_VIEWS:
            _logger.warning(
                "camera %s: lens models are compared by at least %d views, found %d: it gets the usual model; film "
                "more views, or choose a model by --lens",
                *(views.names[camera], LEAST_VIEWS, len(own)),
            )
        model = choose_lens_model(own, advance)
    vector = find_lens(own, model)
    if vector is None:
        raise InputError(
            f"camera {views.names[camera]}",
            expected="views that a lens fits",
            found="none",
            remedy="tilt the board",
        )
    return model, vector


def _instant(views: BoardViews, number: int) -> int:
    """Index of the instant with a number."""
    found = np.flatnonzero(views.number == number)
    if not len(found) or not views.seen[:, found[0]].any():
        seen = views.number[views.seen.any(axis=0)]
        nearest = seen[np.abs(seen - number).argmin()] if len(seen) else "none"
        raise InputError(
            "floor",
            expected="a frame in which a camera sees the board",
            found=f"frame {number}",
            remedy=f"the nearest one is {nearest}",
        )
    return int(found[0])


def _adjust(
    board: Board,
    views: BoardViews,
    chain: Chain,
    start: tuple[tuple[LensModel, ...], tuple[np.ndarray, ...]],
    lenses: LensChoice,
    fixed: int | None,
    advance: Advance,
) -> Bundle:
    """Adjust everything, with the world fixed to the first camera or to the board at an instant."""
    models, vectors = start
    known = lenses.known or {}
    free_camera = np.ones(len(views.names), bool)
    free_board = np.ones(len(views.number), bool)
    T_cam_world, T_world_board = chain.T_cam_world, chain.T_world_board
    if fixed is None:
        free_camera[0] = False
    else:
        T_cam_world = T_cam_world @ T_world_board[fixed] @ _UPWARDS
        T_world_board = np.linalg.inv(T_world_board[fixed] @ _UPWARDS) @ T_world_board
        free_board[fixed] = False
    # Turns about the board's middle and shifts of the middle are nearly independent.
    middle = np.eye(4)
    middle[:3, 3] = board.corners_m.mean(axis=0)
    state = BundleState(vectors, T_cam_world, T_world_board @ middle, np.ones(len(T_world_board)))
    corners_m, free = board.corners_m - middle[:3, 3], (free_camera, free_board)
    bundle = Bundle.of_views(models, state, corners_m, views.corners_px, free=free)
    sizes = [tuple(size) for size in views.image_size_wh.tolist()]
    priors = tuple(model.prior(size) for model, size in zip(models, sizes, strict=True))
    problem = replace(bundle.problem, priors=priors)
    bundle = replace(bundle, problem=problem)
    if problem.size:
        bundle = solve_robustly(bundle)
    advance(1)
    free_lens = tuple(
        np.full(model.size, name not in known) for name, model in zip(views.names, models, strict=True)
    )
    bundle = replace(bundle, problem=replace(problem, free_lens=free_lens))
    bundle = _adjust_with_slips(bundle, board, advance)
    for index, name in enumerate(views.names):
        if not bundle.used[problem.camera == index].any():
            raise InputError(f"camera {name}", expected="views that fit the other cameras", found="none")
    boards = bundle.state.T_world_target @ np.linalg.inv(middle)
    problem = replace(bundle.problem, corners_m=board.corners_m)
    return replace(bundle, state=replace(bundle.state, T_world_target=boards), problem=problem)


@dataclass(frozen=True)
class _Slips:
    """Widths of the slips' distribution.

    Attributes:
        std: (2,), standard deviation of the turn, rad, and of the shift, m.
        scale: (sightings,), variance of a sighting's slip against that of others.
        board_m: size of the board.
    """

    std: Float[np.ndarray, "2"]
    scale: Float[np.ndarray, " sightings"]
    board_m: float

    @staticmethod
    def start(board_m: float, sightings: int) -> _Slips:
        """Wide slips of all sightings."""
        return _Slips(_FIRST_SLIP * np.array([1.0, board_m]), np.ones(sightings), board_m)

    def each(self) -> Float[np.ndarray, "sightings 2"]:
        """(sightings, 2), standard deviations of a sighting's slip, for `Bundle`."""
        return np.sqrt(self.scale)[:, None] * self.std

    def estimated(self, bundle: Bundle) -> _Slips:
        """The widths again, from the slips of an adjustment with these widths."""
        instant, parts = bundle.problem.target, bundle.sightings
        cameras = np.bincount(instant[bundle.used.any(axis=1)], minlength=instant.max() + 1)[instant]
        squares = parts.slip**2
        variance = np.diagonal(parts.slip_covariance, axis1=1, axis2=2)
        widths = np.repeat(self.std**2, 3)
        # The board's pose follows the slips of its views: of two views, each shows half of their difference.
        kept = np.where(cameras > 1, 1 - 1 / np.maximum(cameras, 1), 0.0) / self.scale
        scaled = self.scale[:, None]
        shown = (kept > 0) @ (squares / scaled).reshape(-1, 2, 3).sum(axis=-1)
        expected = kept @ (widths * scaled - variance).clip(0).reshape(-1, 2, 3).sum(axis=-1)
        surprise = ((squares + variance) / widths).sum(axis=-1)
        factor = np.clip(shown / np.maximum(expected, 1e-300), _LARGEST_STEP**-2, _LARGEST_STEP**2)
        least = _LEAST_SLIP * np.array([1.0, self.board_m])
        scale = (_FREEDOM + surprise) / (_FREEDOM + _SLIP_UNKNOWNS)
        return _Slips(np.maximum(self.std * np.sqrt(factor), least), scale, self.board_m)


def _adjust_with_slips(bundle: Bundle, board: Board, advance: Advance) -> Bundle:
    """Adjust with squared residuals; outliers, noise and slips are estimated anew after each adjustment."""
    extent_m = float(np.linalg.norm(np.ptp(board.corners_m, axis=0)))
    seen = np.isfinite(bundle.problem.corners_px).all(axis=-1)
    slips = _Slips.start(extent_m, len(seen))
    bundle = replace(bundle, is_robust=False, slip_std=slips.each())
    for _ in range(_MOST_ROUNDS):
        before, widths = bundle, slips.std
        distance_px = bundle.own_distance_px
        # The median of distances of which each part has a normal distribution (Rayleigh).
        noise_px = np.maximum(LEAST_NOISE_PX, median_by_camera(bundle, distance_px) / np.sqrt(2 * log(2)))
        near = seen & (distance_px <= GATE * noise_px[:, None])
        # Without the views of which too few corners are near.
        count = near.sum(axis=1)
        near &= ((count >= board.least_corners) & (2 * count > seen.sum(axis=1)))[:, None]
        problem = replace(bundle.problem, noise_px=noise_px)
        bundle = replace(bundle, problem=problem, used=near, slip_std=slips.each()).solved()
        slips = slips.estimated(bundle)
        advance(1)
        same = (bundle.used == before.used).all()
        if same and np.abs(np.log(slips.std / widths)).max() < _SETTLED:
            break
    return bundle


#: From the world, z up, to the board's axes, whose z points into the board.
_UPWARDS = np.diag([1.0, -1.0, -1.0, 1.0])


def _result(
    board: Board, views: BoardViews, chain: Chain, models: tuple[LensModel, ...], bundle: Bundle
) -> CalibratedRig:
    covariance = _covariance(bundle)
    problem, state = bundle.problem, bundle.state
    cameras: dict[str, Camera] = {}
    lens_std, centres = [], []
    residual_px, own_px = np.full((2, *views.corners_px.shape[:3]), np.nan)
    used = np.zeros(views.corners_px.shape[:3], bool)
    at = problem.camera, problem.target
    residual_px[at], own_px[at], used[at] = bundle.distance_px, bundle.own_distance_px, bundle.used
    padded = np.pad(covariance, ((0, 1), (0, 1)))
    for index, (name, T) in enumerate(zip(views.names, state.T_cam_world, strict=True)):
        # Unknowns that were not adjusted have the index -1, the padding.
        lens_std.append(np.sqrt(np.diag(padded)[problem.lens_columns[index]]))
        columns = problem.pose_columns[index]
        by_pose = centre_by_pose(T[:3, :3], T[:3, 3])
        centres.append(by_pose @ padded[np.ix_(columns, columns)] @ by_pose.T)
        cameras[name] = models[index].camera(
            state.lenses[index], T, (int(views.image_size_wh[index, 0]), int(views.image_size_wh[index, 1]))
        )
    return CalibratedRig(
        board,
        make_rig(cameras),
        views,
        state.T_world_target,
        residual_px,
        own_px,
        used,
        models,
        tuple(lens_std),
        np.stack(centres),
        chain.shared,
    )


def _covariance(bundle: Bundle) -> Float[np.ndarray, "unknowns unknowns"]:
    """Covariance of the shared unknowns of an adjustment, by the jackknife over the instants.

    Raises:
        InputError: the views do not determine the rig.
    """
    equations = bundle.equations()
    reduced = equations.reduced()
    # An unknown that no view determines may have an information a little below 0, by rounding.
    scale = np.sqrt(np.maximum(np.diag(reduced.information), 0.0))
    undetermined = InputError(
        "board",
        expected="views that determine lenses and places of all cameras",
        found="views that leave some open",
        remedy="tilt the board, and move it through the whole image of each camera; if it was, check that the videos "
        "show it at the same time, and the board's stated numbers and sizes with a ruler",
    )
    if not (scale > 0).all() or np.linalg.cond(reduced.information / np.outer(scale, scale)) > _MAX_CONDITION:
        raise undetermined
    inverse = np.linalg.inv(reduced.information / np.outer(scale, scale)) / np.outer(scale, scale)
    information, pull = _by_instant(bundle, reduced.gain)
    # In units in which the information of all instants is 1, an instant's share of it is a matrix between 0 and 1.
    try:
        half = np.linalg.cholesky((inverse + inverse.T) / 2)
    except np.linalg.LinAlgError:
        raise undetermined from None
    shares, axes = np.linalg.eigh(half.T @ information @ half)
    left = np.maximum(1 - shares, _LEAST_LEFT)
    pulled = np.matvec(axes, np.matvec(axes.swapaxes(-1, -2), pull @ half) / left)
    groups = max(len(pulled), 2)
    covariance = half @ (pulled.T @ pulled) @ half.T
    return covariance * (groups - 1) / groups


def _by_instant(
    bundle: Bundle, gain: Float[np.ndarray, "instants 6 unknowns"]
) -> tuple[Float[np.ndarray, "used unknowns unknowns"], Float[np.ndarray, "used unknowns"]]:
    """Information of each used instant about the shared unknowns, and its pull on them."""
    parts, size, count = bundle.sightings, bundle.problem.size, len(gain)
    column, instant = parts.columns, bundle.problem.block[:, None, None]
    information = summed(
        parts.shared, (instant, column[:, :, None], column[:, None]), (count, size + 1, size + 1)
    )[:, :-1, :-1]
    coupling, block, block_right = bundle.by_block
    pull = summed(parts.shared_right, (instant[..., 0], column), (count, size + 1))[:, :-1]
    pull -= np.matvec(gain.swapaxes(-1, -2), block_right)
    crossed = gain.swapaxes(-1, -2) @ coupling
    information += gain.swapaxes(-1, -2) @ block @ gain - crossed - crossed.swapaxes(-1, -2)
    is_used = np.trace(information, axis1=1, axis2=2) > 0
    return information[is_used], pull[is_used]


def in_new_world(calibrated: CalibratedRig, change: Similarity) -> CalibratedRig:
    """The same rig in a world that is turned and shifted; the covariances stay those against the old origin."""
    T_new_old = np.eye(4)
    T_new_old[:3, :3], T_new_old[:3, 3] = change.R, change.t_m
    return replace(
        calibrated,
        rig=change.rig(calibrated.rig),
        T_world_board=T_new_old @ calibrated.T_world_board,
        centre_covariance_m2=change.covariance_m2(calibrated.centre_covariance_m2),
    )
