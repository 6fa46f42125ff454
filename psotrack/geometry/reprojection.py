"""Points from pixels with what is known of them: refined in the image, with a covariance, without views that are off.

The equations of `triangulation` are linear because they measure errors in space. Noise is in the image: there the
points are refined, and there a view disagrees where its residual is too large for its noise. Its t (see `image_fit`)
is χ² with two degrees of freedom, so that P(t > -2 ln q) = q.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import SettingsError
from psotrack.geometry.cameras import NEAR_M, Camera, project
from psotrack.geometry.image_fit import ImageFit, fit_in_image, project_with_jacobian
from psotrack.geometry.triangulation import projection_equations, solve_normal, viewpoints

__all__ = ["Triangulated", "project_with_jacobian", "reconstruct"]

#: From a linear start two steps do; with rays that are nearly parallel it is more.
_MAX_STEPS = 10
#: Iterations that undo the lens before points are refined, which does not depend on how well it is undone.
_UNBENDINGS = 6


@dataclass(frozen=True)
class Triangulated:
    """Points in space from the views of several cameras.

    Attributes:
        position_m: (..., 3), world, metres; NaN where it cannot be known.
        covariance_m2: (..., 3, 3), of the position, from the noise of the pixels; NaN where the position is.
        reprojection_px: (..., cameras), distance of each view's pixel from the projection, of views that do not count
            too; infinite where the point is behind the camera, NaN where it is not seen or not known.
        used: (..., cameras), views that count; none where the position is not known.
    """

    position_m: Float[np.ndarray, "*points 3"]
    covariance_m2: Float[np.ndarray, "*points 3 3"]
    reprojection_px: Float[np.ndarray, "*points cameras"]
    used: Bool[np.ndarray, "*points cameras"]


def reconstruct(
    cameras: Camera,
    points_px: Float[np.ndarray, "*points cameras 2"],
    weights: Float[np.ndarray, "*points cameras"] | None = None,
    *,
    noise_px: float | Float[np.ndarray, "..."] = 1.0,
    robust: bool = True,
    refine: bool = True,
    false_alarm: float = 1e-3,
) -> Triangulated:
    """World points from pixels: equations (3)-(6) of the paper, refined in the image, without views that disagree.

    While a view disagrees, that one is left out without which the rest agree best. This takes three viewpoints among
    the rest (see `triangulation.viewpoints`). From three in all one is left out only if the other two agree and no
    other two do, for any two agree where one of them is off along the other's epipolar line. Where this does not end
    in agreement nothing is left out, and `reprojection_px` shows it.

    Args:
        cameras: with one leading axis.
        points_px: (..., cameras, 2); NaN where a camera does not see the point.
        weights: (..., cameras), how much each view counts: its variance is noise_px² / weight, and views of weight 0
            do not count. 1 where not given.
        noise_px: standard deviation of a pixel along either axis, one for all or broadcast to (..., cameras). Detectors
            err by a share of what they see: then it is in proportion to the size of the box, or to 1 / depth.
        robust: leave out views that disagree.
        refine: minimise the reprojection error; if not, the position solves the linear equations with those weights.
        false_alarm: probability, at most, that a point whose views are all right loses one of them.

    Returns:
        Points; NaN where fewer than two cameras see them, all rays are parallel, or they meet behind a camera.

    Raises:
        SettingsError: the noise of a view that counts is not above 0, or `false_alarm` is no probability.
    """
    if not 0 < false_alarm < 1:
        raise SettingsError("false_alarm", expected="a probability", found=f"{false_alarm:g}")
    rows, right, seen = projection_equations(cameras, points_px, _UNBENDINGS if refine else 20)
    scale = _scale(seen, weights, noise_px)
    # From here on one axis of points, and none of those of which nothing can be known.
    known = np.asarray((scale > 0).sum(axis=-1) >= 2)
    lines, scale = _Lines(points_px[known], rows[known], right[known]), scale[known]
    start_m = lines.solved(scale)
    if robust:
        scale, refined_m = _without_the_wrong(cameras, lines, scale, start_m, false_alarm)
        start_m = refined_m if refine else lines.solved(scale)
    fit = fit_in_image(cameras, lines.points_px, scale, start_m, _MAX_STEPS if refine else 0)
    there = np.isfinite(fit.cost)
    known[known] = there
    position_m = _spread(known, fit.position_m[there], np.nan)
    pixels, depth = project(cameras, position_m[..., None, :])
    distance_px = np.linalg.norm(pixels - points_px, axis=-1)
    return Triangulated(
        position_m,
        _spread(known, fit.covariance_m2[there], np.nan),
        np.where(np.isfinite(distance_px) & (depth < NEAR_M), np.inf, distance_px),
        _spread(known, scale[there] > 0, False),
    )


@dataclass(frozen=True)
class _Lines:
    """Pixels, NaN where not seen, and their linear equations, from `projection_equations`."""

    points_px: Float[np.ndarray, "points cameras 2"]
    rows: Float[np.ndarray, "points cameras 2 3"]
    right: Float[np.ndarray, "points cameras 2"]

    def at(self, index: Int[np.ndarray, "chosen"]) -> _Lines:
        """Those of some points."""
        return _Lines(self.points_px[index], self.rows[index], self.right[index])

    def solved(self, scale: Float[np.ndarray, "points cameras"]) -> Float[np.ndarray, "points 3"]:
        """(points, 3), NaN where the views that count do not fix a point."""
        shape = (len(scale), 2 * scale.shape[1])
        rows = (self.rows * scale[..., None, None]).reshape(*shape, 3)
        right = (self.right * scale[..., None]).reshape(shape)
        turned = rows.swapaxes(-1, -2)
        return solve_normal(turned @ rows, np.matvec(turned, right))


def _scale(
    seen: Bool[np.ndarray, "*points cameras"],
    weights: Float[np.ndarray, "*points cameras"] | None,
    noise_px: float | Float[np.ndarray, "..."],
) -> Float[np.ndarray, "*points cameras"]:
    """1 / standard deviation of each view's pixel; 0 where it does not count."""
    noise_px = np.broadcast_to(np.asarray(noise_px, np.float64), seen.shape)
    counts = seen if weights is None else seen & (weights > 0)
    if not (noise_px[counts] > 0).all():
        raise SettingsError("noise_px", expected="numbers above 0", found=f"{noise_px[counts].min():g}")
    scale = np.divide(1.0, noise_px, where=counts, out=np.zeros(seen.shape))
    return scale if weights is None else scale * np.sqrt(np.where(counts, weights, 0.0))


def _spread(known: Bool[np.ndarray, "*points"], values: np.ndarray, otherwise: float | bool) -> np.ndarray:
    """The values where they are known."""
    spread = np.full((*known.shape, *values.shape[1:]), otherwise)
    spread[known] = values
    return spread


def _without_the_wrong(
    cameras: Camera,
    lines: _Lines,
    scale: Float[np.ndarray, "points cameras"],
    start_m: Float[np.ndarray, "points 3"],
    false_alarm: float,
) -> tuple[Float[np.ndarray, "points cameras"], Float[np.ndarray, "points 3"]]:
    """The scale, 0 for views that are left out too, and the points after one step from the linear solution.

    That step is as near as it takes to judge views.
    """
    whole = fit_in_image(cameras, lines.points_px, scale, start_m, 1)
    num_views = (scale > 0).sum(axis=-1)
    pending = np.flatnonzero((num_views >= 3) & ~_agrees(whole, scale, false_alarm))
    if not len(pending):
        return scale, whole.position_m
    spot = viewpoints(cameras)[:, None] == np.arange(len(cameras.K))
    scale, position_m, left = scale.copy(), whole.position_m.copy(), scale[pending]
    while len(pending):
        # For each point a trial per view, as if that were not there.
        point, camera = np.nonzero(left > 0)
        trial = left[point]
        trial[np.arange(len(point)), camera] = 0.0
        tried = lines.at(pending[point])
        fit = fit_in_image(cameras, tried.points_px, trial, tried.solved(trial), 1)
        num_spots = ((trial > 0) @ spot > 0).sum(axis=-1)
        possible = np.isfinite(fit.cost) & (num_spots >= 2)
        good = possible & _agrees(fit, trial, false_alarm)
        order = np.lexsort((np.where(possible, fit.cost, np.inf), point))
        best = order[np.unique(point[order], return_index=True)[1]]
        unrivalled = np.bincount(point, good) == 1
        told = possible[best] & ((num_spots[best] >= 3) | (good[best] & unrivalled))
        done = told & good[best]
        scale[pending[done]] = trial[best[done]]
        position_m[pending[done]] = fit.position_m[best[done]]
        pending, left = pending[told & ~done], trial[best[told & ~done]]
    return scale, position_m


def _agrees(
    fit: ImageFit, scale: Float[np.ndarray, "points cameras"], false_alarm: float
) -> Bool[np.ndarray, "points"]:
    """Whether no view disagrees: each of n right ones does with probability q / n, so any with q at most."""
    gate = -2 * np.log(false_alarm / np.maximum((scale > 0).sum(axis=-1), 1))
    return np.isfinite(fit.cost) & (fit.disagreement <= gate[:, None]).all(axis=-1)
