"""psotrack's fitness in vectorised NumPy for pyswarms: a plain version, and a version tuned by hand.

Both versions compute all particles, drones, cameras and windows at once, and return the same values. The cameras must
have no lens distortion and no skew, so NumPy does less work than psotrack's general code.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from psotrack.geometry import NEAR_M, Camera
from psotrack.tracking import SoftIoU
from psotrack.tracking.fitness import MIN_WEIGHT
from psotrack.tracking.patches import FULL


class NumpyFitness(Protocol):
    """Mean fitness over the drones of each particle, as in `psotrack.tracking.fitness.joint_fitness`."""

    def tables(self, coverage: np.ndarray) -> np.ndarray:
        """Summed-area tables (cameras, height + 1, width + 1) of silhouettes, in whole pixels."""
        ...

    def __call__(self, tables: np.ndarray, position_m: np.ndarray) -> np.ndarray:
        """Fitness (particles,) of positions (particles, drones, 3)."""
        ...


class PlainFitness:
    """Plain vectorised NumPy: float64, arrays (windows, particles, drones, cameras)."""

    def __init__(self, cameras: Camera, size_m: np.ndarray, score: SoftIoU, reduction: int) -> None:
        _check_pinhole(cameras)
        self._rotation = cameras.T_cam_world[:, :3, :3]
        self._t = cameras.T_cam_world[:, :3, 3]
        self._K = cameras.K
        self._shapes = np.einsum("cij,dj,ckj->dcik", self._rotation, (size_m / 2) ** 2, self._rotation)
        self._score, self._reduction = score, reduction

    @staticmethod
    def tables(coverage: np.ndarray) -> np.ndarray:
        """As `NumpyFitness.tables`."""
        return np.pad(coverage.cumsum(axis=1).cumsum(axis=2) / FULL, [(0, 0), (1, 0), (1, 0)])

    def __call__(self, tables: np.ndarray, position_m: np.ndarray) -> np.ndarray:
        """As `NumpyFitness`."""
        in_front, x, x_half, y, y_half = self._boxes(position_m)
        height, width = tables.shape[1] - 1, tables.shape[2] - 1

        scales = np.array([*self._score.windows, self._score.ring]).reshape(-1, 1, 1, 1)
        x0, x1 = np.clip(x - scales * x_half, 0, width), np.clip(x + scales * x_half, 0, width)
        y0, y1 = np.clip(y - scales * y_half, 0, height), np.clip(y + scales * y_half, 0, height)
        foreground = (
            _bilinear(tables, x1, y1)
            - _bilinear(tables, x0, y1)
            - _bilinear(tables, x1, y0)
            + _bilinear(tables, x0, y0)
        )
        area = (x1 - x0) * (y1 - y0)
        inner, ring = foreground[:-1], foreground[-1]
        score = (inner / np.maximum(area[:-1] + np.maximum(ring - inner, 0), 1e-6)).mean(axis=0)

        inside_x = np.clip(x + x_half, 0, width) - np.clip(x - x_half, 0, width)
        inside_y = np.clip(y + y_half, 0, height) - np.clip(y - y_half, 0, height)
        weight = np.where(in_front, inside_x * inside_y / np.maximum(4 * x_half * y_half, 1e-6), 0)
        mean = (weight * score).sum(axis=-1) / np.maximum(weight.sum(axis=-1), 1e-6)
        least = self._score.min_cameras
        enough = ((weight > MIN_WEIGHT).sum(axis=-1) >= least) & (weight.sum(axis=-1) > least / 2)
        return np.where(enough, mean, 0).mean(axis=-1)

    def _boxes(self, position_m: np.ndarray) -> tuple[np.ndarray, ...]:
        """Whether a drone is in front of the camera; middle and half side of its box along x and y, reduced pixels."""
        centre = np.einsum("cij,pdj->pdci", self._rotation, position_m) + self._t
        z, s_zz = centre[..., 2], self._shapes[..., 2, 2]
        in_front = z**2 * np.sign(z) > s_zz + NEAR_M
        a = np.where(in_front, z**2 - s_zz, 1)
        edges = []
        for axis in (0, 1):
            along = centre[..., axis]
            b = along * z - self._shapes[..., axis, 2]
            c = along**2 - self._shapes[..., axis, axis]
            root = np.sqrt(np.where(in_front, np.maximum(b**2 - a * c, 1e-12), 1))
            focal, middle = self._K[:, axis, axis], self._K[:, axis, 2] + 0.5
            edges += [focal * b / a + middle, focal * root / a]
        return in_front, *(edge / self._reduction for edge in edges)


def _bilinear(tables: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Read each camera's table at fractional positions (..., cameras), with bilinear interpolation."""
    camera = np.arange(len(tables))
    column = np.minimum(x.astype(int), tables.shape[2] - 2)
    row = np.minimum(y.astype(int), tables.shape[1] - 2)
    fx, fy = x - column, y - row
    upper = (1 - fx) * tables[camera, row, column] + fx * tables[camera, row, column + 1]
    lower = (1 - fx) * tables[camera, row + 1, column] + fx * tables[camera, row + 1, column + 1]
    return (1 - fy) * upper + fy * lower


def _check_pinhole(cameras: Camera) -> None:
    if cameras.dist.shape[-1] or np.any(cameras.K[:, 0, 1]):
        raise ValueError("cameras must have no lens distortion and no skew")


class TunedFitness:
    """NumPy tuned for speed.

    Arrays are float32, with contiguous cameras as the last axis. There is one small matrix product per coordinate, no
    table is read twice at one place, and tables are read by `take` with flat indices.
    """

    def __init__(self, cameras: Camera, size_m: np.ndarray, score: SoftIoU, reduction: int) -> None:
        _check_pinhole(cameras)
        rotation = cameras.T_cam_world[:, :3, :3]
        shapes = np.einsum("cij,dj,ckj->ikdc", rotation, np.square(size_m / 2), rotation)
        self._rotation_t = [np.ascontiguousarray(rotation[:, axis].T, np.float32) for axis in range(3)]
        self._t = np.ascontiguousarray(cameras.T_cam_world[:, :3, 3].T, np.float32)
        self._shapes = np.ascontiguousarray(shapes, np.float32)
        focal = cameras.K[:, 0, 0], cameras.K[:, 1, 1]
        middle = cameras.K[:, 0, 2] + 0.5, cameras.K[:, 1, 2] + 0.5
        self._focal = [(value / reduction).astype(np.float32) for value in focal]
        self._middle = [(value / reduction).astype(np.float32) for value in middle]
        scales = np.array([*score.windows, score.ring], np.float32)
        self._scales = scales.reshape(-1, 1, 1, 1)
        self._min_cameras = score.min_cameras

    @staticmethod
    def tables(coverage: np.ndarray) -> np.ndarray:
        """As `NumpyFitness.tables`, float32."""
        sums = coverage.astype(np.int32)
        for axis in (1, 2):
            np.cumsum(sums, axis=axis, out=sums)
        cameras, height, width = sums.shape
        tables = np.zeros((cameras, height + 1, width + 1), np.float32)
        np.multiply(sums, np.float32(1 / FULL), out=tables[:, 1:, 1:], casting="unsafe")
        return tables

    def __call__(self, tables: np.ndarray, position_m: np.ndarray) -> np.ndarray:
        """As `NumpyFitness`."""
        position_m = position_m.astype(np.float32)
        x, y, z = (
            position_m @ rotation_t + t for rotation_t, t in zip(self._rotation_t, self._t, strict=True)
        )
        s = self._shapes
        in_front = z * np.abs(z) > s[2, 2] + NEAR_M
        a = np.where(in_front, z * z - s[2, 2], 1)
        (x_low, x_high), whole_x, inside_x = self._extent(x, z, a, s[0, 2], s[0, 0], 0, tables.shape[2] - 1)
        (y_low, y_high), whole_y, inside_y = self._extent(y, z, a, s[1, 2], s[1, 1], 1, tables.shape[1] - 1)

        foreground = _tuned_box_sums(tables, x_low, y_low, x_high, y_high)
        area = (x_high[:-1] - x_low[:-1]) * (y_high[:-1] - y_low[:-1])
        inner, ring = foreground[:-1], foreground[-1]
        score = (inner / np.maximum(area + np.maximum(ring - inner, 0), 1e-6)).mean(axis=0)

        weight = np.where(in_front, inside_x * inside_y / np.maximum(whole_x * whole_y, 1e-6), 0)
        mean = (weight * score).sum(axis=-1) / np.maximum(weight.sum(axis=-1), 1e-6)
        enough = np.count_nonzero(weight > MIN_WEIGHT, axis=-1) >= self._min_cameras
        enough &= weight.sum(axis=-1) > self._min_cameras / 2
        return np.where(enough, mean, 0).mean(axis=-1)

    def _extent(
        self,
        along: np.ndarray,
        z: np.ndarray,
        a: np.ndarray,
        s_along_z: np.ndarray,
        s_along: np.ndarray,
        axis: int,
        last: int,
    ) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
        """Along one axis: edges of all windows clipped to the image, length of the box, and length inside the image."""
        b = along * z - s_along_z
        root = np.sqrt(np.maximum(b * b - a * (along * along - s_along), 1e-12)) / a
        middle = self._focal[axis] * (b / a) + self._middle[axis]
        half = self._focal[axis] * root
        inside = np.clip(middle + half, 0, last) - np.clip(middle - half, 0, last)
        halves = self._scales * half
        return (np.clip(middle - halves, 0, last), np.clip(middle + halves, 0, last)), 2 * half, inside


def _tuned_box_sums(
    tables: np.ndarray, x0: np.ndarray, y0: np.ndarray, x1: np.ndarray, y1: np.ndarray
) -> np.ndarray:
    """Sums over fractional boxes (..., cameras): bilinear reads of the tables at the four corners."""
    num_cameras, height1, width1 = tables.shape
    flat = tables.reshape(-1)
    first = np.arange(num_cameras) * (height1 * width1)

    def split(edge: np.ndarray, last: int) -> tuple[np.ndarray, np.ndarray]:
        cell = np.minimum(edge.astype(np.intp), last - 1)
        return cell, edge - cell.astype(np.float32)

    def read(index: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        upper, lower = flat.take(index), flat.take(index + width1)
        upper += fx * (flat.take(index + 1) - upper)
        lower += fx * (flat.take(index + (width1 + 1)) - lower)
        return upper + fy * (lower - upper)

    (i0, fx0), (i1, fx1) = split(x0, width1 - 1), split(x1, width1 - 1)
    (j0, fy0), (j1, fy1) = split(y0, height1 - 1), split(y1, height1 - 1)
    row0, row1 = first + j0 * width1, first + j1 * width1
    bottom = read(row1 + i1, fx1, fy1) - read(row1 + i0, fx0, fy1)
    return bottom - (read(row0 + i1, fx1, fy0) - read(row0 + i0, fx0, fy0))
