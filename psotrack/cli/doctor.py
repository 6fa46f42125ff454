"""`psotrack doctor`: check a sequence's calibration against its detections."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from psotrack.cli.options import (
    CACHE,
    FORCE,
    JOBS,
    JSON,
    SEQUENCE,
    Numbers,
    cache_folder,
    reporting,
)
from psotrack.cli.output import finite_or_none, output_json, print_line, report_to

if TYPE_CHECKING:
    from psotrack.calibration.doctor import Diagnosis
    from psotrack.geometry import Rig

#: Exit code if something was found.
FOUND = 2


@click.command()
@SEQUENCE
@click.option(
    "--detections",
    default="yolo",
    show_default=True,
    metavar="yolo|blobs|FOLDER",
    help="Detections in dl_data, blobs of the foreground, or a folder of files in the layout of dl_data.",
)
@click.option(
    "--bounds",
    "bounds_m",
    type=Numbers(6),
    metavar="X0,X1,Y0,Y1,Z0,Z1",
    help="Bounds of the room, in metres.  [default: far around the cameras, above and below]",
)
@CACHE
@JOBS
@reporting
@FORCE
@JSON
def doctor(
    sequence: Path,
    detections: str,
    bounds_m: tuple[float, float, float, float, float, float] | None,
    cache: Path | None,
    jobs: int | None,
    quiet: bool,
    force: bool,
    json_path: Path | None,
) -> None:
    """Check the calibration of SEQ against the detections of its cameras, before tracking.

    Reports which camera, pair of cameras or file disagrees, by how much, and what to do. It finds a camera that is
    turned, moved or late, has another focal length, or is exchanged with another camera; camera centres that were read
    as translations; millimetres that were read as metres; mirrored axes; a reference with another clock, unit or
    origin. A video is late if its frame i shows what the others show in an earlier frame.

    A fault is named only if it explains the detections clearly better than a sound rig, whose boxes may have lasting
    errors: the middle of a lopsided body's box is not the same point for two cameras. If faults of several cameras
    explain them equally well, as often with three cameras, all are listed and none is certain.

    The exit code is 0 if nothing was found, and 2 if something was found.

    \b
    Examples:
      psotrack doctor data/Real_Data/R12_D4
      psotrack doctor data/Real_Data/R12_D4 --detections blobs --json -
    """
    from psotrack.calibration.doctor import examine
    from psotrack.foreground.silhouettes import SilhouetteSettings, compute
    from psotrack.pipeline import detection_files_of
    from psotrack.recordings import read_detections
    from psotrack.recordings.datasets import open_recording
    from psotrack.settings import BLOBS
    from psotrack.tracking.births import room_bounds
    from psotrack.tracking.matching import from_detections, from_silhouettes

    recording = open_recording(sequence)
    report = report_to(quiet)
    if detections == BLOBS:
        recording = recording.usable(silhouettes=True)
        made = compute(recording, SilhouetteSettings(), cache=cache_folder(cache), jobs=jobs, report=report)
        sightings = from_silhouettes(made, report)
    else:
        files = detection_files_of(recording, detections)
        recording.check_detections(files)
        boxes = {name: read_detections(path) for name, path in files.items()}
        longest = max((each.num_frames for each in recording.frame_times.values()), default=0)
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
    output_json(json_path, _content(recording.rig, diagnosis), force)
    if not quiet and json_path != Path("-"):
        _print(recording.rig, diagnosis)
    for finding in diagnosis.findings:
        print_line(False, json_path, str(finding))
    if diagnosis.findings:
        sys.exit(FOUND)
    print_line(quiet, json_path, f"{recording.name}: nothing disagrees")


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


def _print(rig: Rig, diagnosis: Diagnosis) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(box=box.HORIZONTALS, show_edge=False)
    for heading in ("camera", "detections/frame", "explained", "median (px)", "(noise)", "late (frames)"):
        table.add_column(heading, justify="left" if heading == "camera" else "right")
    for row in _rows(rig, diagnosis):
        late, std = row["late_frames"], row["late_std_frames"]
        table.add_row(
            row["camera"],
            f"{row['detections_per_frame']:.2f}",
            f"{row['explained']:.0%}",
            *("" if row[key] is None else f"{row[key]:.1f}" for key in ("residual_px", "residual_std")),
            "" if late is None else f"{late:+.2f} ± {std:.2f}",
        )
    pairs = Table(box=box.HORIZONTALS, show_edge=False, title="median distance from epipolar lines (px)")
    for heading in ("", *rig.names):
        pairs.add_column(heading, justify="right")
    for name, values in zip(rig.names, diagnosis.epipolar_px, strict=True):
        pairs.add_row(name, *("" if np.isnan(value) else f"{value:.1f}" for value in values))
    Console().print(table)
    Console().print(pairs)
