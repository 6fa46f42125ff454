"""Cameras and rigs: pytrees of calibration, and the projection of world points into them.

Conventions, used by the whole package:

- World: right-handed, z up, metres. Camera: x right, y down, z forward (OpenCV).
- `T_cam_world` maps world to camera: `x_cam = R x_world + t`. Its last column is t, not the camera's centre.
- Pixels: (x, y) = (column, row); the centre of the first pixel is (0, 0), as in OpenCV's calibration.
- Lens distortion is OpenCV's: (k1, k2, p1, p2[, k3[, k4, k5, k6]]); a rig without it has 0 coefficients.

The functions follow their input: NumPy arrays give NumPy float64 (calibration, triangulation), JAX arrays and
tracers give JAX (the tracker). There is one projection, so there is one convention.
"""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from psotrack._typing import Array
from psotrack.errors import SettingsError
from psotrack.geometry.camera_names import chosen_camera

#: Points nearer than this to the camera's plane, or behind it, have no projection.
NEAR_M = 1e-3


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Camera:
    """One camera, or several of them along a leading axis.

    Attributes:
        T_cam_world: (..., 4, 4), world to camera, metres.
        K: (..., 3, 3), intrinsics in pixels.
        dist: (..., coefficients), lens distortion in OpenCV's order; 0, 4, 5 or 8 coefficients.
        image_size_wh: (..., 2), width and height in pixels.
    """

    T_cam_world: Float[Array, "*batch 4 4"]
    K: Float[Array, "*batch 3 3"]
    dist: Float[Array, "*batch coefficients"]
    image_size_wh: Float[Array, "*batch 2"]

    @property
    def centre_world(self) -> Float[Array, "*batch 3"]:
        """(..., 3), the centre of projection in the world, metres: -Rᵀ t."""
        R, t = self.T_cam_world[..., :3, :3], self.T_cam_world[..., :3, 3]
        return -(R.swapaxes(-1, -2) @ t[..., None])[..., 0]

    def __getitem__(self, index: Any) -> Camera:
        """The cameras at `index` of the leading axis."""
        return jax.tree.map(lambda leaf: leaf[index], self)


@dataclass(frozen=True)
class CameraRig:
    """Named cameras that stand still, with everything in float64 on the host.

    Compiled code gets `cameras`, a pytree; the names are for people, so that two rigs of equal shape share a program.

    Attributes:
        names: one per camera.
        cameras: a `Camera` with one leading axis.
    """

    names: tuple[str, ...]
    cameras: Camera

    def __len__(self) -> int:
        return len(self.names)

    def select(self, names: Ordered[str]) -> CameraRig:
        """The rig of some of the cameras, in the order of `names`.

        Args:
            names: of the cameras, spelt as in the rig or as their files are (`cam1i_s` for `cam1`).

        Raises:
            SettingsError: a name is not in the rig, a camera is named twice, or no name is given.
        """
        found = {name: chosen_camera(name, self.names) for name in names}
        unknown = [name for name in names if found[name] is None]
        expected = f"some of {', '.join(self.names)}"
        if unknown or not names:
            raise SettingsError("cameras", expected=expected, found=", ".join(unknown) or "none")
        kept = [camera for camera in (found[name] for name in names) if camera is not None]
        if len(set(kept)) < len(kept):
            twice = ", ".join(name for name in names if kept.count(found[name] or "") > 1)
            raise SettingsError("cameras", expected=f"{expected}, each once", found=twice)
        return CameraRig(tuple(kept), self.cameras[np.array([self.names.index(name) for name in kept])])


def camera(
    *,
    R: Float[np.ndarray, "3 3"],
    t_m: Float[np.ndarray, "3"],
    K: Float[np.ndarray, "3 3"],
    image_size_wh: tuple[int, int],
    dist: Ordered[float] = (),
) -> Camera:
    """One camera from its calibration, checked, in float64.

    Args:
        R: (3, 3), rotation from world to camera.
        t_m: (3,), translation from world to camera in metres (not the centre).
        K: (3, 3), intrinsics in pixels.
        image_size_wh: width and height in pixels.
        dist: 0, 4, 5 or 8 coefficients in OpenCV's order.

    Raises:
        SettingsError: R is no rotation, a number is not finite, K has no positive focal length, the image has no
            pixels, or the number of coefficients is none that OpenCV knows.
    """
    R, t_m, K = (np.asarray(value, np.float64) for value in (R, t_m, K))
    coefficients = np.asarray(dist, np.float64)
    if not all(np.isfinite(value).all() for value in (R, t_m, K, coefficients)):
        raise SettingsError("camera", expected="finite numbers", found="NaN or infinity")
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
        raise SettingsError("camera.R", expected="a rotation matrix", found=f"{R.tolist()}")
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        raise SettingsError(
            "camera.K", expected="focal lengths above 0", found=f"{K[0, 0]:g} and {K[1, 1]:g}"
        )
    if min(image_size_wh) < 1:
        raise SettingsError("camera.image_size_wh", expected="sides of at least 1", found=f"{image_size_wh}")
    if coefficients.shape not in {(0,), (4,), (5,), (8,)}:
        raise SettingsError("camera.dist", expected="0, 4, 5 or 8 coefficients", found=f"{coefficients.size}")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t_m
    return Camera(T, K, coefficients, np.asarray(image_size_wh, np.float64))


def stack(named: dict[str, Camera]) -> CameraRig:
    """A rig of single cameras; shorter distortions are padded with zeros, which change nothing."""
    if not named:
        raise SettingsError("cameras", expected="at least one camera", found="none")
    coefficients = max(one.dist.shape[-1] for one in named.values())
    padded = [
        replace(one, dist=np.pad(one.dist, (0, coefficients - one.dist.shape[-1]))) for one in named.values()
    ]
    return CameraRig(tuple(named), jax.tree.map(lambda *leaves: np.stack(leaves), *padded))


def look_at(
    centre_m: Ordered[float], target_m: Ordered[float], up: Ordered[float] = (0.0, 0.0, 1.0)
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """R and t of a camera at `centre_m` whose optical axis passes through `target_m`, its image upright.

    Raises:
        SettingsError: the target is at the centre, or straight above or below it along `up`.
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
        points_world: (..., 3) metres; for every camera of a rig at every point, pass `points[..., None, :]`.
    """
    R, t = cam.T_cam_world[..., :3, :3], cam.T_cam_world[..., :3, 3]
    # A sum over three terms, written out: a batched matmul of 3 x 3 matrices is slow everywhere.
    return sum((R[..., :, j] * points_world[..., None, j] for j in range(3)), start=t)


def to_pixels(cam: Camera, points_cam: Float[Array, "*#points 3"]) -> Float[Array, "*#points 2"]:
    """Pixels of points in camera coordinates, lens distortion included (OpenCV's `projectPoints`).

    Points behind the camera get the pixels of a point at `NEAR_M`: finite, and of no meaning.
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
        points_world: (..., 3) metres, broadcast as in `to_camera`.

    Returns:
        Pixels (..., 2), and depth (...) in metres along the optical axis. Where depth is below `NEAR_M` the point
        has no projection and the pixels have no meaning.

    Example:
        >>> R, t = look_at((0.0, 0.0, 1.0), (5.0, 0.0, 1.0))
        >>> one = camera(R=R, t_m=t, K=np.diag([1000.0, 1000.0, 1.0]), image_size_wh=(1920, 1080))
        >>> project(one, np.array([5.0, -0.5, 1.0]))[0].round(6).tolist()
        [100.0, 0.0]
    """
    points_cam = to_camera(cam, points_world)
    return to_pixels(cam, points_cam), points_cam[..., 2]


def distort(
    cam: Camera, x: Float[Array, "*#points"], y: Float[Array, "*#points"]
) -> tuple[Float[Array, "*#points"], Float[Array, "*#points"]]:
    """Normalised image coordinates as the lens bends them: OpenCV's rational and tangential model."""
    coefficients = cam.dist.shape[-1]
    if coefficients == 0:
        return x, y
    k1, k2, p1, p2 = (cam.dist[..., i] for i in range(4))
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + (r2 * cam.dist[..., 4] if coefficients > 4 else 0.0)))
    if coefficients == 8:
        radial = radial / (1 + r2 * (cam.dist[..., 5] + r2 * (cam.dist[..., 6] + r2 * cam.dist[..., 7])))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def undistort(
    cam: Camera, pixels: Float[np.ndarray, "*#points 2"], num_iterations: int = 20
) -> Float[np.ndarray, "*#points 2"]:
    """Normalised image coordinates of pixels with the lens undone, by OpenCV's fixed-point iteration, in float64."""
    K = cam.K
    v = (pixels[..., 1] - K[..., 1, 2]) / K[..., 1, 1]
    u = (pixels[..., 0] - K[..., 0, 2] - K[..., 0, 1] * v) / K[..., 0, 0]
    x, y = u, v
    for _ in range(num_iterations if cam.dist.shape[-1] else 0):
        bent_x, bent_y = distort(cam, x, y)
        x, y = x + (u - bent_x), y + (v - bent_y)
    return np.stack([x, y], axis=-1)
