"""A drone's extent at a position, as one box per camera. The pixel convention of all boxes is written here.

Boxes are `xyxy`, half-open, in pixels, with fractional edges: pixel (column i, row j) covers [i, i + 1) x [j, j + 1).
Projected points have pixel centres at whole numbers (OpenCV), so half a pixel is added on the way from one to the
other. On an image reduced by r, edges are divided by r.

A drone's extent is an ellipsoid with the three axes of the world. Its box is exact and cheap: a plane u = const
through the camera with normal n = (1, 0, -u) touches the ellipsoid of shape S centred at X (camera coordinates)
where (n·X)² = nᵀ S n, a quadratic in u; likewise for v (Hartley & Zisserman 2004, section 8.3, on dual quadrics).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from psotrack._typing import Array
from psotrack.cameras import NEAR_M, Camera, distort, to_camera


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Boxes:
    """Boxes in pixels, `x0 <= x1` and `y0 <= y1`, and whether the camera has the drone in front of it.

    Attributes are of equal shape: (..., cameras).
    """

    x0: Float[Array, "*batch"]
    y0: Float[Array, "*batch"]
    x1: Float[Array, "*batch"]
    y1: Float[Array, "*batch"]
    in_front: Bool[Array, "*batch"]


def shape_in_cameras(
    cameras: Camera, size_m: Float[Array, "*drones 3"]
) -> Float[Array, "*drones cameras 3 3"]:
    """Shape matrices S = R diag(size / 2)² Rᵀ of ellipsoids in each camera's coordinates, m².

    Args:
        cameras: with one leading axis.
        size_m: (..., 3), full lengths of the extent along the world's axes.
    """
    R = cameras.T_cam_world[:, :3, :3]
    return jnp.einsum("cij,...j,ckj->...cik", R, jnp.square(size_m / 2), R)


def project_boxes(
    cameras: Camera, position_m: Float[Array, "*#drones 3"], shapes: Float[Array, "*#drones cameras 3 3"]
) -> Boxes:
    """Boxes of ellipsoids at positions, in every camera.

    The lens bends the middles of the box's four sides; at a drone's few degrees that is the box of the bent outline.

    Args:
        cameras: with one leading axis.
        position_m: (..., 3), world.
        shapes: from `shape_in_cameras`; leading axes broadcast against those of `position_m`.

    Returns:
        Boxes with axes (..., cameras).
    """
    centre = to_camera(cameras, position_m[..., None, :])
    z, s_zz = centre[..., 2], shapes[..., 2, 2]
    in_front = z * z * jnp.sign(z) > s_zz + NEAR_M
    # Behind the camera the quadratic has no meaning; any positive denominator keeps values and gradients finite.
    a = jnp.where(in_front, z * z - s_zz, 1.0)

    def tangents(axis: int) -> tuple[Array, Array, Array]:
        along = centre[..., axis]
        b = along * z - shapes[..., axis, 2]
        c = along * along - shapes[..., axis, axis]
        root = jnp.sqrt(jnp.where(in_front, jnp.maximum(b * b - a * c, 1e-12), 1.0))
        return (b - root) / a, (b + root) / a, b / a

    u0, u1, u_mid = tangents(0)
    v0, v1, v_mid = tangents(1)
    K = cameras.K

    def column(u: Array) -> Array:
        x, y = distort(cameras, u, v_mid)
        return K[..., 0, 0] * x + K[..., 0, 1] * y + K[..., 0, 2] + 0.5

    def row(v: Array) -> Array:
        return K[..., 1, 1] * distort(cameras, u_mid, v)[1] + K[..., 1, 2] + 0.5

    return Boxes(column(u0), row(v0), column(u1), row(v1), in_front)
