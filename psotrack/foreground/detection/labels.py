"""Labels for a detector from the reference: each drone's box in space becomes a box in every image (paper, figure 9).

A drone's box in space turns with its body if the reference has orientations; otherwise its sides are parallel to the
world's axes. The label is the box around the eight projected corners, in the pixel convention of `boxes`, cut at the
image's border. The label is larger than the drone's outline, because drones do not reach the corners of their boxes.
"""

from __future__ import annotations

from itertools import product
from typing import Annotated

import msgspec
import numpy as np
from jaxtyping import Float
from msgspec import Meta

from psotrack.geometry import Camera, has_image, rotation_matrices, to_camera, to_pixels
from psotrack.support import Positive, Share, check_types
from psotrack.trajectories import Trajectories

_SIGNS = np.array(list(product((-0.5, 0.5), repeat=3)))


class LabelSettings(msgspec.Struct, frozen=True):
    """Settings of the labels.

    Attributes:
        drone_size_m: full lengths of a drone's box along the body's axes, metres; along the world's axes if the
            reference has no orientations.
        offset_m: vector from the reference's tracked point to the middle of the box, along the same axes, metres.
        min_inside: smallest share of a box that must lie in the image.
        max_hidden: largest share of the visible box that one nearer box may cover.
        every: step between the frames that are used.

    Raises:
        SettingsError: a value is out of range.
    """

    drone_size_m: tuple[Positive, Positive, Positive]
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    min_inside: Share = 0.3
    max_hidden: Share = 0.7
    every: Annotated[int, Meta(ge=1)] = 1

    def __post_init__(self) -> None:
        check_types(self)


def box_corners(truth: Trajectories, settings: LabelSettings) -> Float[np.ndarray, "frames drones 8 3"]:
    """Corners of the drones' boxes in the world, metres; NaN if the pose is unknown.

    A drone that never has an orientation has a level box.

    Args:
        truth: the reference, with or without orientations.
        settings: settings of the labels.
    """
    corners_m = np.array(settings.offset_m) + _SIGNS * np.array(settings.drone_size_m)
    if truth.orientation_wxyz is not None:
        rotation = rotation_matrices(truth.orientation_wxyz)
        rotation[:, np.isnan(rotation).any(axis=(2, 3)).all(axis=0)] = np.eye(3)
        corners_m = np.matvec(rotation[:, :, None], corners_m)
    return truth.position_m[:, :, None] + corners_m


def label_boxes(
    camera: Camera, corners_m: Float[np.ndarray, "frames drones 8 3"], settings: LabelSettings
) -> Float[np.ndarray, "frames drones 4"]:
    """Boxes of drones in the images of a camera, lens distortion included, cut at the image's border.

    Args:
        camera: the camera.
        corners_m: (frames, drones, 8, 3), corners from `box_corners`, metres.
        settings: settings of the labels.

    Returns:
        (frames, drones, 4), xyxy in pixels in the convention of `boxes`. NaN if the drone is behind the camera or
        beyond the fold of its lens, too little of the drone is in the image, or a nearer drone hides it.
    """
    points_cam = to_camera(camera, corners_m)
    pixels = to_pixels(camera, points_cam)
    # Half a pixel converts from pixel centres at whole numbers to pixel edges at whole numbers.
    whole = np.concatenate([pixels.min(axis=2), pixels.max(axis=2)], axis=-1) + 0.5
    cut = np.clip(whole, 0.0, np.tile(camera.image_size_wh, 2))
    area_px = _area(cut)
    in_image = np.asarray(has_image(camera, points_cam)).all(axis=2)
    in_image &= (area_px > 0) & (area_px >= settings.min_inside * _area(whole))
    # Pairs of a drone and another one, (frames, drones, others).
    box, other = cut[:, :, None], cut[:, None]
    low, high = np.maximum(box, other)[..., :2], np.minimum(box, other)[..., 2:]
    common_px = np.maximum(high - low, 0.0).prod(axis=-1)
    distance_m = np.linalg.norm(points_cam.mean(axis=2), axis=-1)
    nearer = in_image[:, None] & (distance_m[:, None] < distance_m[..., None])
    hidden_px = np.where(nearer, common_px, 0.0).max(axis=2, initial=0.0)
    visible = in_image & (hidden_px <= settings.max_hidden * area_px)
    return np.where(visible[..., None], cut, np.nan)


def _area(xyxy: Float[np.ndarray, "*boxes 4"]) -> Float[np.ndarray, "*boxes"]:
    return (xyxy[..., 2:] - xyxy[..., :2]).prod(axis=-1)
