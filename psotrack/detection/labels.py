"""Labels for a detector, made by the reference: each drone's box in space as a box in every image (paper, figure 9).

A drone's box in space turns with its body where the reference knows how; else it stands along the world's axes. The
label is the box around its eight projected corners, in the pixel convention of `boxes`, cut at the image's border. It
holds all of the drone, and more: a box in space has corners where few drones have anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float

from psotrack.errors import SettingsError, check_positive
from psotrack.geometry import NEAR_M, Camera, distort, project, rotation_matrices, to_camera
from psotrack.trajectories import Trajectories

#: Where lenses are looked at: up to 80 degrees off the axis.
_RADII = np.linspace(0.0, 5.7, 571)
_SIGNS = np.array(list(product((-0.5, 0.5), repeat=3)))


@dataclass(frozen=True)
class LabelSettings:
    """How drones become labels.

    Attributes:
        drone_size_m: full lengths of a drone's box along its own axes; along the world's where the reference has no
            orientations.
        offset_m: from the reference's point to the middle of the box, along the same axes.
        min_inside: share of a box that must lie in the image.
        max_hidden: share of what lies in the image that one nearer box may cover.
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
    """Corners of the drones' boxes, world, metres; NaN where the pose is not known.

    Args:
        truth: with orientations or without.
        size_m, offset_m: (3,) or (drones, 3), as in `LabelSettings`.
    """
    corners_m = offset_m[..., None, :] + _SIGNS * size_m[..., None, :]
    if truth.orientation_wxyz is not None:
        rotation = _rotations(truth.orientation_wxyz)
        # (frames, drones, 1, 3, 3) turns (drones or nothing, 8, 3).
        corners_m = np.matvec(rotation[:, :, None], corners_m)
    return truth.position_m[:, :, None, :] + corners_m


def label_boxes(
    cameras: Camera, corners_m: Float[np.ndarray, "*frames drones 8 3"], settings: LabelSettings
) -> Float[np.ndarray, "*frames drones cameras 4"]:
    """Boxes of drones in images, lens distortion included, cut at the image's border.

    Args:
        cameras: with one leading axis.
        corners_m: (..., drones, 8, 3), from `box_corners`.
        settings: which boxes count.

    Returns:
        (..., drones, cameras, 4), xyxy in pixels in the convention of `boxes`; NaN where a drone is behind the camera,
        or beyond what its lens's polynomial holds for, too little of it is in the image, or a nearer one hides it.
    """
    points_cam = to_camera(cameras, corners_m[..., None, :])
    pixels, depth = project(cameras, corners_m[..., None, :])
    # Half a pixel from pixel centres at whole numbers to edges there.
    whole = np.concatenate([pixels.min(axis=-3), pixels.max(axis=-3)], axis=-1) + 0.5
    size_wh = np.asarray(cameras.image_size_wh)
    cut = np.clip(whole, 0.0, np.concatenate([size_wh, size_wh], axis=-1))
    # Polynomials of lenses turn back far outside the image, and bring into it what is not there.
    radius = np.hypot(points_cam[..., 0], points_cam[..., 1]) / np.maximum(depth, NEAR_M)
    there = (depth.min(axis=-2) > NEAR_M) & (radius.max(axis=-2) <= _last_radius(cameras))
    there &= (_area(cut) > 0) & (_area(cut) >= settings.min_inside * _area(whole))
    distance_m = np.linalg.norm(points_cam.mean(axis=-3), axis=-1)
    visible = there & (_covered(cut, distance_m, there) <= settings.max_hidden)
    return np.where(visible[..., None], cut, np.nan)


def _rotations(
    orientation_wxyz: Float[np.ndarray, "frames drones 4"],
) -> Float[np.ndarray, "frames drones 3 3"]:
    """From body to world; none for drones that never have an orientation, NaN where one is missing."""
    rotation = rotation_matrices(orientation_wxyz)
    rotation[:, np.isnan(rotation[..., 0, 0]).all(axis=0)] = np.eye(3)
    return rotation


def _last_radius(cameras: Camera) -> Float[np.ndarray, "cameras"]:
    """How far off the axis, at unit depth, the polynomial of the lens turns back; infinite where it does not."""
    radius = _RADII[:, None] * np.ones(len(cameras.K))
    # Half the difference of both sides is the radial part alone.
    bent = distort(cameras, radius, 0 * radius)[0] - distort(cameras, -radius, 0 * radius)[0]
    turned = np.diff(np.asarray(bent), axis=0) <= 0
    return np.where(turned.any(axis=0), _RADII[turned.argmax(axis=0)], np.inf)


def _area(xyxy: Float[np.ndarray, "*boxes 4"]) -> Float[np.ndarray, "*boxes"]:
    return (xyxy[..., 2] - xyxy[..., 0]) * (xyxy[..., 3] - xyxy[..., 1])


def _covered(
    xyxy: Float[np.ndarray, "*frames drones cameras 4"],
    distance_m: Float[np.ndarray, "*frames drones cameras"],
    there: Bool[np.ndarray, "*frames drones cameras"],
) -> Float[np.ndarray, "*frames drones cameras"]:
    """The largest share of each box that one nearer box covers."""
    one, other = xyxy[..., :, None, :, :], xyxy[..., None, :, :, :]
    low, high = np.maximum(one[..., :2], other[..., :2]), np.minimum(one[..., 2:], other[..., 2:])
    common = np.maximum(high - low, 0.0).prod(axis=-1)
    nearer = there[..., None, :, :] & (distance_m[..., None, :, :] < distance_m[..., :, None, :])
    share = common / np.maximum(_area(one), 1e-12)
    return np.where(nearer, share, 0.0).max(axis=-2, initial=0.0)
