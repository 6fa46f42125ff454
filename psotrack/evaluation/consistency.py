"""Consistency of an estimate: its covariances compared with its errors.

Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4.2
(NEES, the normalised estimation error squared).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.special import gammaincinv

from psotrack.errors import InputError
from psotrack.evaluation.records import Consistency

#: The chi-square distribution with 3 degrees of freedom is below this with probability 0.9.
INSIDE_90 = 2.0 * float(gammaincinv(3 / 2, 0.9))


def consistency(
    residual_m: Float[np.ndarray, "frames drones 3"],
    centred_m: Float[np.ndarray, "frames drones 3"],
    covariance_m2: Float[np.ndarray, "frames drones 3 3"],
    relative_covariance_m2: Float[np.ndarray, "frames drones 3 3"] | None = None,
) -> Consistency:
    """Share of reference positions inside the estimate's 90 % ellipsoid, and mean NEES, over frames and drones.

    NEES is r^T C^-1 r with the residual r and its covariance C. For Gaussian errors with covariance C, NEES has a
    chi-square distribution with 3 degrees of freedom: the mean is 3, and 90 % of the values are below `INSIDE_90`.

    Args:
        residual_m: (frames, drones, 3), estimate minus reference, NaN where either is not known.
        centred_m: (frames, drones, 3), residuals minus each drone's mean residual.
        covariance_m2: (frames, drones, 3, 3), covariances of the estimates in the world; NaN where not known.
        relative_covariance_m2: (frames, drones, 3, 3), covariances of the centred residuals, known where
            `covariance_m2` is; None: the same.

    Raises:
        InputError: a covariance is not positive definite.
    """
    known = np.isfinite(residual_m).all(axis=-1) & np.isfinite(covariance_m2).all(axis=(-2, -1))
    if not known.any():
        return Consistency(None, None, None, None)
    relative_m2 = (covariance_m2 if relative_covariance_m2 is None else relative_covariance_m2)[known]
    smallest_m2 = np.linalg.eigvalsh([covariance_m2[known], relative_m2])[..., 0].min()
    if not smallest_m2 > 0:
        raise InputError(
            "estimate",
            expected="covariances that are positive definite",
            found=f"one whose smallest eigenvalue is {smallest_m2:.3g} m2",
            remedy="leave a covariance empty (NaN) where it is not known",
        )
    raw, centred = _nees(residual_m[known], covariance_m2[known]), _nees(centred_m[known], relative_m2)
    return Consistency(
        inside_90_rate=float(np.mean(raw <= INSIDE_90)),
        mean_nees=float(raw.mean()),
        offset_removed_inside_90_rate=float(np.mean(centred <= INSIDE_90)),
        offset_removed_mean_nees=float(centred.mean()),
    )


def _nees(
    residual_m: Float[np.ndarray, "points 3"], covariance_m2: Float[np.ndarray, "points 3 3"]
) -> Float[np.ndarray, "points"]:
    return np.einsum("ni,ni->n", residual_m, np.linalg.solve(covariance_m2, residual_m[..., None])[..., 0])
