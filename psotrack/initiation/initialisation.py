"""Where the drones are in the first frames, how fast, and how large: found from the silhouettes alone.

Paths through blobs of foreground that several viewpoints agree on are weighed against one another (see `paths`); what
explains blobs that nothing else explains, all the time, is a drone. Its size comes from the blobs that nobody shares.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.geometry import Camera, viewpoints
from psotrack.initiation.paths import Paths, by_viewpoint, propose_paths, refine_paths
from psotrack.silhouettes import find_blobs, stack_blobs

#: What has its middle nearer to the floor is a shadow: a drone that stands on its legs is higher.
FLOOR_CLEARANCE_M = 0.08
#: Over the floor, no drone is taken to be higher than so much of its width.
HIGHEST = 0.3
#: No two drones are nearer to one another than this, on average.
SEPARATION_M = 0.3
#: In fewer frames than this, two viewpoints see rays cross by chance for too long.
LEAST_FRAMES = 8
#: An explanation with so much less evidence (of 2 from two viewpoints) is no rival.
CLEARLY = 0.15
#: So many paths are weighed against one another.
MOST_RIVALS = 16
#: Two viewpoints show a drone in so many of the frames, three in half of them.
NEARLY_ALWAYS = 0.75


@dataclass(frozen=True)
class InitialState:
    """Drones at frame 0.

    Attributes:
        position_m: (drones, 3).
        velocity_m_s: (drones, 3).
        size_m: (drones, 3), full lengths along the world's axes.
        num_cameras: (drones,), cameras that saw the drone, on average.
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
    """The drones that are there throughout the first frames, best seen first.

    Args:
        cameras: with one leading axis, of the image (not reduced).
        coverage: (frames, cameras, height, width), silhouettes of the first frames; ten are plenty.
        reduction: image pixels per silhouette pixel, along each side.
        fps: frames per second.
        bounds_m: (2, 3), corners of the room; its lowest z is the floor, on which shadows lie.
        max_speed_m_s: of a drone.
        drones: how many there are, where that is known: never more are found, and the last ones on less evidence.

    Returns:
        Those for which the frames speak, on the whole; possibly none. Drones that no camera sees by themselves have
        the usual size of the others, or NaN where there is none.
    """
    seen = stack_blobs(
        [[find_blobs(image, reduction) for image in images] for images in coverage], len(cameras.K), reduction
    )
    time_s = np.arange(len(coverage)) / fps
    if not seen.whole.any():
        return InitialState(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    # Shadows on the floor agree between all views as drones do, and they move with them; but they are flat on it.
    floor_z_m = float(bounds_m[0, 2])
    bounds_m = bounds_m + np.array([[0.0, 0.0, FLOOR_CLEARANCE_M], [0.0, 0.0, 0.0]])
    paths = propose_paths(cameras, seen, time_s, bounds_m, max_speed_m_s)
    paths = refine_paths(cameras, seen, time_s, paths[choose_paths(paths, viewpoints(cameras), drones)])
    num_cameras = paths.covered.any(axis=-1).sum(axis=-1).mean(axis=-1)
    paths = paths[np.argsort(-num_cameras, kind="stable")]
    own_m = np.where(paths.alone[..., None], paths.size_m, np.nan)
    sizes_m = np.array([_size(cameras, *of) for of in zip(paths.position_m, own_m, strict=True)]).reshape(
        -1, 3
    )
    height_m = np.median(paths.position_m[..., 2], axis=1) - floor_z_m
    return InitialState(
        position_m=paths.coefficient[:, 0],
        velocity_m_s=paths.coefficient[:, 1],
        size_m=with_usual_size(_without_shadows(sizes_m, height_m)),
        num_cameras=np.sort(num_cameras)[::-1],
    )


def _without_shadows(
    size_m: Float[np.ndarray, "drones 3"], height_m: Float[np.ndarray, "drones"]
) -> Float[np.ndarray, "drones 3"]:
    """Sizes of which those of low drones are no higher than drones are: their blobs hold their shadows, below them."""
    low = height_m < size_m[:, 0]
    highest_m = np.where(low, HIGHEST * size_m[:, 0], np.inf)
    return np.column_stack([size_m[:, :2], np.minimum(size_m[:, 2], highest_m)])


def with_usual_size(size_m: Float[np.ndarray, "drones 3"]) -> Float[np.ndarray, "drones 3"]:
    """Sizes with the median of all for drones whose own is not known; NaN where none is known."""
    known = np.isfinite(size_m).all(axis=-1)
    return np.where(known[:, None], size_m, np.median(size_m[known], axis=0)) if known.any() else size_m


def choose_paths(
    paths: Paths, viewpoint: Int[np.ndarray, "cameras"], drones: int | None = None
) -> Int[np.ndarray, "chosen"]:
    """The paths that are drones: first those that three viewpoints or more show, then those that two do.

    A path's evidence is how well it fits blobs that no chosen path has, its own, summed over the viewpoints; less
    the share of frames in which a viewpoint should show something there and does not. The best goes first. Two views
    alone cannot tell drones from crossings of different drones' rays, except by time: they count where nothing
    speaks against them, they fit well, and no other path that explains the same blobs is nearly as good.

    Args:
        paths: of `propose_paths`.
        viewpoint: (cameras,), of `viewpoints`.
        drones: how many there are, where that is known.
    """
    free = np.ones(paths.covered.shape[1:], bool)
    left = np.arange(len(paths))
    chosen: list[int] = []
    for rule in (_three_views, _two_views, *((_known_to_be_there,) if drones else ())):
        while len(chosen) != drones:
            evidence = _evidence(paths[left], viewpoint, free)
            fits = rule(paths[left], evidence)
            if not fits.any():
                break
            best = int(left[np.where(fits, evidence.total, -np.inf).argmax()])
            chosen.append(best)
            frame, camera = np.nonzero(paths.blob[best] >= 0)
            free[frame, camera, paths.blob[best, frame, camera]] = False
            left = left[_apart(paths, best)[left] >= SEPARATION_M]
    return np.array(chosen, int)


@dataclass(frozen=True)
class _Evidence:
    """What speaks for each path while some have been chosen.

    Attributes:
        own: (paths, frames, cameras), whether it fits a blob that no chosen path has.
        share: (paths, viewpoints), of the frames with such a blob.
        covered: (paths, viewpoints), share of the frames with anything there.
        against: (paths,), viewpoints that should show something there and do not, as shares of the frames.
        total: (paths,), see `choose_paths`.
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
        by_viewpoint(of, viewpoint) for of in (own, np.any(paths.covered, axis=-1), paths.in_view)
    )
    against = (in_view & ~covered).mean(axis=1).sum(axis=-1)
    return _Evidence(own, share.mean(axis=1), covered.mean(axis=1), against, fit - against)


def _three_views(paths: Paths, evidence: _Evidence) -> Bool[np.ndarray, "paths"]:
    """Blobs of its own in three viewpoints, in half of the frames, and no more viewpoints speak against it than for it.

    Silhouettes of small or dark drones flicker: that one is not seen says much less than that it is.
    """
    views = (evidence.share >= 0.5).sum(axis=-1)
    return (views >= 3) & (evidence.against <= evidence.share.sum(axis=-1))


def _two_views(paths: Paths, evidence: _Evidence) -> Bool[np.ndarray, "paths"]:
    """Blobs of its own in two viewpoints, nearly always and well fitting, and no other explanation of them."""
    views = (evidence.share >= NEARLY_ALWAYS).sum(axis=-1)
    fits = (views >= 2) & (evidence.against < 0.25) & (evidence.total >= 0.75 * evidence.share.sum(axis=-1))
    fits &= paths.blob.shape[1] >= LEAST_FRAMES
    rivals = np.flatnonzero(fits)[np.argsort(-evidence.total[fits])][:MOST_RIVALS]
    weight, own, blob, position_m = (
        of[rivals] for of in (evidence.total, evidence.own, paths.blob, paths.position_m)
    )
    same = np.linalg.norm(position_m[:, None] - position_m, axis=-1).mean(axis=-1) < SEPARATION_M
    shared = (own & own[:, None] & (blob == blob[:, None])).mean(axis=2).max(axis=-1) >= 0.5
    best = _best_together(weight, same | shared, weight > 0)
    needed = [best - _best_together(weight, same | shared, ~near) >= CLEARLY for near in same]
    fits[:] = False
    fits[rivals] = needed
    return fits


def _best_together(
    weight: Float[np.ndarray, "paths"],
    exclusive: Bool[np.ndarray, "paths paths"],
    left: Bool[np.ndarray, "paths"],
) -> float:
    """The largest total weight of paths of which no two exclude each other."""
    if not left.any():
        return 0.0
    one = int(left.argmax())
    rest = left.copy()
    rest[one] = False
    with_it = weight[one] + _best_together(weight, exclusive, rest & ~exclusive[one])
    if not (rest & exclusive[one]).any():
        return with_it
    return max(with_it, _best_together(weight, exclusive, rest))


def _known_to_be_there(paths: Paths, evidence: _Evidence) -> Bool[np.ndarray, "paths"]:
    """A blob of its own in one viewpoint, and something there in another, in half of the frames."""
    views = (evidence.covered >= 0.5).sum(axis=-1)
    return (evidence.share.max(axis=-1) >= 0.5) & (views >= 2) & (evidence.against < 0.5)


def _apart(paths: Paths, one: int | np.integer) -> Float[np.ndarray, "paths"]:
    """Mean distance of every path from one of them, metres."""
    return np.linalg.norm(paths.position_m - paths.position_m[one], axis=-1).mean(axis=-1)


def _size(
    cameras: Camera, position_m: Float[np.ndarray, "frames 3"], size_m: Float[np.ndarray, "frames cameras 2"]
) -> Float[np.ndarray, "3"]:
    """Full lengths of an ellipsoid, equal along x and y, whose outlines are as wide and as high as the blobs.

    Seen at elevation e, an ellipsoid of semi-axes a (level) and c (upright) is a wide and
    sqrt(a² sin² e + c² cos² e) high. Medians over frames, so that a few bad blobs do not count. Of the cameras, those
    that look from the side tell most of the height: they are weighted by the inverse of the variance of c²,
    where all h and a are off by the same share.
    """
    ray = position_m[:, None, :] - cameras.centre_world
    sin2 = np.median((ray[..., 2] / np.linalg.norm(ray, axis=-1)) ** 2, axis=0)
    seen = np.isfinite(size_m).any(axis=(0, 2))
    if not seen.any():
        return np.full(3, np.nan)
    level = float(np.nanmedian(size_m[..., 0]))
    high2, sin2 = (np.nanmedian(size_m[:, seen, 1], axis=0) / level) ** 2, sin2[seen]
    weight = (1 - sin2) ** 2 / (high2**2 + sin2**2)
    upright2 = np.average((high2 - sin2) / (1 - sin2), weights=weight)
    # Flat drones seen from above say little of their height; it is never below a tenth of the span.
    return level * np.array([1.0, 1.0, np.sqrt(max(upright2, 0.01))])
