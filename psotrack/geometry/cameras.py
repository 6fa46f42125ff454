"""Cameras and rigs as pytrees, and the projection of world points to pixels.

Conventions of the whole package:

- World: right-handed, z up, metres. Camera: x right, y down, z forward (OpenCV).
- `T_cam_world` maps world to camera: `x_cam = R x_world + t`. Its last column is t, not the camera's centre.
- Pixels: (x, y) = (column, row); the centre of the first pixel is (0, 0), as in OpenCV's calibration.
- Lens distortion is OpenCV's, pinhole or fisheye (see `lenses`); a rig without distortion has 0 coefficients. A point
  beyond the fold of its lens has no image: `has_image`.

The functions return the kind of array that they are given: NumPy float64 in calibration and triangulation, JAX arrays
and tracers in the tracker. Both use the same projection.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack.errors import SettingsError
from psotrack.geometry.camera_names import chosen_cameras
from psotrack.geometry.lenses import (
    FISHEYE_COEFFICIENTS,
    PINHOLE_COEFFICIENTS,
    distort,
    is_one_to_one,
    undistort_normalised,
)
from psotrack.support import short_repr
from psotrack.support.array_types import Array

#: Smallest depth of a point that has a projection, metres.
NEAR_M = 1e-3


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Camera:
    """One camera, or several cameras along a leading axis.

    Attributes:
        T_cam_world: (..., 4, 4), world to camera, metres.
        K: (..., 3, 3), intrinsics in pixels.
        dist: (..., coefficients), lens distortion in OpenCV's order; 0, 4, 5, 8, 12 or 14 coefficients. A fisheye uses
            the first four.
        image_size_wh: (..., 2), width and height in pixels.
        fisheye: (...), True for cameras with OpenCV's fisheye model; None if no camera is a fisheye.
    """

    T_cam_world: Float[Array, "*batch 4 4"]
    K: Float[Array, "*batch 3 3"]
    dist: Float[Array, "*batch coefficients"]
    image_size_wh: Float[Array, "*batch 2"]
    fisheye: Bool[Array, "*batch"] | None = None

    __repr__ = short_repr

    @property
    def centre_world(self) -> Float[Array, "*batch 3"]:
        """(..., 3), the centre of projection in the world, metres: -Rᵀ t."""
        R, t = self.T_cam_world[..., :3, :3], self.T_cam_world[..., :3, 3]
        return -(R.swapaxes(-1, -2) @ t[..., None])[..., 0]

    def __getitem__(self, index: Any) -> Camera:
        """Cameras at `index` of the leading axis."""
        return jax.tree.map(lambda leaf: leaf[index], self)


@dataclass(frozen=True)
class Rig:
    """Named cameras that stand still; arrays are float64 on the host.

    Compiled code gets `cameras` without the names, so that rigs of equal shape share a compiled program.

    Attributes:
        names: one name per camera.
        cameras: a `Camera` with one leading axis.
    """

    names: tuple[str, ...]
    cameras: Camera

    def __len__(self) -> int:
        return len(self.names)

    def select(self, names: Sequence[str]) -> Rig:
        """A rig of chosen cameras, in the order of `names`.

        Args:
            names: names of the cameras, as in the rig or as in the names of files (`cam1i_s` for `cam1`).

        Raises:
            SettingsError: a name is not in the rig, a camera is named twice, or no name is given.
        """
        kept = chosen_cameras(names, self.names)
        return Rig(kept, self.cameras[np.array([self.names.index(name) for name in kept])])


def make_camera(
    *,
    R: Float[np.ndarray, "3 3"],
    t_m: Float[np.ndarray, "3"],
    K: Float[np.ndarray, "3 3"],
    image_size_wh: tuple[int, int],
    dist: Sequence[float] = (),
    fisheye: bool = False,
) -> Camera:
    """Make one camera from its calibration and check the numbers; arrays are float64.

    Args:
        R: (3, 3), rotation from world to camera.
        t_m: (3,), translation from world to camera in metres (not the camera's centre).
        K: (3, 3), intrinsics in pixels.
        image_size_wh: width and height in pixels.
        dist: 0, 4, 5, 8, 12 or 14 coefficients in OpenCV's order; 0 or 4 of a fisheye.
        fisheye: the lens has OpenCV's fisheye model.

    Raises:
        SettingsError: R is not a rotation, a number is not finite, a focal length is not above 0, the image has no
            pixels, or the model of the lens does not have this number of coefficients.
    """
    R, t_m, K = (np.asarray(value, np.float64) for value in (R, t_m, K))
    coefficients = np.asarray(dist, np.float64)
    if not all(np.isfinite(value).all() for value in (R, t_m, K, coefficients)):
        raise SettingsError("make_camera", expected="finite numbers", found="NaN or infinity")
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
        raise SettingsError("camera.R", expected="a rotation matrix", found=f"{R.tolist()}")
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise SettingsError(
            "camera.K", expected="focal lengths above 0", found=f"{K[0, 0]:g} and {K[1, 1]:g}"
        )
    if min(image_size_wh) < 1:
        raise SettingsError("camera.image_size_wh", expected="sides of at least 1", found=f"{image_size_wh}")
    allowed = (0, FISHEYE_COEFFICIENTS) if fisheye else PINHOLE_COEFFICIENTS
    if coefficients.ndim != 1 or coefficients.size not in allowed:
        numbers = f"{', '.join(map(str, allowed[:-1]))} or {allowed[-1]} coefficients"
        expected = f"{numbers} of a fisheye" if fisheye else numbers
        raise SettingsError("camera.dist", expected=expected, found=f"{coefficients.size}")
    if fisheye:
        coefficients = np.pad(coefficients, (0, FISHEYE_COEFFICIENTS - coefficients.size))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t_m
    kind = np.array(True) if fisheye else None
    return Camera(T, K, coefficients, np.asarray(image_size_wh, np.float64), kind)


def make_rig(named: dict[str, Camera]) -> Rig:
    """Make a rig from single cameras by name.

    Shorter lists of distortion coefficients are padded with zeros, which do not change the projection. Lenses may be
    fisheyes and others.
    """
    if not named:
        raise SettingsError("cameras", expected="at least one camera", found="none")
    coefficients = max(camera.dist.shape[-1] for camera in named.values())
    kinds = [camera.fisheye is not None and bool(camera.fisheye) for camera in named.values()]
    padded = [
        replace(
            camera,
            dist=np.pad(camera.dist, (0, coefficients - camera.dist.shape[-1])),
            fisheye=np.array(kind) if any(kinds) else None,
        )
        for camera, kind in zip(named.values(), kinds, strict=True)
    ]
    return Rig(tuple(named), jax.tree.map(lambda *leaves: np.stack(leaves), *padded))


def scale_lens(lens: Camera, image_size_wh: tuple[int, int]) -> Camera:
    """The camera for its images enlarged or reduced to another size, pixels; or several cameras for images of one."""
    factors = np.array(image_size_wh) / lens.image_size_wh
    scale = np.zeros((*factors.shape[:-1], 3, 3))
    scale[..., [0, 1], [0, 1]], scale[..., 2, 2] = factors, 1.0
    # Pixel centres are at whole numbers, so that the edge at -1/2 stays where it is.
    scale[..., :2, 2] = (factors - 1) / 2
    sizes_wh = np.broadcast_to(np.array(image_size_wh, np.float64), factors.shape)
    return replace(lens, K=scale @ lens.K, image_size_wh=sizes_wh)


def look_at(
    centre_m: Sequence[float], target_m: Sequence[float], up: Sequence[float] = (0.0, 0.0, 1.0)
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """R and t of a camera at `centre_m` whose optical axis passes through `target_m` and whose image is upright.

    Args:
        centre_m: position of the camera in the world, metres.
        target_m: a point in the world, metres.
        up: upward direction in the world.

    Returns:
        Rotation (3, 3) and translation (3,) from world to camera, metres.

    Raises:
        SettingsError: the target is at the centre, or exactly above or below the centre along `up`.
    """
    centre = np.asarray(centre_m, np.float64)
    forward = np.asarray(target_m, np.float64) - centre
    right = np.cross(forward, np.asarray(up, np.float64))
    if np.linalg.norm(right) < 1e-9:
        raise SettingsError(
            "look_at", expected="a target off the camera's vertical", found=f"{list(target_m)}"
        )
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return R, -R @ centre


def to_camera(cam: Camera, points_world: Float[Array, "*#points 3"]) -> Float[Array, "*#points 3"]:
    """Camera coordinates of world points; leading axes broadcast against the cameras' axes.

    Args:
        cam: cameras with leading axes (*batch).
        points_world: (..., 3), metres. To get every point in every camera of a rig, pass `points[..., None, :]`.
    """
    R, t = cam.T_cam_world[..., :3, :3], cam.T_cam_world[..., :3, 3]
    # The sum over three terms is written out, because batched products of 3 x 3 matrices are slow in NumPy and JAX.
    return sum((R[..., :, j] * points_world[..., None, j] for j in range(3)), start=t)


def to_pixels(cam: Camera, points_cam: Float[Array, "*#points 3"]) -> Float[Array, "*#points 2"]:
    """Pixels of points in camera coordinates, lens distortion included (OpenCV's `projectPoints`).

    A point behind the camera is projected as if its depth were `NEAR_M`. The pixels of points behind the camera and
    beyond the fold of the lens are finite but have no meaning (see `has_image`).
    """
    xp = np if isinstance(points_cam, np.ndarray) else jnp
    z = xp.maximum(points_cam[..., 2], NEAR_M)
    x, y = points_cam[..., 0] / z, points_cam[..., 1] / z
    x, y = distort(cam, x, y)
    K = cam.K
    u = K[..., 0, 0] * x + K[..., 0, 1] * y + K[..., 0, 2]
    v = K[..., 1, 1] * y + K[..., 1, 2]
    return xp.stack([u, v], axis=-1)


def project(
    cam: Camera, points_world: Float[Array, "*#points 3"]
) -> tuple[Float[Array, "*#points 2"], Float[Array, "*#points"]]:
    """Pixels and depth of world points.

    Args:
        cam: cameras with leading axes (*batch).
        points_world: (..., 3), metres, broadcast as in `to_camera`.

    Returns:
        Pixels (..., 2), and depth (...) in metres along the optical axis. A point with a depth below `NEAR_M`, or
        beyond the fold of the lens, has no image; its pixel has no meaning (see `project_visible`).

    Example:
        >>> R, t = look_at((0.0, 0.0, 1.0), (5.0, 0.0, 1.0))
        >>> one = make_camera(R=R, t_m=t, K=np.diag([1000.0, 1000.0, 1.0]), image_size_wh=(1920, 1080))
        >>> project(one, np.array([5.0, -0.5, 1.0]))[0].round(6).tolist()
        [100.0, 0.0]
    """
    points_cam = to_camera(cam, points_world)
    return to_pixels(cam, points_cam), points_cam[..., 2]


def project_visible(
    cam: Camera, points_world: Float[Array, "*#points 3"]
) -> tuple[Float[Array, "*#points 2"], Float[Array, "*#points"]]:
    """Pixels and depth of world points as from `project`, with NaN pixels for points that have no image.

    Args:
        cam: cameras with leading axes (*batch).
        points_world: (..., 3), metres, broadcast as in `to_camera`.
    """
    points_cam = to_camera(cam, points_world)
    xp = np if isinstance(points_cam, np.ndarray) else jnp
    pixels = xp.where(has_image(cam, points_cam)[..., None], to_pixels(cam, points_cam), xp.nan)
    return pixels, points_cam[..., 2]


def has_image(cam: Camera, points_cam: Float[Array, "*#points 3"]) -> Bool[Array, "*#points"]:
    """True for points that a camera can show: at least `NEAR_M` in front of it, and before the fold of its lens.

    Args:
        cam: cameras with leading axes (*batch).
        points_cam: (..., 3), camera coordinates, metres, broadcast as in `to_camera`.
    """
    in_front = points_cam[..., 2] >= NEAR_M
    if cam.dist.shape[-1] == 0:
        return in_front
    xp = np if isinstance(points_cam, np.ndarray) else jnp
    z = xp.maximum(points_cam[..., 2], NEAR_M)
    return in_front & is_one_to_one(cam, points_cam[..., 0] / z, points_cam[..., 1] / z)


def undistort(cam: Camera, pixels: Float[np.ndarray, "*#points 2"]) -> Float[np.ndarray, "*#points 2"]:
    """Undistorted normalised image coordinates of pixels, in float64; NaN where the lens shows no point.

    Args:
        cam: cameras with leading axes (*batch).
        pixels: (..., 2), distorted pixels.
    """
    K = np.asarray(cam.K)
    v = (pixels[..., 1] - K[..., 1, 2]) / K[..., 1, 1]
    u = (pixels[..., 0] - K[..., 0, 2] - K[..., 0, 1] * v) / K[..., 0, 0]
    return np.stack(undistort_normalised(cam, u, v), axis=-1)
