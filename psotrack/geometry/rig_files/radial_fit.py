"""OpenCV's distortion coefficients for lens models that map distorted to undistorted points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.geometry import LensNumbers, distort

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
    fit = _fitted(K, points, distorted, rational=False)
    if fit[1] > _EXACT_PX:
        fit = min(fit, _fitted(K, points, distorted, rational=True), key=lambda each: each[1])
    return fit


def _fitted(
    K: Float[np.ndarray, "3 3"],
    points: Float[np.ndarray, "n 2"],
    distorted: Float[np.ndarray, "n 2"],
    *,
    rational: bool,
) -> tuple[Float[np.ndarray, " opencv"], float]:
    """k1, k2, p1, p2, k3 by least squares, and of the rational model k4, k5, k6; and the largest error, pixels."""
    x, y = points.T
    r2 = x * x + y * y
    powers = np.stack([r2, r2**2, r2**3], axis=-1)
    tangential = ((2 * x * y, r2 + 2 * x * x), (r2 + 2 * y * y, 2 * x * y))
    design = []
    for axis in (0, 1):
        radial = points[:, axis : axis + 1] * powers
        below = [-distorted[:, axis : axis + 1] * powers] if rational else []
        design.append(np.hstack([radial[:, :2], np.column_stack(tangential[axis]), radial[:, 2:], *below]))
    try:
        dist = np.linalg.lstsq(np.concatenate(design), (distorted - points).T.ravel(), rcond=None)[0]
    except np.linalg.LinAlgError:
        # No distortion, whose error is large.
        dist = np.zeros(8 if rational else 5)
    off = np.stack(distort(LensNumbers(dist), x, y), axis=-1) - distorted
    return dist, float(np.linalg.norm(off * K[[0, 1], [0, 1]], axis=-1).max())
