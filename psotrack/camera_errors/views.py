"""Single cameras' views of tracked drones: where each camera alone sees a drone, relative to the drone's track."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from psotrack.correspondence import Sightings
from psotrack.geometry import (
    NEAR_M,
    Camera,
    cross_matrices,
    project_visible,
    project_with_jacobian,
    to_camera,
)
from psotrack.silhouettes import Exposures, moved_by
from psotrack.tracking import CameraMiddles, FoundDrones

#: A detection is of a drone if it is at most this many standard deviations from the drone's projection.
_GATE = 5.0
#: The standard deviation of a normal distribution over its median absolute deviation.
_MAD_STD = 1.4826


@dataclass(frozen=True)
class CameraViews:
    """Views of the drones of a recording in its cameras, linearised at the drones' tracks.

    Attributes:
        residual_px: (frames, drones, cameras, 2), place of the drone in the camera's image minus the projection of its
            track, pixels; NaN where the camera does not show the place clearly.
        jacobian: (frames, drones, cameras, 2, 3), derivatives of the projection by the position, pixels per metre; 0
            where the drone's position is not known or is not in front of the camera.
        weight: (frames, drones, cameras, 2), weights of the views in the estimate of the position, along columns and
            rows; 0 where the camera does not count. Only their ratios matter.
        flow_px_s: (frames, drones, cameras, 2), velocities of the drones in the images, pixels per second.
        turn_px: (frames, drones, cameras, 2, 3), derivatives of the projection by small turns of the camera about its
            own x, y and z axes, pixels per radian.
    """

    residual_px: Float[np.ndarray, "frames drones cameras 2"]
    jacobian: Float[np.ndarray, "frames drones cameras 2 3"]
    weight: Float[np.ndarray, "frames drones cameras 2"]
    flow_px_s: Float[np.ndarray, "frames drones cameras 2"]
    turn_px: Float[np.ndarray, "frames drones cameras 2 3"]

    @property
    def num_cameras(self) -> int:
        """Number of cameras."""
        return self.weight.shape[2]

    @cached_property
    def shown(self) -> Bool[np.ndarray, "frames drones cameras"]:
        """(frames, drones, cameras), whether the camera shows the place of the drone."""
        return np.asarray(np.isfinite(self.residual_px).all(axis=-1) & (self.weight > 0).all(axis=-1))

    @cached_property
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
    moved_m: Float[np.ndarray, "frames drones cameras 3"] | None = None,
) -> CameraViews:
    """The views, from the drones' places in the images.

    Args:
        cameras: cameras with one leading axis.
        place_px: (frames, drones, cameras, 2), pixels; NaN where a camera does not show the place.
        weight: (frames, drones, cameras, 2), weights of the views in the estimate; 0 where a camera does not count.
        position_m, velocity_m_s: (frames, drones, 3), the tracks, metres and m/s; NaN where they are not known.
        moved_m: (frames, drones, cameras, 3), how far each drone has moved until each camera's exposure, metres (see
            `psotrack.silhouettes.moved_by`); None where all cameras' frames were exposed at the instant.
    """
    known = np.isfinite(position_m).all(axis=-1)
    seen_m = _seen(position_m, moved_m)
    _, depth, jacobian = project_with_jacobian(cameras, seen_m)
    pixels, _ = project_visible(cameras, seen_m)
    ahead = known[..., None] & (depth > NEAR_M) & np.isfinite(pixels).all(axis=-1)
    jacobian = np.where(ahead[..., None, None], jacobian, 0.0)
    # A camera that turns by w moves a point by w x p in its own axes.
    in_camera_m = np.asarray(to_camera(cameras, seen_m))
    by_camera = jacobian @ cameras.T_cam_world[:, :3, :3].swapaxes(-1, -2)
    return CameraViews(
        residual_px=np.where(ahead[..., None], place_px - pixels, np.nan),
        jacobian=jacobian,
        weight=np.where(ahead[..., None], weight, 0.0),
        flow_px_s=np.einsum("...cij,...j->...ci", jacobian, np.nan_to_num(velocity_m_s)),
        turn_px=-by_camera @ cross_matrices(in_camera_m),
    )


def views_of_sightings(
    cameras: Camera,
    sightings: Sightings,
    position_m: Float[np.ndarray, "frames drones 3"],
    velocity_m_s: Float[np.ndarray, "frames drones 3"],
) -> CameraViews:
    """The views, from detections: the detection nearest to a drone's projection, if no other drone is nearer to it.

    Args:
        cameras: cameras with one leading axis.
        sightings: detections of all cameras.
        position_m, velocity_m_s: (frames, drones, 3), the tracks, metres and m/s; NaN where they are not known.
    """
    moved_m = _moved(sightings.exposures, velocity_m_s)
    known = np.isfinite(position_m).all(axis=-1)
    pixels, depth = project_visible(cameras, _seen(position_m, moved_m))
    ahead = known[..., None] & (depth > NEAR_M) & np.isfinite(pixels).all(axis=-1)
    pixels = np.where(ahead[..., None], pixels, np.nan)
    # (frames, drones, cameras, boxes), distances in standard deviations of the detections.
    off_px = sightings.centre_px[:, None] - pixels[..., None, :]
    distance = np.linalg.norm(off_px, axis=-1) / sightings.noise_px[:, None]
    distance = np.where(np.isfinite(distance), distance, np.inf)
    box = distance.argmin(axis=-1)
    nearest = np.take_along_axis(distance, box[..., None], axis=-1)[..., 0]
    own_drone = np.take_along_axis(distance.argmin(axis=1), box.swapaxes(1, 2), axis=-1).swapaxes(1, 2)
    of_drone = np.isfinite(nearest) & (own_drone == np.arange(position_m.shape[1])[:, None])
    # Most detections are of the drones: their median distance shows the real noise, which may exceed the stated noise.
    # Both axes together have a Rayleigh distribution, whose median is 1.18 standard deviations.
    usual = np.median(nearest[of_drone]) / 1.18 if of_drone.any() else 1.0
    of_drone &= nearest <= _GATE * max(1.0, float(usual))
    frame, camera = np.ogrid[: len(box), : box.shape[2]]
    at = (frame[:, None], camera[:, None], box)
    place_px = np.where(of_drone[..., None], sightings.centre_px[at], np.nan)
    weight = np.where(of_drone, np.nan_to_num(sightings.noise_px[at], nan=np.inf) ** -2.0, 0.0)
    views = views_of_places(
        cameras, place_px, np.repeat(weight[..., None], 2, axis=-1), position_m, velocity_m_s, moved_m
    )
    return _without_outliers(views)


def _moved(
    exposures: Exposures | None, velocity_m_s: Float[np.ndarray, "frames drones 3"]
) -> Float[np.ndarray, "frames drones cameras 3"] | None:
    """How far each drone moves until each camera's exposure, metres; None where all are exposed at the instant."""
    return None if exposures is None else moved_by(exposures, np.nan_to_num(velocity_m_s))


def _seen(
    position_m: Float[np.ndarray, "frames drones 3"],
    moved_m: Float[np.ndarray, "frames drones cameras 3"] | None,
) -> Float[np.ndarray, "frames drones #cameras 3"]:
    """Where each camera sees each drone; the origin where a drone's position is not known."""
    seen_m = position_m[:, :, None] if moved_m is None else position_m[:, :, None] + moved_m
    return np.nan_to_num(seen_m)


def _without_outliers(views: CameraViews) -> CameraViews:
    """The views without detections that are far from what is usual for their camera."""
    off_px = views.residual_px - np.nanmedian(views.residual_px, axis=(0, 1)) if views.shown.any() else 0.0
    spread_px = _MAD_STD * np.nanmedian(np.abs(off_px), axis=(0, 1)) if views.shown.any() else 1.0
    far = (np.abs(off_px) > _GATE * np.maximum(spread_px, 1e-6)).any(axis=-1)
    return replace(
        views,
        residual_px=np.where(far[..., None], np.nan, views.residual_px),
        weight=np.where(far[..., None], 0.0, views.weight),
    )


def views_of_middles(
    cameras: Camera,
    exposures: Exposures | None,
    middles: CameraMiddles,
    drones: FoundDrones,
) -> CameraViews:
    """The views, from the middles of the foreground.

    Args:
        cameras: cameras with one leading axis.
        exposures: exposures of the silhouettes; None where all cameras' frames were exposed at the instant.
        middles: the middles (see `psotrack.tracking.middles_in_cameras`).
        drones: the drones of the run.
    """
    # The score changes with a shift relative to the box, so a view counts by the square of this share.
    weight = np.nan_to_num(np.square(1 / np.asarray(middles.half_px, np.float64)))
    return views_of_places(
        cameras,
        np.asarray(middles.middle_px, np.float64),
        weight,
        drones.position_m,
        drones.velocity_m_s,
        _moved(exposures, drones.velocity_m_s),
    )
