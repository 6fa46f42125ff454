"""Triangulation: points in space from the pixels of several cameras, in float64 (paper, equations 1-6).

Each camera that sees a point adds two linear equations in the point's three coordinates. The overdetermined system is
solved by least squares. Pixels are undistorted first, so that the equations are linear.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.geometry.cameras import Camera, project_visible, undistort
from psotrack.geometry.image_scale import undistortion_stretch

#: Largest condition number of the normal equations; beyond this number the rays count as parallel.
MAX_CONDITION = 1e12
#: Side of the cubes in which only one candidate point is kept, metres: below the accuracy of the candidates.
SAME_M = 0.01


def triangulate_linearly(
    cameras: Camera,
    points_px: Float[np.ndarray, "*points cameras 2"],
    weights: Float[np.ndarray, "*points cameras"] | None = None,
) -> Float[np.ndarray, "*points 3"]:
    """World points from pixels, by the normal equations of (3)-(6) in normalised image coordinates.

    One wrong view spoils a point: `triangulate` leaves wrong views out.

    Args:
        cameras: cameras with one leading axis.
        points_px: (..., cameras, 2), pixels; NaN if a camera does not see the point.
        weights: (..., cameras), weight of each camera's two equations; None: 1.

    Returns:
        (..., 3), positions in the world, metres; NaN if fewer than two cameras see the point, or if all rays are
        parallel.
    """
    normal, right, seen = _normal_equations(cameras, points_px, weights)
    return np.where(seen.sum(axis=-1, keepdims=True) >= 2, solve_normal_equations(normal, right), np.nan)


def triangulate_paths(
    cameras: Camera,
    points_px: Float[np.ndarray, "*paths frames cameras 2"],
    time_s: Float[np.ndarray, "frames"] | Float[np.ndarray, "frames cameras"],
    weights: Float[np.ndarray, "*paths frames cameras"] | None = None,
    *,
    noise_m: float = 0.02,
    expected: tuple[float, ...] = (3.0, 2.0),
) -> Float[np.ndarray, "*paths terms 3"]:
    """Polynomial paths of moving points, X(t) = Σ c_k t^k, from the pixels of all frames together.

    The equations are those of `triangulate_linearly` with X(t) in place of X, and one prior for each coefficient except
    c_0: c_k is normal with mean 0 and a standard deviation from `expected`. Frames in which only one camera sees the
    point therefore count too, and short paths are straight.

    Args:
        cameras: cameras with one leading axis.
        points_px: (..., frames, cameras, 2), pixels; NaN if a camera does not see the point.
        time_s: (frames,), times of the frames, seconds; or (frames, cameras), where cameras have times of their own.
        weights: (..., frames, cameras), weight of each camera's two equations; None: 1.
        noise_m: standard deviation of a camera's equations, in metres at the point.
        expected: standard deviations of c_1, c_2 ..., m/s, m/s² ...; their number is the degree of the path.

    Returns:
        (..., 1 + len(expected), 3), coefficients c_0, c_1 ..., metres and seconds; NaN if fewer than two cameras ever
        see the point, or if all rays are parallel.
    """
    if time_s.ndim == 2:
        # Each camera's frame becomes a frame of its own, in which the other cameras see nothing.
        alone = np.eye(time_s.shape[1], dtype=bool)[..., None]
        points_px = np.where(alone, points_px[..., :, None, :, :], np.nan)
        *paths, frames, own, _, _ = points_px.shape
        # Not -1: there may be no path at all.
        points_px = points_px.reshape(*paths, frames * own, *points_px.shape[-2:])
        if weights is not None:
            weights = np.repeat(weights, time_s.shape[1], axis=-2)
    normal, right, seen = _normal_equations(cameras, points_px, weights)
    solvable = seen.any(axis=-2).sum(axis=-1) >= 2
    solvable &= np.linalg.cond(normal.sum(axis=-3)) < MAX_CONDITION
    terms = 1 + len(expected)
    power = time_s.reshape(-1, 1) ** np.arange(terms)
    whole = np.einsum("fk,fl,...fij->...kilj", power, power, normal)
    whole = whole.reshape(*whole.shape[:-4], 3 * terms, 3 * terms)
    stiffness = np.repeat([0.0, *((noise_m / std) ** 2 for std in expected)], 3)
    whole = np.where(solvable[..., None, None], whole + np.diag(stiffness), np.eye(3 * terms))
    rights = np.einsum("fk,...fi->...ki", power, right)
    path = np.linalg.solve(whole, rights.reshape(*rights.shape[:-2], 3 * terms, 1))
    return np.where(solvable[..., None, None], path.reshape(rights.shape), np.nan)


def projection_equations(
    cameras: Camera, points_px: Float[np.ndarray, "*points cameras 2"]
) -> tuple[
    Float[np.ndarray, "*points cameras 2 3"],
    Float[np.ndarray, "*points cameras 2"],
    Bool[np.ndarray, "*points cameras"],
]:
    """Linear equations L X = B of the paper (3) in normalised coordinates: (x r3 - r1) X = t1 - x t3, likewise for y.

    Args:
        cameras: cameras with one leading axis.
        points_px: (..., cameras, 2), pixels; NaN if a camera does not see the point. A pixel where the camera's lens
            shows no point counts as not seen.

    Returns:
        L (..., cameras, 2, 3), B (..., cameras, 2), and a mask (..., cameras) of the cameras that see the points. The
        rows of the other cameras are finite but have no meaning. A fisheye's equations are divided by the stretch of
        its undistorted image, so that their errors are in proportion to errors of the pixels.
    """
    normalised = undistort(cameras, points_px)
    seen = np.isfinite(normalised).all(axis=-1)
    normalised = np.where(seen[..., None], normalised, 0.0)
    T = np.asarray(cameras.T_cam_world)
    rows = normalised[..., :, None] * T[:, 2, None, :3] - T[:, :2, :3]
    right = T[:, :2, 3] - normalised * T[:, 2, None, 3]
    if cameras.fisheye is not None:
        # Far from a fisheye's axis a pixel is a large step of the normalised coordinates.
        weight = np.where(cameras.fisheye, 1 / undistortion_stretch(cameras, normalised), 1.0)[..., None]
        rows, right = weight[..., None] * rows, weight * right
    return rows, right, seen


def _normal_equations(
    cameras: Camera,
    points_px: Float[np.ndarray, "*points cameras 2"],
    weights: Float[np.ndarray, "*points cameras"] | None,
) -> tuple[
    Float[np.ndarray, "*points 3 3"], Float[np.ndarray, "*points 3"], Bool[np.ndarray, "*points cameras"]
]:
    """Left and right side of the normal equations, summed over cameras, and which cameras see the points."""
    rows, right, seen = projection_equations(cameras, points_px)
    weights = seen * (1.0 if weights is None else weights)
    normal = np.einsum("...c,...cik,...cil->...kl", weights, rows, rows)
    return normal, np.einsum("...c,...cik,...ci->...k", weights, rows, right), seen


def solve_normal_equations(
    normal: Float[np.ndarray, "*points 3 3"], right: Float[np.ndarray, "*points 3"]
) -> Float[np.ndarray, "*points 3"]:
    """(..., 3), solutions of normal equations; NaN if the equations are singular."""
    solvable = np.linalg.cond(normal) < MAX_CONDITION
    point = np.linalg.solve(np.where(solvable[..., None, None], normal, np.eye(3)), right[..., None])
    return np.where(solvable[..., None], point[..., 0], np.nan)


def viewpoints(cameras: Camera, nearest_m: float = 0.3) -> Int[np.ndarray, "cameras"]:
    """Viewpoint number of each camera, (cameras,): cameras nearer to each other than `nearest_m` share a number.

    Two cameras beside each other locate a drone hardly better than one camera.
    """
    centre = cameras.centre_world
    label = np.arange(len(centre))
    for a, b in combinations(range(len(centre)), 2):
        if np.linalg.norm(centre[a] - centre[b]) < nearest_m:
            label[label == label[b]] = label[a]
    return label


def match_views(
    cameras: Camera,
    points_px: list[Float[np.ndarray, "_ 2"]],
    radius_px: list[Float[np.ndarray, "_"]],
    bounds_m: Float[np.ndarray, "2 3"],
    *,
    min_viewpoints: int = 3,
    separation_m: float = 0.3,
) -> tuple[Float[np.ndarray, "found 3"], Int[np.ndarray, "found cameras"]]:
    """Points in space from 2D points of several cameras whose correspondence is unknown.

    Every pair of 2D points from two viewpoints proposes a point in space. A camera supports a proposal if one of its 2D
    points lies within the radius of the proposal's projection. Proposals are accepted greedily, the one with most
    support first. An accepted proposal needs unused 2D points from `min_viewpoints` viewpoints, because two views
    cannot distinguish a real drone from a crossing of two drones' rays.

    Args:
        cameras: cameras with one leading axis.
        points_px: for each camera (n, 2), pixels; n may be 0.
        radius_px: for each camera (n,), largest distance between the 2D point and a projection, pixels.
        bounds_m: (2, 3), lowest and highest corner of the searched region, metres.
        min_viewpoints: smallest number of viewpoints (see `viewpoints`).
        separation_m: smallest distance between two accepted points, metres.

    Returns:
        (found, 3) positions, metres, and (found, cameras) the index of each camera's 2D point, or -1.
    """
    viewpoint = viewpoints(cameras)
    proposals, support = triangulate_candidates(cameras, points_px, radius_px, bounds_m)
    found: list[int] = []
    free = support >= 0
    while len(proposals):
        own = np.array([len(set(viewpoint[row])) for row in free])
        total = (support >= 0).sum(axis=-1)
        best = int(np.lexsort((total, own))[-1])
        if own[best] < min_viewpoints:
            break
        found.append(best)
        used = (support == support[best]) & (support[best] >= 0)
        free &= ~used
        near = np.linalg.norm(proposals - proposals[best], axis=-1) < separation_m
        free[near] = False
    return proposals[found], support[found]


def triangulate_candidates(
    cameras: Camera,
    points_px: list[Float[np.ndarray, "_ 2"]],
    radius_px: list[Float[np.ndarray, "_"]],
    bounds_m: Float[np.ndarray, "2 3"],
) -> tuple[Float[np.ndarray, "candidates 3"], Int[np.ndarray, "candidates cameras"]]:
    """Every point in space that 2D points of at least two viewpoints support, false crossings of rays included.

    Arguments and results: see `match_views`. One candidate is kept in each cube with sides of `SAME_M`.
    """
    points = _proposals(cameras, points_px, viewpoints(cameras))
    # Each pass triangulates from all supporting cameras. A 2D point that fits badly, such as the middle of a blob that
    # two drones share, gets a small weight.
    for _ in range(3):
        points = points[_within(points, bounds_m)]
        support, fit = _support(cameras, points, points_px, radius_px)
        points = triangulate_linearly(cameras, _pick(points_px, support), fit**2)
    # NaN is not within the bounds either.
    kept = np.flatnonzero(_within(points, bounds_m))
    _, first = np.unique(np.round(points[kept] / SAME_M), axis=0, return_index=True)
    return points[kept[first]], support[kept[first]]


def _within(
    points: Float[np.ndarray, "points 3"], bounds_m: Float[np.ndarray, "2 3"]
) -> Bool[np.ndarray, "points"]:
    return ((points >= bounds_m[0]) & (points <= bounds_m[1])).all(axis=-1)


def _proposals(
    cameras: Camera, points_px: list[Float[np.ndarray, "_ 2"]], viewpoint: Int[np.ndarray, "cameras"]
) -> Float[np.ndarray, "proposals 3"]:
    """One point for every pair of 2D points from two viewpoints."""
    proposals = [np.empty((0, 3))]
    for a, b in combinations(range(len(points_px)), 2):
        if viewpoint[a] != viewpoint[b] and len(points_px[a]) and len(points_px[b]):
            first, second = np.meshgrid(np.arange(len(points_px[a])), np.arange(len(points_px[b])))
            pairs = np.stack([points_px[a][first.ravel()], points_px[b][second.ravel()]], axis=1)
            proposals.append(triangulate_linearly(cameras[np.array([a, b])], pairs))
    points = np.concatenate(proposals)
    return points[np.isfinite(points).all(axis=-1)]


def _support(
    cameras: Camera,
    proposals: Float[np.ndarray, "proposals 3"],
    points_px: list[Float[np.ndarray, "_ 2"]],
    radius_px: list[Float[np.ndarray, "_"]],
) -> tuple[Int[np.ndarray, "proposals cameras"], Float[np.ndarray, "proposals cameras"]]:
    """Each camera's supporting 2D point of each proposal: its index or -1, and a fit from 1 (exact) to 0.

    The supporting 2D point is the nearest one, if the proposal's projection lies within its radius.
    """
    pixels, depth = project_visible(cameras, proposals[:, None, :])
    support, fit = np.full(depth.shape, -1), np.zeros(depth.shape)
    for camera, (points, radius) in enumerate(zip(points_px, radius_px, strict=True)):
        if len(points):
            distance = np.linalg.norm(pixels[:, camera, None, :] - points, axis=-1)
            distance = np.where((distance <= radius) & (depth[:, camera, None] > 0), distance, np.inf)
            nearest = distance.argmin(axis=-1)
            distance = distance.min(axis=-1)
            fits = np.isfinite(distance)
            support[fits, camera] = nearest[fits]
            fit[fits, camera] = 1 - (distance[fits] / radius[nearest[fits]]) ** 2
    return support, fit


def _pick(
    points_px: list[Float[np.ndarray, "_ 2"]], support: Int[np.ndarray, "proposals cameras"]
) -> Float[np.ndarray, "proposals cameras 2"]:
    """2D points that support each proposal; NaN for a camera without support."""
    picked = np.full((*support.shape, 2), np.nan)
    for camera, points in enumerate(points_px):
        rows = np.flatnonzero(support[:, camera] >= 0)
        if len(rows):
            picked[rows, camera] = points[support[rows, camera]]
    return picked
