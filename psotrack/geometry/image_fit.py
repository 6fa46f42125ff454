"""Points in space whose projections are nearest to given pixels: least squares in the image, in float64.

The cost of a point is the sum of squared distances between pixels and projections, in standard deviations of the
pixels, lens included (Hartley & Zisserman 2004, section 12.3). All points are fitted at once, as a batch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from psotrack.geometry.cameras import NEAR_M, Camera, has_image, to_camera
from psotrack.geometry.lenses import distort, lens_derivative

#: A step shorter than this is not taken, standard deviations of the point.
_LEAST_LENGTH = 1e-4
#: Damping, as a share of the diagonal of the normal equations, to which a small number is added. Two steps suffice near
#: the solution, so the damping is nearly 0 and returns to that value after each success. A step that fails must be
#: damped much more: by this factor.
_LEAST_DAMPING, _MORE_DAMPING, _TINY = 1e-9, 1e3, 1e-12
#: Added to the variances of a residual. If one view alone determines a direction, its residual there has no variance.
_RIDGE = 1e-8


@dataclass(frozen=True)
class ImageFit:
    """Points fitted to pixels.

    Attributes:
        position_m: (points, 3), world, metres; NaN without a start, and where the used views do not fix the point.
        covariance_m2: (points, 3, 3), (JᵀJ)⁻¹ with J in standard deviations of the pixels, m²; meaningless where the
            position is NaN.
        cost: (points,), sum of squared residuals in standard deviations; infinite where the position is NaN, or
            where a used camera cannot show it.
        disagreement: (points, cameras), t = rᵀ S⁻¹ r of each view's residual r, where S = I - J C Jᵀ is the covariance
            of r in the fit with covariance C. t is χ² with two degrees of freedom (studentised residuals: Cook &
            Weisberg 1982, section 2.1). 0 for unused views.
    """

    position_m: Float[np.ndarray, "points 3"]
    covariance_m2: Float[np.ndarray, "points 3 3"]
    cost: Float[np.ndarray, "points"]
    disagreement: Float[np.ndarray, "points cameras"]


def fit_in_image(
    cameras: Camera,
    points_px: Float[np.ndarray, "points cameras 2"],
    scale: Float[np.ndarray, "points cameras"],
    start_m: Float[np.ndarray, "points 3"],
    num_steps: int,
) -> ImageFit:
    """Find the points of least squared distance in the image, near their starts.

    Args:
        cameras: cameras with one leading axis.
        points_px: (points, cameras, 2), pixels; unused views may be NaN.
        scale: (points, cameras), 1 / standard deviation of each view's pixel; 0 for unused views.
        start_m: (points, 3), world, metres; NaN for a point without a start.
        num_steps: largest number of steps; no step makes a point worse. Two suffice near the solution.
    """
    has_start = np.isfinite(start_m).all(axis=-1)
    fit = _linearise(cameras, points_px, scale, np.where(has_start[:, None], start_m, 0.0))
    damping = np.full(len(fit.cost), _LEAST_DAMPING)
    for _ in range(num_steps):
        information, right = fit.information, np.matvec(fit.jacobian.swapaxes(-1, -2), fit.residual)
        stiffness = damping[:, None] * (information.diagonal(axis1=-2, axis2=-1) + _TINY)
        damped = information + stiffness[..., None] * np.eye(3)
        step_m = np.linalg.solve(damped, right[..., None])[..., 0]
        if (np.vecdot(step_m, np.matvec(information, step_m)) < _LEAST_LENGTH**2).all():
            break
        tried = _linearise(cameras, points_px, scale, fit.position_m + step_m)
        better = tried.cost < fit.cost
        damping = np.where(better, _LEAST_DAMPING, damping * _MORE_DAMPING)
        fit = _Fit(
            *(
                np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                for new, old in zip(tried, fit, strict=True)
            )
        )
    information = fit.information
    is_fixed = has_start & (np.linalg.cond(information) < 1 / np.finfo(float).eps)
    covariance_m2 = np.linalg.inv(np.where(is_fixed[:, None, None], information, np.eye(3)))
    return ImageFit(
        np.where(is_fixed[:, None], fit.position_m, np.nan),
        covariance_m2,
        np.where(is_fixed, fit.cost, np.inf),
        _disagreement(fit.residual, fit.jacobian, covariance_m2),
    )


class _Fit(NamedTuple):
    """Points with their residuals.

    Attributes:
        position_m: (points, 3), world, metres.
        residual: (points, equations), measured minus projected in standard deviations, two equations per camera.
        jacobian: (points, equations, 3), derivatives of the projections by the position.
        cost: (points,), sums of squared residuals; infinite where a used camera cannot show a point.
    """

    position_m: Float[np.ndarray, "points 3"]
    residual: Float[np.ndarray, "points equations"]
    jacobian: Float[np.ndarray, "points equations 3"]
    cost: Float[np.ndarray, "points"]

    @property
    def information(self) -> Float[np.ndarray, "points 3 3"]:
        """(points, 3, 3), inverse covariances of the positions, m⁻²."""
        return self.jacobian.swapaxes(-1, -2) @ self.jacobian


def _linearise(
    cameras: Camera,
    points_px: Float[np.ndarray, "points cameras 2"],
    scale: Float[np.ndarray, "points cameras"],
    position_m: Float[np.ndarray, "points 3"],
) -> _Fit:
    pixels, depth, jacobian = project_with_jacobian(cameras, position_m[:, None, :])
    is_used = scale > 0
    is_shown = depth >= NEAR_M
    if cameras.dist.shape[-1]:
        is_shown = np.asarray(has_image(cameras, to_camera(cameras, position_m[:, None, :])))
    residual = np.where(is_used[..., None], (points_px - pixels) * scale[..., None], 0.0)
    residual = residual.reshape(len(scale), 2 * scale.shape[1])
    is_hidden = (is_used & ~is_shown).any(axis=-1)
    cost = np.where(is_hidden, np.inf, np.vecdot(residual, residual))
    return _Fit(position_m, residual, (jacobian * scale[..., None, None]).reshape(*residual.shape, 3), cost)


def project_with_jacobian(
    cameras: Camera, points_world: Float[np.ndarray, "*#points 3"]
) -> tuple[Float[np.ndarray, "*#points 2"], Float[np.ndarray, "*#points"], Float[np.ndarray, "*#points 2 3"]]:
    """Project points, and differentiate the pixels by the points.

    Args:
        cameras: cameras with leading axes (*batch).
        points_world: (..., 3), metres; pass `points[..., None, :]` for every camera of a rig at every point.

    Returns:
        (..., 2), pixels as in `cameras.project`; (...), depths, metres; and (..., 2, 3), derivatives, pixels per metre.
    """
    points_cam = np.asarray(to_camera(cameras, points_world))
    pixels, jacobian = _differentiate(cameras, points_cam, np.asarray(cameras.T_cam_world)[..., :3, :3])
    return pixels, points_cam[..., 2], jacobian


def to_pixels_with_jacobian(
    lens: Camera, points_cam: Float[np.ndarray, "*#points 3"]
) -> tuple[Float[np.ndarray, "*#points 2"], Float[np.ndarray, "*#points 2 3"]]:
    """Pixels of points in camera coordinates, and their derivatives by these coordinates, for adjustments of poses.

    Args:
        lens: cameras with leading axes (*batch); their poses are not used.
        points_cam: (..., 3), metres.
    """
    return _differentiate(lens, points_cam, np.eye(3))


def _differentiate(
    cameras: Camera, points_cam: Float[np.ndarray, "*#points 3"], R: Float[np.ndarray, "*#cameras 3 3"]
) -> tuple[Float[np.ndarray, "*#points 2"], Float[np.ndarray, "*#points 2 3"]]:
    """Pixels, and their derivatives by points whose coordinates R turns into those of the camera."""
    z = np.maximum(points_cam[..., 2:], NEAR_M)
    bent = points_cam[..., :2] / z
    # d(x, y) / d world = (r1 - x r3, r2 - y r3) / z, with the rows r1, r2, r3 of the rotation.
    by_world = (R[..., :2, :] - bent[..., None] * R[..., 2:, :]) / z[..., None]
    if cameras.dist.shape[-1]:
        x, y = bent[..., 0], bent[..., 1]
        xx, xy, yx, yy = (slope[..., None] for slope in lens_derivative(cameras, x, y))
        x_by_world, y_by_world = by_world[..., 0, :], by_world[..., 1, :]
        by_world = np.stack([xx * x_by_world + xy * y_by_world, yx * x_by_world + yy * y_by_world], axis=-2)
        bent = np.stack(distort(cameras, x, y), axis=-1)
    focal_px, skew_px = np.diagonal(cameras.K, axis1=-2, axis2=-1)[..., :2], cameras.K[..., 0, 1]
    pixels, pixels_by_world = focal_px * bent, focal_px[..., None] * by_world
    pixels[..., 0] += skew_px * bent[..., 1]
    pixels_by_world[..., 0, :] += skew_px[..., None] * by_world[..., 1, :]
    return pixels + cameras.K[..., :2, 2], pixels_by_world


def _disagreement(
    residual: Float[np.ndarray, "points equations"],
    jacobian: Float[np.ndarray, "points equations 3"],
    covariance_m2: Float[np.ndarray, "points 3 3"],
) -> Float[np.ndarray, "points cameras"]:
    """(points, cameras), rᵀ S⁻¹ r of each view's two residuals r with covariance S = I - J C Jᵀ."""
    r = residual.reshape(len(residual), residual.shape[1] // 2, 2)
    J = jacobian.reshape(*r.shape, 3)
    JC = (jacobian @ covariance_m2).reshape(J.shape)
    xx = 1 + _RIDGE - np.vecdot(JC[..., 0, :], J[..., 0, :])
    yy = 1 + _RIDGE - np.vecdot(JC[..., 1, :], J[..., 1, :])
    xy = -np.vecdot(JC[..., 0, :], J[..., 1, :])
    x, y = r[..., 0], r[..., 1]
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
