"""Where each camera shows the drones of tracks: at each instant, in the frame that the camera shows then.

A camera's frame is exposed before or after the instant, and the rows of a rolling shutter one after the other. A drone
is drawn where it is at the exposure: at its position plus its velocity times the difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.evaluation import INSIDE_90
from psotrack.geometry import (
    in_images,
    make_extents,
    moved_extents,
    project_boxes,
    project_visible,
    project_with_jacobian,
)
from psotrack.recordings.recording import Recording
from psotrack.recordings.timing import nearest_frames
from psotrack.support import as_written
from psotrack.trajectories import Trajectories

_Vectors = Float[np.ndarray, "frames drones 3"]
_Sizes = Float[np.ndarray, "drones 3"]
#: Number of instants that are projected together, which bounds the memory of long flights.
_TOGETHER = 5000
#: Number of points on the outline of an ellipse.
_OUTLINE_POINTS = 25


@dataclass(frozen=True)
class ImageViews:
    """The drones of tracks as the cameras of a rig show them.

    Attributes:
        frame: (frames, cameras), number of the frame that each camera shows at each instant; -1 for none.
        boxes_px: (frames, drones, cameras, 4), left, top, right and bottom edges in pixels, half-open (see
            `geometry.boxes`); NaN where the drone has no position or is lost, where the camera has no frame, and where
            no part of the box is in the image.
        middle_px: (frames, drones, cameras, 2), the drones' middles, pixels with centres at whole numbers; NaN where
            the camera does not show them, and for tracks without covariances.
        shape_px2: (frames, drones, cameras, 2, 2), matrices S of the outlines (x - middle)ᵀ S⁻¹ (x - middle) = 1 of
            the 90 % ellipsoids; NaN where the middle is.
    """

    frame: Int[np.ndarray, "frames cameras"]
    boxes_px: Float[np.ndarray, "frames drones cameras 4"]
    middle_px: Float[np.ndarray, "frames drones cameras 2"]
    shape_px2: Float[np.ndarray, "frames drones cameras 2 2"]


def view_in_images(recording: Recording, trajectories: Trajectories, size_m: _Sizes) -> ImageViews:
    """The drones in the images of every camera.

    The image of an ellipsoid with covariance C is the ellipse of J C Jᵀ with the projection's derivative J at the
    ellipsoid's middle.

    Args:
        recording: the cameras and the times of their frames.
        trajectories: the tracks.
        size_m: (drones, 3), full lengths of the drones along the world's axes, metres.
    """
    cameras, seen = recording.rig.cameras, trajectories.seen
    pairs = [nearest_frames(recording.exposed[name], trajectories.time_s) for name in recording.rig.names]
    frame, offset_s = (np.stack(parts, axis=1) for parts in zip(*pairs, strict=True))
    position_m = np.where(seen[..., None], trajectories.position_m, np.nan).astype(np.float64)
    exposed_s = _exposures_s(recording, position_m, offset_s)
    moved_m = _velocities_m_s(trajectories)[:, :, None] * exposed_s[..., None]
    there = seen[:, :, None] & (frame >= 0)[:, None]
    middle_px = np.full((*there.shape, 2), np.nan)
    shape_px2 = np.full((*there.shape, 2, 2), np.nan)
    if trajectories.covariance_m2 is not None:
        at_m = position_m[:, :, None] + moved_m
        middle_px, _, jacobian = project_with_jacobian(cameras, at_m)
        shape_px2 = INSIDE_90 * np.einsum(
            "fdcij,fdjk,fdclk->fdcil", jacobian, trajectories.covariance_m2.astype(np.float64), jacobian
        )
        inside = [in_images(cameras[[index]], at_m[:, :, index]) for index in range(len(recording.rig))]
        shown = there & np.concatenate(inside, axis=-1)
        middle_px = np.where(shown[..., None], middle_px, np.nan)
        shape_px2 = np.where(shown[..., None, None], shape_px2, np.nan)
    return ImageViews(frame, _boxes_px(recording, position_m, moved_m, size_m, there), middle_px, shape_px2)


def ellipse_outlines_px(
    middle_px: Float[np.ndarray, "*ellipses 2"], shape_px2: Float[np.ndarray, "*ellipses 2 2"]
) -> Float[np.ndarray, "*ellipses points 2"]:
    """Points on the outlines of ellipses (x - middle)ᵀ S⁻¹ (x - middle) = 1; the last point is the first one again."""
    square, directions = np.linalg.eigh(shape_px2)
    half_px = np.sqrt(np.maximum(square, 0.0))
    turn = np.linspace(0.0, 2 * np.pi, _OUTLINE_POINTS)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return middle_px[..., None, :] + np.einsum("...ij,...j,pj->...pi", directions, half_px, circle)


@as_written()
def _boxes_px(
    recording: Recording,
    position_m: _Vectors,
    moved_m: Float[np.ndarray, "frames drones cameras 3"],
    size_m: _Sizes,
    there: Bool[np.ndarray, "frames drones cameras"],
) -> Float[np.ndarray, "frames drones cameras 4"]:
    """Boxes of drones that have moved since the instant; NaN where they are not shown."""
    cameras = jax.tree.map(
        lambda leaf: jnp.asarray(leaf, bool if leaf.dtype == bool else jnp.float32), recording.rig.cameras
    )
    boxes_px = np.full((*there.shape, 4), np.nan)
    for first in range(0, len(position_m), _TOGETHER):
        part = slice(first, first + _TOGETHER)
        at_m = jnp.asarray(np.nan_to_num(position_m[part]), jnp.float32)
        extents = make_extents(cameras, jnp.asarray(np.broadcast_to(size_m, at_m.shape), jnp.float32))
        boxes = project_boxes(moved_extents(extents, jnp.asarray(moved_m[part], jnp.float32)), at_m)
        shown = there[part] & np.asarray(boxes.in_front)
        boxes_px[part] = np.where(shown[..., None], np.asarray(boxes.xyxy), np.nan)
    image_size_wh = np.asarray(recording.rig.cameras.image_size_wh)
    outside = (boxes_px[..., 2:] <= 0).any(axis=-1) | (boxes_px[..., :2] >= image_size_wh).any(axis=-1)
    boxes_px[outside] = np.nan
    return boxes_px


def _exposures_s(
    recording: Recording,
    position_m: _Vectors,
    offset_s: Float[np.ndarray, "frames cameras"],
) -> Float[np.ndarray, "frames drones cameras"]:
    """Time from each instant to the exposure of each drone in each camera, seconds; 0 where it is not shown."""
    line_time_s = np.array([each.line_time_s for each in recording.placed])
    height_px = np.asarray(recording.rig.cameras.image_size_wh)[:, 1]
    row_px = np.asarray(project_visible(recording.rig.cameras, position_m[:, :, None])[0])[..., 1] + 0.5
    row_px = np.clip(np.nan_to_num(row_px, nan=0.0), 0.0, height_px)
    return offset_s[:, None] + line_time_s * (row_px - height_px / 2)


def _velocities_m_s(trajectories: Trajectories) -> _Vectors:
    """Velocities of the tracks, or differences of their positions; 0 where neither is known, m/s."""
    if trajectories.velocity_m_s is not None:
        return np.nan_to_num(trajectories.velocity_m_s)
    if trajectories.num_frames < 2:
        return np.zeros(trajectories.position_m.shape)
    return np.nan_to_num(np.gradient(trajectories.position_m, trajectories.time_s, axis=0))
