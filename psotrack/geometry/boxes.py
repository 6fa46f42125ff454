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
from psotrack.geometry.cameras import NEAR_M, Camera, distort


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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Extents:
    """Drones of known size as cameras see them: all of their boxes that does not depend on where they are.

    Every number is an array of its own, because positions are tried by the thousand: picked out of matrices within the
    swarm's loop, they would be picked anew in every iteration.

    Attributes:
        cameras: with one leading axis.
        size_m: (..., 3), full lengths along the world's axes.
        rotation: nine of (cameras,), the rows of R one after the other.
        translation_m: three of (cameras,), or of (..., cameras) where ellipsoids sit beside the positions.
        s_xx, s_yy, s_xz, s_yz, s_zz: (..., cameras), of the shape S = R diag(size / 2)² Rᵀ in camera coordinates, m².
        f_x, f_y, skew, c_x, c_y: (cameras,), intrinsics in pixels; c_x and c_y in the convention of boxes.
    """

    cameras: Camera
    size_m: Float[Array, "*drones 3"]
    rotation: tuple[Float[Array, "cameras"], ...]
    translation_m: tuple[Float[Array, "*#drones cameras"], ...]
    s_xx: Float[Array, "*drones cameras"]
    s_yy: Float[Array, "*drones cameras"]
    s_xz: Float[Array, "*drones cameras"]
    s_yz: Float[Array, "*drones cameras"]
    s_zz: Float[Array, "*drones cameras"]
    f_x: Float[Array, "cameras"]
    f_y: Float[Array, "cameras"]
    skew: Float[Array, "cameras"]
    c_x: Float[Array, "cameras"]
    c_y: Float[Array, "cameras"]


def extents(
    cameras: Camera, size_m: Float[Array, "*drones 3"], offset_m: Float[Array, "*drones 3"] | None = None
) -> Extents:
    """Ellipsoids in cameras.

    Args:
        cameras: with one leading axis.
        size_m: (..., 3), full lengths of the extent along the world's axes.
        offset_m: (..., 3), from the positions that are asked about (a body's origin) to the middle of the extent, along
            the world's axes; None is at the positions.
    """
    R, t, K = cameras.T_cam_world[:, :3, :3], cameras.T_cam_world[:, :3, 3], cameras.K
    if offset_m is not None:
        # R (position + offset) + t: part of the translation, so that it costs nothing where positions are tried.
        t = jnp.einsum("cij,...j->...ci", R, offset_m) + t
    S = jnp.einsum("cij,...j,ckj->...cik", R, jnp.square(size_m / 2), R)
    return Extents(
        cameras=cameras,
        size_m=size_m,
        rotation=tuple(R[:, i, j] for i in range(3) for j in range(3)),
        translation_m=tuple(t[..., i] for i in range(3)),
        s_xx=S[..., 0, 0],
        s_yy=S[..., 1, 1],
        s_xz=S[..., 0, 2],
        s_yz=S[..., 1, 2],
        s_zz=S[..., 2, 2],
        f_x=K[:, 0, 0],
        f_y=K[:, 1, 1],
        skew=K[:, 0, 1],
        c_x=K[:, 0, 2] + 0.5,
        c_y=K[:, 1, 2] + 0.5,
    )


def project_boxes(seen: Extents, position_m: Float[Array, "*#drones 3"]) -> Boxes:
    """Boxes of drones at positions, in every camera.

    The lens bends the middles of the box's four sides; at a drone's few degrees that is the box of the bent outline.

    Args:
        seen: from `extents`; its leading axes broadcast against those of `position_m`.
        position_m: (..., 3), world.

    Returns:
        Boxes with axes (..., cameras).
    """
    x_world, y_world, z_world = (position_m[..., i : i + 1] for i in range(3))
    x, y, z = (
        seen.rotation[3 * i] * x_world
        + seen.rotation[3 * i + 1] * y_world
        + seen.rotation[3 * i + 2] * z_world
        + seen.translation_m[i]
        for i in range(3)
    )
    in_front = z * z * jnp.sign(z) > seen.s_zz + NEAR_M
    # Behind the camera the quadratic has no meaning; any positive denominator keeps values and gradients finite.
    a = jnp.where(in_front, z * z - seen.s_zz, 1.0)

    def tangents(along: Array, s_along_z: Array, s_along: Array) -> tuple[Array, Array]:
        b = along * z - s_along_z
        c = along * along - s_along
        root = jnp.sqrt(jnp.where(in_front, jnp.maximum(b * b - a * c, 1e-12), 1.0))
        return b / a, root / a

    (u, u_half), (v, v_half) = tangents(x, seen.s_xz, seen.s_xx), tangents(y, seen.s_yz, seen.s_yy)
    if seen.cameras.dist.shape[-1] == 0:
        x_middle, y_middle = seen.f_x * u + seen.skew * v + seen.c_x, seen.f_y * v + seen.c_y
        return Boxes(x_middle, y_middle, seen.f_x * u_half, seen.f_y * v_half, in_front)

    def column(u: Array) -> Array:
        bent_u, bent_v = distort(seen.cameras, u, v)
        return seen.f_x * bent_u + seen.skew * bent_v + seen.c_x

    def row(v: Array) -> Array:
        return seen.f_y * distort(seen.cameras, u, v)[1] + seen.c_y

    left, right, top, bottom = column(u - u_half), column(u + u_half), row(v - v_half), row(v + v_half)
    return Boxes((left + right) / 2, (top + bottom) / 2, (right - left) / 2, (bottom - top) / 2, in_front)
