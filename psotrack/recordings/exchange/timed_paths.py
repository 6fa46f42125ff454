"""Paths of single drones with times and without frame numbers, and the frames to which their times belong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from psotrack.errors import InputError
from psotrack.recordings import Recording
from psotrack.trajectories import Trajectories, merged, resample

#: Largest number of a frame.
_LARGEST_FRAME = 2**31
#: Largest distance of a time from an instant whose frame number it gets, in intervals. Times that are rounded to
#: milliseconds are within the limit up to 40 frames per second. In 2 % of an interval of 40 ms, a drone at 2 m/s flies
#: 1.6 mm. All other times are brought to the instants by interpolation.
_SAME = 0.02
#: Longest gap between two samples over which positions are interpolated, in intervals between samples: one missing
#: sample is a gap, and stays one.
_GAP = 1.5
#: Orientations that are the identity in every row, up to rounding of text, say that no orientation is known.
_IDENTITY = 1e-9


def timed_path(
    name: str,
    time_s: Float[np.ndarray, "rows"],
    position_m: Float[np.ndarray, "rows 3"],
    orientation_wxyz: Float[np.ndarray, "rows 4"] | None,
    covariance_m2: Float[np.ndarray, "rows 3 3"] | None = None,
) -> Trajectories:
    """The path of one drone, with a frame for each time at which it was seen, seconds, increasing.

    Orientations that are all the identity are left out: formats of poses write it where none is known.
    """
    turned = (
        orientation_wxyz is not None and np.nanmax(np.abs(orientation_wxyz[:, 1:]), initial=0.0) > _IDENTITY
    )
    return Trajectories(
        np.arange(len(time_s)),
        time_s,
        (name,),
        position_m[:, None],
        orientation_wxyz=orientation_wxyz[:, None] if orientation_wxyz is not None and turned else None,
        covariance_m2=None if covariance_m2 is None else covariance_m2[:, None],
    )


def instants_s(recording: Recording | None) -> Float[np.ndarray, "instants"] | None:
    """(instants,), times of a recording's instants, seconds; None if no recording is known."""
    return None if recording is None else recording.timeline().time_s.astype(np.float64)


def interval_s(trajectories: Trajectories) -> float:
    """Mean time from frame to frame, seconds.

    Raises:
        InputError: there is one frame only, which is not frame 0, at a time that is not above 0.
    """
    frame, time_s = trajectories.frame, trajectories.time_s
    if len(frame) > 1:
        interval = float(np.ptp(time_s) / np.ptp(frame))
    else:
        interval = float(time_s[0] / frame[0]) if len(frame) and frame[0] else 1.0
    if not interval > 0:
        raise InputError("tracks", expected="times that increase from frame to frame", found="equal times")
    return interval


def joined(where: object, paths: Sequence[Trajectories], recording: Recording | None) -> Trajectories:
    """One set of trajectories from the paths of several drones.

    If all times are times of the recording's instants, frame numbers are those of the instants. Otherwise, if all times
    are multiples of one interval, frame k is at k intervals: the paths have a rate of their own. Otherwise the paths
    are interpolated at the instants, but never across a missing sample, and covariances are left out. Without a
    recording, frames are the times in their order.

    Args:
        where: the file or folder, for messages.
        paths: at least one path, of `timed_path`.
        recording: the recording, or None if none is known.

    Raises:
        InputError: no time is within the recording, or there are no rows.
    """
    if not any(path.num_frames for path in paths):
        raise InputError(where, expected="at least one pose", found="none")
    all_s = np.unique(np.concatenate([path.time_s for path in paths]))
    instant_s = instants_s(recording)
    if instant_s is not None:
        _check_clock(where, all_s, instant_s)
        at_instants = [_instants_of(path.time_s, instant_s) for path in paths]
        frames = [frame for frame in at_instants if frame is not None]
        if len(frames) == len(paths):
            return merged(paths, frames, lambda frame: instant_s[frame])
    own_s = _own_interval_s(paths)
    if own_s is not None:
        frames = [np.round(path.time_s / own_s).astype(np.int64) for path in paths]
        return merged(paths, frames, lambda frame: frame * own_s)
    if instant_s is None:
        frames = [np.searchsorted(all_s, path.time_s) for path in paths]
        return merged(paths, frames, lambda frame: all_s[frame])
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


def _usual_interval_s(time_s: Float[np.ndarray, "rows"]) -> float:
    """Usual time between two rows, seconds; infinity for a single row."""
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else np.inf


def _instants_of(
    time_s: Float[np.ndarray, "rows"], instant_s: Float[np.ndarray, "instants"]
) -> Int[np.ndarray, "rows"] | None:
    """Numbers of the instants with these times; None unless every time has an instant of its own."""
    if len(instant_s) < 2:
        return np.zeros(len(time_s), np.int64) if len(time_s) == 1 else None
    after = np.clip(np.searchsorted(instant_s, time_s), 1, len(instant_s) - 1)
    nearest = np.where(time_s - instant_s[after - 1] <= instant_s[after] - time_s, after - 1, after)
    limit_s = _SAME * _usual_interval_s(instant_s)
    if (np.abs(instant_s[nearest] - time_s) > limit_s).any() or (np.diff(nearest) <= 0).any():
        return None
    return nearest.astype(np.int64)


def _own_interval_s(paths: Sequence[Trajectories]) -> float | None:
    """The interval of which all times of all paths are multiples; None without such an interval."""
    shortest_s = min(_usual_interval_s(path.time_s) for path in paths)
    longest = max(paths, key=lambda path: np.ptp(path.time_s) if path.num_frames else 0.0)
    if not np.isfinite(shortest_s) or longest.time_s[0] < -_SAME * shortest_s:
        return None
    span_s = float(longest.time_s[-1])
    if not np.isfinite(span_s / shortest_s):
        return None
    # Over a long span, the number of intervals gives the interval better than two rounded times do.
    own_s = span_s / max(round(span_s / shortest_s), 1)
    for path in paths:
        count = path.time_s / own_s
        number = np.round(count)
        is_wrong = (np.abs(count - number) > _SAME) | (number < 0) | (number > _LARGEST_FRAME)
        if is_wrong.any() or (np.diff(number) <= 0).any():
            return None
    return own_s


def _interpolated(
    where: object, paths: Sequence[Trajectories], instant_s: Float[np.ndarray, "instants"]
) -> Trajectories:
    frame = np.arange(len(instant_s))
    parts = [resample(path, frame, instant_s, gap_s=_GAP * _usual_interval_s(path.time_s)) for path in paths]
    if not any(np.isfinite(part.position_m).any() for part in parts):
        expected = "two samples of a drone with an instant of the recording between them"
        raise InputError(where, expected=expected, found="none")
    return merged(parts, [frame] * len(parts), lambda number: instant_s[number])
