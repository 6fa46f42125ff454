"""Lens models of OpenCV: distortion of normalised image coordinates, its derivatives, its inverse, and where it folds.

Two models: the pinhole model with 4, 5, 8, 12 or 14 coefficients (radial, tangential, rational, thin prism, tilted
sensor; `cv2.projectPoints`), and the fisheye model with 4 coefficients (Kannala & Brandt 2006; `cv2.fisheye`), which
reaches 90 degrees off the optical axis. Missing coefficients are 0, which changes no pixel.

A model is one to one around the optical axis only. Where the determinant of its derivative changes sign, it folds: a
point beyond the fold has the pixel of another point that is nearer to the axis, but no real lens shows it there. Such
a point has no image. The functions below take lenses (a `Camera`, for example), and x, y: (...), undistorted normalised
image coordinates: x / z and y / z in the camera. They take and return NumPy or JAX arrays, except the inverse, which is
for NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack.support.array_types import Array

#: Numbers of coefficients that OpenCV's pinhole model has, and its fisheye model.
PINHOLE_COEFFICIENTS = (0, 4, 5, 8, 12, 14)
FISHEYE_COEFFICIENTS = 4

#: Grid on which folds are looked for. The determinant at a point itself decides whether the point is beyond the first
#: fold; the grid has to find the radius from which the determinant is positive again.
_ANGLES = (np.arange(128) + 0.5) / 128 * np.pi / 2
_DIRECTIONS = np.arange(16) / 16 * 2 * np.pi
#: Below this r², series replace quotients by r.
_SMALL_R2 = 1e-12
#: Newton's steps at most, and the largest residual of a solution, relative to 1 + the normalised coordinate: 1e-8 px
#: of a focal length of 1000 px.
_MAX_STEPS = 60
_RESIDUAL = 1e-11
#: A point is given up when even this share of Newton's step makes the residual no smaller.
_LEAST_SHARE = 1e-6
#: Bisections of the angle before Newton's steps, for lenses that are bent much.
_BISECTIONS = 12


@runtime_checkable
class HasLens(Protocol):
    """One lens, or several along leading axes."""

    @property
    def dist(self) -> Float[Array, "*lenses coefficients"]:
        """(..., coefficients), in OpenCV's order k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y; of a
        fisheye k1, k2, k3, k4.
        """

    @property
    def fisheye(self) -> Bool[Array, "*lenses"] | None:
        """(...), which lenses are fisheyes; None: no lens is one."""


class LensNumbers(NamedTuple):
    """A lens without a camera; see `HasLens`."""

    dist: Any
    fisheye: Any = None


def distort(
    lens: HasLens, x: Float[Array, "*#points"], y: Float[Array, "*#points"]
) -> tuple[Float[Array, "*#points"], Float[Array, "*#points"]]:
    """Distorted normalised image coordinates. Arguments: see the module."""
    distorted_x, distorted_y = _by_model(lens, x, y, _pinhole, _fisheye)
    return distorted_x, distorted_y


def lens_derivative(
    lens: HasLens, x: Float[Array, "*#points"], y: Float[Array, "*#points"]
) -> tuple[Float[Array, "*#points"], ...]:
    """Derivatives of the distorted coordinates: x by x, x by y, y by x, y by y. Arguments: see the module."""
    return _by_model(lens, x, y, _pinhole_derivative, _fisheye_derivative)


def undistortion_stretch(
    lens: HasLens, normalised: Float[np.ndarray, "*#points 2"]
) -> Float[np.ndarray, "*#points"]:
    """Factor by which the removal of lens distortion enlarges small lengths, the root mean square of all directions.

    Args:
        lens: lenses.
        normalised: (..., 2), undistorted normalised image coordinates.
    """
    xx, xy, yx, yy = lens_derivative(lens, normalised[..., 0], normalised[..., 1])
    # The squared norm of the inverse of a 2 x 2 matrix is that of the matrix divided by its squared determinant.
    return np.asarray(np.sqrt((xx**2 + xy**2 + yx**2 + yy**2) / 2) / np.abs(xx * yy - xy * yx))


def _by_model(
    lens: HasLens, x: Array, y: Array, pinhole: Callable[..., Any], fisheye: Callable[..., Any]
) -> tuple[Array, ...]:
    """What the function of each lens's model says."""
    xp = _numbers(x)
    if lens.fisheye is None:
        return tuple(pinhole(xp, lens.dist, x, y))
    is_fisheye, pinhole_dist = _parted(xp, lens)
    both = zip(fisheye(xp, lens.dist, x, y), pinhole(xp, pinhole_dist, x, y), strict=True)
    return tuple(xp.where(is_fisheye, one, other) for one, other in both)


def undistort_normalised(
    lens: HasLens, x: Float[Array, "*#points"], y: Float[Array, "*#points"]
) -> tuple[Float[Array, "*#points"], Float[Array, "*#points"]]:
    """Inverse of `distort` in float64, by Newton's method; NaN where no point has this image.

    Args:
        lens: lenses.
        x, y: (...), distorted normalised image coordinates.
    """
    dist = np.asarray(lens.dist)
    if dist.shape[-1] == 0:
        return x, y
    shape = np.broadcast_shapes(np.shape(x), np.shape(y), dist.shape[:-1])
    problem = _Inverse(
        np.broadcast_to(dist, (*shape, dist.shape[-1])).reshape(-1, dist.shape[-1]),
        None if lens.fisheye is None else np.broadcast_to(lens.fisheye, shape).ravel(),
        np.broadcast_to(second_sheet(LensNumbers(dist, lens.fisheye)), shape).ravel(),
        np.stack([np.broadcast_to(part, shape).ravel() for part in (x, y)]).astype(np.float64),
    )
    found = np.full(problem.target.shape, np.nan)
    pending = np.flatnonzero(np.isfinite(problem.target).all(axis=0))
    # The distorted point is a good start for most lenses. For the others, a search of the radius finds a better start.
    for start in (_Inverse.near_start, _Inverse.far_start):
        some = problem.at(pending)
        solved = some.newton(start(some))
        found[:, pending] = solved
        pending = pending[np.isnan(solved[0])]
        if not len(pending):
            break
    return found[0].reshape(shape), found[1].reshape(shape)


def is_one_to_one(
    lens: HasLens,
    x: Float[Array, "*#points"],
    y: Float[Array, "*#points"],
    beyond: Float[Array, "*lenses"] | None = None,
) -> Bool[Array, "*#points"]:
    """True for points before the fold of their lens: no point nearer to the axis has the same image.

    Args:
        lens, x, y: see the module.
        beyond: result of `second_sheet`, for callers that need the result more than once.
    """
    if beyond is None:
        beyond = second_sheet(lens)
    return _rises(_numbers(x), lens, x, y) & (x * x + y * y < beyond * beyond)


def second_sheet(lens: HasLens) -> Float[Array, "*lenses"]:
    """Radius r = hypot(x, y) below which every point with a positive determinant is before the fold; or infinity.

    Beyond the first fold the determinant is negative. Further away it may become positive again, on the second sheet
    of the folded image. The radius lies between the first fold and the second sheet, in the direction in which the
    second sheet begins nearest to the axis.
    """
    if not isinstance(lens.dist, np.ndarray | np.generic):
        return _second_sheet(jnp, lens)
    dist = np.ascontiguousarray(lens.dist, np.float64)
    flat = dist.reshape(-1, dist.shape[-1])
    kinds = np.broadcast_to(False if lens.fisheye is None else lens.fisheye, dist.shape[:-1]).ravel()
    rows = [_second_sheet_of(row.tobytes(), bool(kind)) for row, kind in zip(flat, kinds, strict=True)]
    return np.array(rows).reshape(dist.shape[:-1])


@lru_cache(maxsize=4096)
def _second_sheet_of(dist: bytes, fisheye: bool) -> float:
    """The same for one lens; calibration and triangulation ask again and again for the same few lenses."""
    row = np.frombuffer(dist, np.float64)
    return float(_second_sheet(np, LensNumbers(row, np.array(True) if fisheye else None)))


def _second_sheet(xp: Any, lens: HasLens) -> Array:
    dist, fisheye = lens.dist, lens.fisheye
    radius = np.tan(_ANGLES)
    grid = radius[:, None] * np.stack([np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)])[:, None]
    x, y = (xp.asarray(part, dist.dtype) for part in grid)
    everywhere = LensNumbers(dist[..., None, None, :], None if fisheye is None else fisheye[..., None, None])
    rises = _rises(xp, everywhere, x, y)
    folded = xp.cumsum(~rises, axis=-2) > 0
    again = (folded & rises).any(axis=-1)
    first = again.argmax(axis=-1)
    return xp.where(again.any(axis=-1), xp.asarray(radius, dist.dtype)[xp.maximum(first - 1, 0)], xp.inf)


def _rises(xp: Any, lens: HasLens, x: Array, y: Array) -> Array:
    """True where the determinant of the derivative is positive, and the model has no pole before the point."""
    coefficients = lens.dist.shape[-1]
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        xx, xy, yx, yy = lens_derivative(lens, x, y)
        rises = xx * yy - xy * yx > 0
        if coefficients >= 8:
            pinhole_dist = lens.dist if lens.fisheye is None else _parted(xp, lens)[1]
            rises = rises & (_below(pinhole_dist, x * x + y * y) > 0)
            if coefficients == 14:
                H = _tilt(xp, pinhole_dist)
                flat_x, flat_y = _before_tilt(pinhole_dist, x, y)
                rises = rises & (H[2][0] * flat_x + H[2][1] * flat_y + H[2][2] > 0)
    return rises


def _numbers(array: Any) -> Any:
    return np if isinstance(array, np.ndarray | np.generic) else jnp


def _parted(xp: Any, lens: HasLens) -> tuple[Array, Array]:
    """Which lenses are fisheyes, and the coefficients with 0 for fisheyes: the pinhole model of such a lens is unused,
    but must be finite.
    """
    fisheye = xp.asarray(lens.fisheye)
    return fisheye, xp.where(fisheye[..., None], xp.zeros_like(lens.dist), lens.dist)


def _pinhole(xp: Any, dist: Array, x: Array, y: Array) -> tuple[Array, Array]:
    x, y = _before_tilt(dist, x, y)
    if dist.shape[-1] < 14:
        return x, y
    (a, b, c), (d, e, f), (g, h, i) = _tilt(xp, dist)
    w = g * x + h * y + i
    return (a * x + b * y + c) / w, (d * x + e * y + f) / w


def _before_tilt(dist: Array, x: Array, y: Array) -> tuple[Array, Array]:
    coefficients = dist.shape[-1]
    if coefficients == 0:
        return x, y
    k1, k2, p1, p2 = (dist[..., i] for i in range(4))
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + (r2 * dist[..., 4] if coefficients > 4 else 0.0)))
    if coefficients >= 8:
        radial = radial / _below(dist, r2)
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    if coefficients >= 12:
        bent_x = bent_x + r2 * (dist[..., 8] + r2 * dist[..., 9])
        bent_y = bent_y + r2 * (dist[..., 10] + r2 * dist[..., 11])
    return bent_x, bent_y


def _below(dist: Array, r2: Array) -> Array:
    """Denominator of the rational model."""
    return 1 + r2 * (dist[..., 5] + r2 * (dist[..., 6] + r2 * dist[..., 7]))


def _tilt(xp: Any, dist: Array) -> tuple[tuple[Array, Array, Array], ...]:
    """Rows of the homography to the tilted sensor (OpenCV's `computeTiltProjectionMatrix`)."""
    cos_x, sin_x = xp.cos(dist[..., 12]), xp.sin(dist[..., 12])
    cos_y, sin_y = xp.cos(dist[..., 13]), xp.sin(dist[..., 13])
    first, second = (cos_y, sin_y * sin_x, -sin_y * cos_x), (0 * cos_x, cos_x, sin_x)
    third = sin_y, -cos_y * sin_x, cos_y * cos_x
    to_plane = [
        tuple(third[2] * along[i] - along[2] * third[i] for i in range(3)) for along in (first, second)
    ]
    return (to_plane[0], to_plane[1], third)


def _pinhole_derivative(xp: Any, dist: Array, x: Array, y: Array) -> tuple[Array, ...]:
    coefficients = dist.shape[-1]
    if coefficients == 0:
        one = xp.ones_like(x)
        return one, 0 * one, 0 * one, one
    k1, k2, p1, p2 = (dist[..., i] for i in range(4))
    k3 = dist[..., 4] if coefficients > 4 else 0.0
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    # The derivative of `radial` by r²; the derivative of r² by x is 2 x.
    slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
    if coefficients >= 8:
        k4, k5, k6 = (dist[..., i] for i in range(5, 8))
        below = _below(dist, r2)
        radial = radial / below
        slope = (slope - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / below
    xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    xy = yx = 2 * (x * y * slope + p1 * x + p2 * y)
    if coefficients >= 12:
        prism_x, prism_y = (2 * (dist[..., i] + 2 * r2 * dist[..., i + 1]) for i in (8, 10))
        xx, xy = xx + prism_x * x, xy + prism_x * y
        yx, yy = yx + prism_y * x, yy + prism_y * y
    if coefficients == 14:
        (a, b, c), (d, e, f), (g, h, i) = _tilt(xp, dist)
        bent_x, bent_y = _before_tilt(dist, x, y)
        w = g * bent_x + h * bent_y + i
        u, v = (a * bent_x + b * bent_y + c) / w, (d * bent_x + e * bent_y + f) / w
        u_x, u_y, v_x, v_y = (a - u * g) / w, (b - u * h) / w, (d - v * g) / w, (e - v * h) / w
        xx, xy, yx, yy = (
            u_x * xx + u_y * yx,
            u_x * xy + u_y * yy,
            v_x * xx + v_y * yx,
            v_x * xy + v_y * yy,
        )
    return xx, xy, yx, yy


def _fisheye(xp: Any, dist: Array, x: Array, y: Array) -> tuple[Array, Array]:
    scale = _fisheye_scale(xp, dist, x * x + y * y)[0]
    return x * scale, y * scale


def _fisheye_derivative(xp: Any, dist: Array, x: Array, y: Array) -> tuple[Array, ...]:
    scale, slope = _fisheye_scale(xp, dist, x * x + y * y)
    xy = 2 * x * y * slope
    return scale + 2 * x * x * slope, xy, xy, scale + 2 * y * y * slope


def _fisheye_scale(xp: Any, dist: Array, r2: Array) -> tuple[Array, Array]:
    """Distorted radius divided by r, and the derivative of this quotient by r²."""
    k1, k2, k3, k4 = (dist[..., i] for i in range(4))
    near = r2 < _SMALL_R2
    # Gradients of both branches must be finite, so r is 1 where the series is used.
    safe_r2 = xp.where(near, 1.0, r2)
    r = xp.sqrt(safe_r2)
    angle = xp.arctan(r)
    t2 = angle * angle
    bent = angle * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    bent_by_angle = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    scale = xp.where(near, 1 + (k1 - 1 / 3) * r2, bent / r)
    slope = xp.where(near, k1 - 1 / 3, (bent_by_angle / (1 + safe_r2) - bent / r) / (2 * safe_r2))
    return scale, slope


@dataclass(frozen=True)
class _Inverse:
    """Points whose undistorted coordinates are searched; all arrays have the points as last axis, except `dist`.

    Attributes:
        dist: (points, coefficients).
        fisheye: (points,), or None.
        beyond: (points,), see `second_sheet`.
        target: (2, points), distorted coordinates.
    """

    dist: np.ndarray
    fisheye: np.ndarray | None
    beyond: np.ndarray
    target: np.ndarray

    def at(self, index: np.ndarray) -> _Inverse:
        """Points with these indices."""
        fisheye = None if self.fisheye is None else self.fisheye[index]
        return _Inverse(self.dist[index], fisheye, self.beyond[index], self.target[:, index])

    def _flat(self) -> np.ndarray:
        """The targets on a sensor that is not tilted."""
        if self.dist.shape[-1] < 14:
            return self.target
        H = np.stack([np.stack(np.broadcast_arrays(*row), axis=-1) for row in _tilt(np, self.dist)], axis=-2)
        across = np.linalg.solve(H, np.vstack([self.target, np.ones_like(self.target[:1])]).T[..., None])[
            ..., 0
        ]
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = (across[:, :2] / across[:, 2:]).T
        if self.fisheye is not None:
            flat = np.where(self.fisheye, self.target, flat)
        return np.where(np.isfinite(flat), flat, 0.0)

    def near_start(self) -> np.ndarray:
        """(2, points), the distorted points; of a fisheye without coefficients the undistorted points."""
        start = self._flat()
        if self.fisheye is None:
            return start
        bent = np.hypot(*start)
        scale = np.tan(np.minimum(bent, 1.5)) / np.maximum(bent, 1e-12)
        return np.where(self.fisheye & (bent > 1e-12), start * scale, start)

    def far_start(self) -> np.ndarray:
        """(2, points), points whose image has nearly the right distance from the axis, by bisection of the angle."""
        flat = self._flat()
        wanted = np.hypot(*flat)
        direction = flat / np.maximum(wanted, 1e-300)
        # Only the radial part of the lens: the tangential one and the prism's are small.
        radial = LensNumbers(self.dist.copy(), self.fisheye)
        across = [column for column in range(radial.dist.shape[-1]) if column in (2, 3) or column >= 8]
        radial.dist[:, across] *= 0 if self.fisheye is None else self.fisheye[:, None]
        low, high = np.zeros(len(wanted)), np.full(len(wanted), np.pi / 2)
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            r = np.tan(middle)
            zero = np.zeros_like(r)
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                bent = distort(radial, r, zero)[0]
                is_far = ~_rises(np, radial, r, zero) | ~(bent < wanted) | (r > self.beyond)
            low, high = np.where(is_far, low, middle), np.where(is_far, middle, high)
        return direction * np.tan((low + high) / 2)

    def newton(self, start: np.ndarray) -> np.ndarray:
        """(2, points), solutions; NaN where the steps do not converge, or converge beyond the fold."""
        solution = np.full(start.shape, np.nan)
        at, index, share = start.copy(), np.arange(start.shape[1]), np.ones(start.shape[1])
        with np.errstate(all="ignore"):
            residual, derivative = self._linearise(at)
            for _ in range(_MAX_STEPS):
                some = self.at(index)
                xx, xy, yx, yy = derivative
                step = np.stack([yy * residual[0] - xy * residual[1], xx * residual[1] - yx * residual[0]])
                tried = at + share * step / (xx * yy - xy * yx)
                again, slopes = some._linearise(tried)
                size = np.abs(residual).max(axis=0)
                # A step beyond the fold would lead to another point with the same image.
                better = (np.abs(again).max(axis=0) < size) & (slopes[0] * slopes[3] > slopes[1] * slopes[2])
                small = size <= _RESIDUAL * (1 + np.abs(some.target).max(axis=0))
                # A solution that no step improves is exact but for rounding; other points need a shorter step.
                solution[:, index[small]] = np.where(better, tried, at)[:, small]
                at, residual, derivative = (
                    np.where(better, new, old)
                    for new, old in ((tried, at), (again, residual), (slopes, derivative))
                )
                share = np.where(better, np.minimum(2 * share, 1), share / 4)
                kept = (better | ~small) & (share > _LEAST_SHARE)
                index, at, residual, share = index[kept], at[:, kept], residual[:, kept], share[kept]
                derivative = derivative[:, kept]
                if not len(index):
                    break
            is_there = is_one_to_one(self, solution[0], solution[1], self.beyond)
        return np.where(is_there, solution, np.nan)

    def _linearise(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(2, points), residuals at points, and (4, points), derivatives of the distorted coordinates."""
        residual = self.target - np.stack(distort(self, *at))
        return residual, np.stack(np.broadcast_arrays(*lens_derivative(self, *at)))
