"""Errors that a camera has during the whole recording: it is turned, and its clock is off.

Each camera's three small turns and its clock are fitted to the residuals of all frames together, with the positions
eliminated. The fit is not used to correct anything: how large the fitted values are, beyond what noise explains, shows
the standard deviations of turns and clocks (empirical Bayes; B. Efron, C. Morris, Journal of the American Statistical
Association 68, 1973). With the sum of scores g, its derivative A and an inflation f of the noise, because errors of
neighbouring frames are similar,

    g ~ N(0, f A + s_turn² A_turn A_turnᵀ + s_clock² A_clock A_clockᵀ),

where A_turn and A_clock are columns of A. The two standard deviations are those of the largest likelihood, found as in
`variance_components`.

Few cameras show few turns, so the standard deviations themselves are uncertain. Their posterior distribution with the
Jeffreys prior (G. E. P. Box, G. C. Tiao, Bayesian Inference in Statistical Analysis, 1973, section 1.3) gives the
distribution of a turn that no residual shows: a mixture of normal distributions, which is Student's t where the other
turns are seen without noise. The wide standard deviation is the one whose 90 % ellipsoid contains 90 % of this mixture.

Only errors that no residual shows need it, such as what all clocks are late by. The size of an error that the residuals
do show is known, since the errors that they show are the errors that move the positions. With D and W the diagonal
matrices of likeliest and wide variances, and Q the share of W that remains after the residuals, so that its eigenvalues
are 0 for combinations that are seen and 1 for combinations that are not, the covariance is

    D + (W - D)^1/2 Q (W - D)^1/2,    Q = W^-1/2 (W⁻¹ + A / f)⁻¹ W^-1/2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq
from scipy.special import gammainc, gammaincinv

from psotrack.tracking.camera_errors.variance_components import FittedPlaces, weighted_residuals

#: Largest number of steps of the maximisation, which ends when the variances, in units of the noise, change by less
#: than a share.
_NUM_STEPS, _SETTLED = 200, 1e-5
#: Directions of less information than this share of the largest are not determined.
_LEAST_INFORMATION = 1e-7
#: Standard deviations of the posterior distribution, in units of the scale that the residuals show: dense where most
#: of the posterior is, and far enough for one degree of freedom.
_SCALES = np.concatenate([np.geomspace(0.03, 0.5, 6), np.geomspace(0.55, 2, 20), np.geomspace(2.3, 60, 14)])
#: Probability of the ellipsoid for which the wide standard deviations hold.
_PROBABILITY = 0.9


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
    *,
    with_covariance: bool = True,
) -> ConstantErrors:
    """Fit turns and clocks.

    Args:
        places: residuals and derivatives; all rows are determined.
        turn_px: (rows, cameras, 2, 3), derivatives of the projections by turns, pixels per radian.
        flow_px_s: (rows, cameras, 2), velocities in the images, pixels per second.
        noise_px: (cameras, 2), standard deviations of the noise along columns and rows, pixels.
        inflation: how much more the variance of a sum over frames is than of independent noise.
        with_covariance: whether to compute the covariance; NaN otherwise.
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
    # Units in which turns and clocks are alike.
    of_clock = np.arange(len(score)) % 4 == 3
    unit = np.where(of_clock, _unit(information, of_clock), _unit(information, ~of_clock))
    information, score = information * np.outer(unit, unit), score * unit
    values, vectors = np.linalg.eigh(information)
    kept = values > _LEAST_INFORMATION * max(values[-1], np.finfo(float).tiny)
    values, vectors = values[kept], vectors[:, kept]
    g = vectors.T @ score
    # Directions and columns of A in units of the noise.
    noise = np.sqrt(inflation * values)
    seen = g / noise
    columns = [(values / noise)[:, None] * vectors.T[:, which] for which in (~of_clock, of_clock)]
    shares = [each @ each.T for each in columns]
    variances = _likeliest(seen, shares)
    prior = np.where(of_clock, variances[1], variances[0])
    weighted_seen = np.linalg.solve(_total(shares, variances), seen)
    fitted = (prior * (vectors @ ((values / noise) * weighted_seen)) * unit).reshape(num_cameras, 4)
    scale = [float(unit[which][0]) for which in (~of_clock, of_clock)]
    covariance = np.full((len(score), len(score)), np.nan)
    if with_covariance:
        wide = _wide(seen, shares, variances)
        both = np.where(of_clock, wide[1], wide[0])
        covariance = _covariance(information / inflation, prior, both) * np.outer(unit, unit)
    return ConstantErrors(
        turn_rad=fitted[:, :3],
        clock_s=fitted[:, 3],
        turn_std_rad=scale[0] * float(np.sqrt(variances[0])),
        clock_std_s=scale[1] * float(np.sqrt(variances[1])),
        covariance=covariance,
    )


def _covariance(
    information: Float[np.ndarray, "all all"],
    likeliest: Float[np.ndarray, "all"],
    wide: Float[np.ndarray, "all"],
) -> Float[np.ndarray, "all all"]:
    """Covariance of turns and clocks from their likeliest and wide variances and the information about them."""
    root = np.sqrt(wide)
    # (1 + R A R)⁻¹ by eigenvalues: where the noise is next to nothing, 1 is lost beside R A R in the sum.
    values, vectors = np.linalg.eigh(root[:, None] * information * root)
    unseen = (vectors / (1 + np.maximum(values, 0.0))) @ vectors.T
    more = np.sqrt(np.maximum(wide - likeliest, 0.0))
    return np.diag(likeliest) + more[:, None] * unseen * more


def _total(
    shares: list[Float[np.ndarray, "seen seen"]], variances: Float[np.ndarray, "*grid 2"]
) -> Float[np.ndarray, "*grid seen seen"]:
    """Covariances of the directions, in units of the noise, for variances of turns and clocks."""
    both = sum(variances[..., part, None, None] * share for part, share in enumerate(shares))
    return np.asarray(np.eye(shares[0].shape[0]) + both)


def _likeliest(
    seen: Float[np.ndarray, "seen"], shares: list[Float[np.ndarray, "seen seen"]]
) -> Float[np.ndarray, "2"]:
    """Variances of turns and clocks with the largest likelihood."""
    traces = np.array([np.trace(share) for share in shares])
    variances = np.where(traces > 0, (seen @ seen) / np.maximum(traces, np.finfo(float).tiny), 0.0)
    for _ in range(_NUM_STEPS):
        inverse = np.linalg.inv(_total(shares, variances))
        weighted = inverse @ seen
        expected = np.array([np.vdot(inverse, share) for share in shares])
        found = np.array([weighted @ share @ weighted for share in shares])
        before = variances
        variances = before * np.sqrt(found / np.where(expected > 0, expected, np.inf))
        if (np.abs(variances - before) * traces).max() < _SETTLED * len(seen):
            break
    return variances


def _wide(
    seen: Float[np.ndarray, "seen"],
    shares: list[Float[np.ndarray, "seen seen"]],
    likeliest: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "2"]:
    """Variances of turns and clocks whose 90 % ellipsoids contain 90 % of errors that no residual shows."""
    there = [part for part, share in enumerate(shares) if np.trace(share) > 0]
    wide = np.zeros(len(shares))
    if not there:
        return wide
    inverse = np.linalg.inv(_total(shares, likeliest))
    # The posterior reaches from the likeliest variance to about what the residuals would show at least.
    scales = []
    for part in there:
        solved = inverse @ shares[part]
        least_shown = np.sqrt(2 / np.vdot(solved, solved.T))
        scales.append(np.sqrt(likeliest[part] + least_shown) * _SCALES)
    log_likelihood, determinant = _on_grid(seen, [shares[part] for part in there], scales)
    posterior = np.exp(log_likelihood - log_likelihood.max()) * np.sqrt(np.maximum(determinant, 0.0))
    for axis in range(len(there)):
        steps = np.gradient(np.log(_SCALES))
        posterior *= np.expand_dims(steps, tuple(other for other in range(len(there)) if other != axis))
    for axis, part in enumerate(there):
        share = posterior.sum(axis=tuple(other for other in range(len(there)) if other != axis))
        wide[part] = _wide_variance(np.square(scales[axis]), share / share.sum())
    return wide


def _on_grid(
    seen: Float[np.ndarray, "seen"], shares: list[Float[np.ndarray, "seen seen"]], scales: list[np.ndarray]
) -> tuple[Float[np.ndarray, "*grid"], Float[np.ndarray, "*grid"]]:
    """Log likelihoods on a grid of one or two standard deviations, and determinants of their Fisher informations.

    The information is about the logarithms of the standard deviations. The covariance 1 + a A + b B has no inverse of
    its own at each point of the grid, which would take minutes for many cameras. For each a, one basis makes 1 + a A
    the identity and B diagonal. Then a sum over the diagonal gives the likelihood for any b.
    """
    a, b = (np.square(scale) for scale in (scales[0], scales[-1]))
    own, axes = np.linalg.eigh(shares[0])
    own, seen = np.maximum(own, 0.0), axes.T @ seen
    if len(shares) == 1:
        total = 1 + a[:, None] * own
        log_likelihood = -(np.log(total) + np.square(seen) / total).sum(axis=-1) / 2
        return log_likelihood, 2 * np.square(a[:, None] * own / total).sum(axis=-1)
    other = axes.T @ shares[1] @ axes
    rows = [_for_one_variance(seen, own, other, each, b) for each in a]
    log_likelihood, determinant = (np.stack(of) for of in zip(*rows, strict=True))
    return log_likelihood, determinant


def _for_one_variance(
    seen: Float[np.ndarray, "seen"],
    own: Float[np.ndarray, "seen"],
    other: Float[np.ndarray, "seen seen"],
    a: float,
    b: Float[np.ndarray, "grid"],
) -> tuple[Float[np.ndarray, "grid"], Float[np.ndarray, "grid"]]:
    """One row of `_on_grid`: A is diagonal, with the elements `own`; B is `other`."""
    root = 1 / np.sqrt(1 + a * own)
    values, vectors = np.linalg.eigh(root[:, None] * other * root)
    values = np.maximum(values, 0.0)
    total = 1 + b[:, None] * values
    squares = np.square(vectors.T @ (root * seen))
    log_likelihood = -(np.log1p(a * own).sum() + (np.log(total) + squares / total).sum(axis=-1)) / 2
    # a A and b B in this basis, times the inverse covariance: their products have these traces.
    by_a = (vectors.T * (a * own * np.square(root))) @ vectors
    by_b = b[:, None] * values / total
    both_a = ((1 / total) @ np.square(by_a) / total).sum(axis=-1)
    both_b = np.square(by_b).sum(axis=-1)
    crossed = (by_b / total * np.diag(by_a)).sum(axis=-1)
    return log_likelihood, 4 * (both_a * both_b - np.square(crossed))


def _wide_variance(variance: Float[np.ndarray, "grid"], share: Float[np.ndarray, "grid"]) -> float:
    """The variance whose 90 % ellipsoid, in three dimensions, contains 90 % of a mixture of normal distributions."""
    limit = 2 * gammaincinv(3 / 2, _PROBABILITY)

    def more_inside(log_wide: float) -> float:
        return float(share @ gammainc(3 / 2, limit * np.exp(log_wide) / variance / 2)) - _PROBABILITY

    return float(np.exp(brentq(more_inside, np.log(variance[0]) - 5, np.log(variance[-1]) + 5)))


def _unit(information: Float[np.ndarray, "all all"], which: np.ndarray) -> float:
    """A unit of some parameters in which their mean information is 1; 1 where there is no information."""
    mean = float(np.diag(information)[which].mean())
    return 1 / np.sqrt(mean) if mean > 0 else 1.0
