"""Where each camera shows the drones of tracks: at each instant, in the frame that the camera shows then.

A camera's frame is exposed before or after the instant, and the rows of a rolling shutter one after the other. A drone
is drawn where it is at the exposure: at its position plus its velocity times the difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from psotrack.evaluation import INSIDE_90
from psotrack.geometry import (
    in_images,
    make_extents,
    moved_extents,
    project_boxes,
    project_visible,
    project_with_jacobian,
)
from psotrack.recordings import Recording, Timeline, nearest_frames
from psotrack.trajectories import Trajectories

#: Number of instants that are projected together, which bounds the memory of long flights.
_TOGETHER = 5000
#: Number of points on the outline of an ellipse.
_OUTLINE_POINTS = 25


@dataclass(frozen=True)
class ImageEllipses:
    """Outlines of the 90 % ellipsoids in the images, in linear approximation at the ellipsoid's middle.

    Attributes:
        middle_px: (frames, drones, cameras, 2), pixels with centres at whole numbers; NaN where the camera does not
            show the drone.
        shape_px2: (frames, drones, cameras, 2, 2), matrices S of the outlines (x - middle)ᵀ S⁻¹ (x - middle) = 1.
    """

    middle_px: Float[np.ndarray, "frames drones cameras 2"]
    shape_px2: Float[np.ndarray, "frames drones cameras 2 2"]


def shown_frames(recording: Recording, trajectories: Trajectories) -> Timeline:
    """The frame that each camera of the rig shows at each instant of tracks, by the tracks' own times."""
    exposed = recording.exposed
    pairs = [nearest_frames(exposed[name], trajectories.time_s) for name in recording.rig.names]
    line_time_s = np.array([recording.line_time_s.get(name, 0.0) for name in recording.rig.names])
    return Timeline(
        cameras=recording.rig.names,
        rate_hz=recording.fps,
        time_s=np.asarray(trajectories.time_s, np.float64),
        frame=np.stack([frame for frame, _ in pairs], axis=1),
        offset_s=np.stack([offset_s for _, offset_s in pairs], axis=1),
        line_time_s=line_time_s if line_time_s.any() else None,
    )


def boxes_in_images(
    recording: Recording, trajectories: Trajectories, size_m: Float[np.ndarray, "drones 3"]
) -> Float[np.ndarray, "frames drones cameras 4"]:
    """Boxes of the drones in every camera.

    Args:
        recording: the cameras and the times of their frames.
        trajectories: the tracks.
        size_m: (drones, 3), full lengths of the drones along the world's axes, metres.

    Returns:
        (frames, drones, cameras, 4), left, top, right and bottom edges in pixels, half-open (see `geometry.boxes`); NaN
        where the drone has no position or is lost, where the camera has no frame, and where no part of the box is in
        the image.
    """
    shown = shown_frames(recording, trajectories)
    cameras = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, bool if leaf.dtype == bool else jnp.float32), recording.rig.cameras
    )
    boxes_px = np.full((trajectories.num_frames, trajectories.num_drones, len(recording.rig), 4), np.nan)
    offset_s = _exposure_offsets_s(recording, trajectories, shown)
    velocity_m_s, seen = _velocities_m_s(trajectories), trajectories.seen
    for first in range(0, trajectories.num_frames, _TOGETHER):
        part = slice(first, first + _TOGETHER)
        moved_m = velocity_m_s[part, :, None] * offset_s[part, ..., None]
        position_m = np.where(seen[part, :, None], trajectories.position_m[part], 0.0)
        extents = make_extents(cameras, jnp.asarray(np.broadcast_to(size_m, position_m.shape), jnp.float32))
        boxes = project_boxes(
            moved_extents(extents, jnp.asarray(moved_m, jnp.float32)), jnp.asarray(position_m, jnp.float32)
        )
        there = np.asarray(boxes.in_front) & seen[part, :, None] & shown.is_there[part, None]
        boxes_px[part] = np.where(there[..., None], np.asarray(boxes.xyxy), np.nan)
    return _inside(boxes_px, np.asarray(recording.rig.cameras.image_size_wh))


def ellipses_in_images(recording: Recording, trajectories: Trajectories) -> ImageEllipses | None:
    """Outlines of the tracks' 90 % ellipsoids in every camera; None for tracks without covariances.

    The image of an ellipsoid with covariance C is the ellipse of J C Jᵀ with the projection's derivative J.
    """
    if trajectories.covariance_m2 is None:
        return None
    shown = shown_frames(recording, trajectories)
    offset_s = _exposure_offsets_s(recording, trajectories, shown)
    moved_m = _velocities_m_s(trajectories)[:, :, None] * offset_s[..., None]
    seen = trajectories.seen
    position_m = np.where(seen[..., None], trajectories.position_m, np.nan).astype(np.float64)
    at_m = position_m[:, :, None] + moved_m
    middle_px, _, jacobian = project_with_jacobian(recording.rig.cameras, at_m)
    visible = np.stack(
        [
            np.asarray(in_images(recording.rig.cameras[[camera]], at_m[:, :, camera]))[..., 0]
            for camera in range(len(recording.rig))
        ],
        axis=-1,
    )
    visible &= shown.is_there[:, None]
    shape_px2 = INSIDE_90 * np.einsum(
        "fdcij,fdjk,fdclk->fdcil", jacobian, trajectories.covariance_m2.astype(np.float64), jacobian
    )
    return ImageEllipses(
        np.where(visible[..., None], middle_px, np.nan), np.where(visible[..., None, None], shape_px2, np.nan)
    )


def ellipse_outlines_px(
    middle_px: Float[np.ndarray, "*ellipses 2"], shape_px2: Float[np.ndarray, "*ellipses 2 2"]
) -> Float[np.ndarray, "*ellipses points 2"]:
    """Points on the outlines of ellipses (x - middle)ᵀ S⁻¹ (x - middle) = 1; the last point is the first one again."""
    square, directions = np.linalg.eigh(shape_px2)
    half_px = np.sqrt(np.maximum(square, 0.0))
    turn = np.linspace(0.0, 2 * np.pi, _OUTLINE_POINTS)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return middle_px[..., None, :] + np.einsum("...ij,...j,pj->...pi", directions, half_px, circle)


def _exposure_offsets_s(
    recording: Recording, trajectories: Trajectories, shown: Timeline
) -> Float[np.ndarray, "frames drones cameras"]:
    """Time from each instant to the exposure of each drone in each camera, seconds; 0 where it is not shown."""
    offset_s = np.repeat(shown.offset_s[:, None], trajectories.num_drones, axis=1)
    if shown.line_time_s is None:
        return offset_s
    height_px = np.asarray(recording.rig.cameras.image_size_wh)[:, 1]
    position_m = np.asarray(trajectories.position_m, np.float64)[:, :, None]
    row_px = np.asarray(project_visible(recording.rig.cameras, position_m)[0])[..., 1] + 0.5
    row_px = np.clip(np.nan_to_num(row_px, nan=0.0), 0.0, height_px)
    return offset_s + shown.line_time_s * (row_px - height_px / 2)


def _velocities_m_s(trajectories: Trajectories) -> Float[np.ndarray, "frames drones 3"]:
    """Velocities of the tracks, or differences of their positions; 0 where neither is known, m/s."""
    if trajectories.velocity_m_s is not None:
        return np.nan_to_num(trajectories.velocity_m_s)
    if trajectories.num_frames < 2:
        return np.zeros(trajectories.position_m.shape)
    return np.nan_to_num(np.gradient(trajectories.position_m, trajectories.time_s, axis=0))


def _inside(
    boxes_px: Float[np.ndarray, "frames drones cameras 4"], image_size_wh: Float[np.ndarray, "cameras 2"]
) -> Float[np.ndarray, "frames drones cameras 4"]:
    """The boxes, NaN where no part of the box is in the image."""
    outside = (boxes_px[..., 2:] <= 0).any(axis=-1) | (boxes_px[..., :2] >= image_size_wh).any(axis=-1)
    boxes_px[outside] = np.nan
    return boxes_px
