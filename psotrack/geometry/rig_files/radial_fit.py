"""OpenCV's distortion coefficients for lens models that map distorted to undistorted points."""

from __future__ import annotations

import contextlib

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

    Least squares on a grid of pixels: first of k1, k2, p1, p2, k3, and if that leaves more than a hundredth of a pixel,
    of the rational model.

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
    fit = _fitted(K, points, distorted, 5)
    if fit[1] > _EXACT_PX:
        fit = min(fit, _fitted(K, points, distorted, 8), key=lambda each: each[1])
    return fit


def _fitted(
    K: Float[np.ndarray, "3 3"],
    points: Float[np.ndarray, "n 2"],
    distorted: Float[np.ndarray, "n 2"],
    num_coefficients: int,
) -> tuple[Float[np.ndarray, " opencv"], float]:
    """OpenCV's first coefficients by least squares in the image, and their largest error, pixels."""
    from scipy.optimize import least_squares  # takes 0.2 s

    focal_px = K[[0, 1], [0, 1]][:, None]

    def off_px(dist: Float[np.ndarray, " opencv"]) -> Float[np.ndarray, " residuals"]:
        off = np.stack(distort(LensNumbers(dist), *points.T)) - distorted.T
        return (off * focal_px).ravel()

    dist = np.zeros(num_coefficients)
    with contextlib.suppress(ValueError):  # no finite distances: no distortion, whose error is large
        dist = least_squares(off_px, dist, method="lm").x
    return dist, float(np.linalg.norm(off_px(dist).reshape(2, -1), axis=0).max())
