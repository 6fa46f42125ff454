"""Single cameras' views of tracked drones: where each camera alone sees a drone, relative to the drone's track."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from psotrack.foreground.silhouettes import Exposures, moved_by
from psotrack.geometry import (
    NEAR_M,
    Camera,
    cross_matrices,
    project_visible,
    project_with_jacobian,
    to_camera,
)
from psotrack.tracking.camera_errors.variance_components import FittedPlaces
from psotrack.tracking.matching import Sightings

#: Number of frames that are computed at once: those of all frames would take gigabytes for a long recording.
_FRAMES_AT_ONCE = 1000
#: A sighting that no track uses may be of a drone whose image is nearer than the length of the sighting.
_REACH = 2.0


@dataclass(frozen=True)
class CameraViews:
    """Views of the drones of a recording in its cameras, linearised at the drones' tracks.

    What follows from the attributes is computed when it is asked for. For all frames of a long recording it would take
    gigabytes, so it is asked of `parts`.

    Attributes:
        cameras: cameras with one leading axis.
        exposures: exposures of the cameras' frames; None where all were exposed at the instant.
        position_m, velocity_m_s: (frames, drones, 3), the tracks, metres and m/s; NaN where they are not known.
        residual_px: (frames, drones, cameras, 2), place of the drone in the camera's image minus the projection of its
            track, pixels; NaN where the camera does not show the place clearly.
        jacobian: (frames, drones, cameras, 2, 3), derivatives of the projection by the position, pixels per metre; 0
            where the drone's position is not known or is not in front of the camera.
        weight: (frames, drones, cameras, 2), weights of the views in the estimate of the position, along columns and
            rows; 0 where the camera does not count. Only their ratios matter.
    """

    cameras: Camera
    exposures: Exposures | None
    position_m: Float[np.ndarray, "frames drones 3"]
    velocity_m_s: Float[np.ndarray, "frames drones 3"]
    residual_px: Float[np.ndarray, "frames drones cameras 2"]
    jacobian: Float[np.ndarray, "frames drones cameras 2 3"]
    weight: Float[np.ndarray, "frames drones cameras 2"]

    def __getitem__(self, frames: slice) -> CameraViews:
        """The views of some frames."""
        names = ("position_m", "velocity_m_s", "residual_px", "jacobian", "weight")
        parts = {name: getattr(self, name)[frames] for name in names}
        return CameraViews(self.cameras, _at(self.exposures, frames), **parts)

    def parts(self) -> Iterator[CameraViews]:
        """The views of some frames after the other."""
        return (self[frames] for frames in _blocks(len(self.weight)))

    @property
    def num_cameras(self) -> int:
        """Number of cameras."""
        return self.weight.shape[2]

    @cached_property
    def shown(self) -> Bool[np.ndarray, "frames drones cameras"]:
        """(frames, drones, cameras), whether the camera shows the place of the drone."""
        return np.asarray(np.isfinite(self.residual_px).all(axis=-1) & (self.weight > 0).all(axis=-1))

    @property
    def places(self) -> FittedPlaces:
        """The views of all frames and drones, as rows."""
        cameras = self.num_cameras
        return FittedPlaces(
            np.nan_to_num(self.residual_px).reshape(-1, cameras, 2),
            self.jacobian.reshape(-1, cameras, 2, 3),
            self.shown.reshape(-1, cameras),
        )

    @property
    def flow_px_s(self) -> Float[np.ndarray, "frames drones cameras 2"]:
        """(frames, drones, cameras, 2), velocities of the drones in the images, pixels per second."""
        return np.einsum("...cij,...j->...ci", self.jacobian, np.nan_to_num(self.velocity_m_s))

    @property
    def turn_px(self) -> Float[np.ndarray, "frames drones cameras 2 3"]:
        """(frames, drones, cameras, 2, 3), derivatives of the projection by small turns of the camera, px per radian.

        The turns are about the camera's own x, y and z axes.
        """
        # A camera that turns by w moves a point by w x p in its own axes.
        seen_m = _seen(self.position_m, self.velocity_m_s, self.exposures)
        in_camera_m = np.asarray(to_camera(self.cameras, seen_m))
        by_camera = self.jacobian @ self.cameras.T_cam_world[:, :3, :3].swapaxes(-1, -2)
        return -by_camera @ cross_matrices(in_camera_m)

    @property
    def gain(self) -> Float[np.ndarray, "frames drones cameras 3 2"]:
        """(frames, drones, cameras, 3, 2), derivatives of the estimated position by the cameras' places, m per pixel.

        That of weighted least squares, (Σ Jᵀ W J)⁻¹ Jᵀ W; 0 where the cameras do not determine a position.
        """
        weighted = self.jacobian.swapaxes(-1, -2) * self.weight[..., None, :]
        normal = (weighted @ self.jacobian).sum(axis=2)
        scale = np.trace(normal, axis1=-2, axis2=-1)[..., None, None] / 3
        least = np.linalg.eigvalsh(normal / np.where(scale > 0, scale, 1.0))[..., 0]
        solvable = ((scale[..., 0, 0] > 0) & (least > 1e-9))[..., None, None]
        inverse = np.linalg.inv(np.where(solvable, normal, np.eye(3)))
        return np.where(solvable[..., None], inverse[:, :, None] @ weighted, 0.0)


def views_of_places(
    cameras: Camera,
    place_px: Float[np.ndarray, "frames drones cameras 2"],
    weight: Float[np.ndarray, "frames drones cameras 2"],
    position_m: Float[np.ndarray, "frames drones 3"],
    velocity_m_s: Float[np.ndarray, "frames drones 3"],
    exposures: Exposures | None = None,
) -> CameraViews:
    """The views, from the drones' places in the images.

    Args:
        cameras: cameras with one leading axis.
        place_px: (frames, drones, cameras, 2), pixels; NaN where a camera does not show the place.
        weight: (frames, drones, cameras, 2), weights of the views in the estimate; 0 where a camera does not count.
        position_m, velocity_m_s: (frames, drones, 3), the tracks, metres and m/s; NaN where they are not known.
        exposures: exposures of the cameras' frames; None where all were exposed at the instant.
    """
    parts = []
    for frames in _blocks(len(place_px)):
        seen_m = _seen(position_m[frames], velocity_m_s[frames], _at(exposures, frames))
        pixels = _visible(cameras, position_m[frames], seen_m)
        ahead = np.isfinite(pixels).all(axis=-1)[..., None]
        jacobian = np.where(ahead[..., None], project_with_jacobian(cameras, seen_m)[2], 0.0)
        parts.append((place_px[frames] - pixels, jacobian, np.where(ahead, weight[frames], 0.0)))
    linear = map(np.concatenate, zip(*parts, strict=True))
    return CameraViews(cameras, exposures, position_m, velocity_m_s, *linear)


def with_nearest_sightings(
    cameras: Camera,
    place_px: Float[np.ndarray, "frames drones cameras 2"],
    sightings: Sightings,
    position_m: Float[np.ndarray, "frames drones 3"],
    velocity_m_s: Float[np.ndarray, "frames drones 3"],
) -> Float[np.ndarray, "frames drones cameras 2"]:
    """The drones' places, also in cameras that show a drone too far from its track to count in the track.

    There the sighting counts that is nearest to the drone, and has no nearer drone.

    Args:
        cameras, place_px, position_m, velocity_m_s: as in `views_of_places`.
        sightings: sightings of all cameras, at the instants of the places.
    """
    parts = []
    for frames in _blocks(len(place_px)):
        part, at_m = sightings[frames], position_m[frames]
        seen_m = _seen(at_m, velocity_m_s[frames], part.exposures)
        off_px = part.centre_px[:, None] - _visible(cameras, at_m, seen_m)[..., None, :]
        length2 = np.nan_to_num(np.square(off_px).sum(axis=-1), nan=np.inf)
        near = length2 < _REACH**2 * part.size_px.prod(axis=-1)[:, None]
        near &= length2 == length2.min(axis=1, keepdims=True)
        near &= length2 == length2.min(axis=-1, keepdims=True)
        nearest_px = np.take_along_axis(off_px, near.argmax(axis=-1)[..., None, None], axis=3)[..., 0, :]
        nearest_px = nearest_px + _visible(cameras, at_m, at_m[:, :, None])
        parts.append(np.where(near.any(axis=-1, keepdims=True), nearest_px, np.nan))
    return np.where(np.isfinite(place_px), place_px, np.concatenate(parts))


def _blocks(num_frames: int) -> Iterator[slice]:
    """Blocks of frames that are computed at once."""
    return (slice(first, first + _FRAMES_AT_ONCE) for first in range(0, num_frames, _FRAMES_AT_ONCE))


def _at(exposures: Exposures | None, frames: slice) -> Exposures | None:
    return None if exposures is None else exposures[frames]


def _seen(
    position_m: Float[np.ndarray, "frames drones 3"],
    velocity_m_s: Float[np.ndarray, "frames drones 3"],
    exposures: Exposures | None,
) -> Float[np.ndarray, "frames drones #cameras 3"]:
    """Where each camera sees each drone; the origin where a drone's position is not known."""
    moved_m = 0.0 if exposures is None else moved_by(exposures, np.nan_to_num(velocity_m_s))
    return np.nan_to_num(position_m[:, :, None] + moved_m)


def _visible(
    cameras: Camera,
    position_m: Float[np.ndarray, "frames drones 3"],
    seen_m: Float[np.ndarray, "frames drones #cameras 3"],
) -> Float[np.ndarray, "frames drones cameras 2"]:
    """Pixels of drones where each camera sees them; NaN where the position is not known or has no image."""
    pixels, depth = project_visible(cameras, seen_m)
    known = np.isfinite(position_m).all(axis=-1)[..., None]
    ahead = known & (depth > NEAR_M) & np.isfinite(pixels).all(axis=-1)
    return np.where(ahead[..., None], pixels, np.nan)
