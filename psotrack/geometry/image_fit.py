"""Least squares in the image: points in space whose projections are nearest to pixels, in float64.

Squared distances between pixels and projections, in standard deviations of the pixels, lens included (Hartley &
Zisserman 2004, section 12.3), made small by Levenberg's damped Gauss-Newton steps for all points at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.geometry.cameras import NEAR_M, Camera, distort, to_camera

#: Steps shorter than this, in standard deviations of the point, are the last.
_SETTLED = 1e-4
#: Levenberg's damping at first and at least, as a share of the diagonal; a step that fails makes it this much larger.
_DAMPING, _STIFFER = 1e-9, 1e3
#: A view may have a direction that it alone decides: no covariance, a residual of rounding errors, t of about 0.
_RIDGE = 1e-8

#: Residuals in standard deviations (points, equations), two per camera; their derivative by the position; and their sum
#: of squares (points,), infinite where a point is behind a camera that sees it.
_Image = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class ImageFit:
    """Points fitted to pixels.

    Attributes:
        position_m: (points, 3); NaN where there was no start, or the views that count do not fix a point.
        covariance_m2: (points, 3, 3), (JᵀJ)⁻¹ with J in standard deviations of the pixels; of no meaning without a
            position.
        cost: (points,), sum of squared residuals in standard deviations; infinite where there is no position, and where
            it is behind a camera that counts.
        disagreement: (points, cameras), t = rᵀ S⁻¹ r of each view's residual r. In the fit that r takes part in, r has
            the covariance S = I - J C Jᵀ, so that t is χ² with two degrees of freedom (studentised residuals: Cook &
            Weisberg 1982, section 2.1). 0 for views that do not count.
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
    """Points of least squared distance in the image, near where they start.

    Args:
        cameras: with one leading axis.
        points_px: (points, cameras, 2); what does not count may be NaN.
        scale: (points, cameras), 1 / standard deviation of each view's pixel; 0 for views that do not count.
        start_m: (points, 3), NaN for none.
        num_steps: at most; none makes a point worse. Near the solution two do.
    """
    there = np.isfinite(start_m).all(axis=-1)
    position_m = np.where(there[:, None], start_m, 0.0)
    residual, jacobian, cost = _in_image(cameras, points_px, scale, position_m)
    damping = np.full(len(position_m), _DAMPING)
    for _ in range(num_steps):
        step = _step(residual, jacobian, damping)
        moved = np.matvec(jacobian, step)
        if (np.vecdot(moved, moved) < _SETTLED**2).all():
            break
        tried = _in_image(cameras, points_px, scale, position_m + step)
        better = tried[2] < cost
        damping = np.where(better, _DAMPING, damping * _STIFFER)
        position_m = np.where(better[:, None], position_m + step, position_m)
        residual = np.where(better[:, None], tried[0], residual)
        jacobian = np.where(better[:, None, None], tried[1], jacobian)
        cost = np.where(better, tried[2], cost)
    normal = _normal(jacobian)
    there &= np.linalg.cond(normal) < 1 / np.finfo(float).eps
    covariance_m2 = np.linalg.inv(np.where(there[:, None, None], normal, np.eye(3)))
    return ImageFit(
        np.where(there[:, None], position_m, np.nan),
        covariance_m2,
        np.where(there, cost, np.inf),
        _disagreement(residual, jacobian, covariance_m2),
    )


def project_with_jacobian(
    cameras: Camera, points_world: Float[np.ndarray, "*#points 3"]
) -> tuple[Float[np.ndarray, "*#points 2"], Float[np.ndarray, "*#points"], Float[np.ndarray, "*#points 2 3"]]:
    """Pixels and depth as `cameras.project` has them, and the derivative of the pixels by the world point.

    Args:
        cameras: with leading axes (*batch).
        points_world: (..., 3), metres; for every camera of a rig at every point, pass `points[..., None, :]`.

    Returns:
        (..., 2) pixels, (...) metres, and (..., 2, 3) pixels per metre.
    """
    points_cam = np.asarray(to_camera(cameras, points_world))
    depth = points_cam[..., 2]
    z = np.maximum(depth, NEAR_M)
    x, y = points_cam[..., 0] / z, points_cam[..., 1] / z
    bent_x, bent_y = distort(cameras, x, y)
    K, R = cameras.K, cameras.T_cam_world[..., :3, :3]
    u = K[..., 0, 0] * bent_x + K[..., 0, 1] * bent_y + K[..., 0, 2]
    v = K[..., 1, 1] * bent_y + K[..., 1, 2]
    # d(x, y) / d world = (r1 - x r3, r2 - y r3) / z: the rows of the linear equations.
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
    """Of `cameras.distort` by x and y, each (..., 1): ((x by x, x by y), (y by x, y by y))."""
    coefficients = cameras.dist.shape[-1]
    if coefficients == 0:
        return (np.ones(1), np.zeros(1)), (np.zeros(1), np.ones(1))
    k = np.zeros((8, *cameras.dist.shape[:-1]))
    k[:coefficients] = np.moveaxis(np.asarray(cameras.dist), -1, 0)
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    r2 = x * x + y * y
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
    # By r²; that of r² by x is 2 x.
    slope = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / below
    xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    xy = 2 * (x * y * slope + p1 * x + p2 * y)
    return (xx[..., None], xy[..., None]), (xy[..., None], yy[..., None])


def _step(
    residual: Float[np.ndarray, "points equations"],
    jacobian: Float[np.ndarray, "points equations 3"],
    damping: Float[np.ndarray, "points"],
) -> Float[np.ndarray, "points 3"]:
    """Of Gauss and Newton, with Levenberg's damping."""
    normal = _normal(jacobian)
    # A little more, because a point that no view fixes has a diagonal of zeros.
    stiff = damping[:, None] * (normal.diagonal(axis1=-2, axis2=-1) + 1e-12)
    damped = normal + stiff[..., None] * np.eye(3)
    return -np.linalg.solve(damped, np.matvec(jacobian.swapaxes(-1, -2), residual)[..., None])[..., 0]


def _in_image(
    cameras: Camera,
    points_px: Float[np.ndarray, "points cameras 2"],
    scale: Float[np.ndarray, "points cameras"],
    position_m: Float[np.ndarray, "points 3"],
) -> _Image:
    pixels, depth, jacobian = project_with_jacobian(cameras, position_m[:, None, :])
    counts = scale > 0
    residual = np.where(counts[..., None], (pixels - points_px) * scale[..., None], 0.0)
    residual = residual.reshape(len(scale), 2 * scale.shape[1])
    behind = ((depth < NEAR_M) & counts).any(axis=-1)
    cost = np.where(behind, np.inf, np.vecdot(residual, residual))
    return residual, (jacobian * scale[..., None, None]).reshape(*residual.shape, 3), cost


def _disagreement(
    residual: Float[np.ndarray, "points equations"],
    jacobian: Float[np.ndarray, "points equations 3"],
    covariance_m2: Float[np.ndarray, "points 3 3"],
) -> Float[np.ndarray, "points cameras"]:
    """rᵀ S⁻¹ r of each view's two residuals r, of covariance S = I - J C Jᵀ in standard deviations."""
    r = residual.reshape(len(residual), residual.shape[1] // 2, 2)
    J = jacobian.reshape(*r.shape, 3)
    JC = (jacobian @ covariance_m2).reshape(J.shape)
    xx = 1 + _RIDGE - np.vecdot(JC[..., 0, :], J[..., 0, :])
    yy = 1 + _RIDGE - np.vecdot(JC[..., 1, :], J[..., 1, :])
    xy = -np.vecdot(JC[..., 0, :], J[..., 1, :])
    x, y = r[..., 0], r[..., 1]
    return (yy * x * x - 2 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)


def _normal(jacobian: Float[np.ndarray, "points equations 3"]) -> Float[np.ndarray, "points 3 3"]:
    return jacobian.swapaxes(-1, -2) @ jacobian
