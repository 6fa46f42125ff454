"""Drones that the tracks of a chunk of frames do not explain: a newcomer is a place for the tracker to begin at.

Where unexplained foreground agrees over three or more viewpoints it is followed through the chunk, and is a newcomer if
it behaves as a drone does: it stays, it moves no faster than one, it is as large as one, it is clear of the floor and
of all known drones, and hardly a camera that ought to see it does not.

A drone that is found a second late leaves a gap; one that does not exist stays for the rest of the video. So every rule
errs on the side of no newcomer.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, UInt8

from psotrack.geometry import Camera, match_views, project, viewpoints
from psotrack.initiation.initialisation import FLOOR_CLEARANCE_M, InitialState, find_drones
from psotrack.initiation.residual_foreground import (
    NOTHING,
    Glance,
    Known,
    Rest,
    SearchVolume,
    both,
    glance,
    known,
    rest,
)
from psotrack.silhouettes import LEAST_RADIUS_CELLS, find_blobs

#: Of so many frames in a row, a newcomer must be seen in so many.
OF_FRAMES, MIN_FRAMES = 10, 8
#: Over so many frames in which nothing is seen a newcomer is followed.
MAX_GAP = 5
#: Its foreground is nowhere spread out by more than this, as a mean square, while it is followed.
MAX_GROWTH = 1.5
#: Every so many frames one is searched for newcomers: whatever is there for `OF_FRAMES` is met.
SEARCH_STEP = 8
#: A newcomer is at most so many times smaller or larger than the known drones; or of such a span, if none is known.
SIZE_RATIO, SPANS_M = 2.0, (0.1, 1.5)
#: What moves by less than this share of its span within `OF_FRAMES` stands still.
MIN_TRAVEL = 0.04
#: What goes farther than this share of its span has come from elsewhere.
MIN_WAY = 0.5


@dataclass(frozen=True)
class TrackCandidate:
    """A drone that no track explains.

    Attributes:
        frame: of the chunk, the first in which it is there.
        position_m, velocity_m_s: (3,), in that frame.
        size_m: (3,), full lengths along the world's axes.
        num_cameras: that see it in that frame.
        moves: whether it changes its place. What does not may be a hole in the background, where a drone stood while
            the background was learned.
    """

    frame: int
    position_m: Float[np.ndarray, "3"]
    velocity_m_s: Float[np.ndarray, "3"]
    size_m: Float[np.ndarray, "3"]
    num_cameras: int
    moves: bool


def find_candidates(
    cameras: Camera,
    coverage: UInt8[np.ndarray, "frames cameras height width"],
    position_m: Float[np.ndarray, "frames drones 3"],
    explains: Bool[np.ndarray, "frames drones"],
    size_m: Float[np.ndarray, "drones 3"],
    *,
    reduction: int,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
) -> tuple[TrackCandidate, ...]:
    """Drones in a chunk of frames that are none of those that were tracked in it.

    Args:
        cameras: with one leading axis, of the image (not reduced).
        coverage: (frames, cameras, height, width), silhouettes.
        position_m: (frames, drones, 3), of the known drones; any value, NaN too, where they explain nothing.
        explains: (frames, drones), where a known drone is known well enough to explain foreground.
        size_m: (drones, 3), of the known drones, full lengths along the world's axes.
        reduction: image pixels per silhouette pixel, along each side.
        fps: frames per second.
        bounds_m: (2, 3), corners of the room; its lowest z is the floor, on which shadows lie.
        max_speed_m_s: of a drone.

    Returns:
        None in a chunk of fewer than `OF_FRAMES` frames.
    """
    clear_m = bounds_m + np.array([[0.0, 0.0, FLOOR_CLEARANCE_M], [0.0, 0.0, 0.0]])
    spans_m = _spans(size_m)
    room = SearchVolume(cameras, viewpoints(cameras), clear_m, reduction)
    drones = known(room, np.where(explains[..., None], position_m, np.nan), size_m)
    find = partial(
        find_drones, cameras, reduction=reduction, fps=fps, bounds_m=bounds_m, max_speed_m_s=max_speed_m_s
    )
    found: list[TrackCandidate] = []
    paths: list[list[Glance]] = []
    for frame in range(0, len(coverage) - OF_FRAMES + SEARCH_STEP, SEARCH_STEP):
        proposals = _proposals(room, rest(coverage[frame], drones, frame), spans_m)
        beside = _beside(frame, len(coverage))
        there = _proposals(room, rest(coverage[beside], drones, beside), spans_m) if proposals else []
        for place, size in proposals:
            shift = (beside - frame) * _shift(place, size, there, max_speed_m_s / fps)
            path = _followed(room, coverage, drones, frame, place, size, shift)
            newcomer = _judged(path, size, fps, max_speed_m_s)
            if newcomer is not None and newcomer.moves:
                # One frame with known drones beside it says little of the size, which says what foreground is its own.
                best = _best_seen(path)
                size = _size(find(coverage[best : best + OF_FRAMES]), path[best], size)
                path = _followed(room, coverage, drones, frame, path[frame].position_m, size, shift)
                newcomer = _judged(path, size, fps, max_speed_m_s)
            if newcomer is None or not spans_m[0] <= size.max() <= spans_m[1]:
                continue
            if any(_continues(path, earlier, max_speed_m_s / fps) for earlier in paths):
                continue
            paths.append(path)
            found.append(newcomer)
            drones = both(drones, known(room, _places(path)[:, None], size[None]))
    return tuple(found)


def _proposals(
    room: SearchVolume, left: Rest, spans_m: tuple[float, float]
) -> list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]:
    """Places in a frame where three viewpoints have foreground of a drone's size, and that size."""
    cameras = room.cameras
    corners = np.stack(np.meshgrid(*room.bounds_m.T), axis=-1).reshape(-1, 1, 3)
    farthest_m = np.linalg.norm(corners - cameras.centre_world, axis=-1).max(axis=0)
    focal_px = np.stack([cameras.K[:, 0, 0], cameras.K[:, 1, 1]], axis=-1)
    least_px = spans_m[0] * focal_px.min(axis=-1) / farthest_m
    blobs = [find_blobs(image, room.reduction) for image in left.foreground]
    large = [one.size_px.max(axis=-1) >= least for one, least in zip(blobs, least_px, strict=True)]
    centre_px = [one.centre_px[keep] for one, keep in zip(blobs, large, strict=True)]
    size_px = [one.size_px[keep] for one, keep in zip(blobs, large, strict=True)]
    # The middle of a drone's blob is nearer to its projection than half of the blob's smaller side.
    radius_px = [np.maximum(size.min(axis=-1) / 2, LEAST_RADIUS_CELLS * room.reduction) for size in size_px]
    points, support = match_views(cameras, centre_px, radius_px, room.bounds_m)
    _, depth = project(cameras, points[:, None])
    proposals = []
    for row, point in enumerate(points):
        seen = np.flatnonzero(support[row] >= 0)
        sides_px = np.array([size_px[camera][support[row, camera]] for camera in seen])
        width, height = np.median(sides_px * depth[row, seen, None] / focal_px[seen], axis=0)
        if spans_m[0] <= width <= spans_m[1]:
            proposals.append((point, np.array([width, width, height])))
    return proposals


def _followed(
    room: SearchVolume,
    coverage: UInt8[np.ndarray, "frames cameras height width"],
    drones: Known,
    frame: int,
    position_m: Float[np.ndarray, "3"],
    size_m: Float[np.ndarray, "3"],
    shift_m: Float[np.ndarray, "3"],
) -> list[Glance]:
    """What is at a place in a frame, and wherever it is before and after it: a glance for each frame.

    It moves by about `shift_m` from that frame to the next.
    """

    def look(at: int, place: Float[np.ndarray, "3"]) -> Glance:
        left = rest(coverage[at], drones, at)
        return glance(room, left, drones.position_m[at], drones.size_m, place, size_m)

    path = [NOTHING] * len(coverage)
    path[frame] = look(frame, position_m)
    for step, end in ((1, len(coverage)), (-1, -1)):
        place, shift, last = path[frame].position_m, step * shift_m, frame
        for at in range(frame + step, end, step) if path[frame].there else ():
            gap = abs(at - last)
            seen = look(at, place + gap * shift)
            if seen.there and seen.spread > MAX_GROWTH * path[frame].spread:
                # A drone and the hole that it leaves are one for a while. What comes apart is no place to begin at;
                # what is left once they are apart is one.
                if step == 1:
                    return [NOTHING] * len(path)
                break
            if seen.there:
                # The mean of the last shifts: a single one is as noisy as the places.
                shift = (shift + (seen.position_m - place) / gap) / 2
                place, last, path[at] = seen.position_m, at, seen
            elif gap > MAX_GAP:
                break
    return path


def _beside(frame: int, num_frames: int) -> int:
    """The next frame, or the one before the last."""
    return frame + 1 if frame + 1 < num_frames else frame - 1


def _shift(
    place_m: Float[np.ndarray, "3"],
    size_m: Float[np.ndarray, "3"],
    beside: list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]],
    reach_m: float,
) -> Float[np.ndarray, "3"]:
    """How far it is to the nearest place beside of about its span; 0 if that is farther than anything moves.

    A flat drone that sinks fast is out of its ellipse by the next frame: it must be known where to look for it.
    """
    span = size_m.max()
    alike = [place for place, size in beside if 1 / SIZE_RATIO <= size.max() / span <= SIZE_RATIO]
    shifts = np.array([place - place_m for place in alike]).reshape(-1, 3)
    distance = np.linalg.norm(shifts, axis=-1)
    return shifts[distance.argmin()] if (distance <= reach_m).any() else np.zeros(3)


def _judged(
    path: list[Glance], size_m: Float[np.ndarray, "3"], fps: float, max_speed_m_s: float
) -> TrackCandidate | None:
    """The newcomer, if what was followed is one."""
    there = np.array([one.there for one in path])
    for frame in np.flatnonzero(there[: max(len(there) - OF_FRAMES + 1, 0)]).tolist():
        rows = frame + np.flatnonzero(there[frame : frame + OF_FRAMES])
        if len(rows) < MIN_FRAMES:
            continue
        places = _places(path)[rows]
        if np.linalg.norm(places[-1] - places[0]) * fps > max_speed_m_s * (rows[-1] - rows[0]):
            continue
        # A drone turns within half a second: a straight line would be off by centimetres at its ends.
        _, velocity, position = np.polyfit((rows - frame) / fps, places, 2)
        return TrackCandidate(
            frame=frame,
            position_m=position,
            velocity_m_s=velocity * min(1.0, max_speed_m_s / max(float(np.linalg.norm(velocity)), 1e-9)),
            size_m=size_m,
            num_cameras=path[frame].num_cameras,
            moves=_moves(_places(path)[there], float(size_m.max())),
        )
    return None


def _moves(places_m: Float[np.ndarray, "places 3"], span_m: float) -> bool:
    """Whether it moves at first and at last, or has come from elsewhere.

    A hole only seems to move, while the drone is still over it, and by a quarter of its span.
    """
    if float(np.linalg.norm(places_m[-1] - places_m[0])) > MIN_WAY * span_m:
        return True
    ends = (places_m[:OF_FRAMES], places_m[-OF_FRAMES:])
    return all(float(np.linalg.norm(np.ptp(end, axis=0))) > MIN_TRAVEL * span_m for end in ends)


def _places(path: list[Glance]) -> Float[np.ndarray, "frames 3"]:
    """(frames, 3), NaN where nothing is there."""
    return np.array([one.position_m if one.there else NOTHING.position_m for one in path])


def _continues(path: list[Glance], earlier: list[Glance], reach_m: float) -> bool:
    """Whether one begins where the earlier one has got to by then: a drone that one loses from sight for a while."""
    begin, end = (np.flatnonzero([one.there for one in each]) for each in (path, earlier))
    distance = np.linalg.norm(path[begin[0]].position_m - earlier[end[-1]].position_m)
    return bool(begin[0] > end[-1] and distance <= reach_m * (begin[0] - end[-1]))


def _best_seen(path: list[Glance]) -> int:
    """The frame with which the `OF_FRAMES` begin in which most cameras see it."""
    seeing = np.array([one.num_cameras * one.there for one in path])
    total = np.convolve(seeing, np.ones(OF_FRAMES), mode="valid")
    return int(np.where(seeing[: len(total)] > 0, total, -1).argmax())


def _size(start: InitialState, at: Glance, size_m: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Size of the drone of the start that is at a place; if there is none, what it was taken to be."""
    distance = np.linalg.norm(start.position_m - at.position_m, axis=-1)
    near = np.flatnonzero((distance < size_m.max() / 2) & np.isfinite(start.size_m).all(axis=-1))
    return start.size_m[near[distance[near].argmin()]] if len(near) else size_m


def _spans(known_m: Float[np.ndarray, "drones 3"]) -> tuple[float, float]:
    """Least and largest span of a newcomer."""
    spans = known_m.max(axis=-1)
    return (float(spans.min()) / SIZE_RATIO, float(spans.max()) * SIZE_RATIO) if len(spans) else SPANS_M
