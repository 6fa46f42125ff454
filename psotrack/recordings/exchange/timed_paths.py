"""Tracks of other programs on the clock of a recording: their times say to which frames they belong."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError
from psotrack.recordings import Recording, Timeline
from psotrack.trajectories import Trajectories, merged, resample

_logger = logging.getLogger(__name__)
#: Largest number of a frame.
_LARGEST_FRAME = 2**31
#: Largest distance of a time from a multiple of the tracks' own interval, in intervals.
_SAME = 0.02
#: Longest gap between two samples over which positions are interpolated, in intervals between samples: one missing
#: sample is a gap, and stays one.
_GAP = 1.5


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
        paths: at least one path, of `trajectories.timed_path`.
        recording: the recording, or None if none is known.

    Raises:
        InputError: no time is within the recording, or there are no rows.
    """
    if not any(path.num_frames for path in paths):
        raise InputError(where, expected="at least one pose", found="none")
    all_s = np.unique(np.concatenate([path.time_s for path in paths]))
    timeline = None if recording is None else recording.timeline()
    if timeline is not None:
        _check_clock(where, paths, timeline)
        at_instants = [timeline.numbers_of(path.time_s) for path in paths]
        frames = [frame for frame in at_instants if frame is not None]
        if len(frames) == len(paths):
            return merged(paths, frames, lambda frame: timeline.time_s[frame])
    own_s = own_interval_s(paths)
    if own_s is not None:
        frames = [np.round(path.time_s / own_s).astype(np.int64) for path in paths]
        return merged(paths, frames, lambda frame: frame * own_s)
    if timeline is None:
        frames = [np.searchsorted(all_s, path.time_s) for path in paths]
        return merged(paths, frames, lambda frame: all_s[frame])
    return _interpolated(where, paths, timeline.time_s)


def on_clock(where: object, tracks: Trajectories, recording: Recording | None) -> Trajectories:
    """Tracks of a file with frame numbers and times: the times decide, as they do in formats that have no numbers.

    The tracks stay as they are where both agree, be it with the recording's instants or with a rate of their own.
    Otherwise `joined` finds the frames, a warning says so, and the status is lost with the old frames.

    Args:
        where: the file, for messages.
        tracks: the tracks.
        recording: the recording, or None if none is known.

    Raises:
        InputError: no time is within the recording.
    """
    if recording is None or not tracks.num_frames:
        return tracks
    timeline, frame, time_s = recording.timeline(), tracks.frame, tracks.time_s
    _check_clock(where, [tracks], timeline)
    own_s = float(time_s[-1] / frame[-1]) if frame[-1] else 1 / recording.fps
    own_rate = own_s > 0 and bool(np.abs(time_s / own_s - frame).max() <= _SAME)
    if timeline.has(frame, time_s) or own_rate:
        return tracks
    position_m = np.where(tracks.seen[..., None], tracks.position_m, np.nan)
    found = joined(where, [replace(tracks, position_m=position_m, status=None, num_cameras=None)], recording)
    instants = np.minimum(frame, timeline.num_instants - 1)
    row = int(np.argmax(np.abs(timeline.time_s[instants] - time_s)))
    there = int(np.argmin(np.abs(timeline.time_s - time_s[row])))
    _logger.warning(
        "%s: frame numbers and times disagree, and the times decide: frame %d is at %.6g s, where the recording has "
        "frame %d (%.6g s)", where, frame[row], time_s[row], there, timeline.time_s[there],
    )  # fmt: skip
    return found


def _check_clock(where: object, paths: Sequence[Trajectories], timeline: Timeline) -> None:
    """Raise `InputError` for times outside of the recording, or in another unit than seconds."""
    time_s = np.unique(np.concatenate([path.time_s for path in paths]))
    begin_s, end_s = timeline.time_s[[0, -1]]
    unit = timeline.unit_of(time_s)
    if unit or time_s[-1] < begin_s - 1 or time_s[0] > end_s + 1:
        raise InputError(
            where,
            expected=f"times on the recording's clock, {begin_s:g} to {end_s:g} s",
            found=f"{time_s[0]:.6g} to {time_s[-1]:.6g}{f', which look like {unit}' if unit else ' s'}",
            remedy="write seconds" if unit else "subtract the time at which the recording begins",
        )


def _usual_interval_s(time_s: Float[np.ndarray, "rows"]) -> float:
    """Usual time between two rows, seconds; infinity for a single row."""
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else np.inf


def own_interval_s(paths: Sequence[Trajectories]) -> float | None:
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
