"""A rig from a single point that moves before all cameras: a light, a ball, a drone.

Two cameras see a point along two rays that meet, whatever the point is: the essential matrix (Nistér, PAMI 26(6), 2004)
gives the direction from one camera to the other. The pair that sees most at wide angles begins; each further camera is
placed by points that are known already (perspective-n-point), and after each camera all are adjusted together: a point
is a target with a single corner (`calibration.bundle`), whose turn nothing shows; the first camera stays where it is;
the unit of length is open, and damped steps hardly change it. Detections of other things are left out by random
sampling, first with a wide gate. Scale, axes and origin of the world stay open: see `world`.

How well the cameras are known depends on what fixes the world, and on correlated errors: of the lens, of a detector, of
GPS. So the covariances are those of a jackknife: the adjustment and the fit of the world again without each tenth of
the recording (J. W. Tukey 1958; H. R. Künsch 1989 for parts of a series). Where it shows that the sightings hardly
determine a camera, the rigs without each tenth are found from nothing, because others may fit as well.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.calibration.bundle import GATE, Bundle, BundleState, spread_px
from psotrack.calibration.extrinsics import solve_pnp_ransac
from psotrack.calibration.lens_models import known_lenses
from psotrack.calibration.rig.world import Similarity
from psotrack.errors import InputError
from psotrack.geometry import Rig, triangulate_linearly, undistort
from psotrack.support import block_jackknife

#: Distance in the image up to which a detection may be of the point, while the cameras are not yet adjusted, pixels.
_WIDE_PX = 15.0
#: Standard deviation of a detection before any adjustment, pixels: such a gate of 5 deviations is the wide one.
_FIRST_PX = _WIDE_PX / GATE
#: Distance in the image of sightings that give the first pair of cameras, pixels: the error of a usual detector.
_NARROW_PX = 2.0
#: Smallest number of instants that a pair of cameras must share, and of known points for a further camera.
_LEAST_SHARED = 12
#: Angle between two cameras' rays from which on a wider one is no better, degrees.
_WIDE_DEG = 10.0
#: Largest number of instants that are used: neighbouring ones tell nearly the same.
_MOST_INSTANTS = 1500
#: Points farther away than a multiple of the median distance are where rays are nearly parallel: multiples to try.
_FAR = (10.0, 4.0, 2.0, 1.5)
#: Smallest standard deviation of a detection, pixels.
_LEAST_NOISE_PX = 0.2
#: Number of parts of the recording for the jackknife.
_PARTS = 10
#: A camera's place is hardly determined if its standard deviation is above this fraction of the rig's size.
LOOSE = 0.1
#: Smallest number of points per camera: a pose has six unknowns, and fewer points leave it almost free.
_LEAST_POINTS = 6
#: Smallest information about a combination of the cameras' unknowns, against the largest one.
_LEAST_INFORMATION = 1e-13


@dataclass(frozen=True)
class PointViews:
    """Pixels of one or several points in all cameras.

    Attributes:
        names: names of the cameras.
        point: (sightings,), index of the point: 0, or one of two ends of a stick.
        number: (sightings,), number of the instant.
        points_px: (sightings, cameras, 2), pixels; NaN where a camera does not see the point.
    """

    names: tuple[str, ...]
    point: Int[np.ndarray, " sightings"]
    number: Int[np.ndarray, " sightings"]
    points_px: Float[np.ndarray, "sightings cameras 2"]


@dataclass(frozen=True)
class PointRig:
    """A rig from a moving point; its unit of length is open until `world` sets it.

    Attributes:
        rig: the cameras.
        views: the sightings.
        points_m: (sightings, 3), world, in the rig's unit of length; NaN where fewer than two cameras see a point.
        residual_px: (sightings, cameras), distances in the image, also of outliers; NaN where a camera does not see a
            point.
        used: (sightings, cameras), False for outliers and for unseen points.
    """

    rig: Rig
    views: PointViews
    points_m: Float[np.ndarray, "sightings 3"]
    residual_px: Float[np.ndarray, "sightings cameras"]
    used: Bool[np.ndarray, "sightings cameras"]

    def by_number(self, point: int) -> dict[int, Float[np.ndarray, "3"]]:
        """Positions of a point, or of one end of a stick, by the number of the instant."""
        of_point = self.views.point == point
        return dict(zip(self.views.number[of_point].tolist(), self.points_m[of_point], strict=True))


def calibrate_by_point(lenses: Rig, views: PointViews) -> PointRig:
    """Place cameras with known lenses by a point that moves before them.

    The first camera of the best pair is the world, and the distance to the second is the unit.

    Args:
        lenses: the cameras' lenses, in the order of `views.names`.
        views: pixels of the point.

    Raises:
        InputError: no pair of cameras sees the point often enough, or a camera cannot be joined to the others.
    """
    views = _thinned(views)
    first, second, T = _best_pair(lenses, views)
    placed = {first: np.eye(4), second: T}
    while True:
        some = sorted(placed)
        names = tuple(views.names[index] for index in some)
        cameras = replace(lenses.cameras[np.array(some)], T_cam_world=np.array([placed[one] for one in some]))
        seen = replace(views, names=names, points_px=views.points_px[:, some])
        found = _adjust_near(Rig(names, cameras), seen)
        if len(placed) == len(lenses):
            return found
        placed = dict(zip(some, np.asarray(found.rig.cameras.T_cam_world), strict=True))
        index, T = _next_camera(lenses, views, found.points_m, placed)
        placed[index] = T


def covariance_of_centres(
    found: PointRig, world_of: Callable[[PointRig], Similarity]
) -> Float[np.ndarray, "cameras 3 3"]:
    """Estimate the covariances of the camera centres in the world that `world_of` finds, square metres.

    Args:
        found: the rig.
        world_of: the change from a rig's own world and unit to the world that is meant.

    Raises:
        InputError: the sightings without a part of the recording do not determine the cameras or the world.
    """
    near = _jackknife(found, world_of, is_anew=False)
    centres = world_of(found).points(np.asarray(found.rig.cameras.centre_world))
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1).max(axis=1)
    if (np.sqrt(np.trace(near, axis1=1, axis2=2)) < LOOSE * apart).all():
        return near
    # Sightings that determine the rig so little may fit other rigs as well, far from this one: look for them.
    return _jackknife(found, world_of, is_anew=True)


def _jackknife(
    found: PointRig, world_of: Callable[[PointRig], Similarity], *, is_anew: bool
) -> Float[np.ndarray, "cameras 3 3"]:
    """Covariances of the centres from adjustments without a part of the recording, from this rig or from nothing."""
    part = np.unique(found.views.number, return_inverse=True)[1]
    part = part * _PARTS // (part.max() + 1)
    used_px = np.where(found.used[..., None], found.views.points_px, np.nan)
    rigs = [found]
    for left_out in range(_PARTS):
        kept = replace(found.views, points_px=np.where((part != left_out)[:, None, None], used_px, np.nan))
        again = None
        if is_anew:
            # None where the rest determines no rig: then from this rig.
            with contextlib.suppress(InputError):
                again = calibrate_by_point(found.rig, kept)
        rigs.append(_adjust_near(found.rig, kept) if again is None else again)
    own, *others = [world_of(each).points(np.asarray(each.rig.cameras.centre_world)).ravel() for each in rigs]
    covariance = block_jackknife(own, np.array(others))
    return np.einsum("cicj->cij", covariance.reshape(-1, 3, len(own) // 3, 3))


def _thinned(views: PointViews) -> PointViews:
    """Sightings of at least two cameras, evenly thinned out."""
    both = np.flatnonzero(np.isfinite(views.points_px[..., 0]).sum(axis=1) >= 2)
    if not len(both):
        raise InputError("points", expected="instants at which two cameras see the point", found="none")
    numbers = np.unique(views.number[both])
    kept = both[np.isin(views.number[both], numbers[:: max(1, -(-len(numbers) // _MOST_INSTANTS))])]
    return replace(views, point=views.point[kept], number=views.number[kept], points_px=views.points_px[kept])


def _best_pair(lenses: Rig, views: PointViews) -> tuple[int, int, Float[np.ndarray, "4 4"]]:
    """The pair that sees most points at wide angles, and the transform from its first to its second camera."""
    rays = np.stack(
        [undistort(lenses.cameras[index], views.points_px[:, index]) for index in range(len(lenses))], axis=1
    )
    best: tuple[float, int, int, np.ndarray] | None = None
    most = (0, 0, 1)
    for first, second in combinations(range(len(lenses)), 2):
        both = np.isfinite(rays[:, [first, second]]).all(axis=(1, 2))
        most = max(most, (int(both.sum()), first, second))
        if both.sum() < _LEAST_SHARED:
            continue
        focal_px = float(np.mean([lenses.cameras.K[index, 0, 0] for index in (first, second)]))
        here, there = np.ascontiguousarray(rays[both, first]), np.ascontiguousarray(rays[both, second])
        found = _relative_pose(here, there, focal_px)
        if found is None or found[1].sum() < _LEAST_SHARED:
            continue
        T, good = found
        directions = [np.column_stack([part[good], np.ones(good.sum())]) for part in (here, there)]
        directions = [part / np.linalg.norm(part, axis=1, keepdims=True) for part in directions]
        cosine = np.vecdot(directions[0], directions[1] @ T[:3, :3])
        angle_deg = float(np.median(np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))))
        score = good.sum() * min(angle_deg / _WIDE_DEG, 1.0)
        if best is None or score > best[0]:
            best = score, first, second, T
    if best is None:
        count, first, second = most
        raise InputError(
            "points",
            expected=f"at least {_LEAST_SHARED} instants at which two cameras see the same point",
            found=f"{count} of {views.names[first]} and {views.names[second]} at most",
            remedy="move the point where two cameras see it, and check that equal frames are of one instant",
        )
    return best[1:]


def _relative_pose(
    here: Float[np.ndarray, "shared 2"], there: Float[np.ndarray, "shared 2"], focal_px: float
) -> tuple[Float[np.ndarray, "4 4"], Bool[np.ndarray, " shared"]] | None:
    """Transform between two cameras from rays that meet, its shift of length 1, and which rays agree with it.

    Random sampling with local optimisation (O. Chum, J. Matas & J. Kittler, Locally optimized RANSAC, 2003).
    """
    E, good = cv2.findEssentialMat(
        here, there, np.eye(3), method=cv2.USAC_ACCURATE, prob=0.9999, threshold=_NARROW_PX / focal_px
    )
    if E is None or E.shape != (3, 3):
        return None
    # A point behind a camera cannot be seen, however well the rays meet there.
    _, R, t, good = cv2.recoverPose(E, here, there, np.eye(3), mask=good)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, np.ravel(t)
    return T, np.ravel(good) > 0


def _next_camera(
    lenses: Rig,
    views: PointViews,
    points_m: Float[np.ndarray, "sightings 3"],
    placed: dict[int, Float[np.ndarray, "4 4"]],
) -> tuple[int, Float[np.ndarray, "4 4"]]:
    """Place the camera that sees most of the known points."""
    known = np.isfinite(points_m[:, 0])
    seen = {
        index: known & np.isfinite(views.points_px[:, index, 0])
        for index in range(len(lenses))
        if index not in placed
    }
    index = max(seen, key=lambda one: int(seen[one].sum()))
    rays = undistort(lenses.cameras[index], views.points_px[seen[index], index])
    focal_px = float(lenses.cameras.K[index, 0, 0])
    found = solve_pnp_ransac(points_m[seen[index]], rays, _WIDE_PX / focal_px, tries=2000)
    if found is not None and found[1].sum() >= _LEAST_SHARED:
        return index, found[0]
    usable = int(np.isfinite(rays[:, 0]).sum())
    raise InputError(
        f"camera {views.names[index]}",
        expected=f"at least {_LEAST_SHARED} instants at which it sees the point with two other cameras",
        found=f"{usable} that no pose of it fits" if usable else "none",
        remedy="move the point where this camera and two others see it",
    )


def _adjust_near(rig: Rig, views: PointViews) -> PointRig:
    """Adjust without the sightings whose rays are nearly parallel: their point may be anywhere far away.

    Raises:
        InputError: the sightings do not determine the cameras.
    """
    centres = np.asarray(rig.cameras.centre_world)
    far = np.linalg.norm(triangulate_linearly(rig.cameras, views.points_px) - centres.mean(axis=0), axis=-1)
    typical = float(np.nanmedian(far)) if np.isfinite(far).any() else 0.0
    for multiple in _FAR:
        near_px = np.where((far < multiple * typical)[:, None, None], views.points_px, np.nan)
        try:
            return replace(adjust(rig, replace(views, points_px=near_px)), views=views)
        except np.linalg.LinAlgError:
            # A point went to infinity: points that are not so far away stay.
            continue
    raise InputError(
        "points",
        expected="sightings that determine the cameras",
        found="rays that are nearly parallel",
        remedy="move the point nearer, and where the cameras see it from different sides",
    )


def adjust(rig: Rig, views: PointViews) -> PointRig:
    """Adjust the cameras of a rig, and triangulate the points, so that projections agree with measured pixels.

    Args:
        rig: approximate cameras; the first one stays.
        views: pixels of the same points in all cameras.

    Raises:
        InputError: the points do not determine the cameras; the message names a camera that sees too few points.
        SettingsError: a lens has skew.
        numpy.linalg.LinAlgError: a point went to infinity.
    """
    points_px = views.points_px
    placed = np.isfinite(points_px).all(axis=-1)
    placed &= (placed.sum(axis=1) >= 2)[:, None]
    start_m = triangulate_linearly(rig.cameras, np.where(placed[..., None], points_px, np.nan))
    placed &= np.isfinite(start_m).all(axis=-1)[:, None]
    _check_seen(rig, placed)
    models, lenses = zip(*known_lenses(rig).values(), strict=True)
    targets = np.tile(np.eye(4), (len(start_m), 1, 1))
    targets[:, :3, 3] = start_m
    state = BundleState(lenses, np.asarray(rig.cameras.T_cam_world), targets, np.ones(len(targets)))
    free = np.arange(len(rig)) > 0, np.ones(len(targets), bool)
    views_px = np.where(placed[..., None], points_px, np.nan).swapaxes(0, 1)[:, :, None]
    bundle = Bundle.of_views(models, state, np.zeros((1, 3)), views_px, free=free, noise_px=_FIRST_PX)
    bundle = bundle.solved()
    seen = bundle.problem.target, bundle.problem.camera
    unknowns = 6 * len(rig) - 7 + 3 * int(placed.any(axis=1).sum())
    noise_px = max(_LEAST_NOISE_PX, spread_px(bundle.distance_px[:, 0], unknowns))
    problem = replace(bundle.problem, noise_px=np.full(len(seen[0]), noise_px))
    bundle = replace(bundle, problem=problem).solved()
    used, residual_px = placed, np.full(placed.shape, np.nan)
    # The gate depends on the fit and the fit on the gate. The loop ends if they alternate.
    for _ in range(5):
        residual_px[seen] = bundle.distance_px[:, 0]
        inliers = residual_px <= GATE * max(_LEAST_NOISE_PX, spread_px(residual_px[used], unknowns))
        # A point that only one camera sees has no position.
        inliers &= (inliers.sum(axis=1) >= 2)[:, None]
        before, used = used, inliers
        bundle = replace(bundle, used=used[seen][:, None], is_robust=False).solved()
        if (used == before).all():
            break
    residual_px[seen] = bundle.distance_px[:, 0]
    _check_seen(rig, used)
    _check_connected(bundle)
    cameras = replace(rig.cameras, T_cam_world=bundle.state.T_cam_world)
    points_m = np.where(used.any(axis=1)[:, None], bundle.state.T_world_target[:, :3, 3], np.nan)
    return PointRig(Rig(rig.names, cameras), views, points_m, residual_px, used)


def _check_seen(rig: Rig, seen: Bool[np.ndarray, "points cameras"]) -> None:
    for name, count in zip(rig.names, seen.sum(axis=0).tolist(), strict=True):
        if count < _LEAST_POINTS:
            raise InputError(
                f"camera {name}",
                expected=f"at least {_LEAST_POINTS} points that another camera sees too",
                found=f"{count}",
                remedy="leave the camera out",
            )


def _check_connected(bundle: Bundle) -> None:
    """Check that points determine the cameras but for the unit of length, which has no information."""
    information = bundle.equations().reduced().information
    scale = np.sqrt(np.diag(information))
    strength = np.linalg.eigvalsh(information / np.outer(scale, scale))
    if strength[1] < _LEAST_INFORMATION * strength[-1]:
        raise InputError(
            "cameras",
            expected="points that connect all cameras",
            found="cameras that share no points with the others",
        )
