"""The volume in which drones fly and their largest speed, from the cameras and from what moves before them.

Cameras alone do not say where drones fly: cameras on the ground look up at drones of any height. In some short windows
of frames, points are therefore triangulated from detections or blobs that agree in three views, or in two where no
third camera has the place in view; and from the detections that are left, in any two views, because something may hide
a drone from the third camera. A point moves if it goes on through its window at a constant velocity. Chance
crossings of rays do not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from psotrack.correspondence import Sightings, from_silhouettes, match, wide_bounds
from psotrack.geometry import Rig, reconstruct, viewpoints
from psotrack.initiation.initial_state import room_bounds
from psotrack.settings import USUAL_SPEED_M_S
from psotrack.silhouettes import Silhouettes

#: Number of windows, frames of a window, and frames of it in which a point must be found.
WINDOWS, WINDOW_FRAMES, MIN_FOUND = 40, 6, 5
#: Time between two frames of a window, seconds; at lower rates, one frame.
STEP_S = 0.04
#: Largest speed that is looked for, m/s, and largest acceleration, m/s².
FASTEST_M_S, LARGEST_ACCELERATION_M_S2 = 60.0, 15.0
#: Largest number of sightings per image: of noisy silhouettes the largest blobs count.
MOST_SIGHTINGS = 12
#: A point counts if its standard deviation is below this share of its distance from the cameras.
MOST_VAGUE = 0.1
#: The volume reaches beyond the points by this share of their largest extent, metres at least. Only some windows are
#: looked at, and drones that fly far fly high too.
MARGIN, LEAST_MARGIN_M = 0.15, 1.0
#: The room of the cameras is extended where points are outside of it, or nearer to its border than this, metres.
NEAR_BOUND_M = 0.5
#: The speed limit is this many times the largest speed that is seen.
SPEED_MARGIN = 1.5
#: Share of the points that may be outliers, on each side.
OUTLIERS = 0.01
#: A smaller share of the points outside of given bounds is not worth a warning.
FEW_OUTSIDE = 0.2
#: Cameras whose optical axes point down by this much, on average, look down on a floor (sine of the angle). Below a
#: floor there are only shadows and reflections, unless most of what moves is there.
LOOKS_DOWN, MOST_BELOW = 0.05, 0.75


@dataclass(frozen=True)
class MovingPoints:
    """Points that move on through a window of frames.

    Attributes:
        position_m: (points, 3), positions in the first frame of each window, metres.
        std_m: (points,), standard deviations of the positions, root of the sum over the axes, metres.
        speed_m_s: (points,), speeds.
        speed_std_m_s: (points,), standard deviations of the speeds.
    """

    position_m: Float[np.ndarray, "points 3"]
    std_m: Float[np.ndarray, "points"]
    speed_m_s: Float[np.ndarray, "points"]
    speed_std_m_s: Float[np.ndarray, "points"]

    def __len__(self) -> int:
        return len(self.position_m)

    @property
    def largest_speed_m_s(self) -> float:
        """Largest speed, without the part that noise makes up, and without outliers."""
        certain = np.sqrt(np.maximum(self.speed_m_s**2 - self.speed_std_m_s**2, 0.0))
        return float(np.quantile(certain, 1 - OUTLIERS))


@dataclass(frozen=True)
class FlightVolume:
    """Where drones are searched and how fast they may be, and where the numbers come from.

    Attributes:
        bounds_m: (2, 3), lowest and highest corner, metres.
        bounds_from: "given", "cameras", or "cameras and moving points", which extend the room of the cameras.
        max_speed_m_s: largest speed of a drone, m/s.
        speed_from: "given", "default" or "moving points".
        num_points: number of moving points; None where they were not looked for.
        share_outside: share of the moving points outside of the bounds; 0 where few are.
        seen_speed_m_s: largest speed of the moving points; 0 where there are none.
    """

    bounds_m: Float[np.ndarray, "2 3"]
    bounds_from: str
    max_speed_m_s: float
    speed_from: str
    num_points: int | None = None
    share_outside: float = 0.0
    seen_speed_m_s: float = 0.0

    @property
    def record(self) -> dict[str, Any]:
        """The volume, fit for JSON."""
        return {**vars(self), "bounds_m": self.bounds_m.tolist()}


def flight_volume(
    rig: Rig,
    points: MovingPoints | None,
    *,
    bounds_m: tuple[float, ...] | None = None,
    max_speed_m_s: float | None = None,
) -> FlightVolume:
    """The volume in which drones are searched, and their speed limit; given values win.

    Args:
        rig: the cameras.
        points: moving points; None where they are not known.
        bounds_m: given bounds (x0, x1, y0, y1, z0, z1), metres.
        max_speed_m_s: given speed limit, m/s.
    """
    found = points if points is not None and len(points) else None
    room_m, bounds_from = room_bounds(rig), "cameras"
    if bounds_m is not None:
        room_m, bounds_from = np.array(bounds_m, np.float64).reshape(3, 2).T, "given"
    elif found is not None:
        extended_m = _extended(rig, room_m, found)
        if (extended_m != room_m).any():
            room_m, bounds_from = extended_m, "cameras and moving points"
    seen_m_s = 0.0 if found is None else found.largest_speed_m_s
    speed_m_s, speed_from = USUAL_SPEED_M_S, "default"
    if max_speed_m_s is not None:
        speed_m_s, speed_from = max_speed_m_s, "given"
    elif SPEED_MARGIN * seen_m_s > speed_m_s:
        speed_m_s, speed_from = round(SPEED_MARGIN * seen_m_s, 1), "moving points"
    outside = 0.0
    if found is not None:
        within = ((found.position_m >= room_m[0]) & (found.position_m <= room_m[1])).all(axis=-1)
        outside = float((~within).mean())
    return FlightVolume(
        room_m,
        bounds_from,
        speed_m_s,
        speed_from,
        num_points=None if points is None else len(points),
        share_outside=outside if outside > FEW_OUTSIDE else 0.0,
        seen_speed_m_s=seen_m_s,
    )


def _extended(rig: Rig, room_m: Float[np.ndarray, "2 3"], points: MovingPoints) -> Float[np.ndarray, "2 3"]:
    """The room, extended to the moving points outside of it with a margin."""
    low, high = np.quantile(points.position_m, [OUTLIERS, 1 - OUTLIERS], axis=0)
    margin_m = max(LEAST_MARGIN_M, MARGIN * float((high - low).max()))
    low_m = np.where(low < room_m[0] + NEAR_BOUND_M, np.minimum(low - margin_m, room_m[0]), room_m[0])
    high_m = np.where(high > room_m[1] - NEAR_BOUND_M, np.maximum(high + margin_m, room_m[1]), room_m[1])
    axis_z = rig.cameras.T_cam_world[:, 2, 2].mean()
    below = points.position_m[:, 2] < room_m[0, 2]
    if axis_z < -LOOKS_DOWN and below.mean() < MOST_BELOW:
        low_m[2] = room_m[0, 2]
    return np.stack([low_m, high_m])


def moving_detections(rig: Rig, sightings: Sightings, fps: float) -> MovingPoints:
    """Points that move, from detections; windows begin where at least two viewpoints have detections."""
    seen = np.isfinite(sightings.noise_px).any(axis=-1)
    viewpoint = viewpoints(rig.cameras)
    by_viewpoint = np.stack([seen[:, viewpoint == one].any(axis=1) for one in np.unique(viewpoint)], axis=-1)
    frames = np.flatnonzero(by_viewpoint.sum(axis=-1) >= 2)
    several = by_viewpoint.shape[1] > 2
    return _find(rig, sightings.in_frames, frames, fps, passes=(None, 2) if several else (None,))


def moving_blobs(rig: Rig, silhouettes: Silhouettes, fps: float) -> MovingPoints:
    """Points that move, from the blobs of silhouettes."""

    def read(frames: Int[np.ndarray, "chosen"]) -> Sightings:
        first, last = int(frames[0]), int(frames[-1])
        return from_silhouettes(silhouettes, first=first, stop=last + 1).in_frames(frames - first)

    return _find(rig, read, np.arange(silhouettes.num_frames), fps)


def _find(
    rig: Rig,
    read: Callable[[Int[np.ndarray, "chosen"]], Sightings],
    frames: Int[np.ndarray, "frames"],
    fps: float,
    passes: tuple[int | None, ...] = (None,),
) -> MovingPoints:
    """Points that move, in windows that are spread over the frames.

    Args:
        rig: the cameras.
        read: gives the sightings of frames.
        frames: (frames,), numbers of the frames from which windows may begin, ascending; the last window ends at the
            last of them.
        fps: frames per second.
        passes: smallest numbers of viewpoints (see `match`), each for the sightings that the ones before left.
    """
    step = max(1, round(STEP_S * fps))
    reach = step * (WINDOW_FRAMES - 1)
    starts = frames[frames <= frames[-1] - reach] if len(frames) else frames
    if not len(starts):
        return _joined([])
    chosen = np.unique(starts[np.linspace(0, len(starts) - 1, min(WINDOWS, len(starts))).round().astype(int)])
    found = []
    for first in chosen.tolist():
        sightings = read(first + step * np.arange(WINDOW_FRAMES))
        found.append(_moving_in_window(_triangulated(rig, sightings, passes), step / fps))
    return _joined(found)


@dataclass(frozen=True)
class _Points:
    """Points of one frame: positions (points, 3), metres, and standard deviations (points,), metres."""

    position_m: Float[np.ndarray, "points 3"]
    std_m: Float[np.ndarray, "points"]


def _triangulated(rig: Rig, sightings: Sightings, passes: tuple[int | None, ...]) -> list[_Points]:
    """The points of each frame in which detections of enough cameras agree."""
    wide_m = wide_bounds(rig)
    points = []
    for frame in range(sightings.num_frames):
        view = sightings.at(frame).largest(MOST_SIGHTINGS)
        centre_px, noise_px = view.found(view.centre_px), view.found(view.noise_px)
        found = []
        for min_views in passes:
            groups = match(rig.cameras, centre_px, noise_px, bounds_m=wide_m, min_views=min_views)
            found.append(_reconstructed(rig, groups.detection, centre_px, noise_px))
            for camera, used in enumerate(groups.detection.T):
                # A row that is not finite is no detection; the others keep their numbers.
                centre_px[camera] = centre_px[camera].copy()
                centre_px[camera][used[used >= 0]] = np.nan
        points.append(
            _Points(
                np.concatenate([each.position_m for each in found]),
                np.concatenate([each.std_m for each in found]),
            )
        )
    return points


def _reconstructed(
    rig: Rig,
    detection: Int[np.ndarray, "groups cameras"],
    centre_px: list[Float[np.ndarray, "_ 2"]],
    noise_px: list[Float[np.ndarray, "_"]],
) -> _Points:
    """The points of groups of detections that are not too vague."""
    seen = detection >= 0
    of_group = np.full((*detection.shape, 2), np.nan)
    noise = np.ones(detection.shape)
    for camera, used in enumerate(detection.T):
        of_group[seen[:, camera], camera] = centre_px[camera][used[seen[:, camera]]]
        noise[seen[:, camera], camera] = noise_px[camera][used[seen[:, camera]]]
    lines = reconstruct(rig.cameras, of_group, noise_px=noise)
    std_m = np.sqrt(np.trace(lines.covariance_m2, axis1=-2, axis2=-1))
    distance_m = np.linalg.norm(lines.position_m[:, None] - rig.cameras.centre_world, axis=-1).min(
        axis=-1, initial=np.inf
    )
    kept = std_m < MOST_VAGUE * distance_m
    return _Points(lines.position_m[kept], std_m[kept])


def _moving_in_window(window: list[_Points], step_s: float) -> MovingPoints:
    """Points that begin in the first or second frame and go on at a constant velocity."""
    found = []
    for first in range(WINDOW_FRAMES - MIN_FOUND + 1):
        for begin_m, begin_std_m in zip(window[first].position_m, window[first].std_m, strict=True):
            for second in range(first + 1, first + 2 + WINDOW_FRAMES - MIN_FOUND - first):
                moving = _follow(window, first, begin_m, float(begin_std_m), second, step_s)
                found += [] if moving is None else [moving]
    return _joined(found)


def _follow(
    window: list[_Points],
    first: int,
    begin_m: Float[np.ndarray, "3"],
    begin_std_m: float,
    second: int,
    step_s: float,
) -> MovingPoints | None:
    """The point that goes on from `begin_m` to the nearest point of frame `second` and further; None if it does not."""
    near = _nearest(window[second], begin_m, FASTEST_M_S * step_s * (second - first) + 3 * begin_std_m)
    if near is None:
        return None
    frames, places, stds = [first, second], [begin_m, window[second].position_m[near]], [begin_std_m]
    stds.append(float(window[second].std_m[near]))
    for frame in range(second + 1, WINDOW_FRAMES):
        rate = (places[-1] - places[0]) / (frames[-1] - frames[0])
        expected_m = places[0] + rate * (frame - frames[0])
        share = (frame - frames[0]) / (frames[-1] - frames[0])
        off_m = 0.5 * LARGEST_ACCELERATION_M_S2 * (step_s * (frame - frames[0])) ** 2 + 3 * share * max(stds)
        near = _nearest(window[frame], expected_m, off_m)
        if near is not None:
            frames.append(frame)
            places.append(window[frame].position_m[near])
            stds.append(float(window[frame].std_m[near]))
    if len(frames) < MIN_FOUND:
        return None
    time_s = step_s * (np.array(frames) - np.mean(frames))
    velocity = time_s @ np.array(places) / (time_s @ time_s)
    speed_std = float(np.median(stds) / np.sqrt(time_s @ time_s))
    speed = float(np.linalg.norm(velocity))
    return MovingPoints(begin_m[None], np.array([begin_std_m]), np.array([speed]), np.array([speed_std]))


def _nearest(points: _Points, place_m: Float[np.ndarray, "3"], within_m: float) -> int | None:
    """Index of the nearest point within a distance; None if there is none."""
    distance_m = np.linalg.norm(points.position_m - place_m, axis=-1)
    return int(distance_m.argmin()) if distance_m.min(initial=np.inf) <= within_m else None


def _joined(parts: list[MovingPoints]) -> MovingPoints:
    """All points of the parts."""
    return MovingPoints(
        np.concatenate([part.position_m for part in parts] or [np.empty((0, 3))]),
        *(
            np.concatenate([getattr(part, name) for part in parts] or [np.empty(0)])
            for name in ("std_m", "speed_m_s", "speed_std_m_s")
        ),
    )
