"""Which sightings a position explains: the one gate of the doctor, of tracks and of their record."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from psotrack.foreground.silhouettes import moved_by
from psotrack.geometry import NEAR_M, Camera, project_visible
from psotrack.tracking.matching.groups import UNEXPLAINED_COST
from psotrack.tracking.matching.sightings import Sightings


def are_near(
    cameras: Camera,
    sightings: Sightings,
    position_m: Float[np.ndarray, "frames drones 3"],
    velocity_m_s: Float[np.ndarray, "frames drones 3"] | None = None,
) -> Bool[np.ndarray, "frames drones cameras boxes"]:
    """(frames, drones, cameras, boxes), whether a position explains a sighting: 1 in 1000 of its own is farther.

    Args:
        cameras: cameras with one leading axis.
        sightings: sightings of all cameras.
        position_m: (frames, drones, 3), positions at the instants, metres; NaN where they are not known.
        velocity_m_s: (frames, drones, 3), by which positions are moved to the exposures, m/s; None: they stay.
    """
    seen_m = position_m[:, :, None]
    if velocity_m_s is not None and sightings.exposures is not None:
        seen_m = seen_m + moved_by(sightings.exposures, velocity_m_s)
    pixels, depth = project_visible(cameras, np.nan_to_num(seen_m))
    off_px = sightings.centre_px[:, None] - pixels[:, :, :, None]
    known = np.isfinite(position_m).all(axis=-1)[..., None] & (depth > NEAR_M)
    near = np.square(off_px).sum(axis=-1) < UNEXPLAINED_COST * np.square(sightings.noise_px)[:, None]
    return np.asarray(near & known[..., None])
