"""How drones look in all views: colours by status, and the ellipsoids of their covariances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.evaluation import INSIDE_90
from psotrack.trajectories import Status, Trajectories

#: Fraction of the pale colour in the colours of predicted drones, and the grey of lost ones, 0 to 255.
_COASTING_PALER, _LOST_GREY = 0.65, 150


def statuses(trajectories: Trajectories) -> Int[np.ndarray, "frames drones"]:
    """Status of each drone in each frame; of tracks without status: lost where there is no position."""
    if trajectories.status is not None:
        return trajectories.status
    return np.where(trajectories.seen, int(Status.TRACKED), int(Status.LOST))


def colour_rgb(colour: str) -> tuple[int, int, int]:
    """A colour #rrggbb as red, green and blue, 0 to 255."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def status_rgb(
    status: Int[np.ndarray, "*frames drones"],
    colours: Sequence[str],
    *,
    lighter: float = 0.0,
    pale: int = 255,
) -> UInt8[np.ndarray, "*frames drones 3"]:
    """Colours by status: the drone's own where it is tracked, paler where it is predicted, grey where it is lost.

    Args:
        status: (..., drones), values of `Status`.
        colours: a colour per drone, as #rrggbb.
        lighter: fraction of white that is mixed into all colours, for dark backgrounds.
        pale: grey level that is mixed into the colours of predicted drones, 0 to 255.
    """
    own = np.array([colour_rgb(colour) for colour in colours], float).reshape(-1, 3)
    own += lighter * (255 - own)
    of_status = {
        Status.TRACKED: own,
        Status.COASTING: own + _COASTING_PALER * (pale - own),
        Status.LOST: np.full_like(own, _LOST_GREY),
    }
    table = np.rint([of_status[each] for each in Status]).astype(np.uint8)
    return table[status, np.arange(len(colours))]


@dataclass(frozen=True)
class Ellipsoids:
    """Ellipsoids about points.

    Attributes:
        half_axes_m: (..., 3), half lengths of the axes, from the shortest to the longest, metres; NaN if unknown.
        rotation: (..., 3, 3), rotation matrices whose columns are the directions of the axes in the world.
    """

    half_axes_m: Float[np.ndarray, "*points 3"]
    rotation: Float[np.ndarray, "*points 3 3"]


def ellipsoids_90(covariance_m2: Float[np.ndarray, "*points 3 3"]) -> Ellipsoids:
    """The ellipsoid that holds 90 % of each normal distribution.

    Args:
        covariance_m2: (..., 3, 3), covariances, m²; NaN where unknown.
    """
    known = np.isfinite(covariance_m2).all(axis=(-2, -1))
    whole = np.where(known[..., None, None], covariance_m2, np.eye(3)).astype(np.float64)
    variance_m2, directions = np.linalg.eigh(whole)
    # Eigenvectors may form a left-handed system, which is no rotation.
    directions[..., :, 0] *= np.linalg.det(directions)[..., None]
    half_m = np.sqrt(np.maximum(variance_m2, 0.0) * INSIDE_90)
    return Ellipsoids(np.where(known[..., None], half_m, np.nan), directions)
