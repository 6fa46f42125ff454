"""How well a rig agrees with what its cameras see: sightings that lines of sight from three viewpoints explain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.correspondence import CameraSightings, Sightings, match
from psotrack.geometry import Camera, CameraRig, reconstruct, viewpoints
from psotrack.initiation import room_bounds
from psotrack.settings import TrackSettings

#: Two viewpoints agree by chance.
MIN_VIEWPOINTS = 3
#: Squared distance in standard deviations from which on a sighting is another drone's: one in 1000 is farther off.
UNEXPLAINED = 13.8


@dataclass(frozen=True)
class Agreement:
    """What a rig makes of sightings.

    Attributes:
        frame: (points,), of each point that is seen from three viewpoints.
        position_m: (points, 3), world.
        centre_px: (points, cameras, 2), the sightings that belong to it; NaN for none.
        noise_px: (points, cameras), their standard deviations.
        used: (points, cameras), views that agree.
        residual_px: (points, cameras), distances from where the point is seen; NaN for none.
        num_sightings: (cameras,), in the frames that were looked at.
        num_frames: that were looked at.
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
        """Of all sightings, those that are explained; one that is of two drones counts twice, in all at most 1."""
        return min(1.0, float(self.used.sum() / max(self.num_sightings.sum(), 1)))

    @property
    def share_of_camera(self) -> Float[np.ndarray, "cameras"]:
        """The same for each camera."""
        return np.minimum(1.0, self.used.sum(axis=0) / np.maximum(self.num_sightings, 1))


def agreement(rig: CameraRig, sightings: Sightings, frames: Int[np.ndarray, "chosen"]) -> Agreement:
    """Match the sightings of some frames over all cameras, and triangulate them.

    Args:
        rig: as it is read.
        sightings: of its cameras.
        frames: to look at.
    """
    bounds_m = _wide_bounds(rig)
    numbers: list[np.ndarray] = []
    centres: list[np.ndarray] = []
    noises: list[np.ndarray] = []
    for frame in frames.tolist():
        view = sightings.at(frame)
        found = _matched(rig, view, bounds_m)
        numbers.append(np.full(len(found), frame))
        centres.append(view.grouped(view.centre_px, found))
        noises.append(view.grouped(view.noise_px, found))
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
    rig: CameraRig, view: CameraSightings, bounds_m: Float[np.ndarray, "2 3"]
) -> Int[np.ndarray, "points cameras"]:
    """Which sightings are of which point; none where a rig is so wrong that its equations are singular."""
    try:
        with np.errstate(all="ignore"):
            found = match(
                rig.cameras, view.found(view.centre_px), view.found(view.noise_px), bounds_m=bounds_m
            )
    except np.linalg.LinAlgError:
        return np.empty((0, len(rig)), int)
    return found.detection


def num_viewpoints(cameras: Camera, seen: Bool[np.ndarray, "points cameras"]) -> Int[np.ndarray, "points"]:
    """From how many viewpoints points are seen."""
    label = viewpoints(cameras)
    at = label[:, None] == np.unique(label)
    return (seen.astype(int) @ at.astype(int) > 0).sum(axis=-1)


def _wide_bounds(rig: CameraRig) -> Float[np.ndarray, "2 3"]:
    """The room, and as much below the floor and above: where z = 0 is, a rig that is wrong may not know."""
    bounds_m = room_bounds(rig, TrackSettings())
    height_m = bounds_m[1, 2] - bounds_m[0, 2]
    bounds_m[:, 2] += -height_m, height_m
    return bounds_m
