"""Errors that a camera has during the whole recording: it is turned, and its clock is off.

Each camera's three small turns and its clock are fitted to the residuals of all frames together, with the positions
eliminated. The fit is not used to correct anything: how large the fitted values are, beyond what noise explains, shows
the variances of turns and clocks (empirical Bayes; B. Efron, C. Morris, Journal of the American Statistical Association
68, 1973). With the sum of scores g, its derivative A and an inflation f of the noise, because errors of neighbouring
frames are correlated,

    g ~ N(0, f A + s_turn² A_turn A_turnᵀ + s_clock² A_clock A_clockᵀ),

where A_turn and A_clock are columns of A. The two variances are those of the largest likelihood, found as in
`variance_components`.

Few cameras show few turns, so a variance is itself uncertain, with as many degrees of freedom as its Fisher information
says (F. E. Satterthwaite, Biometrics Bulletin 2(6), 1946), and a turn that no residual shows has Student's t
distribution. Its wide variance is the one whose 90 % ellipsoid contains 90 % of that distribution.

Only errors that no residual shows need it, such as what all clocks are late by. The size of an error that the residuals
do show is known, since the errors that they show are the errors that move the positions. With D and W the diagonal
matrices of likeliest and wide variances, and Q the part of W that remains after the residuals, so that its eigenvalues
are 0 for combinations that are seen and 1 for combinations that are not, the covariance is

    D + (W - D)^1/2 Q (W - D)^1/2,    Q = W^-1/2 (W⁻¹ + A / f)⁻¹ W^-1/2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import eigh  # NumPy's waits long for threads of BLAS where processors are shared
from scipy.special import fdtri, gammaincinv

from psotrack.tracking.camera_errors.variance_components import FittedPlaces, weighted_residuals

#: Largest number of steps of the maximisation, which ends when the variances, in units of the noise, change by less
#: than this fraction.
_NUM_STEPS, _SETTLED = 200, 1e-5
#: Directions of less information than this fraction of the largest are not determined.
_LEAST_INFORMATION = 1e-7
#: Probability of the ellipsoid for which the wide variances hold, and its squared radius in standard deviations.
_PROBABILITY = 0.9
_RADIUS2 = 2 * float(gammaincinv(3 / 2, _PROBABILITY))


@dataclass(frozen=True)
class ConstantErrors:
    """Turns and clocks of the cameras.

    Attributes:
        turn_rad: (cameras, 3), turns about the cameras' own axes as the residuals show them, radians.
        clock_s: (cameras,), how late each camera's clock shows a drone, relative to the others, seconds.
        turn_std_rad: standard deviation of a turn about one axis, radians.
        clock_std_s: standard deviation of a clock, seconds.
        covariance: (4 cameras, 4 cameras), of turns about x, y and z, radians, and clock, seconds, camera by camera;
            larger where residuals show little.
    """

    turn_rad: Float[np.ndarray, "cameras 3"]
    clock_s: Float[np.ndarray, "cameras"]
    turn_std_rad: float
    clock_std_s: float
    covariance: Float[np.ndarray, "all all"]


def fit_constant_errors(
    places: FittedPlaces,
    turn_px: Float[np.ndarray, "rows cameras 2 3"],
    flow_px_s: Float[np.ndarray, "rows cameras 2"],
    noise_px: Float[np.ndarray, "cameras 2"],
    inflation: float,
) -> ConstantErrors:
    """Fit turns and clocks.

    Args:
        places: residuals and derivatives; all rows are determined.
        turn_px: (rows, cameras, 2, 3), derivatives of the projections by turns, pixels per radian.
        flow_px_s: (rows, cameras, 2), velocities in the images, pixels per second.
        noise_px: (cameras, 2), standard deviations of the noise along columns and rows, pixels.
        inflation: how much more the variance of a sum over frames is than of independent noise.
    """
    num_cameras = places.shown.shape[1]
    weight = np.where(places.shown[..., None], np.square(1 / noise_px), 0.0)
    left, weighted, inverse = weighted_residuals(places, weight)
    # Four parameters for each camera: three turns and the clock. A late clock shows the drone where it was.
    design = np.concatenate([turn_px, -flow_px_s[..., None]], axis=-1) * (weight > 0)[..., None]
    own = np.einsum("rci,rcip,rciq->cpq", weight, design, design)
    crossed = np.einsum("rcik,rcip->rcpk", weighted, design).reshape(len(weight), 4 * num_cameras, 3)
    # All rows together as one product of matrices; not by BLAS, whose threads wait long where processors are shared.
    solved, crossed = (of.swapaxes(0, 1).reshape(4 * num_cameras, -1) for of in (crossed @ inverse, crossed))
    information = -np.einsum("am,bm->ab", solved, crossed)
    for camera in range(num_cameras):
        part = slice(4 * camera, 4 * camera + 4)
        information[part, part] += own[camera]
    score = np.einsum("rcip,rci->cp", design, left).ravel()
    # Units in which turns and clocks are alike: their mean information is 1.
    kinds = np.arange(len(score)) % 4 == 3
    mean = np.where(kinds, *(np.diag(information)[which].mean() for which in (kinds, ~kinds)))
    unit = 1 / np.sqrt(np.where(mean > 0, mean, 1.0))
    information, score = information * np.outer(unit, unit), score * unit
    values, vectors = eigh(information)
    kept = values > _LEAST_INFORMATION * max(values[-1], np.finfo(float).tiny)
    values, vectors = values[kept], vectors[:, kept]
    # Directions and columns of A in units of the noise.
    noise = np.sqrt(inflation * values)
    seen = vectors.T @ score / noise
    columns = (values / noise)[:, None] * vectors.T
    parts = np.stack([columns[:, which] @ columns[:, which].T for which in (~kinds, kinds)])
    variances = _likeliest(seen, parts)
    inverse_total = np.linalg.inv(_total(parts, variances))
    likeliest, wide = (
        each[kinds.astype(int)] for each in (variances, _wide(inverse_total, parts, variances))
    )
    fitted = (likeliest * (columns.T @ inverse_total @ seen) * unit).reshape(num_cameras, 4)
    deviation = np.sqrt(likeliest[[0, 3]]) * unit[[0, 3]]
    return ConstantErrors(
        turn_rad=fitted[:, :3],
        clock_s=fitted[:, 3],
        turn_std_rad=float(deviation[0]),
        clock_std_s=float(deviation[1]),
        covariance=_covariance(information / inflation, likeliest, wide) * np.outer(unit, unit),
    )


def _covariance(
    information: Float[np.ndarray, "all all"],
    likeliest: Float[np.ndarray, "all"],
    wide: Float[np.ndarray, "all"],
) -> Float[np.ndarray, "all all"]:
    """Covariance of turns and clocks from their likeliest and wide variances and the information about them."""
    root = np.sqrt(wide)
    # (1 + R A R)⁻¹ by eigenvalues: where the noise is next to nothing, 1 is lost beside R A R in the sum.
    values, vectors = eigh(root[:, None] * information * root)
    unseen = (vectors / (1 + np.maximum(values, 0.0))) @ vectors.T
    more = np.sqrt(np.maximum(wide - likeliest, 0.0))
    return np.diag(likeliest) + more[:, None] * unseen * more


def _total(
    parts: Float[np.ndarray, "2 seen seen"], variances: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "seen seen"]:
    """Covariance of the directions, in units of the noise, for variances of turns and clocks."""
    return np.eye(parts.shape[-1]) + np.tensordot(variances, parts, axes=1)


def _likeliest(
    seen: Float[np.ndarray, "seen"], parts: Float[np.ndarray, "2 seen seen"]
) -> Float[np.ndarray, "2"]:
    """Variances of turns and clocks with the largest likelihood."""
    traces = np.trace(parts, axis1=-2, axis2=-1)
    variances = np.where(traces > 0, (seen @ seen) / np.maximum(traces, np.finfo(float).tiny), 0.0)
    for _ in range(_NUM_STEPS):
        inverse = np.linalg.inv(_total(parts, variances))
        weighted = inverse @ seen
        expected = np.einsum("ij,pij->p", inverse, parts)
        found = np.einsum("i,pij,j->p", weighted, parts, weighted)
        before = variances
        variances = before * np.sqrt(found / np.where(expected > 0, expected, np.inf))
        if (np.abs(variances - before) * traces).max() < _SETTLED * len(seen):
            break
    return variances


def _wide(
    inverse: Float[np.ndarray, "seen seen"],
    parts: Float[np.ndarray, "2 seen seen"],
    likeliest: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "2"]:
    """Variances of turns and clocks whose 90 % ellipsoids contain 90 % of errors that no residual shows.

    A variance of less than its own standard error cannot be told from none: the standard error counts.
    """
    solved = inverse @ parts
    information = np.einsum("pij,pji->p", solved, solved) / 2
    shown = information > 0
    information = np.where(shown, information, 1.0)
    variances = np.maximum(likeliest, np.sqrt(1 / information))
    degrees = 2 * np.square(variances) * information
    return np.where(shown, variances * student_inflation(degrees), 0.0)


def student_inflation(degrees: float | Float[np.ndarray, "variances"]) -> np.ndarray:
    """Ratio of the variance whose 90 % ellipsoid holds 90 % to one that is known with some degrees of freedom."""
    return np.asarray(3 * fdtri(3, degrees, _PROBABILITY) / _RADIUS2)
