"""Tracks of static cameras, at all frames of these tracks and of the cameras on drones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from psotrack.inside_out.fusing.resampling import is_informative
from psotrack.trajectories import UNASSIGNED, Status, Trajectories

#: Standard deviation along each axis of tracks without covariances, metres; the fusion estimates its scale.
_UNSTATED_M = 0.03


@dataclass(frozen=True)
class OutsideTracks:
    """Tracks with all optional values filled in: NaN where unknown, and `LOST` where there is no position.

    Attributes:
        frame, time_s: (frames,), numbers and times, seconds.
        position_m, velocity_m_s: (frames, tracks, 3), world.
        covariance_m2: (frames, tracks, 3, 3), of the positions.
        status: (frames, tracks), values of `Status`.
    """

    frame: Int[np.ndarray, "frames"]
    time_s: Float[np.ndarray, "frames"]
    position_m: Float[np.ndarray, "frames tracks 3"]
    velocity_m_s: Float[np.ndarray, "frames tracks 3"]
    covariance_m2: Float[np.ndarray, "frames tracks 3 3"]
    status: Int[np.ndarray, "frames tracks"]

    @property
    def tracked_m(self) -> Float[np.ndarray, "frames tracks 3"]:
        """(frames, tracks, 3), positions of tracks that are neither coasting nor lost; NaN elsewhere."""
        return np.where((self.status == Status.TRACKED)[..., None], self.position_m, np.nan)


def align_tracks(outside: Trajectories, also_s: Iterable[Float[np.ndarray, "_"]]) -> OutsideTracks:
    """The tracks at their own frames, and at frames of the same rate for other times.

    Args:
        outside: tracks of static cameras.
        also_s: times of cameras on drones, by the clock of the tracks, seconds; times before frame 0 are left out.
    """
    frame, time_s = _frames(outside, list(also_s))
    rows = np.isin(frame, outside.frame)
    shape = (len(frame), outside.num_drones)

    def at_frames(values: np.ndarray | None, *rest: int) -> np.ndarray:
        found = np.full((*shape, *rest), np.nan)
        if values is not None:
            found[rows] = values
        return found

    status = np.full(shape, int(Status.LOST))
    own = np.where(outside.seen, int(Status.TRACKED), int(Status.LOST))
    status[rows] = own if outside.status is None else outside.status
    position_m, covariance_m2 = at_frames(outside.position_m, 3), at_frames(outside.covariance_m2, 3, 3)
    if outside.covariance_m2 is None:
        covariance_m2[:] = _UNSTATED_M**2 * np.eye(3)
    informative = is_informative(covariance_m2)
    status[~informative | ~np.isfinite(position_m).all(axis=2)] = Status.LOST
    return OutsideTracks(
        frame=frame,
        time_s=time_s,
        position_m=position_m,
        velocity_m_s=at_frames(outside.velocity_m_s, 3),
        covariance_m2=np.where(informative[..., None, None], covariance_m2, np.nan),
        status=status,
    )


def select_track(
    values: Float[np.ndarray, "frames tracks *rest"], track: Int[np.ndarray, "frames"]
) -> Float[np.ndarray, "frames *rest"]:
    """Values of the chosen track in each frame; NaN where none is chosen."""
    chosen = values[np.arange(len(track)), track].copy()
    chosen[track == UNASSIGNED] = np.nan
    return chosen


def _frames(
    outside: Trajectories, also_s: list[Float[np.ndarray, "_"]]
) -> tuple[Int[np.ndarray, "frames"], Float[np.ndarray, "frames"]]:
    if outside.num_frames > 1:
        step_s = float(np.median(np.diff(outside.time_s) / np.diff(outside.frame)))
    else:
        steps_s = np.concatenate([np.diff(times_s) for times_s in also_s])
        step_s = float(np.median(steps_s)) if len(steps_s) else 1.0
    first_frame, first_s = outside.frame[0], outside.time_s[0]
    others = [first_frame + np.round((times_s - first_s) / step_s) for times_s in also_s]
    numbers = np.concatenate([outside.frame, *(other[other >= 0] for other in others)])
    frame = np.unique(numbers.astype(np.int64))
    time_s = first_s + step_s * (frame - first_frame)
    time_s[np.isin(frame, outside.frame)] = outside.time_s
    return frame, time_s
