"""Paths with times and without frame numbers, and the frames to which their times belong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from psotrack.errors import InputError
from psotrack.support import short_repr
from psotrack.trajectories import Trajectories, resample

#: Largest distance of a time from an instant whose frame number it gets, in intervals. Times that are rounded to
#: milliseconds are within the limit up to 40 frames per second. In 2 % of an interval of 40 ms, a drone at 2 m/s flies
#: Largest number of a frame.
_LARGEST_FRAME = 2**31
#: 1.6 mm. All other times are brought to the instants by interpolation.
_SAME = 0.02
#: Longest gap between two samples over which positions are interpolated, in intervals between samples: one missing
#: sample is a gap, and stays one.
_GAP = 1.5
#: Orientations that are the identity in every row, up to rounding of text, say that no orientation is known.
_IDENTITY = 1e-9


@dataclass(frozen=True, repr=False)
class TimedPath:
    """The path of one drone, with a row for each time at which it was seen.

    Attributes:
        name: name of the drone.
        time_s: (rows,), increasing times, seconds.
        position_m: (rows, 3), positions, metres.
        orientation_wxyz: (rows, 4), unit quaternions, body to world; NaN where unknown; None if never known.
        covariance_m2: (rows, 3, 3), covariances of the positions, m²; NaN where unknown; None if never known.
    """

    name: str
    time_s: Float[np.ndarray, "rows"]
    position_m: Float[np.ndarray, "rows 3"]
    orientation_wxyz: Float[np.ndarray, "rows 4"] | None = None
    covariance_m2: Float[np.ndarray, "rows 3 3"] | None = None

    __repr__ = short_repr

    @property
    def interval_s(self) -> float:
        """Usual time between two rows, seconds; infinity for a single row."""
        return float(np.median(np.diff(self.time_s))) if len(self.time_s) > 1 else np.inf


def known_orientations(
    orientation_wxyz: Float[np.ndarray, "rows 4"],
) -> Float[np.ndarray, "rows 4"] | None:
    """The orientations, or None if all are the identity: formats of poses write it where none is known."""
    turned = np.abs(orientation_wxyz[:, 1:]).max(initial=0.0) > _IDENTITY
    return orientation_wxyz if turned else None


def joined(
    where: object, paths: Sequence[TimedPath], instant_s: Float[np.ndarray, "instants"] | None
) -> Trajectories:
    """One set of trajectories from the paths of several drones.

    If all times are times of the instants, frame numbers are those of the instants. Otherwise, if all times are
    multiples of one interval, frame k is at k intervals: the paths have a rate of their own. Otherwise the paths are
    interpolated at the instants, but never across a missing sample, and covariances are left out. Without instants,
    frames are the times in their order.

    Args:
        where: the file or folder, for messages.
        paths: at least one path with at least one row.
        instant_s: (instants,), times of a recording's instants, seconds; None if no recording is known.

    Raises:
        InputError: no time is within the recording, or there are no rows.
    """
    if not any(len(path.time_s) for path in paths):
        raise InputError(where, expected="at least one pose", found="none")
    all_s = np.unique(np.concatenate([path.time_s for path in paths]))
    if instant_s is not None:
        _check_clock(where, all_s, instant_s)
        frames = [_instants_of(path.time_s, instant_s) for path in paths]
        if all(frame is not None for frame in frames):
            return _on_frames(paths, frames, lambda frame: instant_s[frame])
    interval_s = _own_interval_s(paths)
    if interval_s is not None:
        frames = [np.round(path.time_s / interval_s).astype(np.int64) for path in paths]
        return _on_frames(paths, frames, lambda frame: frame * interval_s)
    if instant_s is None:
        frames = [np.searchsorted(all_s, path.time_s) for path in paths]
        return _on_frames(paths, frames, lambda frame: all_s[frame])
    return _interpolated(where, paths, instant_s)


def _check_clock(
    where: object, all_s: Float[np.ndarray, "times"], instant_s: Float[np.ndarray, "instants"]
) -> None:
    if all_s[-1] < instant_s[0] - 1 or all_s[0] > instant_s[-1] + 1:
        raise InputError(
            where,
            expected=f"times on the recording's clock, {instant_s[0]:g} to {instant_s[-1]:g} s",
            found=f"{all_s[0]:.6g} to {all_s[-1]:.6g} s",
            remedy="subtract the time at which the recording begins",
        )


def _instants_of(
    time_s: Float[np.ndarray, "rows"], instant_s: Float[np.ndarray, "instants"]
) -> Int[np.ndarray, "rows"] | None:
    """Numbers of the instants with these times; None unless every time has an instant of its own."""
    if len(instant_s) < 2:
        return np.zeros(len(time_s), np.int64) if len(time_s) == 1 else None
    after = np.clip(np.searchsorted(instant_s, time_s), 1, len(instant_s) - 1)
    nearest = np.where(time_s - instant_s[after - 1] <= instant_s[after] - time_s, after - 1, after)
    limit_s = _SAME * float(np.median(np.diff(instant_s)))
    if (np.abs(instant_s[nearest] - time_s) > limit_s).any() or (np.diff(nearest) <= 0).any():
        return None
    return nearest.astype(np.int64)


def _own_interval_s(paths: Sequence[TimedPath]) -> float | None:
    """The interval of which all times of all paths are multiples; None without such an interval."""
    shortest_s = min(path.interval_s for path in paths)
    longest = max(paths, key=lambda path: np.ptp(path.time_s) if len(path.time_s) else 0.0)
    if not np.isfinite(shortest_s) or longest.time_s[0] < -_SAME * shortest_s:
        return None
    span_s = float(longest.time_s[-1])
    if not np.isfinite(span_s / shortest_s):
        return None
    # Over a long span, the number of intervals gives the interval better than two rounded times do.
    interval_s = span_s / max(round(span_s / shortest_s), 1)
    for path in paths:
        count = path.time_s / interval_s
        number = np.round(count)
        is_wrong = (np.abs(count - number) > _SAME) | (number < 0) | (number > _LARGEST_FRAME)
        if is_wrong.any() or (np.diff(number) <= 0).any():
            return None
    return interval_s


def _on_frames(
    paths: Sequence[TimedPath],
    frames: Sequence[Int[np.ndarray, "_"] | None],
    time_of: Callable[[Int[np.ndarray, "frames"]], Float[np.ndarray, "frames"]],
) -> Trajectories:
    """Trajectories in the frames that some path has."""
    numbers = [np.zeros(0, np.int64) if frame is None else frame for frame in frames]
    frame = np.unique(np.concatenate(numbers)).astype(np.int64)

    def grid(name: str, *shape: int) -> np.ndarray | None:
        if all(getattr(path, name) is None for path in paths):
            return None
        values = np.full((len(frame), len(paths), *shape), np.nan)
        for drone, (path, number) in enumerate(zip(paths, numbers, strict=True)):
            value = getattr(path, name)
            if value is not None:
                values[np.searchsorted(frame, number), drone] = value
        return values

    position_m = grid("position_m", 3)
    assert position_m is not None
    return Trajectories(
        frame=frame,
        time_s=time_of(frame).astype(np.float64),
        drones=tuple(path.name for path in paths),
        position_m=position_m,
        orientation_wxyz=grid("orientation_wxyz", 4),
        covariance_m2=grid("covariance_m2", 3, 3),
    )


def _interpolated(
    where: object, paths: Sequence[TimedPath], instant_s: Float[np.ndarray, "instants"]
) -> Trajectories:
    frame = np.arange(len(instant_s))
    parts = []
    for path in paths:
        if len(path.time_s) < 2:
            parts.append(TimedPath(path.name, instant_s, np.full((len(frame), 3), np.nan)))
            continue
        orientation = None if path.orientation_wxyz is None else path.orientation_wxyz[:, None]
        own = Trajectories(
            np.arange(len(path.time_s)),
            path.time_s,
            (path.name,),
            path.position_m[:, None],
            orientation_wxyz=orientation,
        )
        new = resample(own, frame, instant_s, gap_s=_GAP * path.interval_s)
        turned = None if new.orientation_wxyz is None else new.orientation_wxyz[:, 0]
        parts.append(TimedPath(path.name, instant_s, new.position_m[:, 0], turned))
    if not any(np.isfinite(part.position_m).any() for part in parts):
        raise InputError(
            where,
            expected="two samples of a drone with an instant of the recording between them",
            found="none",
        )
    return _on_frames(parts, [frame] * len(parts), lambda number: instant_s[number])
