"""OpenCV's distortion coefficients for lens models that map distorted to undistorted points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

#: Points of the grid along each side of the image.
_GRID = 41
#: Largest error of five coefficients for which the rational model is not tried, pixels.
_EXACT_PX = 0.01


def fit_distortion(
    K: Float[np.ndarray, "3 3"],
    image_size_wh: tuple[int, int],
    centre_px: Float[np.ndarray, "2"],
    radial: Float[np.ndarray, " coefficients"],
) -> tuple[Float[np.ndarray, " opencv"], float] | None:
    """Fit OpenCV's coefficients to the correction r (1 + k1 r² + k2 r⁴ + ...) of distorted points.

    With undistorted points (x, y), OpenCV's distorted points are linear in k1, k2, p1, p2, k3: one linear least-squares
    problem on a grid of pixels. If that leaves more than a hundredth of a pixel, the rational model is fitted, which is
    linear after multiplication by its denominator.

    Args:
        K: intrinsics, pixels.
        image_size_wh: width and height of the images, pixels.
        centre_px: centre of the correction, pixels.
        radial: k1, k2, ...; r is the distance of a distorted point from the centre, in units of the focal length fx.

    Returns:
        5 or 8 coefficients in OpenCV's order and the largest error in the image, pixels; None if the correction is not
        monotone within the image, so that no lens has it.
    """
    width, height = image_size_wh
    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, _GRID), np.linspace(-0.5, height - 0.5, _GRID))
    distorted = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1).reshape(-1, 2)
    centre = np.array([(centre_px[0] - K[0, 2]) / K[0, 0], (centre_px[1] - K[1, 2]) / K[1, 1]])
    arm = distorted - centre
    powers = np.arange(1, len(radial) + 1)
    # A centre far outside of the image has no finite squares.
    with np.errstate(over="ignore", invalid="ignore"):
        r2 = (arm**2).sum(axis=-1)
        gain = 1 + (radial * r2[:, None] ** powers).sum(axis=-1)
        slope = 1 + ((2 * powers + 1) * radial * r2[:, None] ** powers).sum(axis=-1)
    if not (np.isfinite(slope) & (slope > 0)).all():
        return None
    points = centre + arm * gain[:, None]
    fits = [_polynomial(points, distorted)]
    errors = [_largest_error_px(K, points, distorted, fits[0])]
    if errors[0] > _EXACT_PX:
        fits.append(_rational(points, distorted))
        errors.append(_largest_error_px(K, points, distorted, fits[1]))
    best = int(np.argmin(errors))
    return fits[best], errors[best]


def _polynomial(
    points: Float[np.ndarray, "n 2"], distorted: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "5"]:
    """k1, k2, p1, p2, k3."""
    design = np.concatenate([_columns(points, axis) for axis in (0, 1)])
    return _solved(design, (distorted - points).T.ravel())


def _rational(
    points: Float[np.ndarray, "n 2"], distorted: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "8"]:
    """k1, k2, p1, p2, k3, k4, k5, k6."""
    r2 = (points**2).sum(axis=-1)
    below = np.stack([r2, r2**2, r2**3], axis=-1)
    design = np.concatenate(
        [
            np.hstack([_columns(points, axis), -distorted[:, axis : axis + 1] * below])
            for axis in (0, 1)
        ]
    )  # fmt: skip
    return _solved(design, (distorted - points).T.ravel())


def _solved(
    design: Float[np.ndarray, "rows columns"], values: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, " columns"]:
    """The least-squares solution; no distortion where there is none, and the error of the fit is then large."""
    try:
        return np.linalg.lstsq(design, values, rcond=None)[0]
    except np.linalg.LinAlgError:
        return np.zeros(design.shape[1])


def _columns(points: Float[np.ndarray, "n 2"], axis: int) -> Float[np.ndarray, "n 5"]:
    """Derivatives of one distorted coordinate by k1, k2, p1, p2, k3."""
    x, y = points.T
    r2 = x * x + y * y
    along = points[:, axis]
    p1, p2 = (2 * x * y, r2 + 2 * x * x) if axis == 0 else (r2 + 2 * y * y, 2 * x * y)
    return np.stack([along * r2, along * r2**2, p1, p2, along * r2**3], axis=-1)


def _largest_error_px(
    K: Float[np.ndarray, "3 3"],
    points: Float[np.ndarray, "n 2"],
    distorted: Float[np.ndarray, "n 2"],
    dist: Float[np.ndarray, " coefficients"],
) -> float:
    x, y = points.T
    r2 = x * x + y * y
    radial = 1 + r2 * (dist[0] + r2 * (dist[1] + r2 * dist[4]))
    if len(dist) > 5:
        radial = radial / (1 + r2 * (dist[5] + r2 * (dist[6] + r2 * dist[7])))
    bent = points * radial[:, None] + np.stack(
        [2 * dist[2] * x * y + dist[3] * (r2 + 2 * x * x), dist[2] * (r2 + 2 * y * y) + 2 * dist[3] * x * y],
        axis=-1,
    )
    return float(np.linalg.norm((bent - distorted) * K[[0, 1], [0, 1]], axis=-1).max())
