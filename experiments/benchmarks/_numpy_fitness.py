"""psotrack's fitness in vectorised NumPy for pyswarms, tuned by hand.

All particles, drones, cameras and windows are computed at once. The cameras must have no lens distortion and no skew,
so NumPy does less work than psotrack's general code.
"""

from __future__ import annotations

import numpy as np

from psotrack.geometry import NEAR_M, Camera
from psotrack.tracking.swarm import SoftIoU
from psotrack.tracking.swarm.fitness import MIN_WEIGHT
from psotrack.tracking.swarm.patches import FULL


class NumpyFitness:
    """Mean fitness over the drones of each particle, as in `psotrack.tracking.swarm.fitness.joint_fitness`.

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
        """Summed-area tables (cameras, height + 1, width + 1) of silhouettes, float32, in whole pixels."""
        sums = coverage.astype(np.int32)
        for axis in (1, 2):
            np.cumsum(sums, axis=axis, out=sums)
        cameras, height, width = sums.shape
        tables = np.zeros((cameras, height + 1, width + 1), np.float32)
        np.multiply(sums, np.float32(1 / FULL), out=tables[:, 1:, 1:], casting="unsafe")
        return tables

    def __call__(self, tables: np.ndarray, position_m: np.ndarray) -> np.ndarray:
        """Fitness (particles,) of positions (particles, drones, 3)."""
        position_m = position_m.astype(np.float32)
        x, y, z = (
            position_m @ rotation_t + t for rotation_t, t in zip(self._rotation_t, self._t, strict=True)
        )
        s = self._shapes
        in_front = z * np.abs(z) > s[2, 2] + NEAR_M
        a = np.where(in_front, z * z - s[2, 2], 1)
        (x_low, x_high), whole_x, inside_x = self._extent(x, z, a, s[0, 2], s[0, 0], 0, tables.shape[2] - 1)
        (y_low, y_high), whole_y, inside_y = self._extent(y, z, a, s[1, 2], s[1, 1], 1, tables.shape[1] - 1)

        foreground = _box_sums(tables, x_low, y_low, x_high, y_high)
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


def _box_sums(
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


def _check_pinhole(cameras: Camera) -> None:
    if cameras.dist.shape[-1] or np.any(cameras.K[:, 0, 1]):
        raise ValueError("cameras must have no lens distortion and no skew")
