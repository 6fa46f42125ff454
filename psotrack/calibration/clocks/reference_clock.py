"""The clock of a recording's reference: its offset from the videos, and the reference at the times of tracks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from psotrack.errors import InputError
from psotrack.evaluation import Offset, find_offset
from psotrack.recordings import Recording
from psotrack.trajectories import UNASSIGNED, Trajectories, resample

#: Largest offset that is tried where nobody says one, seconds.
USUAL_OFFSET_S = 2.0
#: Tracks whose rate differs by less than this share from the recording's have the recording's rate.
_RATE_TOLERANCE = 1e-3


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
    rate_hz = float(np.ptp(tracks.frame) / max(np.ptp(tracks.time_s), 1e-9))
    if tracks.num_frames > 1 and abs(rate_hz / recording.fps - 1) >= _RATE_TOLERANCE:
        recording = replace(recording, timing=replace(recording.timing, rate_hz=rate_hz))
        time_s = recording.timeline().time_s
        truth = resample(truth, np.arange(len(time_s)), time_s)
    if offset_s is None:
        return truth, 0.0
    if offset_s == "auto":
        offset_s = reference_offset(recording, tracks).offset.offset_s
    time_s = recording.timeline().time_s
    return resample(own_reference(recording), np.arange(len(time_s)), time_s, later_s=offset_s), offset_s


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
