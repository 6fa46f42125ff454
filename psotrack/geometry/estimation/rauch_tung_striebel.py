"""One step of the backward pass of a Rauch-Tung-Striebel smoother, for NumPy and for JAX.

H. E. Rauch, F. Tung, C. T. Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3(8), 1965.
A smoother runs its Kalman filter over all frames, and then calls `backward_step` from the last frame to the first.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from psotrack.support.array_types import Array


def backward_step(
    covariance: Float[Array, "*batch n n"],
    transition: Float[Array, "*batch n n"],
    process_noise: Float[Array, "*batch n n"],
    predicted_covariance: Float[Array, "*batch n n"],
    later_covariance: Float[Array, "*batch n n"],
    deviation: Float[Array, "*batch n columns"],
) -> tuple[Float[Array, "*batch n columns"], Float[Array, "*batch n n"]]:
    """Correct one filtered frame by the smoothed frame after it.

    A state on a manifold passes deviations in the tangent space of the predicted state, and `later_covariance` in the
    same space; the change that comes back is in the tangent space of the filtered state.

    Args:
        covariance: (..., n, n), covariance P of the filtered state of this frame.
        transition: (..., n, n), matrix F from this frame to the next one.
        process_noise: (..., n, n), covariance Q that the transition adds.
        predicted_covariance: (..., n, n), F P Fᵀ + Q, covariance of the next frame as predicted from this one. A
            component of variance 0 is known exactly: it takes no part and is not corrected.
        later_covariance: (..., n, n), covariance of the smoothed state of the next frame.
        deviation: (..., n, columns), smoothed minus predicted state of the next frame. Further columns are other
            quantities that the same gain corrects.

    Returns:
        (..., n, columns), what to add to the filtered state; and (..., n, n), the smoothed covariance.
    """
    xp = np if isinstance(covariance, np.ndarray) else jnp
    identity = xp.eye(covariance.shape[-1])
    # The gain P Fᵀ P_predicted⁻¹ is solved for in units of the standard deviations, so that metres and m/s² have the
    # same weight. A 1 on the diagonal decouples a component that has no variance.
    variance = xp.diagonal(predicted_covariance, axis1=-2, axis2=-1)
    is_known = variance == 0
    unit = xp.sqrt(xp.where(is_known, 1.0, variance))[..., None]
    correlation = predicted_covariance / (unit * unit.swapaxes(-1, -2))
    correlation = correlation + xp.where(is_known[..., None], identity, 0.0)
    gain = (xp.linalg.solve(correlation, (transition @ covariance) / unit) / unit).swapaxes(-1, -2)
    # P + G (P_later - P_predicted) Gᵀ is a difference, which rounding makes negative after many frames. This is a sum.
    kept = identity - gain @ transition
    added = process_noise + later_covariance
    smoothed = kept @ covariance @ kept.swapaxes(-1, -2) + gain @ added @ gain.swapaxes(-1, -2)
    return gain @ deviation, (smoothed + smoothed.swapaxes(-1, -2)) / 2
