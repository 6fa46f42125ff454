"""Triangulation by the reprojection error: refined points with covariances, without views that disagree.

The linear equations of `triangulation` measure errors in space, but the noise is in the image. Points are therefore
refined in the image. A view disagrees if its residual is too large for its noise: its statistic t (see `image_fit`) is
χ² with two degrees of freedom, so that P(t > -2 ln q) = q.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import SettingsError
from psotrack.geometry.cameras import Camera, has_image, to_camera, to_pixels
from psotrack.geometry.image_fit import ImageFit, fit_in_image
from psotrack.geometry.triangulation import projection_equations, solve_equations, viewpoints

#: Largest number of refinement steps. From a linear start two steps suffice; nearly parallel rays need more.
_MAX_STEPS = 10
#: Number of rounds in which the noise and the views that disagree with it are found in turn.
_NOISE_ROUNDS = 10
#: Relative change of the noise below which it is found.
_NOISE_TOLERANCE = 0.03
#: Least number of views that show the noise: the standard error of their median is a sixth of the noise.
_LEAST_VIEWS = 20
#: Noise that is taken if too few views show it, and the least noise that is learned, pixels.
_USUAL_NOISE_PX, _LEAST_NOISE_PX = 1.0, 1e-3
#: Median of χ² with two degrees of freedom.
_MEDIAN_DISAGREEMENT = 2 * np.log(2)


@dataclass(frozen=True)
class Triangulated:
    """Points in space from the views of several cameras.

    Attributes:
        position_m: (..., 3), positions in the world, metres; NaN if unknown.
        covariance_m2: (..., 3, 3), covariance of the position from the noise of the pixels, m²; NaN if unknown.
        reprojection_px: (..., cameras), distance between each view's pixel and the projection, pixels, also of views
            that are left out; infinite if the camera cannot show the point, NaN if it is not seen or unknown.
        used: (..., cameras), True for views that the position is computed from.
    """

    position_m: Float[np.ndarray, "*points 3"]
    covariance_m2: Float[np.ndarray, "*points 3 3"]
    reprojection_px: Float[np.ndarray, "*points cameras"]
    used: Bool[np.ndarray, "*points cameras"]


def triangulate(
    cameras: Camera,
    points_px: Float[np.ndarray, "*points cameras 2"],
    weights: Float[np.ndarray, "*points cameras"] | None = None,
    *,
    noise_px: float | Float[np.ndarray, "..."] | None = None,
) -> Float[np.ndarray, "*points 3"]:
    """World points of least reprojection error from pixels, without views that disagree; `reconstruct` says more.

    Args:
        cameras: cameras with one leading axis, such as `rig.cameras`.
        points_px: (..., cameras, 2), pixels; NaN if a camera does not see the point.
        weights: (..., cameras), weights of the views; None: 1.
        noise_px: standard deviation of a pixel along either axis, pixels; None learns one number from the residuals of
            all points.

    Returns:
        (..., 3), positions in the world, metres; NaN if fewer than two cameras see the point, all rays are parallel, or
        the rays meet behind a camera.

    Raises:
        SettingsError: the noise of a used view is not above 0.
    """
    return reconstruct(cameras, points_px, weights, noise_px=noise_px).position_m


def reconstruct(
    cameras: Camera,
    points_px: Float[np.ndarray, "*points cameras 2"],
    weights: Float[np.ndarray, "*points cameras"] | None = None,
    *,
    noise_px: float | Float[np.ndarray, "..."] | None = None,
    robust: bool = True,
    refine: bool = True,
    false_alarm: float = 1e-3,
) -> Triangulated:
    """World points from pixels: equations (3)-(6) of the paper, refined in the image, without views that disagree.

    As long as a view disagrees, one view is left out: the view without which the remaining views agree best. The
    remaining views must have three viewpoints (see `triangulation.viewpoints`). With three viewpoints in total, a view
    is left out only if the other two agree and no other pair agrees, because a pair also agrees if one of its views is
    wrong along the epipolar line of the other. If this does not lead to agreement, all views are used, and
    `reprojection_px` shows the disagreement.

    Args:
        cameras: cameras with one leading axis.
        points_px: (..., cameras, 2), pixels; NaN if a camera does not see the point.
        weights: (..., cameras), weights of the views: the variance of a view is noise_px² / weight, and a view of
            weight 0 is not used. None: 1.
        noise_px: standard deviation of a pixel along either axis, pixels; one number, or broadcast to (..., cameras).
            For detectors it is in proportion to the size of the box, or to 1 / depth. None learns one number for all
            views of weight 1 from the residuals of points that three cameras see; 1 pixel
            if these are too few.
        robust: leave out views that disagree.
        refine: minimise the reprojection error; if not, the position solves the linear equations with these weights.
        false_alarm: largest probability that a view of a point is left out although all views are correct.

    Returns:
        Points; NaN if fewer than two cameras see the point, all rays are parallel, or the rays meet behind a camera.

    Raises:
        SettingsError: the noise of a used view is not above 0, or `false_alarm` is not a probability.
    """
    if not 0 < false_alarm < 1:
        raise SettingsError("false_alarm", expected="a probability", found=f"{false_alarm:g}")
    rows, right, seen = projection_equations(cameras, points_px)
    scale = _inverse_deviation(seen, weights, _USUAL_NOISE_PX if noise_px is None else noise_px)
    # From here on the points have one axis, and points with fewer than two views are absent.
    known = np.asarray((scale > 0).sum(axis=-1) >= 2)
    lines, scale = _Lines(points_px[known], rows[known], right[known]), scale[known]
    start_m = lines.solve(scale)
    if noise_px is None:
        scale = scale / _learn_noise(cameras, lines, scale, start_m, false_alarm if robust else None)
    if robust:
        scale, refined_m = _without_outliers(cameras, lines, scale, start_m, false_alarm)
        start_m = refined_m if refine else lines.solve(scale)
    fit = fit_in_image(cameras, lines.points_px, scale, start_m, _MAX_STEPS if refine else 0)
    fitted = np.isfinite(fit.cost)
    known[known] = fitted
    position_m = _scatter(known, fit.position_m[fitted], np.nan)
    points_cam = to_camera(cameras, position_m[..., None, :])
    distance_px = np.linalg.norm(to_pixels(cameras, points_cam) - points_px, axis=-1)
    return Triangulated(
        position_m,
        _scatter(known, fit.covariance_m2[fitted], np.nan),
        np.where(np.isfinite(distance_px) & ~has_image(cameras, points_cam), np.inf, distance_px),
        _scatter(known, scale[fitted] > 0, False),
    )


@dataclass(frozen=True)
class _Lines:
    """Pixels of points and their linear equations from `projection_equations`.

    Attributes:
        points_px: (points, cameras, 2), pixels; NaN if a camera does not see the point.
        rows: (points, cameras, 2, 3), left sides of the equations.
        right: (points, cameras, 2), right sides of the equations.
    """

    points_px: Float[np.ndarray, "points cameras 2"]
    rows: Float[np.ndarray, "points cameras 2 3"]
    right: Float[np.ndarray, "points cameras 2"]

    def at(self, index: Int[np.ndarray, "chosen"]) -> _Lines:
        """Pixels and equations of the points with these indices."""
        return _Lines(self.points_px[index], self.rows[index], self.right[index])

    def solve(self, scale: Float[np.ndarray, "points cameras"]) -> Float[np.ndarray, "points 3"]:
        """(points, 3), weighted least-squares solutions, metres; NaN if the used views do not determine a point."""
        return solve_equations(self.rows, self.right, scale)


def _learn_noise(
    cameras: Camera,
    lines: _Lines,
    scale: Float[np.ndarray, "points cameras"],
    start_m: Float[np.ndarray, "points 3"],
    false_alarm: float | None,
) -> float:
    """The pixels' noise in standard deviations of `scale`, from the median disagreement of views that agree.

    The disagreement of a view is χ² with two degrees of freedom times the squared noise. Noise and views that disagree
    are found in turn. The search begins with little noise: with much noise, wrong views would agree and hide.

    Args:
        cameras, lines, scale, start_m: as in `_without_outliers`.
        false_alarm: largest probability that a view of a point is left out although all views are correct; None leaves
            no view out.
    """
    shows = (scale > 0).sum(axis=-1) >= 3
    lines, scale, start_m = lines.at(np.flatnonzero(shows)), scale[shows], start_m[shows]
    noise = 1.0
    for _ in range(_NOISE_ROUNDS):
        used, position_m = scale, start_m
        if false_alarm is not None:
            kept, position_m = _without_outliers(cameras, lines, scale / noise, start_m, false_alarm)
            used = np.where(kept > 0, scale, 0.0)
        fit = fit_in_image(cameras, lines.points_px, used, position_m, _MAX_STEPS)
        found = (used > 0) & (np.isfinite(fit.cost) & ((used > 0).sum(axis=-1) >= 3))[:, None]
        if found.sum() < _LEAST_VIEWS:
            return noise
        before = noise
        noise = max(
            float(np.sqrt(np.median(fit.disagreement[found]) / _MEDIAN_DISAGREEMENT)), _LEAST_NOISE_PX
        )
        if abs(noise / before - 1) < _NOISE_TOLERANCE:
            break
    return noise


def _inverse_deviation(
    seen: Bool[np.ndarray, "*points cameras"],
    weights: Float[np.ndarray, "*points cameras"] | None,
    noise_px: float | Float[np.ndarray, "..."],
) -> Float[np.ndarray, "*points cameras"]:
    """1 / standard deviation of each view's pixel, 1 / pixels; 0 for views that are not used."""
    noise_px = np.broadcast_to(np.asarray(noise_px, np.float64), seen.shape)
    used = seen if weights is None else seen & (weights > 0)
    if not (noise_px[used] > 0).all():
        raise SettingsError("noise_px", expected="numbers above 0", found=f"{noise_px[used].min():g}")
    scale = np.divide(1.0, noise_px, where=used, out=np.zeros(seen.shape))
    return scale if weights is None else scale * np.sqrt(np.where(used, weights, 0.0))


def _scatter(known: Bool[np.ndarray, "*points"], values: np.ndarray, fill: float | bool) -> np.ndarray:
    """Array of the shape of `known`, with the values at True and `fill` at False."""
    scattered = np.full((*known.shape, *values.shape[1:]), fill)
    scattered[known] = values
    return scattered


def _without_outliers(
    cameras: Camera,
    lines: _Lines,
    scale: Float[np.ndarray, "points cameras"],
    start_m: Float[np.ndarray, "points 3"],
    false_alarm: float,
) -> tuple[Float[np.ndarray, "points cameras"], Float[np.ndarray, "points 3"]]:
    """The scale with 0 for views that are left out, and the points after one step from the linear solution.

    One step is accurate enough to decide whether views agree.
    """
    whole = fit_in_image(cameras, lines.points_px, scale, start_m, 1)
    num_views = (scale > 0).sum(axis=-1)
    pending = np.flatnonzero((num_views >= 3) & ~_agrees(whole, scale, false_alarm))
    if not len(pending):
        return scale, whole.position_m
    spot = viewpoints(cameras)[:, None] == np.arange(len(cameras.K))
    scale, position_m, left = scale.copy(), whole.position_m.copy(), scale[pending]
    while len(pending):
        # One trial per point and view: the point without this view.
        point, camera = np.nonzero(left > 0)
        trial = left[point]
        trial[np.arange(len(point)), camera] = 0.0
        tried = lines.at(pending[point])
        fit = fit_in_image(cameras, tried.points_px, trial, tried.solve(trial), 1)
        num_spots = ((trial > 0) @ spot > 0).sum(axis=-1)
        possible = np.isfinite(fit.cost) & (num_spots >= 2)
        good = possible & _agrees(fit, trial, false_alarm)
        order = np.lexsort((np.where(possible, fit.cost, np.inf), point))
        best = order[np.unique(point[order], return_index=True)[1]]
        only_choice = np.bincount(point, good) == 1
        decided = possible[best] & ((num_spots[best] >= 3) | (good[best] & only_choice))
        done = decided & good[best]
        scale[pending[done]] = trial[best[done]]
        position_m[pending[done]] = fit.position_m[best[done]]
        pending, left = pending[decided & ~done], trial[best[decided & ~done]]
    return scale, position_m


def _agrees(
    fit: ImageFit, scale: Float[np.ndarray, "points cameras"], false_alarm: float
) -> Bool[np.ndarray, "points"]:
    """True for points without a disagreeing view.

    Each of n correct views disagrees with probability q / n, so that at least one view disagrees with probability q
    at most.
    """
    gate = -2 * np.log(false_alarm / np.maximum((scale > 0).sum(axis=-1), 1))
    return np.isfinite(fit.cost) & (fit.disagreement <= gate[:, None]).all(axis=-1)
