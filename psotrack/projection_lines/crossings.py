"""One frame of the projection lines: which sightings are of which drone, and where their lines of sight cross."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.correspondence import CUT_SHARE, CameraSightings, match
from psotrack.geometry import NEAR_M, Camera, project, reconstruct

#: No sighting is known better, however well the cameras agree.
LEAST_NOISE_PX = 0.1
#: Of drones that share a sighting all but one are hidden: its middle is off theirs by so much of its sides, as that of
#: one that the image's border cuts.
SHARED_SHARE = CUT_SHARE


@dataclass(frozen=True)
class Crossings:
    """Where the lines of sight of sightings cross that are of one drone.

    Attributes:
        expected: (crossings,), index of the expected drone that it is; -1 for one that nobody expected.
        position_m: (crossings, 3).
        covariance_m2: (crossings, 3, 3), from the noise of the sightings.
        seen: (crossings, cameras), cameras whose sightings count.
        disagreement: (crossings,), squared reprojection errors over the noise, per degree of freedom: about 1 where the
            noise is right.
        span_m: (crossings, 2), width and height of the sightings at that distance, the median of the cameras.
    """

    expected: Int[np.ndarray, "crossings"]
    position_m: Float[np.ndarray, "crossings 3"]
    covariance_m2: Float[np.ndarray, "crossings 3 3"]
    seen: Bool[np.ndarray, "crossings cameras"]
    disagreement: Float[np.ndarray, "crossings"]
    span_m: Float[np.ndarray, "crossings 2"]


def crossings(
    cameras: Camera,
    view: CameraSightings,
    bounds_m: Float[np.ndarray, "2 3"],
    expected_m: Float[np.ndarray, "drones 3"],
    expected_covariance_m2: Float[np.ndarray, "drones 3 3"],
    dispersion: Float[np.ndarray, "drones"],
) -> Crossings:
    """Match sightings over the cameras, and triangulate what belongs together without the views that disagree.

    Args:
        cameras: with one leading axis.
        view: the frame.
        bounds_m: (2, 3), corners of the room.
        expected_m, expected_covariance_m2: (drones, 3) and (drones, 3, 3), where drones are expected.
        dispersion: (drones,), how many times larger than `view.noise_px`² the variance of a sighting of each drone has
            been so far.
    """
    # What nobody expected is like what is known.
    dispersion = np.append(dispersion, np.median(dispersion) if len(dispersion) else 1.0)
    # In doubt a detector is taken to be as good as it says: what is matched is judged afterwards.
    scale = np.sqrt(max(1.0, dispersion[-1]))
    groups = match(
        cameras,
        view.found(view.centre_px),
        [scale * noise_px for noise_px in view.found(view.noise_px)],
        bounds_m=bounds_m,
        expected_m=expected_m,
        expected_covariance_m2=expected_covariance_m2,
    )
    centre_px, size_px, noise_px = (
        view.grouped(values, groups.detection) for values in (view.centre_px, view.size_px, view.noise_px)
    )
    several = _shared(groups.detection)
    hidden_px = np.where(several, SHARED_SHARE * np.sqrt(size_px.prod(axis=-1)), 0.0)
    noise_px = np.hypot(noise_px, hidden_px)
    # How well a drone is seen by itself says nothing of the others before it.
    usual = np.where(several, 1.0, np.sqrt(dispersion[groups.expected])[:, None])
    known_px = np.maximum(noise_px * usual, LEAST_NOISE_PX)
    lines = reconstruct(cameras, centre_px, noise_px=np.nan_to_num(known_px, nan=1.0))
    kept = lines.used.any(axis=-1)
    position_m, seen = lines.position_m[kept], lines.used[kept]
    squared = np.where(seen, lines.reprojection_px[kept] / noise_px[kept], 0.0) ** 2
    depth = project(cameras, position_m[:, None])[1]
    focal_px = np.stack([cameras.K[:, 0, 0], cameras.K[:, 1, 1]], axis=-1)
    span_m = np.where(seen[..., None], size_px[kept] * depth[..., None] / focal_px, np.nan)
    return Crossings(
        expected=groups.expected[kept],
        position_m=position_m,
        covariance_m2=lines.covariance_m2[kept],
        seen=seen,
        disagreement=squared.sum(axis=-1) / (2 * seen.sum(axis=-1) - 3),
        span_m=np.nanmedian(span_m, axis=1),
    )


def in_view(cameras: Camera, position_m: Float[np.ndarray, "drones 3"]) -> Bool[np.ndarray, "drones cameras"]:
    """(drones, cameras), cameras in whose images the drones are."""
    pixels, depth = project(cameras, position_m[:, None])
    inside = (pixels >= -0.5) & (pixels <= cameras.image_size_wh - 0.5)
    return np.asarray(inside.all(axis=-1) & (depth > NEAR_M))


def _shared(detection: Int[np.ndarray, "groups cameras"]) -> Bool[np.ndarray, "groups cameras"]:
    """(groups, cameras), whether the sighting is that of several groups."""
    return ((detection[:, None] == detection) & (detection >= 0)).sum(axis=1) > 1
