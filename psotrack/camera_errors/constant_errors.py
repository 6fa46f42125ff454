"""Errors that a camera has during the whole recording: it is turned, and its clock is off.

Each camera's three small turns and its clock are fitted to the residuals of all frames together, with the positions
eliminated. The fit is not used to correct anything: how large the fitted values are, beyond what noise explains, shows
the standard deviations of turns and clocks (empirical Bayes; B. Efron, C. Morris, Journal of the American Statistical
Association 68, 1973). With the sum of scores g, its derivative A and an inflation f of the noise, because errors of
neighbouring frames are similar,

    g ~ N(0, f A + s_turn² A_turn A_turnᵀ + s_clock² A_clock A_clockᵀ),

where A_turn and A_clock are columns of A. The two standard deviations are those of the largest likelihood, found as in
`variance_components`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.camera_errors.variance_components import FittedPlaces, weighted_residuals

#: Number of steps of the maximisation.
_NUM_STEPS = 200
#: Directions of less information than this share of the largest are not determined.
_LEAST_INFORMATION = 1e-7


@dataclass(frozen=True)
class ConstantErrors:
    """Turns and clocks of the cameras.

    Attributes:
        turn_rad: (cameras, 3), turns about the cameras' own axes as the residuals show them, radians.
        clock_s: (cameras,), how late each camera's clock shows a drone, relative to the others, seconds.
        turn_std_rad: standard deviation of a turn about one axis, radians.
        clock_std_s: standard deviation of a clock, seconds.
    """

    turn_rad: Float[np.ndarray, "cameras 3"]
    clock_s: Float[np.ndarray, "cameras"]
    turn_std_rad: float
    clock_std_s: float


def fit_constant_errors(
    places: FittedPlaces,
    turn_px: Float[np.ndarray, "rows cameras 2 3"],
    flow_px_s: Float[np.ndarray, "rows cameras 2"],
    noise_px: Float[np.ndarray, "cameras"],
    inflation: float,
) -> ConstantErrors:
    """Fit turns and clocks.

    Args:
        places: residuals and derivatives; all rows are determined.
        turn_px: (rows, cameras, 2, 3), derivatives of the projections by turns, pixels per radian.
        flow_px_s: (rows, cameras, 2), velocities in the images, pixels per second.
        noise_px: (cameras,), standard deviations of the noise, pixels.
        inflation: how much more the variance of a sum over frames is than of independent noise.
    """
    num_cameras = places.shown.shape[1]
    weight = np.where(places.shown, np.square(1 / noise_px), 0.0)
    left, weighted, inverse = weighted_residuals(places, weight)
    # Four parameters for each camera: three turns and the clock. A late clock shows the drone where it was.
    design = np.concatenate([turn_px, -flow_px_s[..., None]], axis=-1) * (weight > 0)[..., None, None]
    own = np.einsum("rc,rcip,rciq->cpq", weight, design, design)
    crossed = np.einsum("rcik,rcip->rcpk", weighted, design).reshape(len(weight), 4 * num_cameras, 3)
    information = -np.einsum("rak,rkl,rbl->ab", crossed, inverse, crossed, optimize=True)
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
    # A's columns of turns and of clocks in the basis of its determined directions.
    columns = [(values[:, None] * vectors.T)[:, which] for which in (~of_clock, of_clock)]
    variance = np.full(2, max(float(np.square(g / values).mean()), 1e-12) if len(g) else 0.0)
    V = np.diag(inflation * values)
    for _ in range(_NUM_STEPS if len(g) else 0):
        V = np.diag(inflation * values) + sum(
            v * part @ part.T for v, part in zip(variance, columns, strict=True)
        )
        solved = np.linalg.solve(V, np.column_stack([g, *columns]))
        first = 1
        for number, part in enumerate(columns):
            expected = np.einsum("ij,ij->", part, solved[:, first : first + part.shape[1]])
            first += part.shape[1]
            found = np.square(part.T @ solved[:, 0]).sum()
            variance[number] *= np.sqrt(found / expected) if expected > 0 else 0.0
    prior = np.where(of_clock, variance[1] if len(g) else 0.0, variance[0] if len(g) else 0.0)
    fitted = prior * (vectors @ (values * np.linalg.solve(V, g))) if len(g) else np.zeros(len(score))
    fitted = (fitted * unit).reshape(num_cameras, 4)
    scale = [float(unit[which][0]) for which in (~of_clock, of_clock)]
    return ConstantErrors(
        turn_rad=fitted[:, :3],
        clock_s=fitted[:, 3],
        turn_std_rad=scale[0] * float(np.sqrt(variance[0])),
        clock_std_s=scale[1] * float(np.sqrt(variance[1])),
    )


def _unit(information: Float[np.ndarray, "all all"], which: np.ndarray) -> float:
    """A unit of some parameters in which their mean information is 1; 1 where there is no information."""
    mean = float(np.diag(information)[which].mean())
    return 1 / np.sqrt(mean) if mean > 0 else 1.0
