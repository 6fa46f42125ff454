"""Paths of drones through a few frames, from blobs of foreground that nobody has told apart.

What one frame cannot tell, several can: rays to different drones cross by chance, but not in every frame. Every point
on which two viewpoints agree proposes a path, which gathers the blobs that fit it in all frames and cameras.

How well a blob fits is f = (1 - (d / r)²) (1 - (log w / log `WIDEST`)²), with its middle at a distance d from the path,
its radius r, and w, how many times wider it is than the other cameras say. f² is its weight (for d Tukey's biweight):
the middle of a blob that two drones share is the middle of neither, and counts little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from psotrack.geometry import Camera, project, triangulate_candidates, triangulate_paths, viewpoints
from psotrack.silhouettes import ViewBlobs

#: A blob that is so many times wider than what the other cameras see holds more than the drone; narrower, less.
WIDEST = 1.6
#: Paths whose ends lie in one cube with such sides are the same.
SAME_PATH_M = 0.02
#: What a blob's middle jumps by when a rotor appears: a slow drone may seem faster than it is.
JUMP_M = 0.1
#: Points of one frame that paths start from; silhouettes full of noise have no end of them.
MOST_POINTS = 300


@dataclass(frozen=True)
class Paths:
    """Paths, and what the cameras show there.

    Attributes:
        coefficient: (paths, terms, 3), of the powers of time (see `triangulate_paths`).
        position_m: (paths, frames, 3).
        blob: (paths, frames, cameras), the whole blob whose middle fits best, or -1.
        fit: (paths, frames, cameras), how well, from 1 to 0; 0 where there is none.
        covered: (paths, frames, cameras, blobs), the blobs whose boxes hold the path.
        in_view: (paths, frames, cameras), whether the path is in the image.
        size_m: (paths, frames, cameras, 2), width and height of the blob at the path's depth; NaN where none.
    """

    coefficient: Float[np.ndarray, "paths terms 3"]
    position_m: Float[np.ndarray, "paths frames 3"]
    blob: Int[np.ndarray, "paths frames cameras"]
    fit: Float[np.ndarray, "paths frames cameras"]
    covered: Bool[np.ndarray, "paths frames cameras blobs"]
    in_view: Bool[np.ndarray, "paths frames cameras"]
    size_m: Float[np.ndarray, "paths frames cameras 2"]

    def __getitem__(self, index: Int[np.ndarray, "chosen"]) -> Paths:
        return Paths(*(value[index] for value in vars(self).values()))

    def __len__(self) -> int:
        return len(self.coefficient)

    @property
    def alone(self) -> Bool[np.ndarray, "paths frames cameras"]:
        """Whether each path has a blob that holds none of the others."""
        return self.has_one_of(self.covered.sum(axis=0) <= 1)

    def has_one_of(
        self, blobs: Bool[np.ndarray, "frames cameras blobs"]
    ) -> Bool[np.ndarray, "paths frames cameras"]:
        """Whether each path's blob is one of these."""
        frame, camera = np.indices(self.blob.shape[1:])
        return (self.blob >= 0) & blobs[frame, camera, self.blob]


def propose_paths(
    cameras: Camera,
    seen: ViewBlobs,
    time_s: Float[np.ndarray, "frames"],
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
) -> Paths:
    """All paths that two viewpoints or more agree on; most of them are nobody's.

    A path starts from two frames that follow one another: the first ones, those in the middle or the last ones. From
    there it grows to twice as many frames at a time.

    Args:
        cameras: with one leading axis.
        seen: one frame or more, with a blob somewhere.
        time_s: (frames,), of the frames, the first at 0.
        bounds_m: (2, 3), corners of the region where drones are.
        max_speed_m_s: of a drone.
    """
    frames = len(time_s)
    paths = []
    for first in sorted({0, max(frames // 2 - 1, 0), max(frames - 2, 0)}):
        path = _starts(cameras, seen, time_s, first, bounds_m, max_speed_m_s)
        reach = 1
        while reach < 2 * frames:
            window = np.abs(np.arange(frames) - first) <= reach
            path = _refit(cameras, seen[window], time_s[window], path)
            reach *= 2
        paths.append(path)
    found = look(cameras, seen, time_s, _refit(cameras, seen, time_s, np.concatenate(paths)))
    middle = np.median(found.position_m, axis=1)
    return found[np.flatnonzero(((middle >= bounds_m[0]) & (middle <= bounds_m[1])).all(axis=-1))]


def look(
    cameras: Camera,
    seen: ViewBlobs,
    time_s: Float[np.ndarray, "frames"],
    coefficient: Float[np.ndarray, "paths terms 3"],
) -> Paths:
    """What the cameras show at each path."""
    position = _positions(coefficient, time_s)
    pixels, depth = project(cameras, position[:, :, None, :])
    in_front = depth > 0
    away = pixels[..., None, :] - seen.centre_px
    distance = np.linalg.norm(away, axis=-1) / seen.radius_px
    distance = np.where(seen.whole & in_front[..., None] & (distance <= 1), distance, np.inf)
    blob = distance.argmin(axis=-1)
    least = distance.min(axis=-1)
    size_m = (
        2
        * _pick(seen.half_px, blob)
        * depth[..., None]
        / np.stack([cameras.K[:, 0, 0], cameras.K[:, 1, 1]], axis=-1)
    )
    width_m = np.where(np.isfinite(least), size_m[..., 0], np.inf)
    usual_m = _lower_median(_lower_median(width_m, axis=1), axis=2)
    fits = np.isfinite(least)
    unlike = np.log(np.where(fits, width_m, 1) / np.where(fits, usual_m, 1)) / np.log(WIDEST)
    fits &= np.abs(unlike) < 1
    return Paths(
        coefficient=coefficient,
        position_m=position,
        blob=np.where(fits, blob, -1),
        fit=np.where(fits, (1 - np.where(fits, least, 0) ** 2) * (1 - unlike**2), 0),
        covered=np.asarray(
            (np.abs(away) <= seen.half_px + seen.least_radius_px).all(axis=-1) & in_front[..., None]
        ),
        in_view=np.asarray(((pixels >= 0) & (pixels < cameras.image_size_wh)).all(axis=-1) & in_front),
        size_m=np.where(fits[..., None], size_m, np.nan),
    )


def _lower_median(values: Float[np.ndarray, "*shape"], axis: int) -> Float[np.ndarray, "*reduced"]:
    """Of the finite ones; the lower of two in the middle, infinite where there is none. The axis stays."""
    rank = np.maximum(np.isfinite(values).sum(axis=axis, keepdims=True) - 1, 0) // 2
    return np.take_along_axis(np.sort(values, axis=axis), rank, axis)


def refine_paths(
    cameras: Camera, seen: ViewBlobs, time_s: Float[np.ndarray, "frames"], paths: Paths
) -> Paths:
    """Paths of drones that are known to be there.

    A blob that holds two of them says where neither is; it counts only where nothing else places the drone.
    """
    viewpoint = viewpoints(cameras)
    for _ in range(3):
        alone = paths.alone
        enough = by_viewpoint(np.any(alone, axis=1), viewpoint).sum(axis=-1) >= 2
        weights = np.where(enough[:, None, None] & ~alone, 0.0, paths.fit**2)
        path = triangulate_paths(cameras, _pick(seen.centre_px, paths.blob), time_s, weights)
        paths = look(cameras, seen, time_s, np.where(np.isfinite(path), path, paths.coefficient))
    return paths


def by_viewpoint(
    values: Shaped[np.ndarray, "*shape cameras"], viewpoint: Int[np.ndarray, "cameras"]
) -> Shaped[np.ndarray, "*shape viewpoints"]:
    """The largest value among the cameras of each viewpoint."""
    return np.stack([values[..., viewpoint == one].max(axis=-1) for one in np.unique(viewpoint)], axis=-1)


def _starts(
    cameras: Camera,
    seen: ViewBlobs,
    time_s: Float[np.ndarray, "frames"],
    first: int,
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
) -> Float[np.ndarray, "paths terms 3"]:
    """Straight paths through every two points of a frame and the next that a drone can fly between."""
    second = min(first + 1, len(time_s) - 1)
    here, there = (_points(cameras, seen, frame, bounds_m) for frame in (first, second))
    step_s = time_s[second] - time_s[first]
    near = np.linalg.norm(here[:, None] - there, axis=-1) <= max_speed_m_s * step_s + JUMP_M
    a, b = np.nonzero(near)
    velocity = (there[b] - here[a]) / step_s if second > first else np.zeros((len(a), 3))
    return np.stack([here[a] - velocity * time_s[first], velocity, np.zeros((len(a), 3))], axis=1)


def _points(
    cameras: Camera, seen: ViewBlobs, frame: int, bounds_m: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "points 3"]:
    """Points of one frame that two viewpoints agree on, those with most viewpoints first."""
    whole, radius = seen.whole[frame], seen.radius_px[frame]
    points_px = [seen.centre_px[frame, camera, there] for camera, there in enumerate(whole)]
    radius_px = [of[there] for of, there in zip(radius, whole, strict=True)]
    points, support = triangulate_candidates(cameras, points_px, radius_px, bounds_m)
    views = by_viewpoint(support >= 0, viewpoints(cameras)).sum(axis=-1)
    return points[np.argsort(-views, kind="stable")[:MOST_POINTS]]


def _refit(
    cameras: Camera,
    seen: ViewBlobs,
    time_s: Float[np.ndarray, "frames"],
    path: Float[np.ndarray, "paths terms 3"],
) -> Float[np.ndarray, "refitted terms 3"]:
    """Paths through the blobs that fit them, those that have come to be the same only once."""
    paths = look(cameras, seen, time_s, path)
    path = triangulate_paths(cameras, _pick(seen.centre_px, paths.blob), time_s, paths.fit**2)
    path = path[np.isfinite(path).all(axis=(1, 2))]
    ends = _positions(path, time_s[[0, -1]]).reshape(len(path), 6)
    return path[np.unique(np.round(ends / SAME_PATH_M), axis=0, return_index=True)[1]]


def _positions(
    path: Float[np.ndarray, "paths terms 3"], time_s: Float[np.ndarray, "frames"]
) -> Float[np.ndarray, "paths frames 3"]:
    return np.einsum("fk,pki->pfi", time_s[:, None] ** np.arange(path.shape[1]), path)


def _pick(
    values: Float[np.ndarray, "frames cameras blobs 2"], blob: Int[np.ndarray, "paths frames cameras"]
) -> Float[np.ndarray, "paths frames cameras 2"]:
    """Of each path's blobs; NaN where it has none."""
    frame, camera = np.indices(blob.shape[1:])
    return np.where(blob[..., None] >= 0, values[frame, camera, blob], np.nan)
