"""Boxes of drones in cameras, and the pixel convention of all boxes.

Boxes are `xyxy`, half-open, in pixels, with fractional edges: pixel (column i, row j) covers [i, i + 1) x [j, j + 1).
Projected points have pixel centres at whole numbers (OpenCV), so that half a pixel is added to convert a projected
point to the convention of boxes. On an image reduced by the factor r, edges are divided by r.

A drone's extent is an ellipsoid whose axes are parallel to the world's axes. The box of an ellipsoid has a closed
form: a plane u = const through the camera with normal n = (1, 0, -u) touches the ellipsoid of shape S centred at X
(camera coordinates) where (n·X)² = nᵀ S n, a quadratic in u; likewise for v (Hartley & Zisserman 2004, section 8.3, on
dual quadrics). Of a lens with distortion, the planes u = const are those of its linearisation at the ellipsoid's
middle, and the points where they touch the ellipsoid are projected through the lens itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from psotrack.geometry.cameras import NEAR_M, Camera
from psotrack.geometry.lenses import distort, is_one_to_one, lens_derivative, second_sheet
from psotrack.support.array_types import Array

#: Middle and half width of the interval between the tangents of an ellipsoid along one direction across the optical
#: axis, in undistorted coordinates, from the middle's coordinate along the direction and two elements of the shape:
#: along the direction and the axis, and along the direction twice.
_Tangents = Callable[[Array, Array, Array], tuple[Array, Array]]


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
        s_xx, s_xy, s_yy, s_xz, s_yz, s_zz: (..., cameras), elements of the shape S = R diag(size / 2)² Rᵀ in camera
            coordinates, m².
        f_x, f_y, skew, c_x, c_y: (cameras,), intrinsics in pixels; c_x and c_y in the convention of boxes.
        beyond: (cameras,), radii of the lenses' folds (`lenses.second_sheet`); None without distortion.
    """

    cameras: Camera
    size_m: Float[Array, "*drones 3"]
    rotation: tuple[Float[Array, "cameras"], ...]
    translation_m: tuple[Float[Array, "*#drones cameras"], ...]
    s_xx: Float[Array, "*drones cameras"]
    s_xy: Float[Array, "*drones cameras"]
    s_yy: Float[Array, "*drones cameras"]
    s_xz: Float[Array, "*drones cameras"]
    s_yz: Float[Array, "*drones cameras"]
    s_zz: Float[Array, "*drones cameras"]
    f_x: Float[Array, "cameras"]
    f_y: Float[Array, "cameras"]
    skew: Float[Array, "cameras"]
    c_x: Float[Array, "cameras"]
    c_y: Float[Array, "cameras"]
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
        s_xy=S[..., 0, 1],
        s_yy=S[..., 1, 1],
        s_xz=S[..., 0, 2],
        s_yz=S[..., 1, 2],
        s_zz=S[..., 2, 2],
        f_x=K[:, 0, 0],
        f_y=K[:, 1, 1],
        skew=K[:, 0, 1],
        c_x=K[:, 0, 2] + 0.5,
        c_y=K[:, 1, 2] + 0.5,
        beyond=second_sheet(cameras) if cameras.dist.shape[-1] else None,
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

    Without distortion the boxes are exact. With distortion they are those around four points of the drone's surface,
    which are the outermost points for the lens as linearised at the drone's middle: exact up to the square of the
    drone's angular size. A drone that reaches beyond the fold of a lens, or beyond 90 degrees off the axis, has no box,
    because the lens would show a part of the drone where something else is.

    Args:
        seen: extents from `make_extents`; the leading axes broadcast against those of `position_m`.
        position_m: (..., 3), positions in the world, metres.

    Returns:
        Boxes with axes (..., cameras).
    """
    x, y, z = (position_m[..., i : i + 1] for i in range(3))
    return boxes_at(seen, x, y, z)


def boxes_at(
    seen: Extents,
    x_m: Float[Array, "*#drones 1"],
    y_m: Float[Array, "*#drones 1"],
    z_m: Float[Array, "*#drones 1"],
) -> Boxes:
    """`project_boxes` for the coordinates of the positions one by one: a kernel cannot take columns of an array."""
    x, y, z = (
        seen.rotation[3 * i] * x_m
        + seen.rotation[3 * i + 1] * y_m
        + seen.rotation[3 * i + 2] * z_m
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

    if seen.cameras.dist.shape[-1]:
        return _distorted_boxes(seen, (x, y, jnp.where(in_front, z, 1.0)), in_front, tangents)
    (u, u_half), (v, v_half) = tangents(x, seen.s_xz, seen.s_xx), tangents(y, seen.s_yz, seen.s_yy)
    x_middle, y_middle = seen.f_x * u + seen.skew * v + seen.c_x, seen.f_y * v + seen.c_y
    return Boxes(x_middle, y_middle, seen.f_x * u_half, seen.f_y * v_half, in_front)


def _distorted_boxes(
    seen: Extents, middle: tuple[Array, Array, Array], in_front: Array, tangents: _Tangents
) -> Boxes:
    """Boxes of ellipsoids with these middles in lenses with distortion."""
    x, y, z = middle
    xx, xy, yx, yy = lens_derivative(seen.cameras, x / z, y / z)
    slopes = (seen.f_x * xx + seen.skew * yx, seen.f_x * xy + seen.skew * yy), (yx, yy)
    # Without the barriers, XLA computes the derivative again for each side, and the sides for each number of a box.
    slopes = _computed_once(seen, slopes)
    columns, rows = (
        [distort(seen.cameras, *point) for point in _outermost(seen, middle, in_front, tangents, slope)]
        for slope in slopes
    )
    left, right = (seen.f_x * u + seen.skew * v + seen.c_x for u, v in columns)
    top, bottom = (seen.f_y * v + seen.c_y for _, v in rows)
    left, right, top, bottom = _computed_once(seen, (left, right, top, bottom))
    return Boxes(
        (left + right) / 2,
        (top + bottom) / 2,
        (right - left) / 2,
        (bottom - top) / 2,
        in_front & _is_shown(seen, middle, tangents),
    )


def _computed_once(seen: Extents, values: Any) -> Any:
    """The values behind a barrier; in a kernel, which has no barriers, as they are."""
    in_kernel = isinstance(seen.cameras.dist, jax.Ref)
    return values if in_kernel else jax.lax.optimization_barrier(values)


def _outermost(
    seen: Extents,
    middle: tuple[Array, Array, Array],
    in_front: Array,
    tangents: _Tangents,
    slope: tuple[Array, Array],
) -> list[tuple[Array, Array]]:
    """The two points of an ellipsoid's surface in which p u + q v is least and largest; undistorted coordinates.

    Args:
        seen, middle, in_front, tangents: see `project_boxes`.
        slope: p and q.
    """
    x, y, z = middle
    p, q = slope
    # Only the direction counts, and squares of large numbers would be infinite.
    length = jnp.abs(p) + jnp.abs(q) + 1e-30
    p, q = p / length, q / length
    s_px, s_py, s_pz = (
        p * along_x + q * along_y
        for along_x, along_y in ((seen.s_xx, seen.s_xy), (seen.s_xy, seen.s_yy), (seen.s_xz, seen.s_yz))
    )
    along = p * x + q * y
    at, half = tangents(along, s_pz, p * s_px + q * s_py)
    points = []
    for sign in (-1, 1):
        w = at + sign * half
        if seen.cameras.fisheye is not None:
            # A fisheye shows drones up to 90 degrees off the axis, where the plane of the undistorted image stretches
            # them without limit: there the pixel's slope at the middle itself says more than the plane's tangent.
            w = jnp.where(jnp.asarray(seen.cameras.fisheye), along / z, w)
        # The plane across n = (p, q, -w) that touches the ellipsoid does so at X + S n / sqrt(n' S n).
        s_x, s_y, s_z = s_px - w * seen.s_xz, s_py - w * seen.s_yz, s_pz - w * seen.s_zz
        reach = sign / jnp.sqrt(jnp.maximum(p * s_x + q * s_y - w * s_z, 1e-12))
        depth = jnp.where(in_front, jnp.maximum(z + reach * s_z, NEAR_M), 1.0)
        points.append(((x + reach * s_x) / depth, (y + reach * s_y) / depth))
    return points


def _is_shown(seen: Extents, middle: tuple[Array, Array, Array], tangents: _Tangents) -> Array:
    """True where the part of an ellipsoid that is farthest from the optical axis is before the fold of the lens."""
    x, y, _ = middle
    radius = jnp.sqrt(x * x + y * y) + 1e-9
    p, q = x / radius, y / radius
    s_along = p * p * seen.s_xx + 2 * p * q * seen.s_xy + q * q * seen.s_yy
    at, half = tangents(radius, p * seen.s_xz + q * seen.s_yz, s_along)
    farthest = at + half
    return jnp.asarray(is_one_to_one(seen.cameras, p * farthest, q * farthest, seen.beyond))
