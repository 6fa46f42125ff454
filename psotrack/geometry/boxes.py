"""Boxes of drones in cameras, and the pixel convention of all boxes.

Boxes are `xyxy`, half-open, in pixels, with fractional edges: pixel (column i, row j) covers [i, i + 1) x [j, j + 1).
Projected points have pixel centres at whole numbers (OpenCV), so that half a pixel is added to convert a projected
point to the convention of boxes. On an image reduced by the factor r, edges are divided by r.

A drone's extent is an ellipsoid whose axes are parallel to the world's axes. The box of an ellipsoid has a closed
form: a plane u = const through the camera with normal n = (1, 0, -u) touches the ellipsoid of shape S centred at X
(camera coordinates) where (n·X)² = nᵀ S n, a quadratic in u; likewise for v (Hartley & Zisserman 2004, section 8.3, on
dual quadrics).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from psotrack._typing import Array
from psotrack.geometry.cameras import NEAR_M, Camera, distort
from psotrack.geometry.lenses import is_one_to_one, lens_derivative, second_sheet


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Boxes:
    """Boxes of drones in cameras, as middles and half sizes, because the score scales boxes about their middles.

    Attributes:
        x_middle, y_middle: (..., cameras), middle of the box, pixels.
        x_half, y_half: (..., cameras), half width and half height, pixels.
        in_front: (..., cameras), True if the drone is in front of the camera, and before the fold of its lens; other
            boxes have no meaning.
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
    """The parts of drones' boxes that do not depend on the drones' positions.

    Every number is an array of its own, because the swarm tries thousands of positions in a loop: elements of a matrix
    would be extracted again in every iteration.

    Attributes:
        cameras: cameras with one leading axis.
        size_m: (..., 3), full lengths of the drones along the world's axes, metres.
        rotation: nine arrays of shape (cameras,), the rows of R one after the other.
        translation_m: three arrays of shape (cameras,), or (..., cameras) for ellipsoids with an offset, metres.
        s_xx, s_yy, s_xz, s_yz, s_zz: (..., cameras), elements of the shape S = R diag(size / 2)² Rᵀ in camera
            coordinates, m².
        f_x, f_y, skew, c_x, c_y: (cameras,), intrinsics in pixels; c_x and c_y in the convention of boxes.
        shape_m2: (..., cameras, 3, 3), the whole shape S; None where no camera is a fisheye.
        beyond: (cameras,), radii of the lenses' folds (`lenses.second_sheet`); None without distortion.
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
    shape_m2: Float[Array, "*drones cameras 3 3"] | None = None
    beyond: Float[Array, "cameras"] | None = None


def make_extents(
    cameras: Camera, size_m: Float[Array, "*drones 3"], offset_m: Float[Array, "*drones 3"] | None = None
) -> Extents:
    """Prepare the projection of drones' ellipsoids to boxes.

    Args:
        cameras: cameras with one leading axis.
        size_m: (..., 3), full lengths of the drones along the world's axes, metres.
        offset_m: (..., 3), vector from a drone's position (such as its body's origin) to the middle of its ellipsoid,
            along the world's axes, metres; None: the middle is the position.
    """
    R, t, K = cameras.T_cam_world[:, :3, :3], cameras.T_cam_world[:, :3, 3], cameras.K
    if offset_m is not None:
        # R (position + offset) + t: the offset becomes part of the translation and costs nothing per tried position.
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
        shape_m2=None if cameras.fisheye is None else S,
        beyond=second_sheet(cameras.dist, cameras.fisheye) if cameras.dist.shape[-1] else None,
    )


def moved_extents(seen: Extents, moved_m: Float[Array, "*drones cameras 3"]) -> Extents:
    """Extents of drones that each camera sees at a place of its own, because it sees them at a time of its own.

    Args:
        seen: extents from `make_extents`.
        moved_m: (..., cameras, 3), vector from a drone's position to the place at which the camera sees the drone,
            metres. The boxes cost no more than without the vector.
    """
    translation_m = tuple(
        seen.translation_m[i] + sum(seen.rotation[3 * i + j] * moved_m[..., j] for j in range(3))
        for i in range(3)
    )
    return replace(seen, translation_m=translation_m)


def project_boxes(seen: Extents, position_m: Float[Array, "*#drones 3"]) -> Boxes:
    """Boxes of drones at positions, in every camera.

    Lens distortion is applied to the middles of the box's four sides. A drone covers a few degrees, where this box
    equals the box of the distorted outline. In a fisheye, whose undistorted image stretches drones far from the axis,
    the projection is linearised at the drone's middle instead. A drone that reaches beyond the fold of a lens has no
    box, because the lens would show it where another drone is.

    Args:
        seen: extents from `make_extents`; the leading axes broadcast against those of `position_m`.
        position_m: (..., 3), positions in the world, metres.

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
    # Behind the camera the quadratic has no meaning. Any positive denominator keeps values and gradients finite.
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
    is_shown = _is_shown(seen, (u, v), (u_half, v_half))
    boxes = Boxes(
        (left + right) / 2, (top + bottom) / 2, (right - left) / 2, (bottom - top) / 2, in_front & is_shown
    )
    if seen.cameras.fisheye is None:
        return boxes
    near = _linearised_boxes(seen, x, y, jnp.where(in_front, z, 1.0), boxes.in_front)
    fisheye = jnp.asarray(seen.cameras.fisheye)
    return jax.tree.map(lambda one, other: jnp.where(fisheye, one, other), near, boxes)


def _is_shown(seen: Extents, middle: tuple[Array, Array], half: tuple[Array, Array]) -> Array:
    """True where the part of an ellipsoid that is farthest from the optical axis is before the fold of the lens."""
    radius = jnp.sqrt(middle[0] * middle[0] + middle[1] * middle[1]) + 1e-9
    x, y = (at + reach * at / radius for at, reach in zip(middle, half, strict=True))
    return jnp.asarray(is_one_to_one(seen.cameras.dist, seen.cameras.fisheye, x, y, seen.beyond))


def _linearised_boxes(seen: Extents, x: Array, y: Array, z: Array, in_front: Array) -> Boxes:
    """Boxes of ellipsoids with middles (x, y, z): the image of the shape S is J S Jᵀ, J the projection's derivative."""
    u, v = x / z, y / z
    bent_u, bent_v = distort(seen.cameras, u, v)
    xx, xy, yx, yy = lens_derivative(seen.cameras.dist, seen.cameras.fisheye, u, v)
    by_u, by_v = (
        jnp.stack([by_x, by_y, -(u * by_x + v * by_y)], axis=-1) / z[..., None]
        for by_x, by_y in ((xx, xy), (yx, yy))
    )

    def half(along: Array) -> Array:
        return jnp.sqrt(jnp.maximum(jnp.einsum("...i,...ij,...j->...", along, seen.shape_m2, along), 1e-12))

    return Boxes(
        seen.f_x * bent_u + seen.skew * bent_v + seen.c_x,
        seen.f_y * bent_v + seen.c_y,
        half(seen.f_x[:, None] * by_u + seen.skew[:, None] * by_v),
        half(seen.f_y[:, None] * by_v),
        in_front,
    )
