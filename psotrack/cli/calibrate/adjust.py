"""`psotrack calibrate adjust`: correct a rig by the drones that its cameras see."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from scipy.spatial.transform import Rotation

from psotrack.cli.calibrate.options import OUT
from psotrack.cli.options import SEQUENCE, running
from psotrack.cli.output import Output
from psotrack.cli.records import HelpfulCommand, options_of
from psotrack.errors import InputError

if TYPE_CHECKING:
    from psotrack.calibration import DroneViews, Improved
    from psotrack.calibration.doctor import CheckedAdjustment
    from psotrack.geometry import Rig
    from psotrack.recordings import Recording


#: What is said of a rig in which all cameras may be off.
ALL_OFF = (
    "all cameras may be off by a little, and drones do not tell which of them are right, nor where the rig as a whole "
    "is: the rig is written unchanged; calibrate it anew, or name cameras that are right with --fixed"
)


@dataclass(frozen=True)
class Adjusting:
    """By what a rig is adjusted.

    Attributes:
        tracks: tracks of SEQ's drones, a file of `track`.
        fixed: cameras that are not moved.
        refine_focal_length: scale all focal lengths by a common factor, too.
        noise_px: standard deviation of the middle of a box from frame to frame, along x and along y, in pixels; None:
            1, plus 5 % of the box's mean side.
    """

    tracks: Path
    fixed: tuple[str, ...] = ()
    refine_focal_length: bool = False
    noise_px: float | None = None


@click.command(cls=HelpfulCommand)
@SEQUENCE
@options_of(Adjusting, "how")
@OUT
@running(progress=False)
def adjust(
    output: Output,
    sequence: Path,
    how: Adjusting,
    out: Path,
) -> None:
    """Move the cameras of SEQ that disagree with the other cameras about its drones, by a bundle adjustment.

    The adjustment uses the middles of SEQ's detections that contain a tracked drone; where the cameras' frames were not
    exposed together, the middles are moved by the drone's motion to common times. A middle has an error of about a
    pixel that stays the same for many frames, so that cameras are placed to a centimetre or two. Only cameras whose
    error is certainly larger are moved, and only if the moved cameras fit views better that the adjustment did not use:
    each quarter of the recording is left out in turn. If there is none, OUT is the unchanged rig.

    Drones show neither the world's origin nor its axes nor its scale: the cameras that agree hold them. If small errors
    of all cameras explain the disagreement as well as errors of some cameras, OUT is the unchanged rig, because an
    adjusted rig would agree with itself, but not better with the world.

    \b
    Example:
      psotrack calibrate adjust data/Simulated_Data/S02_D4_A --tracks tracks.csv --out better.toml
    """
    from psotrack.calibration import PlacedCameras, find_drones_in_boxes
    from psotrack.calibration.doctor import improve_with_check
    from psotrack.geometry.rig_files import write_rig
    from psotrack.recordings import read_detections
    from psotrack.recordings.datasets import open_recording
    from psotrack.recordings.exchange import read_tracks

    output.refuse(out)
    recording = open_recording(sequence)
    if not recording.detections:
        raise InputError(
            sequence,
            expected="detections in dl_data or in recording.toml",
            found="none",
            remedy="`psotrack detect` makes them",
        )
    recording.check_detections(recording.detections)
    detections = {name: read_detections(path) for name, path in recording.detections.items()}
    flown = read_tracks(how.tracks, recording=recording if recording.videos else None)
    frame_times = None
    if not _is_synchronous(recording):
        frame_times = {name: times for name, times in recording.exposed.items() if name in detections}
    views = find_drones_in_boxes(recording.rig, detections, flown, frame_times=frame_times)
    held = how.fixed
    checked = improve_with_check(
        recording.rig, views, how.noise_px, fixed=held, refine_focal_length=how.refine_focal_length
    )
    improved = checked.improved
    write_rig(out, improved.rig, force=output.force)
    rows = _rows(recording.rig, improved, views, held)
    output.result(PlacedCameras(improved.rig, rows, path=out))
    if checked.all_off:
        output.say(ALL_OFF)
    elif checked.better:
        output.say(_in_words(improved, rows))
    for line in _check_in_words(checked):
        output.say(line)
    if how.refine_focal_length:
        scale, std = improved.everything.focal_scale, improved.everything.focal_scale_std
        done = "" if improved.rescaled else ", which may be chance: the focal lengths are not changed"
        output.say(f"focal lengths x {scale:.5f} ± {std:.5f}{done}")


def _is_synchronous(recording: Recording) -> bool:
    """Whether frames of equal number were exposed together, to a tenth of a frame."""
    times = [each.times for each in recording.cameras if each.detections and each.times]
    longest = max(times, key=lambda each: each.num_frames)
    return all(
        np.abs(each.time_s - longest.time_s[: each.num_frames]).max(initial=0.0) <= 0.1 / longest.fps
        for each in times
    )


def _rows(
    rig: Rig, improved: Improved, views: DroneViews, held: tuple[str, ...]
) -> dict[str, dict[str, Any]]:
    """Results of each camera, by name."""
    from psotrack.calibration import row_of

    shown = improved.everything if improved.final is None else improved.final
    T, T_before = (np.asarray(one.cameras.T_cam_world) for one in (improved.rig, rig))
    turns = Rotation.from_matrix(T[:, :3, :3] @ T_before[:, :3, :3].swapaxes(-1, -2))
    turned_deg = np.linalg.norm(turns.as_rotvec(degrees=True), axis=-1)
    centre_m, before_m = (np.asarray(one.cameras.centre_world) for one in (improved.rig, rig))
    moved_m = np.linalg.norm(centre_m - before_m, axis=-1)
    rows = {}
    for index, name in enumerate(rig.names):
        seen = np.isfinite(shown.residual_px[:, index])
        rows[name] = row_of(
            centre_m[index],
            improved.centre_covariance_m2[index],
            shown.residual_px[seen, index],
            shown.used[seen, index],
            [point for point, there in zip(views.points, seen, strict=True) if there],
        )
        rows[name]["moved_m"] = float(moved_m[index])
        rows[name]["turned_deg"] = float(turned_deg[index])
        rows[name]["verdict"] = "moved" if name in improved.moved else "fixed" if name in held else "agrees"
    return rows


def _check_in_words(checked: CheckedAdjustment) -> list[str]:
    """How the adjustment was checked."""
    lines = []
    if checked.uncertain and checked.better and not checked.all_off:
        names = ", ".join(checked.uncertain)
        lines.append(f"{names}: not moved, because lasting errors of the boxes explain the disagreement, too")
    if checked.left_out_px is not None:
        before, after = (f"{value:.2f} px" for value in checked.left_out_px)
        fits = f"{before} with the given rig, {after} with the adjusted one"
        lines.append(
            f"views that were left out: median distance {fits}"
            if checked.better
            else f"{', '.join(checked.uncertain)}: not moved: views that were left out do not fit better: {fits}; "
            "the rig is written unchanged"
        )
    return lines


def _in_words(improved: Improved, rows: dict[str, dict[str, Any]]) -> str:
    """The results in one line."""
    if not improved.moved:
        what = "only the focal lengths are changed" if improved.rescaled else "the rig is written unchanged"
        known_mm = [1e3 * float(np.linalg.norm(row["centre_std_m"])) for row in rows.values()]
        stated_mm = [value for value in known_mm if value > 0] or [0.0]
        return (
            "no camera is off by more than the uncertainty of these detections, which is "
            f"{min(stated_mm):.0f} to {max(stated_mm):.0f} mm: {what}"
        )
    parts = [
        f"{name} is off: moved by {1e3 * rows[name]['moved_m']:.0f} mm, "
        f"turned by {rows[name]['turned_deg']:.2f} degrees"
        for name in improved.moved
    ]
    parts += [
        f"or the focal length of {name} is wrong (x {scale:.3f} ± {std:.3f}): check its lens"
        for name, (scale, std) in improved.zoomed.items()
    ]
    return "; ".join([*parts, "the other cameras stay"])
