"""How large the errors of corners and of markers' places are in a recording, from the residuals of its frames.

A single frame has few markers, so the frames of a recording are counted together. Both variances are chosen so that the
weighted squares of the residuals are as large as their covariances let expect (estimation of variance components:
W. Förstner, Ein Verfahren zur Schätzung von Varianz- und Kovarianzkomponenten, Allgemeine Vermessungs-Nachrichten 86,
1979). Residuals do not show all errors: a shift of all corners in the image looks like a turn of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from psotrack.inside_out.pose.equations import Equations
from psotrack.inside_out.pose.records import CornerNoise

#: Weight of the variances before, as a number of residuals.
_PRIOR_RESIDUALS = 10.0
#: Number of estimates, each with the covariances by the one before. Smallest and largest deviations.
_TURNS = 20
_LEAST, _MOST = CornerNoise(0.1, 1e-5), CornerNoise(30.0, 0.05)


def estimate_noise(frames: Sequence[Equations], noise: CornerNoise) -> CornerNoise:
    """The errors by the residuals of frames.

    Args:
        frames: equations of frames at their poses.
        noise: errors with which the poses were estimated.
    """
    frames = [one for one in frames if one.fits.sum() > 4]
    factor = np.array([1.0, noise.place_m**2])
    for _ in range(_TURNS):
        sums = np.full((2, 2), _PRIOR_RESIDUALS)
        for one in frames:
            sums += _observed_and_expected(replace(one, variances=(factor[0], factor[1], one.variances[2])))
        factor = factor * sums[0] / sums[1]
        least = (_LEAST.scale / noise.scale) ** 2, _LEAST.place_m**2
        most = (_MOST.scale / noise.scale) ** 2, _MOST.place_m**2
        factor = np.clip(factor, least, most)
    own, place_m = np.sqrt(factor)
    return replace(noise, scale=float(noise.scale * own), place_m=float(place_m))


def _observed_and_expected(frame: Equations) -> Float[np.ndarray, "2 2"]:
    """Weighted squares of a frame's residuals by the corners' own errors and by the places; and their expectations."""
    try:
        step, covariance = frame.solved(np.zeros(2))
    except np.linalg.LinAlgError:
        return np.zeros((2, 2))
    weight = frame.weight
    weighted = (weight @ (frame.residual_px - frame.slopes @ step)[..., None])[..., 0]
    by_unknowns = weight @ frame.slopes
    left = weight - by_unknowns @ covariance @ by_unknowns.swapaxes(1, 2)
    own, place_m2, _ = frame.variances
    parts = own * frame.own, place_m2 * frame.by_place
    observed = [float(np.einsum("mi,mij,mj->", weighted, part, weighted)) for part in parts]
    expected = [float(np.einsum("mij,mji->", left, part)) for part in parts]
    return np.array([observed, expected])
