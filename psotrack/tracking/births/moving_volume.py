"""The volume in which drones fly and their largest speed, from the cameras and from what moves before them.

Cameras alone do not say where drones fly: cameras on the ground look up at drones of any height. In some short windows
of frames, drones are therefore looked for in a region so wide that no drone is outside, and of any speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view

from psotrack.foreground.silhouettes import Silhouettes
from psotrack.geometry import Rig, viewpoints
from psotrack.settings import USUAL_SPEED_M_S
from psotrack.support import evenly_spread
from psotrack.tracking.births.births import NO_DRONES, BirthRules, Births, FlightLimits, TrackCandidate
from psotrack.tracking.births.initial_state import room_bounds
from psotrack.tracking.matching import Sightings, from_silhouettes, wide_bounds
from psotrack.trajectories import Tracks

#: Number of windows, of silhouettes at most and of detections at least; frames of a window, enough for a drone to be
#: born before two cameras that miss it at times; share of the frames of a long recording of detections in which windows
#: are.
WINDOWS, WINDOW_FRAMES, WINDOWS_SHARE = 12, 30, 0.2
#: Time between two frames of a window, seconds; at lower rates, one frame.
STEP_S = 0.04
#: Largest speed that is looked for, m/s.
FASTEST_M_S = 60.0
#: Largest number of sightings per image: of noisy silhouettes the largest blobs count.
MOST_SIGHTINGS = 12
#: A point counts if its standard deviation is below this share of its distance from the cameras.
MOST_VAGUE = 0.1
#: The volume reaches beyond the points by as much as drones fly between two windows, metres at least.
LEAST_MARGIN_M = 1.0
#: The speed limit is this many times the largest speed that is seen.
SPEED_MARGIN = 1.5
#: Speeds of tracks are those over the first time, their median over the second, seconds: one jump is not fast.
SPEED_LAG_S, SPEED_S = 0.1, 0.3
#: A track that is faster than this share of the limit may be cut off by it.
AT_LIMIT = 0.95
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
        position_m: (points, 3), positions where they were first found, metres.
        speed_m_s: (points,), speeds.
        speed_std_m_s: (points,), standard deviations of the speeds.
        apart_s: longest time from a frame to the nearest window.
    """

    position_m: Float[np.ndarray, "points 3"]
    speed_m_s: Float[np.ndarray, "points"]
    speed_std_m_s: Float[np.ndarray, "points"]
    apart_s: float

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
        speed_from: "given", "default", "moving points", or "tracks" that were faster than any of these.
        num_points: number of moving points; None where they were not looked for.
        share_outside: share of the moving points outside of the bounds; 0 where few are.
        seen_speed_m_s: largest speed of the moving points, or of the tracks; 0 where there are none.
        num_faster: number of sightings that a first limit, which the tracks raised, may have cut off.
    """

    bounds_m: Float[np.ndarray, "2 3"]
    bounds_from: str
    max_speed_m_s: float
    speed_from: str
    num_points: int | None = None
    share_outside: float = 0.0
    seen_speed_m_s: float = 0.0
    num_faster: int = 0

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
    room_m, bounds_from = room_bounds(rig, bounds_m), "cameras" if bounds_m is None else "given"
    if bounds_m is None and found is not None:
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


def with_speed_of_tracks(volume: FlightVolume, tracks: Tracks, fps: float) -> FlightVolume:
    """The volume, with a higher speed limit where tracks reach the one that nobody gave; the same volume elsewhere.

    Moving points are looked for in a part of the frames only, and whoever is fast is there for few of them.

    Args:
        volume: the volume in which the tracks were made.
        tracks: tracks of all frames.
        fps: frames per second.
    """
    lag, count = max(1, round(SPEED_LAG_S * fps)), max(3, round(SPEED_S * fps))
    if volume.speed_from == "given" or tracks.num_frames < lag + count:
        return volume
    found_m, variance_m2 = tracks.found_m(), np.trace(tracks.measured_covariance_m2, axis1=-2, axis2=-1)
    step2_m2 = np.square(found_m[lag:] - found_m[:-lag]).sum(axis=-1) - variance_m2[lag:] - variance_m2[:-lag]
    windows_m2 = sliding_window_view(step2_m2, count, axis=0)
    windows_m2 = windows_m2[np.isfinite(windows_m2).mean(axis=-1) > 2 / 3]
    speed_m_s = np.sqrt(np.maximum(np.nanmedian(windows_m2, axis=-1), 0.0)) * fps / lag
    seen_m_s = float(np.quantile(speed_m_s, 1 - OUTLIERS)) if len(speed_m_s) else 0.0
    least_m_s = AT_LIMIT * volume.max_speed_m_s
    if seen_m_s < least_m_s:
        return volume
    return replace(
        volume,
        max_speed_m_s=round(SPEED_MARGIN * seen_m_s, 1),
        speed_from="tracks",
        seen_speed_m_s=seen_m_s,
        num_faster=volume.num_faster + int((speed_m_s >= least_m_s).sum()),
    )


def _extended(rig: Rig, room_m: Float[np.ndarray, "2 3"], points: MovingPoints) -> Float[np.ndarray, "2 3"]:
    """The room, extended to the moving points and as far about them as drones fly between the windows."""
    low_m, high_m = np.quantile(points.position_m, [OUTLIERS, 1 - OUTLIERS], axis=0)
    margin_m = max(LEAST_MARGIN_M, points.largest_speed_m_s * points.apart_s)
    low_m, high_m = np.minimum(low_m - margin_m, room_m[0]), np.maximum(high_m + margin_m, room_m[1])
    axis_z = rig.cameras.T_cam_world[:, 2, 2].mean()
    below = points.position_m[:, 2] < room_m[0, 2]
    if axis_z < -LOOKS_DOWN and below.mean() < MOST_BELOW:
        low_m[2] = room_m[0, 2]
    return np.stack([low_m, high_m])


def moving_points(
    rig: Rig,
    found: Sightings | Silhouettes,
    fps: float,
    size_m: tuple[float, ...] | None = None,
    *,
    any_size: bool = False,
) -> MovingPoints:
    """Points that move, in windows that are spread over the frames: drones that are born there.

    Args:
        rig: the cameras.
        found: detections of all frames, or silhouettes, whose blobs are the detections. Windows begin where at least
            two viewpoints have detections; of silhouettes, anywhere.
        fps: frames per second.
        size_m: full lengths of the drones, metres, where they are given.
        any_size: whether all sizes count (see `BirthRules`).
    """
    frames, rules = np.arange(found.num_frames), BirthRules(size_m=size_m, any_size=any_size)
    if isinstance(found, Sightings):
        seen, viewpoint = np.isfinite(found.noise_px).any(axis=-1), viewpoints(rig.cameras)
        by_viewpoint = [seen[:, viewpoint == one].any(axis=1) for one in np.unique(viewpoint)]
        frames = np.flatnonzero(np.sum(by_viewpoint, axis=0) >= 2)
        # Two views that agree in nearly all frames are enough: something may hide the drone from a third camera.
        rules = replace(rules, min_viewpoints=2)
    step = max(1, round(STEP_S * fps))
    windows_long = len(frames) / (step * WINDOW_FRAMES)
    if isinstance(found, Sightings):
        count = max(WINDOWS, round(WINDOWS_SHARE * windows_long))
    else:
        # Windows of a short recording hardly overlap: a frame of silhouettes takes 5 ms.
        count = min(WINDOWS, math.ceil(windows_long))
    last = 0 if not len(frames) else int(frames[-1])
    starts = frames[frames <= max(last - step * (WINDOW_FRAMES - 1), 0)]
    starts = starts[evenly_spread(len(starts), count)]
    points, limits = [], FlightLimits(fps / step, wide_bounds(rig), FASTEST_M_S)
    # The last window ends at the last of the frames.
    windows = [
        np.arange(first, min(first + step * WINDOW_FRAMES, last + 1), step) for first in starts.tolist()
    ]
    shown = np.unique(np.concatenate([np.empty(0, int), *windows]))
    sightings = found[shown] if isinstance(found, Sightings) else from_silhouettes(found, frames=shown)
    for window in windows:
        births = Births(rig.cameras, limits, rules)
        for instant, number in enumerate(np.searchsorted(shown, window).tolist()):
            births.step(instant, sightings[number].largest(MOST_SIGHTINGS), NO_DRONES)
        points += [_point(rig, candidate, step / fps) for candidate in births.candidates()]
    table = np.array([point for point in points if point is not None]).reshape(-1, 5)
    apart_s = max(int(np.diff(starts).max(initial=0)) - step * WINDOW_FRAMES, 0) / 2 / fps
    return MovingPoints(table[:, :3], table[:, 3], table[:, 4], apart_s)


def _point(rig: Rig, candidate: TrackCandidate, step_s: float) -> tuple[float, ...] | None:
    """Position, speed and its standard deviation; None where the position is too vague to say anything."""
    place_m, variance_m2 = candidate.position_m, np.trace(candidate.path[candidate.instant].covariance_m2)
    nearest_m = np.linalg.norm(place_m - rig.cameras.centre_world, axis=-1).min()
    if np.sqrt(variance_m2) > MOST_VAGUE * nearest_m:
        return None
    time_s = step_s * np.array([*candidate.path])
    places_m = np.array([one.position_m for one in candidate.path.values()])
    (velocity, _), residual = np.polyfit(time_s, places_m, 1), time_s - time_s.mean()
    std_m = np.sqrt(np.median([np.trace(one.covariance_m2) for one in candidate.path.values()]))
    speed_std_m_s = std_m / np.sqrt((residual**2).sum())
    return (*place_m.tolist(), float(np.linalg.norm(velocity)), float(speed_std_m_s))
