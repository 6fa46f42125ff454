"""Paths of drones through several frames, from blobs of foreground that are not yet assigned to drones.

In a single frame, rays to different drones may cross by chance; over several frames they do not. Every point in which
rays of two viewpoints cross proposes a path. The path is then fitted to the blobs near it in all frames and cameras.

The fit of a blob to a path is f = (1 - (d / r)²) (1 - (log w / log `WIDEST`)²), where d is the distance from the blob's
middle to the path, r the blob's radius, and w the ratio of its width to the width in the other cameras. The blob's
weight is f² (for d, Tukey's biweight). So a blob that two drones share, whose middle is at neither drone, counts
little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from psotrack.geometry import (
    Camera,
    project_visible,
    sizes_m,
    to_camera,
    triangulate_candidates,
    triangulate_paths,
    viewpoints,
)
from psotrack.silhouettes import ViewBlobs

#: Largest ratio of a blob's width to the width in the other cameras, or the inverse. A wider blob holds more than the
#: drone, a narrower one less.
WIDEST = 1.6
#: Paths whose first and last positions round to the same multiples of this length are the same path.
SAME_PATH_M = 0.02
#: Distance by which a blob's middle may jump when a rotor appears, which makes a slow drone seem faster.
JUMP_M = 0.1
#: Largest number of points per frame from which paths start; noisy silhouettes have very many crossings of rays.
MOST_POINTS = 300


@dataclass(frozen=True)
class Paths:
    """Paths, and the blobs that the cameras show at them.

    Attributes:
        coefficient: (paths, terms, 3), coefficients of the powers of time (see `triangulate_paths`).
        position_m: (paths, frames, 3), positions in the world, metres.
        blob: (paths, frames, cameras), index of the whole blob that fits best; -1 for none.
        fit: (paths, frames, cameras), fit of this blob, from 0 to 1; 0 for none.
        covered: (paths, frames, cameras, blobs), whether the blob's box holds the path.
        in_view: (paths, frames, cameras), whether the path is in the image.
        size_m: (paths, frames, cameras, 2), width and height of the blob at the path's depth; NaN for none.
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
        """(paths, frames, cameras), whether the path has a blob in which there is no other path."""
        return self.has_one_of(self.covered.sum(axis=0) <= 1)

    def has_one_of(
        self, blobs: Bool[np.ndarray, "frames cameras blobs"]
    ) -> Bool[np.ndarray, "paths frames cameras"]:
        """(paths, frames, cameras), whether the path has a blob, and the blob is one of `blobs`."""
        frame, camera = np.indices(self.blob.shape[1:])
        return (self.blob >= 0) & blobs[frame, camera, self.blob]


def propose_paths(
    cameras: Camera,
    seen: ViewBlobs,
    time_s: Float[np.ndarray, "frames"],
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
) -> Paths:
    """Propose all paths that at least two viewpoints show; most of these paths belong to no drone.

    A path starts as a straight line through two consecutive frames: the first two, the middle two or the last two. Its
    window of frames is then doubled, with a new fit each time, until it holds all frames.

    Args:
        cameras: cameras with one leading axis.
        seen: blobs of at least one frame; at least one image has a blob.
        time_s: (frames,), times of the frames; the first is 0.
        bounds_m: (2, 3), corners of the region where drones may be.
        max_speed_m_s: largest speed of a drone.
    """
    frames = len(time_s)
    paths = []
    for first in sorted({0, max(frames // 2 - 1, 0), max(frames - 2, 0)}):
        path = _straight_paths(cameras, seen, time_s, first, bounds_m, max_speed_m_s)
        reach = 1
        while reach < 2 * frames:
            window = np.abs(np.arange(frames) - first) <= reach
            path = _refit(cameras, seen[window], time_s[window], path)
            reach *= 2
        paths.append(path)
    found = match_blobs(cameras, seen, time_s, _refit(cameras, seen, time_s, np.concatenate(paths)))
    middle = np.median(found.position_m, axis=1)
    return found[np.flatnonzero(((middle >= bounds_m[0]) & (middle <= bounds_m[1])).all(axis=-1))]


def match_blobs(
    cameras: Camera,
    seen: ViewBlobs,
    time_s: Float[np.ndarray, "frames"],
    coefficient: Float[np.ndarray, "paths terms 3"],
) -> Paths:
    """Find the blobs that fit each path in all frames and cameras."""
    position = _positions(coefficient, time_s)
    pixels, depth = project_visible(cameras, _seen_positions(coefficient, seen, time_s))
    in_front = depth > 0
    if seen.exposures is not None:
        in_front = in_front & np.asarray(seen.exposures.is_there)
    offset = pixels[..., None, :] - seen.centre_px
    distance = np.linalg.norm(offset, axis=-1) / seen.radius_px
    distance = np.where(seen.whole & in_front[..., None] & (distance <= 1), distance, np.inf)
    blob = distance.argmin(axis=-1)
    smallest = distance.min(axis=-1)
    points_cam = np.asarray(to_camera(cameras, position[:, :, None, :]))
    size_m = sizes_m(cameras, points_cam, 2 * _pick(seen.half_px, blob))
    width_m = np.where(np.isfinite(smallest), size_m[..., 0], np.inf)
    median_m = _lower_median(_lower_median(width_m, axis=1), axis=2)
    fits = np.isfinite(smallest)
    log_ratio = np.log(np.where(fits, width_m, 1) / np.where(fits, median_m, 1)) / np.log(WIDEST)
    fits &= np.abs(log_ratio) < 1
    return Paths(
        coefficient=coefficient,
        position_m=position,
        blob=np.where(fits, blob, -1),
        fit=np.where(fits, (1 - np.where(fits, smallest, 0) ** 2) * (1 - log_ratio**2), 0),
        covered=np.asarray(
            (np.abs(offset) <= seen.half_px + seen.least_radius_px).all(axis=-1) & in_front[..., None]
        ),
        in_view=np.asarray(((pixels >= 0) & (pixels < cameras.image_size_wh)).all(axis=-1) & in_front),
        size_m=np.where(fits[..., None], size_m, np.nan),
    )


def _lower_median(values: Float[np.ndarray, "*shape"], axis: int) -> Float[np.ndarray, "*reduced"]:
    """Lower median of the finite values along an axis, which stays; infinite where no value is finite."""
    rank = np.maximum(np.isfinite(values).sum(axis=axis, keepdims=True) - 1, 0) // 2
    return np.take_along_axis(np.sort(values, axis=axis), rank, axis)


def refine_paths(
    cameras: Camera, seen: ViewBlobs, time_s: Float[np.ndarray, "frames"], paths: Paths
) -> Paths:
    """Refit paths that are known to be drones.

    A blob that holds two paths shows the position of neither drone. Such a blob counts only for a path that has too few
    blobs of its own.
    """
    viewpoint = viewpoints(cameras)
    for _ in range(3):
        alone = paths.alone
        enough = by_viewpoint(np.any(alone, axis=1), viewpoint).sum(axis=-1) >= 2
        weights = np.where(enough[:, None, None] & ~alone, 0.0, paths.fit**2)
        path = triangulate_paths(cameras, _pick(seen.centre_px, paths.blob), _times(seen, time_s), weights)
        paths = match_blobs(cameras, seen, time_s, np.where(np.isfinite(path), path, paths.coefficient))
    return paths


def by_viewpoint(
    values: Shaped[np.ndarray, "*shape cameras"], viewpoint: Int[np.ndarray, "cameras"]
) -> Shaped[np.ndarray, "*shape viewpoints"]:
    """Largest value among the cameras of each viewpoint."""
    return np.stack([values[..., viewpoint == one].max(axis=-1) for one in np.unique(viewpoint)], axis=-1)


def _straight_paths(
    cameras: Camera,
    seen: ViewBlobs,
    time_s: Float[np.ndarray, "frames"],
    first: int,
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
) -> Float[np.ndarray, "paths terms 3"]:
    """Straight paths through each pair of points of two consecutive frames that a drone can fly between."""
    second = min(first + 1, len(time_s) - 1)
    from_m, to_m = (_crossing_points(cameras, seen, frame, bounds_m) for frame in (first, second))
    step_s = time_s[second] - time_s[first]
    near = np.linalg.norm(from_m[:, None] - to_m, axis=-1) <= max_speed_m_s * step_s + JUMP_M
    a, b = np.nonzero(near)
    velocity = (to_m[b] - from_m[a]) / step_s if second > first else np.zeros((len(a), 3))
    return np.stack([from_m[a] - velocity * time_s[first], velocity, np.zeros((len(a), 3))], axis=1)


def _crossing_points(
    cameras: Camera, seen: ViewBlobs, frame: int, bounds_m: Float[np.ndarray, "2 3"]
) -> Float[np.ndarray, "points 3"]:
    """Points of one frame in which rays of at least two viewpoints cross, sorted by the number of viewpoints."""
    whole, radius = seen.whole[frame], seen.radius_px[frame]
    points_px = [seen.centre_px[frame, camera, chosen] for camera, chosen in enumerate(whole)]
    radius_px = [all_px[chosen] for all_px, chosen in zip(radius, whole, strict=True)]
    points, support = triangulate_candidates(cameras, points_px, radius_px, bounds_m)
    views = by_viewpoint(support >= 0, viewpoints(cameras)).sum(axis=-1)
    return points[np.argsort(-views, kind="stable")[:MOST_POINTS]]


def _refit(
    cameras: Camera,
    seen: ViewBlobs,
    time_s: Float[np.ndarray, "frames"],
    path: Float[np.ndarray, "paths terms 3"],
) -> Float[np.ndarray, "refitted terms 3"]:
    """Fit each path to its blobs again, and merge paths that have become the same."""
    paths = match_blobs(cameras, seen, time_s, path)
    path = triangulate_paths(cameras, _pick(seen.centre_px, paths.blob), _times(seen, time_s), paths.fit**2)
    path = path[np.isfinite(path).all(axis=(1, 2))]
    ends = _positions(path, time_s[[0, -1]]).reshape(len(path), 6)
    return path[np.unique(np.round(ends / SAME_PATH_M), axis=0, return_index=True)[1]]


def _times(
    seen: ViewBlobs, time_s: Float[np.ndarray, "frames"]
) -> Float[np.ndarray, "frames"] | Float[np.ndarray, "frames cameras"]:
    """Times of the frames, seconds; of each camera where cameras have times of their own."""
    return time_s if seen.exposures is None else time_s[:, None] + np.asarray(seen.exposures.offset_s)


def _seen_positions(
    path: Float[np.ndarray, "paths terms 3"], seen: ViewBlobs, time_s: Float[np.ndarray, "frames"]
) -> Float[np.ndarray, "paths frames #cameras 3"]:
    """Positions at the times at which the cameras see them; the same for all cameras that are synchronous."""
    times_s = _times(seen, time_s)
    position = _positions(path, times_s.ravel())
    return position.reshape(len(path), len(time_s), times_s.size // max(len(time_s), 1), 3)


def _positions(
    path: Float[np.ndarray, "paths terms 3"], time_s: Float[np.ndarray, "frames"]
) -> Float[np.ndarray, "paths frames 3"]:
    return np.einsum("fk,pki->pfi", time_s[:, None] ** np.arange(path.shape[1]), path)


def _pick(
    values: Float[np.ndarray, "frames cameras blobs 2"], blob: Int[np.ndarray, "paths frames cameras"]
) -> Float[np.ndarray, "paths frames cameras 2"]:
    """Values of each path's blobs; NaN where a path has no blob."""
    frame, camera = np.indices(blob.shape[1:])
    return np.where(blob[..., None] >= 0, values[frame, camera, blob], np.nan)
