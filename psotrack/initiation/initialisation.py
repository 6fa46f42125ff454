"""Positions, velocities and sizes of the drones in the first frames, found from the silhouettes alone.

Candidates are paths through blobs of foreground in several viewpoints (see `paths`). A path is a drone if it fits, in
most frames, blobs that no other chosen path fits. A drone's size is estimated from blobs that hold no other drone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.geometry import Camera, viewpoints
from psotrack.initiation.paths import Paths, by_viewpoint, propose_paths, refine_paths
from psotrack.silhouettes import Exposures, ViewBlobs, border_cells, find_blobs, stack_blobs

#: Smallest height of a drone's middle above the floor, metres. A path below this height is a shadow, because the middle
#: of a drone that stands on its legs is higher.
FLOOR_CLEARANCE_M = 0.08
#: Largest height of a drone that is low over the floor, as a share of its width.
MAX_HEIGHT_SHARE = 0.3
#: Smallest mean distance of two drones, metres.
SEPARATION_M = 0.3
#: Smallest number of frames in which a path that only two viewpoints show can be a drone. In fewer frames, rays to
#: different drones may cross by chance in every frame.
MIN_FRAMES_OF_TWO_VIEWS = 8
#: Evidence that the frames must lose without a path that only two viewpoints show; the evidence of two viewpoints is 2
#: at most.
MIN_LOST_EVIDENCE = 0.15
#: Largest number of paths of two viewpoints that are compared with each other, because the time grows exponentially.
MAX_RIVALS = 16
#: Smallest share of the frames in which each of two viewpoints must show a drone; with three viewpoints, half of the
#: frames suffice.
SHARE_OF_TWO_VIEWS = 0.75


@dataclass(frozen=True)
class InitialState:
    """Positions, velocities and sizes of the drones at frame 0.

    Attributes:
        position_m: (drones, 3), positions in the world, metres.
        velocity_m_s: (drones, 3), velocities, metres per second.
        size_m: (drones, 3), full lengths along the world's axes, metres.
        num_cameras: (drones,), mean number of cameras that show the drone.
    """

    position_m: Float[np.ndarray, "drones 3"]
    velocity_m_s: Float[np.ndarray, "drones 3"]
    size_m: Float[np.ndarray, "drones 3"]
    num_cameras: Float[np.ndarray, "drones"]


def find_drones(
    cameras: Camera,
    coverage: UInt8[np.ndarray, "frames cameras height width"],
    *,
    reduction: int,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
    drones: int | None = None,
) -> InitialState:
    """Find the drones that the silhouettes show throughout the first frames.

    Args:
        cameras: cameras with one leading axis, for images of full size.
        coverage: (frames, cameras, height, width), silhouettes of the first frames; ten frames suffice.
        reduction: image pixels per silhouette pixel, along each side.
        fps: frames per second.
        bounds_m: (2, 3), corners of the room, metres; the lowest z is the floor, on which shadows lie.
        max_speed_m_s: largest speed of a drone, metres per second.
        drones: number of drones, if it is known: at most this number is found, and weaker evidence suffices for the
            last drones.

    Returns:
        The drones, possibly none; the drone that most cameras show is first. A drone whose blobs all hold another drone
        too has the median size of the other drones, or NaN if no size is known.
    """
    return find_drones_in_blobs(
        cameras,
        all_blobs(coverage, reduction, borders=border_cells(cameras.image_size_wh, reduction)),
        fps=fps,
        bounds_m=bounds_m,
        max_speed_m_s=max_speed_m_s,
        drones=drones,
    )


def all_blobs(
    coverage: UInt8[np.ndarray, "frames cameras height width"],
    reduction: int,
    exposures: Exposures | None = None,
    borders: Int[np.ndarray, "cameras 2"] | None = None,
) -> ViewBlobs:
    """The blobs of all frames and cameras, and when the frames were exposed.

    Args:
        coverage: (frames, cameras, height, width), the silhouettes, 0 to 255.
        reduction: image pixels per cell, along each side.
        exposures: when the frames were exposed; None where all were exposed together.
        borders: (cameras, 2), width and height of the images in cells; None where all fill the arrays.
    """
    ends = [None] * coverage.shape[1] if borders is None else list(borders)
    blobs = [
        [find_blobs(image, reduction, end) for image, end in zip(images, ends, strict=True)]
        for images in coverage
    ]
    return replace(stack_blobs(blobs, coverage.shape[1], reduction), exposures=exposures)


def find_drones_in_blobs(
    cameras: Camera,
    seen: ViewBlobs,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
    drones: int | None = None,
) -> InitialState:
    """Find the drones that the blobs of the first frames show (see `find_drones`), at the time of the first instant.

    Args:
        cameras: cameras with one leading axis, for images of full size.
        seen: blobs of the first frames, and when the frames were exposed.
        fps, bounds_m, max_speed_m_s, drones: as in `find_drones`.
    """
    time_s = np.arange(len(seen.whole)) / fps
    if not seen.whole.any():
        return InitialState(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    # Shadows on the floor agree in all views and move with the drones, but a shadow has no height above the floor.
    floor_z_m = float(bounds_m[0, 2])
    bounds_m = bounds_m + np.array([[0.0, 0.0, FLOOR_CLEARANCE_M], [0.0, 0.0, 0.0]])
    paths = propose_paths(cameras, seen, time_s, bounds_m, max_speed_m_s)
    paths = refine_paths(cameras, seen, time_s, paths[choose_paths(paths, viewpoints(cameras), drones)])
    num_cameras = paths.covered.any(axis=-1).sum(axis=-1).mean(axis=-1)
    paths = paths[np.argsort(-num_cameras, kind="stable")]
    own_m = np.where(paths.alone[..., None], paths.size_m, np.nan)
    sizes_m = np.array(
        [_estimate_size(cameras, *path) for path in zip(paths.position_m, own_m, strict=True)]
    ).reshape(-1, 3)
    height_m = np.median(paths.position_m[..., 2], axis=1) - floor_z_m
    return InitialState(
        position_m=paths.coefficient[:, 0],
        velocity_m_s=paths.coefficient[:, 1],
        size_m=fill_unknown_sizes(_limit_heights(sizes_m, height_m)),
        num_cameras=np.sort(num_cameras)[::-1],
    )


def _limit_heights(
    size_m: Float[np.ndarray, "drones 3"], height_m: Float[np.ndarray, "drones"]
) -> Float[np.ndarray, "drones 3"]:
    """Sizes, with limited heights of low drones: the blob of a low drone holds its shadow, which is below the drone.

    Args:
        size_m: (drones, 3), estimated sizes, metres.
        height_m: (drones,), heights of the drones above the floor, metres.
    """
    low = height_m < size_m[:, 0]
    highest_m = np.where(low, MAX_HEIGHT_SHARE * size_m[:, 0], np.inf)
    return np.column_stack([size_m[:, :2], np.minimum(size_m[:, 2], highest_m)])


def fill_unknown_sizes(size_m: Float[np.ndarray, "drones 3"]) -> Float[np.ndarray, "drones 3"]:
    """Replace sizes that are NaN with the median of the known sizes; NaN stays where no size is known."""
    known = np.isfinite(size_m).all(axis=-1)
    return np.where(known[:, None], size_m, np.median(size_m[known], axis=0)) if known.any() else size_m


def choose_paths(
    paths: Paths, viewpoint: Int[np.ndarray, "cameras"], drones: int | None = None
) -> Int[np.ndarray, "chosen"]:
    """Choose the paths that are drones: first paths that three or more viewpoints show, then paths that two show.

    The evidence for a path is the fit of blobs that no chosen path has, summed over the viewpoints, minus the share of
    frames in which a viewpoint should show the path and does not. The path with the most evidence is chosen first. Two
    viewpoints cannot tell a drone from crossing rays to different drones in a single frame. So a path that only two
    viewpoints show must fit well in nearly all frames, must be missing in no viewpoint, and must explain its blobs
    clearly better than every other path.

    Args:
        paths: result of `propose_paths`.
        viewpoint: (cameras,), the viewpoint of each camera, from `viewpoints`.
        drones: number of drones, if it is known.

    Returns:
        (chosen,), indices of the chosen paths, in the order of choice.
    """
    free = np.ones(paths.covered.shape[1:], bool)
    left = np.arange(len(paths))
    chosen: list[int] = []
    for rule in (_shown_by_three_views, _shown_by_two_views, *((_shown_weakly,) if drones else ())):
        while len(chosen) != drones:
            evidence = _evidence(paths[left], viewpoint, free)
            fits = rule(paths[left], evidence)
            if not fits.any():
                break
            best = int(left[np.where(fits, evidence.total, -np.inf).argmax()])
            chosen.append(best)
            frame, camera = np.nonzero(paths.blob[best] >= 0)
            free[frame, camera, paths.blob[best, frame, camera]] = False
            left = left[_mean_distance_m(paths, best)[left] >= SEPARATION_M]
    return np.array(chosen, int)


@dataclass(frozen=True)
class _Evidence:
    """Evidence for each path that is not chosen yet.

    Attributes:
        own: (paths, frames, cameras), whether the path fits a blob that no chosen path has.
        share: (paths, viewpoints), share of the frames with such a blob.
        covered: (paths, viewpoints), share of the frames with any foreground at the path.
        against: (paths,), share of the frames in which a viewpoint should show the path and does not, summed over the
            viewpoints.
        total: (paths,), the evidence (see `choose_paths`).
    """

    own: Bool[np.ndarray, "paths frames cameras"]
    share: Float[np.ndarray, "paths viewpoints"]
    covered: Float[np.ndarray, "paths viewpoints"]
    against: Float[np.ndarray, "paths"]
    total: Float[np.ndarray, "paths"]


def _evidence(
    paths: Paths, viewpoint: Int[np.ndarray, "cameras"], free: Bool[np.ndarray, "frames cameras blobs"]
) -> _Evidence:
    own = paths.has_one_of(free)
    fit = by_viewpoint(own * paths.fit, viewpoint).mean(axis=1).sum(axis=-1)
    share, covered, in_view = (
        by_viewpoint(value, viewpoint) for value in (own, np.any(paths.covered, axis=-1), paths.in_view)
    )
    against = (in_view & ~covered).mean(axis=1).sum(axis=-1)
    return _Evidence(own, share.mean(axis=1), covered.mean(axis=1), against, fit - against)


def _shown_by_three_views(paths: Paths, evidence: _Evidence) -> Bool[np.ndarray, "paths"]:
    """Whether each path has own blobs in at least three viewpoints, each in half of the frames.

    The evidence against a path may be as large as the evidence for it, because silhouettes of small or dark drones
    flicker: a missing blob says much less than a blob.
    """
    views = (evidence.share >= 0.5).sum(axis=-1)
    return (views >= 3) & (evidence.against <= evidence.share.sum(axis=-1))


def _shown_by_two_views(paths: Paths, evidence: _Evidence) -> Bool[np.ndarray, "paths"]:
    """Whether each path fits own blobs in two viewpoints well, in nearly all frames, and no other paths explain them.

    Of paths that are near each other or share blobs, at most one is a drone. A path is needed if the largest total
    evidence of compatible paths is clearly smaller without this path and the paths near it.
    """
    views = (evidence.share >= SHARE_OF_TWO_VIEWS).sum(axis=-1)
    fits = (views >= 2) & (evidence.against < 0.25) & (evidence.total >= 0.75 * evidence.share.sum(axis=-1))
    fits &= paths.blob.shape[1] >= MIN_FRAMES_OF_TWO_VIEWS
    rivals = np.flatnonzero(fits)[np.argsort(-evidence.total[fits])][:MAX_RIVALS]
    weight, own, blob, position_m = (
        value[rivals] for value in (evidence.total, evidence.own, paths.blob, paths.position_m)
    )
    same = np.linalg.norm(position_m[:, None] - position_m, axis=-1).mean(axis=-1) < SEPARATION_M
    shared = (own & own[:, None] & (blob == blob[:, None])).mean(axis=2).max(axis=-1) >= 0.5
    best = _max_compatible_weight(weight, same | shared, weight > 0)
    needed = [
        best - _max_compatible_weight(weight, same | shared, ~near) >= MIN_LOST_EVIDENCE for near in same
    ]
    fits[:] = False
    fits[rivals] = needed
    return fits


def _max_compatible_weight(
    weight: Float[np.ndarray, "paths"],
    exclusive: Bool[np.ndarray, "paths paths"],
    left: Bool[np.ndarray, "paths"],
) -> float:
    """Largest total weight of paths of which no two exclude each other (maximum weight independent set).

    Args:
        weight: (paths,), weights of the paths.
        exclusive: (paths, paths), whether two paths exclude each other.
        left: (paths,), paths that may be used.
    """
    if not left.any():
        return 0.0
    first = int(left.argmax())
    rest = left.copy()
    rest[first] = False
    with_first = weight[first] + _max_compatible_weight(weight, exclusive, rest & ~exclusive[first])
    if not (rest & exclusive[first]).any():
        return with_first
    return max(with_first, _max_compatible_weight(weight, exclusive, rest))


def _shown_weakly(paths: Paths, evidence: _Evidence) -> Bool[np.ndarray, "paths"]:
    """Whether each path has own blobs in one viewpoint, and any foreground in another, each in half of the frames."""
    views = (evidence.covered >= 0.5).sum(axis=-1)
    return (evidence.share.max(axis=-1) >= 0.5) & (views >= 2) & (evidence.against < 0.5)


def _mean_distance_m(paths: Paths, index: int | np.integer) -> Float[np.ndarray, "paths"]:
    """Mean distance of every path from the path of an index, metres."""
    return np.linalg.norm(paths.position_m - paths.position_m[index], axis=-1).mean(axis=-1)


def _estimate_size(
    cameras: Camera, position_m: Float[np.ndarray, "frames 3"], size_m: Float[np.ndarray, "frames cameras 2"]
) -> Float[np.ndarray, "3"]:
    """Full lengths of an ellipsoid, equal along x and y, whose outlines are as wide and as high as the blobs, metres.

    At elevation e, an ellipsoid with the semi-axes a (horizontal) and c (vertical) has an outline with the semi-axes a
    and h = sqrt(a² sin² e + c² cos² e). Medians over the frames suppress a few bad blobs. Cameras that look from the
    side determine the height best: the weight of a camera is the inverse of the variance of c² if all h and a have the
    same relative error.

    Args:
        cameras: cameras with one leading axis.
        position_m: (frames, 3), positions of the drone, metres.
        size_m: (frames, cameras, 2), width and height of the drone's own blobs at the drone's depth, metres; NaN where
            a camera has no such blob.
    """
    ray = position_m[:, None, :] - cameras.centre_world
    sin2 = np.median((ray[..., 2] / np.linalg.norm(ray, axis=-1)) ** 2, axis=0)
    seen = np.isfinite(size_m).any(axis=(0, 2))
    if not seen.any():
        return np.full(3, np.nan)
    horizontal = float(np.nanmedian(size_m[..., 0]))
    height2, sin2 = (np.nanmedian(size_m[:, seen, 1], axis=0) / horizontal) ** 2, sin2[seen]
    weight = (1 - sin2) ** 2 / (height2**2 + sin2**2)
    vertical2 = np.average((height2 - sin2) / (1 - sin2), weights=weight)
    # Blobs of flat drones seen from above determine the height badly. It is a tenth of the width at least.
    return horizontal * np.array([1.0, 1.0, np.sqrt(max(vertical2, 0.01))])
