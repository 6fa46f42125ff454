"""The clock of a recording's reference: its offset from the videos, and the reference at the times of tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from psotrack.errors import InputError
from psotrack.evaluation import Offset, find_offset
from psotrack.recordings import Recording, Timeline
from psotrack.trajectories import UNASSIGNED, Trajectories, resample

#: Largest offset that is tried where nobody says one, seconds.
USUAL_OFFSET_S = 2.0
#: Fewest rows of tracks whose regular frames show a rate below the recording's: by chance, two or three are regular.
_LEAST_ROWS = 5


@dataclass(frozen=True)
class ReferenceOffset:
    """The offset between the clocks of a reference and of the videos; its text is what `doctor --tracks` prints.

    Attributes:
        name: name of the recording.
        offset: the offset.
        partners: the track that follows each drone of the reference, by the drone's name; None without one.
        fps: frames per second of the videos.
        frame: the frame of the lever arms.
    """

    name: str
    offset: Offset
    partners: dict[str, str | None]
    fps: float
    frame: Literal["body", "world"]

    def to_dict(self) -> dict[str, Any]:
        """The offset, with None for missing numbers."""
        found = self.offset
        arms = zip(self.partners.items(), found.lever_arm_m.tolist(), strict=True)
        return {
            "offset_s": found.offset_s,
            "std_s": found.std_s,
            "mean_distance_before_m": found.mean_distance_before_m,
            "mean_distance_m": found.mean_distance_m,
            "overlap": found.overlap,
            "lever_arm_frame": self.frame,
            "drones": [
                {"drone": drone, "estimate": partner, "lever_arm_m": None if partner is None else arm_m}
                for (drone, partner), arm_m in arms
            ],
            "curve": {
                "offset_s": found.curve_s.tolist(),
                "mean_distance_m": [None if value != value else value for value in found.curve_m.tolist()],
            },
        }

    def __str__(self) -> str:
        found, ahead = self.offset, self.offset.offset_s >= 0
        before_m = found.mean_distance_before_m
        before = "nothing to compare" if before_m is None else f"{1e3 * before_m:.1f} mm"
        return (
            f"{self.name}: the reference's clock is {abs(found.offset_s):.4f} s (± {found.std_s:.4f} s) "
            f"{'ahead of' if ahead else 'behind'} the videos' ({found.offset_s * self.fps:+.2f} frames): the videos "
            f"show the scene {'early' if ahead else 'late'}; mean distance, lever arms taken out: "
            f"{before} before, {1e3 * found.mean_distance_m:.1f} mm after"
        )


def reference_offset(
    recording: Recording, tracks: Trajectories, *, max_offset_s: float = USUAL_OFFSET_S
) -> ReferenceOffset:
    """Find the offset between the clocks of a recording's reference and of its videos, from the drones' motion.

    Args:
        recording: the recording, with a reference.
        tracks: tracks at the times of the videos.
        max_offset_s: largest offset that is tried, forwards and backwards, seconds.

    Raises:
        InputError: there is no reference, or it does not determine the offset (see `find_offset`).
        SettingsError: `max_offset_s` is smaller than an interval of the reference.
    """
    own = own_reference(recording)
    offset = find_offset(tracks, own.time_s, own.position_m, own.orientation_wxyz, max_offset_s=max_offset_s)
    partners = (None if index == UNASSIGNED else tracks.drones[index] for index in offset.partner)
    return ReferenceOffset(
        recording.name,
        offset,
        dict(zip(own.drones, partners, strict=True)),
        recording.fps,
        "world" if own.orientation_wxyz is None else "body",
    )


def reference_for(
    recording: Recording, tracks: Trajectories, offset_s: float | Literal["auto"] | None = None
) -> tuple[Trajectories, float]:
    """The reference of a recording at the instants of tracks, and the time by which its clock is ahead, seconds.

    Args:
        recording: the recording.
        tracks: tracks, at the recording's rate or at one of their own (`track --rate`).
        offset_s: time by which the reference's clock is ahead of the videos', seconds; "auto" finds it; None: as the
            recording says.

    Raises:
        InputError: there is no reference, or its offset cannot be found.
    """
    truth = recording.truth
    if truth is None:
        raise InputError(recording.name, expected="a reference to compare with", found="none")
    timeline = recording.timeline()
    own = _own_frames(timeline, tracks)
    if offset_s is None:
        return truth if own is None else resample(truth, *own), 0.0
    if offset_s == "auto":
        offset_s = reference_offset(recording, tracks).offset.offset_s
    frame, time_s = own or (np.arange(timeline.num_instants), timeline.time_s)
    return resample(own_reference(recording), frame, time_s, later_s=offset_s), offset_s


def _own_frames(
    timeline: Timeline, tracks: Trajectories
) -> tuple[Int[np.ndarray, "frames"], Float[np.ndarray, "frames"]] | None:
    """Numbers and times of the frames of tracks with a rate of their own; None where it is the recording's."""
    # Some formats have rows in which nothing is seen, and others leave them out.
    seen = tracks.seen.any(axis=1)
    frame, time_s = tracks.frame[seen], tracks.time_s[seen]
    if len(frame) < 2:
        return None
    steps = np.diff(frame)
    step = int(np.median(steps))
    is_slow = step > 1 and len(frame) >= _LEAST_ROWS and not (steps % step).any()
    if not is_slow and timeline.has(frame, time_s):
        return None
    interval_s = float(np.ptp(time_s) / np.ptp(frame))
    first_s = time_s[0] - frame[0] * interval_s
    last = int((timeline.time_s[-1] - first_s) / interval_s + 1e-6)
    number = np.arange(frame[0] % step, last + 1, step) if is_slow else np.arange(last + 1)
    return number, first_s + number * interval_s


def own_reference(recording: Recording) -> Trajectories:
    """The reference of a recording at its own rate, with orientations only if every position has one.

    Raises:
        InputError: the recording has no reference.
    """
    known = recording.reference
    if known is None:
        raise InputError(recording.folder, expected="a reference to synchronise with", found="none")
    reference = known.truth if known.own is None else known.own
    if reference.orientation_wxyz is not None:
        turned = np.isfinite(reference.orientation_wxyz).all(axis=-1)
        if not turned[reference.seen].all():
            return replace(reference, orientation_wxyz=None)
    return reference
