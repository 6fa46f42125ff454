"""Labels for a detector from the reference: each drone's box in space becomes a box in every image (paper, figure 9).

A drone's box in space turns with its body if the reference has orientations; otherwise its sides are parallel to the
world's axes. The label is the box around the eight projected corners, in the pixel convention of `boxes`, cut at the
image's border. The label is larger than the drone's outline, because drones do not reach the corners of their boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float

from psotrack.errors import SettingsError, check_positive
from psotrack.geometry import Camera, has_image, rotation_matrices, to_camera, to_pixels
from psotrack.trajectories import Trajectories

_SIGNS = np.array(list(product((-0.5, 0.5), repeat=3)))


@dataclass(frozen=True)
class LabelSettings:
    """Settings of the labels.

    Attributes:
        drone_size_m: full lengths of a drone's box along the body's axes, metres; along the world's axes if the
            reference has no orientations.
        offset_m: vector from the reference's tracked point to the middle of the box, along the same axes, metres.
        min_inside: smallest share of a box that must lie in the image.
        max_hidden: largest share of the visible box that one nearer box may cover.

    Raises:
        SettingsError: a value is out of range.
    """

    drone_size_m: tuple[float, float, float]
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    min_inside: float = 0.3
    max_hidden: float = 0.7

    def __post_init__(self) -> None:
        for length_m in self.drone_size_m:
            check_positive("drone_size_m", length_m)
        for name in ("min_inside", "max_hidden"):
            if not 0 <= getattr(self, name) <= 1:
                raise SettingsError(name, expected="a share, 0 to 1", found=f"{getattr(self, name):g}")


def box_corners(
    truth: Trajectories, size_m: Float[np.ndarray, "*#drones 3"], offset_m: Float[np.ndarray, "*#drones 3"]
) -> Float[np.ndarray, "frames drones 8 3"]:
    """Corners of the drones' boxes in the world, metres; NaN if the pose is unknown.

    Args:
        truth: the reference, with or without orientations.
        size_m: (3,) or (drones, 3), lengths of the boxes as in `LabelSettings`, metres.
        offset_m: (3,) or (drones, 3), offsets as in `LabelSettings`, metres.
    """
    corners_m = offset_m[..., None, :] + _SIGNS * size_m[..., None, :]
    if truth.orientation_wxyz is not None:
        rotation = _rotations(truth.orientation_wxyz)
        # Rotations (frames, drones, 1, 3, 3) times corners (8, 3) or (drones, 8, 3).
        corners_m = np.matvec(rotation[:, :, None], corners_m)
    return truth.position_m[:, :, None, :] + corners_m


def label_boxes(
    cameras: Camera, corners_m: Float[np.ndarray, "*frames drones 8 3"], settings: LabelSettings
) -> Float[np.ndarray, "*frames drones cameras 4"]:
    """Boxes of drones in images, lens distortion included, cut at the image's border.

    Args:
        cameras: cameras with one leading axis.
        corners_m: (..., drones, 8, 3), corners from `box_corners`, metres.
        settings: settings of the labels.

    Returns:
        (..., drones, cameras, 4), xyxy in pixels in the convention of `boxes`. NaN if the drone is behind the camera or
        beyond the fold of its lens, too little of the drone is in the image, or a nearer drone hides
        it.
    """
    points_cam = to_camera(cameras, corners_m[..., None, :])
    pixels = to_pixels(cameras, points_cam)
    # Half a pixel converts from pixel centres at whole numbers to pixel edges at whole numbers.
    whole = np.concatenate([pixels.min(axis=-3), pixels.max(axis=-3)], axis=-1) + 0.5
    size_wh = np.asarray(cameras.image_size_wh)
    cut = np.clip(whole, 0.0, np.concatenate([size_wh, size_wh], axis=-1))
    in_image = np.asarray(has_image(cameras, points_cam)).all(axis=-2)
    in_image &= (_area(cut) > 0) & (_area(cut) >= settings.min_inside * _area(whole))
    distance_m = np.linalg.norm(points_cam.mean(axis=-3), axis=-1)
    visible = in_image & (_covered_share(cut, distance_m, in_image) <= settings.max_hidden)
    return np.where(visible[..., None], cut, np.nan)


def _rotations(
    orientation_wxyz: Float[np.ndarray, "frames drones 4"],
) -> Float[np.ndarray, "frames drones 3 3"]:
    """Rotations from body to world: identity for drones that never have an orientation, NaN in frames without one."""
    rotation = rotation_matrices(orientation_wxyz)
    rotation[:, np.isnan(rotation[..., 0, 0]).all(axis=0)] = np.eye(3)
    return rotation


def _area(xyxy: Float[np.ndarray, "*boxes 4"]) -> Float[np.ndarray, "*boxes"]:
    return (xyxy[..., 2] - xyxy[..., 0]) * (xyxy[..., 3] - xyxy[..., 1])


def _covered_share(
    xyxy: Float[np.ndarray, "*frames drones cameras 4"],
    distance_m: Float[np.ndarray, "*frames drones cameras"],
    in_image: Bool[np.ndarray, "*frames drones cameras"],
) -> Float[np.ndarray, "*frames drones cameras"]:
    """Largest share of each box that one nearer box covers."""
    box, other = xyxy[..., :, None, :, :], xyxy[..., None, :, :, :]
    low, high = np.maximum(box[..., :2], other[..., :2]), np.minimum(box[..., 2:], other[..., 2:])
    common = np.maximum(high - low, 0.0).prod(axis=-1)
    nearer = in_image[..., None, :, :] & (distance_m[..., None, :, :] < distance_m[..., :, None, :])
    share = common / np.maximum(_area(box), 1e-12)
    return np.where(nearer, share, 0.0).max(axis=-2, initial=0.0)
