"""Agreement of a rig with its cameras' sightings: points that are seen from at least three viewpoints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.geometry import Camera, Rig, reconstruct, viewpoints
from psotrack.tracking.matching import Sightings, match

#: Smallest number of viewpoints of a point: two viewpoints often agree by chance.
MIN_VIEWPOINTS = 3
#: Largest squared distance of a sighting from the projection of its point, squared standard deviations: 1 in 1000 right
#: sightings is farther (χ² distribution, two degrees of freedom).
MAX_SQUARED_DISTANCE = 13.8


@dataclass(frozen=True)
class Agreement:
    """Points that a rig triangulates from sightings, each seen from at least three viewpoints.

    Attributes:
        frame: (points,), number of each point's frame.
        position_m: (points, 3), positions in the world, metres.
        centre_px: (points, cameras, 2), the point's sightings, pixels; NaN for no sighting.
        noise_px: (points, cameras), standard deviations of the sightings, pixels; NaN for no sighting.
        used: (points, cameras), True for sightings that agree with the point.
        residual_px: (points, cameras), distances of the sightings from the point's projections, pixels; NaN for no
            sighting.
        num_sightings: (cameras,), numbers of sightings in the examined frames.
        num_frames: number of examined frames.
    """

    frame: Int[np.ndarray, "points"]
    position_m: Float[np.ndarray, "points 3"]
    centre_px: Float[np.ndarray, "points cameras 2"]
    noise_px: Float[np.ndarray, "points cameras"]
    used: Bool[np.ndarray, "points cameras"]
    residual_px: Float[np.ndarray, "points cameras"]
    num_sightings: Int[np.ndarray, "cameras"]
    num_frames: int

    @property
    def share(self) -> float:
        """Share of all sightings that agree with a point, at most 1: a sighting of two drones counts twice."""
        return min(1.0, float(self.used.sum() / max(self.num_sightings.sum(), 1)))

    @property
    def share_of_camera(self) -> Float[np.ndarray, "cameras"]:
        """(cameras,), share of each camera's sightings that agree with a point, at most 1."""
        return np.minimum(1.0, self.used.sum(axis=0) / np.maximum(self.num_sightings, 1))


def measure_agreement(
    rig: Rig, sightings: Sightings, frames: Int[np.ndarray, "chosen"], bounds_m: Float[np.ndarray, "2 3"]
) -> Agreement:
    """Match the sightings of some frames over all cameras, and triangulate the points.

    Args:
        rig: the rig to check.
        sightings: sightings of the rig's cameras.
        frames: (chosen,), numbers of the frames to examine.
        bounds_m: (2, 3), corners of the region where bodies can be, metres.
    """
    numbers: list[np.ndarray] = []
    centres: list[np.ndarray] = []
    noises: list[np.ndarray] = []
    for frame in frames.tolist():
        view = sightings[frame]
        found = view.grouped(_matched(rig, view, bounds_m))
        numbers.append(np.full(len(found.centre_px), frame))
        centres.append(found.centre_px)
        noises.append(found.noise_px)
    frame_of, centre_px, all_noise_px = (np.concatenate(values) for values in (numbers, centres, noises))
    lines = reconstruct(rig.cameras, centre_px, noise_px=np.nan_to_num(all_noise_px, nan=1.0))
    kept = num_viewpoints(rig.cameras, lines.used) >= MIN_VIEWPOINTS
    return Agreement(
        frame_of[kept],
        lines.position_m[kept],
        centre_px[kept],
        all_noise_px[kept],
        lines.used[kept],
        lines.reprojection_px[kept],
        np.isfinite(sightings.noise_px[frames]).sum(axis=(0, 2)),
        len(frames),
    )


def _matched(
    rig: Rig, view: Sightings, bounds_m: Float[np.ndarray, "2 3"]
) -> Int[np.ndarray, "points cameras"]:
    """Indices of the sightings of each point; no points if the rig is so wrong that the equations are singular."""
    try:
        with np.errstate(all="ignore"):
            return match(rig.cameras, view.centre_px, view.noise_px, bounds_m=bounds_m).detection
    except np.linalg.LinAlgError:
        return np.empty((0, len(rig)), int)


def num_viewpoints(cameras: Camera, seen: Bool[np.ndarray, "points cameras"]) -> Int[np.ndarray, "points"]:
    """Number of viewpoints from which each point is seen."""
    label = viewpoints(cameras)
    at = label[:, None] == np.unique(label)
    return (seen.astype(int) @ at.astype(int) > 0).sum(axis=-1)
