"""Points in space whose projections are nearest to given pixels: least squares in the image, in float64.

The cost of a point is the sum of squared distances between pixels and projections, in standard deviations of the
pixels, lens included (Hartley & Zisserman 2004, section 12.3). All points are fitted at once, as a batch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from psotrack.estimation import Damping, NormalEquations, Step, levenberg_marquardt
from psotrack.geometry.cameras import NEAR_M, Camera, distort, to_camera

#: A step shorter than this is not taken, standard deviations of the point.
_LEAST_LENGTH = 1e-4
#: Two steps suffice near the solution, so the damping is nearly 0 and returns to that value after each success. A step
#: that fails must be damped much more.
_DAMPING = Damping(first=1e-9, least=1e-9, largest=np.inf, increase=1e3, decrease=0.0)
#: Added to the variances of a residual. If one view alone determines a direction, its residual there has no variance.
_RIDGE = 1e-8


@dataclass(frozen=True)
class ImageFit:
    """Points fitted to pixels.

    Attributes:
        position_m: (points, 3), world, metres; NaN without a start, and where the used views do not fix the point.
        covariance_m2: (points, 3, 3), (JᵀJ)⁻¹ with J in standard deviations of the pixels, m²; meaningless where the
            position is NaN.
        cost: (points,), sum of squared residuals in standard deviations; infinite where the position is NaN or behind
            a used camera.
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
    start = _linearise(_Views(cameras, points_px, scale), np.where(has_start[:, None], start_m, 0.0))
    fit = levenberg_marquardt(start, max_steps=num_steps, least_length=_LEAST_LENGTH, damping=_DAMPING)
    information = fit.information
    is_fixed = has_start & (np.linalg.cond(information) < 1 / np.finfo(float).eps)
    covariance_m2 = np.linalg.inv(np.where(is_fixed[:, None, None], information, np.eye(3)))
    return ImageFit(
        np.where(is_fixed[:, None], fit.position_m, np.nan),
        covariance_m2,
        np.where(is_fixed, fit.cost, np.inf),
        _disagreement(fit.residual, fit.jacobian, covariance_m2),
    )


@dataclass(frozen=True)
class _Views:
    """Pixels of all points in all cameras; attributes as in `fit_in_image`."""

    cameras: Camera
    points_px: Float[np.ndarray, "points cameras 2"]
    scale: Float[np.ndarray, "points cameras"]


@dataclass(frozen=True)
class _Points:
    """Points with their residuals, `estimation.least_squares.Linearised`.

    Attributes:
        views: the pixels.
        position_m: (points, 3), world, metres.
        residual: (points, equations), measured minus projected in standard deviations, two equations per camera.
        jacobian: (points, equations, 3), derivatives of the projections by the position.
        cost: (points,), sums of squared residuals; infinite where a point is behind a used camera.
    """

    views: _Views
    position_m: Float[np.ndarray, "points 3"]
    residual: Float[np.ndarray, "points equations"]
    jacobian: Float[np.ndarray, "points equations 3"]
    cost: Float[np.ndarray, "points"]

    @cached_property
    def information(self) -> Float[np.ndarray, "points 3 3"]:
        """(points, 3, 3), inverse covariances of the positions, m⁻²."""
        return self.jacobian.swapaxes(-1, -2) @ self.jacobian

    def equations(self) -> NormalEquations:
        return NormalEquations(self.information, np.matvec(self.jacobian.swapaxes(-1, -2), self.residual))

    def moved(self, step: Step) -> _Points:
        return _linearise(self.views, self.position_m + step.shared)


def _linearise(views: _Views, position_m: Float[np.ndarray, "points 3"]) -> _Points:
    pixels, depth, jacobian = project_with_jacobian(views.cameras, position_m[:, None, :])
    scale = views.scale
    is_used = scale > 0
    residual = np.where(is_used[..., None], (views.points_px - pixels) * scale[..., None], 0.0)
    residual = residual.reshape(len(scale), 2 * scale.shape[1])
    is_behind = ((depth < NEAR_M) & is_used).any(axis=-1)
    cost = np.where(is_behind, np.inf, np.vecdot(residual, residual))
    jacobian = (jacobian * scale[..., None, None]).reshape(*residual.shape, 3)
    return _Points(views, position_m, residual, jacobian, cost)


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
    depth = points_cam[..., 2]
    z = np.maximum(depth, NEAR_M)
    x, y = points_cam[..., 0] / z, points_cam[..., 1] / z
    bent_x, bent_y = distort(cameras, x, y)
    K, R = cameras.K, cameras.T_cam_world[..., :3, :3]
    u = K[..., 0, 0] * bent_x + K[..., 0, 1] * bent_y + K[..., 0, 2]
    v = K[..., 1, 1] * bent_y + K[..., 1, 2]
    # d(x, y) / d world = (r1 - x r3, r2 - y r3) / z, with the rows r1, r2, r3 of the rotation.
    x_by_world = (R[..., 0, :] - x[..., None] * R[..., 2, :]) / z[..., None]
    y_by_world = (R[..., 1, :] - y[..., None] * R[..., 2, :]) / z[..., None]
    (xx, xy), (yx, yy) = _lens_derivative(cameras, x, y)
    bent_x_by_world = xx * x_by_world + xy * y_by_world
    bent_y_by_world = yx * x_by_world + yy * y_by_world
    u_by_world = K[..., 0, 0, None] * bent_x_by_world + K[..., 0, 1, None] * bent_y_by_world
    v_by_world = K[..., 1, 1, None] * bent_y_by_world
    return np.stack([u, v], axis=-1), depth, np.stack([u_by_world, v_by_world], axis=-2)


def _lens_derivative(
    cameras: Camera, x: Float[np.ndarray, "*#points"], y: Float[np.ndarray, "*#points"]
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Derivatives of `cameras.distort`, each (..., 1): ((x by x, x by y), (y by x, y by y))."""
    coefficients = cameras.dist.shape[-1]
    if coefficients == 0:
        return (np.ones(1), np.zeros(1)), (np.zeros(1), np.ones(1))
    k = np.zeros((8, *cameras.dist.shape[:-1]))
    k[:coefficients] = np.moveaxis(np.asarray(cameras.dist), -1, 0)
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    r2 = x * x + y * y
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
    # The derivative of `radial` by r²; the derivative of r² by x is 2 x.
    slope = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / below
    xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    xy = 2 * (x * y * slope + p1 * x + p2 * y)
    return (xx[..., None], xy[..., None]), (xy[..., None], yy[..., None])


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
