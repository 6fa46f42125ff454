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
    """Boxes in pixels, and whether the camera has the drone in front of it.

    Kept as middles and halves, because windows scale boxes about their middles.

    Attributes are of equal shape: (..., cameras).
    """

    x_middle: Float[Array, "*batch"]
    y_middle: Float[Array, "*batch"]
    x_half: Float[Array, "*batch"]
    y_half: Float[Array, "*batch"]
    in_front: Bool[Array, "*batch"]

    @property
    def xyxy(self) -> Float[Array, "*batch 4"]:
        """(..., cameras, 4), left, top, right and bottom edges, half-open."""
        edges = (
            self.x_middle - self.x_half,
            self.y_middle - self.y_half,
            self.x_middle + self.x_half,
            self.y_middle + self.y_half,
        )
        return jnp.stack(edges, axis=-1)


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

    def tangents(axis: int) -> tuple[Array, Array]:
        along = centre[..., axis]
        b = along * z - shapes[..., axis, 2]
        c = along * along - shapes[..., axis, axis]
        root = jnp.sqrt(jnp.where(in_front, jnp.maximum(b * b - a * c, 1e-12), 1.0))
        return b / a, root / a

    (u, u_half), (v, v_half) = tangents(0), tangents(1)
    K = cameras.K
    if cameras.dist.shape[-1] == 0:
        x = K[..., 0, 0] * u + K[..., 0, 1] * v + K[..., 0, 2]
        y = K[..., 1, 1] * v + K[..., 1, 2]
        return Boxes(x + 0.5, y + 0.5, K[..., 0, 0] * u_half, K[..., 1, 1] * v_half, in_front)

    def column(u: Array) -> Array:
        bent_u, bent_v = distort(cameras, u, v)
        return K[..., 0, 0] * bent_u + K[..., 0, 1] * bent_v + K[..., 0, 2]

    def row(v: Array) -> Array:
        return K[..., 1, 1] * distort(cameras, u, v)[1] + K[..., 1, 2]

    left, right, top, bottom = column(u - u_half), column(u + u_half), row(v - v_half), row(v + v_half)
    return Boxes(
        (left + right) / 2 + 0.5, (top + bottom) / 2 + 0.5, (right - left) / 2, (bottom - top) / 2, in_front
    )
