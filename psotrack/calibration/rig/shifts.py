"""Cameras whose frames are counted wrongly: their sightings fit what the other cameras see at other instants.

What moves is elsewhere at another instant, so a camera whose frames are counted wrongly has no pose that fits. By a
moving point it is placed by its slowest sightings then, and the rest are left out as if they were of something else. A
board's motion is known to each camera alone, and tells the shift before any camera is placed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from psotrack.calibration.boards import Board
from psotrack.calibration.extrinsics import solve_pnp_ransac
from psotrack.calibration.lens_models import LensModel
from psotrack.calibration.rig.moving_point import PointViews
from psotrack.calibration.rig.start import find_board_poses
from psotrack.calibration.rig.views import BoardViews
from psotrack.geometry import Rig, project, triangulate_linearly, undistort
from psotrack.support import similarity
from psotrack.trajectories.resampling import interpolated

#: Largest shift of a moving point that is looked for, instants: two seconds of 30 per second.
_MOST_SHIFT = 60
#: Distance in the image up to which a moving point's sighting fits, pixels: ten times the error of a usual detector.
_FITS_PX = 5.0
#: A camera of whose sightings a larger fraction fits is sound.
_SOUND = 0.6
#: Least gain of the fraction that fits to tell a shift; clutter fits a few more sightings at any shift.
_LEAST_GAIN = 0.2
#: Smallest and largest number of sightings that are compared.
_LEAST, _MOST = 24, 300
#: Smallest number of instants that two cameras share at a shift of a board, and largest number of frames between two
#: instants, half a second of 30 per second: a hand turns round within less.
_LEAST_SHARED, _MOST_STEP = 12, 15
#: Largest fraction of a board's motion that a shift leaves, and largest part of what no shift leaves. Errors
#: of poses leave some hundredths, of a poor lens a tenth; a wrong shift leaves most.
_EXPLAINED, _BETTER = 0.3, 0.5
#: Rounds of a fit of two motions without outliers.
_ROUNDS = 4


@dataclass(frozen=True)
class Shift:
    """A camera whose sightings fit the others better at other instants.

    Attributes:
        camera: name of the camera.
        instants: its sightings of an instant fit the others at this many instants later.
        fits: fraction of its sightings that fit as they are counted.
        shifted_fits: fraction that fits with the shift.
    """

    camera: str
    instants: int
    fits: float
    shifted_fits: float

    def __str__(self) -> str:
        early, add, to = ("early", "add", "to") if self.instants > 0 else ("late", "subtract", "from")
        count = abs(self.instants)
        return (
            f"{self.camera} shows the scene {early} by about {count} instants: {self.shifted_fits:.0%} of its "
            f"sightings fit the other cameras then, {self.fits:.0%} as its frames are counted; "
            f"{add} {count} instants {to} its time_offset_s in a recording.toml, or check its frame numbers, and run "
            "again"
        )


def find_point_shifts(rig: Rig, views: PointViews) -> list[Shift]:
    """Cameras whose sightings of a moving point fit the others much better if their instants are counted otherwise.

    Args:
        rig: the rig that was found from the sightings.
        views: all sightings, of which instants follow each other at one rate.
    """
    key, shifts = 2 * views.number + views.point, []
    for index in range(len(rig) if len(rig) > 2 else 0):
        # Positions of the point by the other cameras, where these agree.
        others_px = views.points_px.copy()
        others_px[:, index] = np.nan
        points_m = triangulate_linearly(rig.cameras, others_px)
        distance_px = np.linalg.norm(project(rig.cameras, points_m[:, None])[0] - others_px, axis=-1)
        disagree = np.any(distance_px > _FITS_PX, axis=1)
        points_m = np.where(disagree[:, None], np.nan, points_m)
        shifts += _shift(rig, index, key, views.points_px[:, index], points_m)
    return shifts


def find_board_shifts(
    board: Board, views: BoardViews, lenses: Mapping[str, tuple[LensModel, np.ndarray]]
) -> Int[np.ndarray, " cameras"]:
    """At how many frames later each camera shows what the first one shows, by the way the board moves.

    A camera alone knows how the board moves before it. Two cameras that look at one board see the same motion, turned
    and shifted, if their frames are counted rightly. All shifts are compared at which the cameras share a third of the
    most instants that they can share; between searched frames, the board is interpolated.

    Args:
        board: the board.
        views: pixels of its corners, at instants whose numbers count frames.
        lenses: model and vector of each camera's lens, as its own views have it.

    Returns:
        (cameras,), 0 also where the motion does not tell a shift.
    """
    count = len(views.names)
    # Pictures that were taken now and then show no motion.
    if count < 2 or len(views.number) < _LEAST_SHARED or np.median(np.diff(views.number)) > _MOST_STEP:
        return np.zeros(count, np.int64)
    seen = np.stack(
        [_points_of_board(board, views, index, *lenses[name]) for index, name in enumerate(views.names)]
    )
    cost, shifts = np.zeros((count, count)), np.zeros((count, count), np.int64)
    for first, second in combinations(range(count), 2):
        left, shift = _motion_shift(views.number, seen[first], seen[second])
        shifts[first, second], shifts[second, first] = shift, -shift
        # A pair whose motion tells nothing is counted as it is, and joins only what nothing else joins.
        cost[first, second] = 1 + left
    order, before = breadth_first_order(minimum_spanning_tree(cost), 0, directed=False)
    found = np.zeros(count, np.int64)
    for camera in order[1:]:
        found[camera] = found[before[camera]] + shifts[before[camera], camera]
    return found


def _points_of_board(
    board: Board, views: BoardViews, camera: int, model: LensModel, lens: Float[np.ndarray, " unknowns"]
) -> Float[np.ndarray, "instants 2 3"]:
    """The board's middle and a point in front of it at each instant, camera, metres; NaN where it is not seen.

    They are the same if the corners of a board that looks alike after a turn are in another order.
    """
    half_m = float(np.linalg.norm(np.ptp(board.corners_m, axis=0))) / 2
    points_m = board.corners_m.mean(axis=0) - [[0.0, 0.0, 0.0], [0.0, 0.0, half_m]]
    found = np.full((len(views.number), 2, 3), np.nan)
    for instant in np.flatnonzero(views.seen[camera]):
        for T in find_board_poses(board, model.normalise(lens, views.corners_px[camera, instant]))[:1]:
            found[instant] = points_m @ T[:3, :3].T + T[:3, 3]
    return found


def _motion_shift(
    number: Int[np.ndarray, " instants"],
    first_m: Float[np.ndarray, "instants 2 3"],
    second_m: Float[np.ndarray, "instants 2 3"],
) -> tuple[float, int]:
    """What one motion leaves of another at the shift that explains it best, as a fraction of the motion; the shift."""
    step = int(np.median(np.diff(number)))
    # Between searched frames the motion is interpolated, also over one at which the board is not seen.
    second_at = interpolated(number.astype(np.float64), second_m, 2.0 * step)
    last = int(number[-1] - number[0])
    tried: dict[int, tuple[float, int]] = {}

    def best(shifts: Iterable[int]) -> int:
        tried.update((shift, _left(first_m, second_at(number + float(shift)))) for shift in shifts)
        least = max(_LEAST_SHARED, max(shared for _, shared in tried.values()) / 3)
        return min(tried, key=lambda shift: (tried[shift][1] < least, tried[shift][0]))

    # First where no frame is interpolated, then at single frames.
    coarse = best(range(-(last // step) * step, last + 1, step))
    shift = best(range(coarse - step, coarse + step + 1))
    (left, shared), still = tried[shift], tried[0][0]
    is_certain = shared >= _LEAST_SHARED and left < min(_EXPLAINED, _BETTER * still)
    return (left, shift) if is_certain else (min(still, 1.0), 0)


def _left(
    a_m: Float[np.ndarray, "instants 2 3"], b_m: Float[np.ndarray, "instants 2 3"]
) -> tuple[float, int]:
    """Median distance between two motions, one of them turned and shifted, as a fraction of the motion's extent.

    Also the number of instants at which both are known.
    """
    both = np.isfinite(a_m).all(axis=(1, 2)) & np.isfinite(b_m).all(axis=(1, 2))
    shared = int(both.sum())
    if shared < _LEAST_SHARED:
        return np.inf, shared
    a, b = a_m[both].reshape(-1, 3), b_m[both].reshape(-1, 3)
    near = np.ones(len(a), bool)
    for _ in range(_ROUNDS):
        _, R, t_m = similarity(b[near], a[near], with_scale=False)
        distance_m = np.linalg.norm(b @ R.T + t_m - a, axis=-1)
        # The half that fits best, and what fits about as well, says where the next round looks.
        near = distance_m <= 2 * np.median(distance_m)
    extent_m = np.median(np.linalg.norm(a - np.median(a, axis=0), axis=-1))
    return float(np.median(distance_m) / max(extent_m, 1e-300)), shared


def _shift(
    rig: Rig,
    index: int,
    key: Int[np.ndarray, " points"],
    points_px: Float[np.ndarray, "points 2"],
    points_m: Float[np.ndarray, "points 3"],
) -> list[Shift]:
    """The shift of a camera, if it has one; the camera is placed anew for each shift.

    Args:
        rig: the cameras.
        index: index of the camera.
        key: numbers of points, two for each instant.
        points_px: the camera's pixels of the points; NaN where it does not see one.
        points_m: their positions by the other cameras; NaN where they do not know one.
    """
    gate = _FITS_PX / float(rig.cameras.K[index, 0, 0])
    rays, known = undistort(rig.cameras[index], points_px), np.isfinite(points_m[:, 0])
    is_seen = np.isfinite(rays[:, 0])
    rays, known_m = rays[is_seen], points_m[known]
    fractions: dict[int, float] = {}
    least = _LEAST
    for shift in sorted(range(-_MOST_SHIFT, _MOST_SHIFT + 1), key=abs):
        _, here, there = np.intersect1d(key[is_seen] + shift * 2, key[known], return_indices=True)
        if len(here) >= least:
            some = np.linspace(0, len(here) - 1, min(len(here), _MOST)).astype(np.int64)
            found = solve_pnp_ransac(known_m[there[some]], rays[here[some]], gate)
            fractions[shift] = 0.0 if found is None else float(found[1].mean())
        if shift == 0:
            if fractions.get(0, 1.0) >= _SOUND:
                return []
            # The sightings of one instant or two, of a long shift, fit some pose in any case.
            least = max(_LEAST, len(here) // 2)
    best = max(fractions, key=lambda shift: fractions[shift])
    gain = fractions[best] - fractions[0]
    return [Shift(rig.names[index], best, fractions[0], fractions[best])] if gain > _LEAST_GAIN else []
