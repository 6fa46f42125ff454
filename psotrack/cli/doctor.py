"""`psotrack doctor`: check a sequence's calibration against its detections."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from psotrack.cli.options import (
    BODIES,
    CACHE,
    FORCE,
    JOBS,
    JSON,
    SEQUENCE,
    cache_folder,
    detections_of,
    plot_option,
    reporting,
)
from psotrack.cli.output import Output, finite_or_none, pass_output
from psotrack.cli.records import HelpfulCommand
from psotrack.cli.types import Numbers
from psotrack.errors import errors_name

if TYPE_CHECKING:
    from psotrack.calibration.clocks import Offset
    from psotrack.calibration.doctor import Diagnosis
    from psotrack.geometry import Rig
    from psotrack.trajectories import Trajectories

#: Exit code if something was found.
FOUND = 1


@click.command(cls=HelpfulCommand)
@SEQUENCE
@click.option(
    "--detections",
    metavar="yolo|blobs|FOLDER",
    help="Detections in dl_data, blobs of the foreground, or a folder of files in the layout of dl_data.  [default: "
    "yolo where there are some, else blobs]",
)
@click.option(
    "--bounds",
    "bounds_m",
    type=Numbers(6),
    metavar="X0,X1,Y0,Y1,Z0,Z1",
    help="Bounds of the room, in metres.  [default: far around the cameras, above and below]",
)
@click.option(
    "--tracks",
    type=click.Path(path_type=Path),
    metavar="TRACKS",
    help="Find the offset between the clocks of SEQ's reference and of its videos instead, from the motion in TRACKS.",
)
@click.option(
    "--max-offset",
    "max_offset_s",
    type=float,
    default=2.0,
    show_default=True,
    help="Largest offset that is tried, in seconds, in both directions, with --tracks.",
)
@plot_option("the mean distance over the offsets, with --tracks", "beside TRACKS, as .offset.png")
@BODIES
@CACHE
@JOBS
@reporting
@FORCE
@JSON
@pass_output
def doctor(
    output: Output,
    sequence: Path,
    tracks: Path | None,
    bodies: dict[str, tuple[str, ...]],
    max_offset_s: float,
    plot: Path | None,
    **check: Any,
) -> None:
    """Check the calibration of SEQ against the detections of its cameras, before tracking.

    Reports which camera, pair of cameras or file disagrees, by how much, and what to do. It finds a camera that is
    turned, moved or late, has another focal length, or is exchanged with another camera; camera centres that were read
    as translations; millimetres that were read as metres; mirrored axes; a reference with another clock, unit or
    origin. A video is late if its frame i shows what the others show in an earlier frame.

    A fault is named only if it explains the detections clearly better than a sound rig, whose boxes may have lasting
    errors: the middle of a lopsided body's box is not the same point for two cameras. If faults of several cameras
    explain them equally well, as often with three cameras, all are listed and none is certain.

    With --tracks, the offset of the reference's clock minimises the mean distance between TRACKS and the reference, to
    a fraction of a frame. Each drone may have a constant lever arm.

    The exit code is 0 if nothing was found, 1 if something was found, and 2 for an error.

    \b
    Examples:
      psotrack doctor my_lab
      psotrack doctor data/Real_Data/R12_D4 --detections blobs --json -
      psotrack doctor data/Real_Data/R12_D4 --tracks tracks.csv --max-offset 10 --plot offset.png
    """
    if tracks is None:
        _examine(output, sequence, bodies, **check)
    else:
        _synchronise(output, sequence, tracks, bodies, max_offset_s, plot)


def _examine(
    output: Output,
    sequence: Path,
    bodies: dict[str, tuple[str, ...]],
    detections: str | None,
    bounds_m: tuple[float, float, float, float, float, float] | None,
    cache: Path | None,
    jobs: int | None,
) -> None:
    """Check a rig."""
    from psotrack.calibration.doctor import examine
    from psotrack.foreground.silhouettes import SilhouetteSettings, compute
    from psotrack.pipeline import detection_files_of
    from psotrack.recordings import read_detections
    from psotrack.recordings.datasets import open_recording
    from psotrack.settings import BLOBS
    from psotrack.tracking.births import room_bounds
    from psotrack.tracking.matching import from_detections, from_silhouettes

    recording = open_recording(sequence, bodies=bodies)
    report, detections = output.report, detections or detections_of(output, recording)
    if detections == BLOBS:
        recording = recording.usable(silhouettes=True)
        made = compute(recording, SilhouetteSettings(), cache=cache_folder(cache), jobs=jobs, report=report)
        sightings = from_silhouettes(made, report)
    else:
        files = detection_files_of(recording, detections)
        recording.check_detections(files)
        boxes = {name: read_detections(path) for name, path in files.items()}
        longest = max((each.times.num_frames for each in recording.cameras if each.times), default=0)
        sightings = from_detections(boxes, recording.rig, longest)
    sightings = sightings.at_instants(recording.timeline())
    bounds_m = recording.bounds_m if bounds_m is None else bounds_m
    diagnosis = examine(
        recording.rig,
        sightings,
        fps=recording.fps,
        reference=recording.truth,
        bounds_m=None if bounds_m is None else room_bounds(recording.rig, bounds_m),
    )
    output.json(_content(recording.rig, diagnosis))
    _print(output, recording.rig, diagnosis, recording.fps)
    if diagnosis.findings:
        output.say(*map(str, diagnosis.findings), always=True)
        sys.exit(FOUND)
    output.say(f"{recording.name}: nothing disagrees")


def _rows(rig: Rig, diagnosis: Diagnosis) -> list[dict[str, Any]]:
    """Measurements of each camera, one row per camera."""
    found = diagnosis.found
    rows = []
    for index, name in enumerate(rig.names):
        residual_px = found.residual_px[:, index][found.used[:, index]]
        noise_px = found.noise_px[:, index][found.used[:, index]]
        rows.append(
            {
                "camera": name,
                "detections_per_frame": float(found.num_sightings[index] / max(found.num_frames, 1)),
                "explained": float(found.share_of_camera[index]),
                "residual_px": float(np.median(residual_px)) if len(residual_px) else None,
                "residual_std": float(np.median(residual_px / noise_px)) if len(residual_px) else None,
                "late_frames": finite_or_none(diagnosis.late_frames[index]),
                "late_std_frames": finite_or_none(diagnosis.late_std_frames[index]),
            }
        )
    return rows


def _content(rig: Rig, diagnosis: Diagnosis) -> dict[str, Any]:
    """The diagnosis as JSON, with null for missing numbers."""
    fit = diagnosis.reference
    return {
        "findings": [
            {
                **vars(finding),
                "cameras": list(finding.cameras),
                "nearly_as_likely": list(finding.nearly_as_likely),
            }
            for finding in diagnosis.findings
        ],
        "frames": diagnosis.found.num_frames,
        "explained": diagnosis.found.share,
        "cameras": _rows(rig, diagnosis),
        "epipolar_px": [[finite_or_none(value) for value in row] for row in diagnosis.epipolar_px],
        "reference_m": None if fit is None else fit.before_m,
    }


def _print(output: Output, rig: Rig, diagnosis: Diagnosis, fps: float) -> None:
    rows, to_ms = [], 1e3 / fps
    for row in _rows(rig, diagnosis):
        late, std = row["late_frames"], row["late_std_frames"]
        rows.append(
            (
                row["camera"],
                f"{row['detections_per_frame']:.2f}",
                f"{row['explained']:.0%}",
                *("" if row[key] is None else f"{row[key]:.1f}" for key in ("residual_px", "residual_std")),
                "" if late is None else f"{late * to_ms:+.0f} ± {std * to_ms:.0f}",
            )
        )
    headings = ("camera", "detections/frame", "explained", "median (px)", "(noise)", "late (ms)")
    output.table(headings, rows)
    pairs = (
        (name, *("" if np.isnan(value) else f"{value:.1f}" for value in values))
        for name, values in zip(rig.names, diagnosis.epipolar_px, strict=True)
    )
    output.table(("", *rig.names), pairs, title="median distance from epipolar lines (px)")


def _synchronise(
    output: Output,
    sequence: Path,
    tracks: Path,
    bodies: dict[str, tuple[str, ...]],
    max_offset_s: float,
    plot: Path | None,
) -> None:
    """Find the offset of the reference's clock."""
    from psotrack.calibration.clocks import find_offset, own_reference, save_curve
    from psotrack.recordings.datasets import open_recording
    from psotrack.recordings.exchange import read_tracks

    recording = open_recording(sequence, bodies=bodies)
    reference = own_reference(recording)
    estimate = read_tracks(tracks, recording=recording)
    with errors_name(f"{tracks} and {sequence}"):
        offset = find_offset(
            estimate,
            reference.time_s,
            reference.position_m,
            reference.orientation_wxyz,
            max_offset_s=max_offset_s,
        )
    output.json(_offset_content(offset, estimate, reference))
    output.say(f"{recording.name}: {offset_in_words(offset, recording.fps)}")
    if plot is not None:
        picture = plot if plot.name else tracks.with_suffix(".offset.png")
        save_curve(picture, offset, force=output.force)
        output.say(f"picture: {picture}")


def offset_in_words(offset: Offset, fps: float) -> str:
    """What was found, in one line."""
    before = (
        "nothing to compare" if offset.mean_distance_before_m is None else _mm(offset.mean_distance_before_m)
    )
    ahead = offset.offset_s >= 0
    return (
        f"the reference's clock is {abs(offset.offset_s):.4f} s (± {offset.std_s:.4f} s) "
        f"{'ahead of' if ahead else 'behind'} the videos' ({offset.offset_s * fps:+.2f} frames): the videos show the "
        f"scene {'early' if ahead else 'late'}; mean distance, lever arms taken out: "
        f"{before} before, {_mm(offset.mean_distance_m)} after"
    )


def _mm(value_m: float) -> str:
    return f"{1e3 * value_m:.1f} mm"


def _offset_content(offset: Offset, estimate: Trajectories, reference: Trajectories) -> dict[str, Any]:
    """The offset as JSON, with null for missing numbers."""
    from psotrack.trajectories import UNASSIGNED

    drones = [
        {
            "drone": name,
            "estimate": None if partner == UNASSIGNED else estimate.drones[partner],
            "lever_arm_m": None if partner == UNASSIGNED else offset.lever_arm_m[drone].tolist(),
        }
        for drone, (name, partner) in enumerate(zip(reference.drones, offset.partner, strict=True))
    ]
    return {
        "offset_s": offset.offset_s,
        "std_s": offset.std_s,
        "mean_distance_before_m": offset.mean_distance_before_m,
        "mean_distance_m": offset.mean_distance_m,
        "overlap": offset.overlap,
        "lever_arm_frame": "world" if reference.orientation_wxyz is None else "body",
        "drones": drones,
        "curve": {
            "offset_s": offset.curve_s.tolist(),
            "mean_distance_m": [None if value != value else value for value in offset.curve_m.tolist()],
        },
    }
