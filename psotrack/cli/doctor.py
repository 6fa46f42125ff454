"""`psotrack doctor`: check a sequence's calibration against its detections."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from psotrack.cli.commands import command
from psotrack.cli.options import Bodies, Cache, Jobs, Seq, cache_folder, detections_of
from psotrack.cli.output import Output
from psotrack.cli.types import says
from psotrack.errors import errors_name

#: Exit code if something was found.
FOUND = 1
_Bounds = tuple[float, float, float, float, float, float]


@command()
def doctor(
    output: Output,
    sequence: Seq,
    *,
    detections: Annotated[str | None, says(metavar="yolo|blobs|FOLDER")] = None,
    bounds_m: Annotated[_Bounds | None, says(metavar="X0,X1,Y0,Y1,Z0,Z1")] = None,
    tracks: Annotated[Path | None, says(metavar="TRACKS")] = None,
    max_offset_s: float = 2.0,
    bodies: Bodies,
    cache: Cache = None,
    jobs: Jobs = None,
) -> None:
    """Check the calibration of SEQ against the detections of its cameras, before tracking.

    Reports which camera, pair of cameras or file disagrees, by how much, and what to do. It finds a camera that is
    turned, moved or late, has another focal length, or is exchanged with another camera; camera centres that were read
    as translations; millimetres that were read as metres; mirrored axes; a reference that is far from what the
    cameras see. A video is late if its frame i shows what the others show in an earlier frame.

    A fault is named only if it explains the detections clearly better than a sound rig, whose boxes may have
    correlated errors: the middle of a lopsided body's box is not the same point for two cameras. If faults of several
    cameras explain them equally well, as often with two or three cameras, all are listed and none is certain.

    With --tracks, the offset of the reference's clock minimises the mean distance between TRACKS and the reference, to
    a fraction of a frame. Each drone may have a constant lever arm.

    The exit code is 0 if nothing was found, 1 if something was found, and 2 for an error.

    \b
    Examples:
      psotrack doctor my_lab
      psotrack doctor data/Real_Data/R12_D4 --detections blobs --json -
      psotrack doctor data/Real_Data/R12_D4 --tracks tracks.csv --max-offset 10

    Options:
        detections: detections in dl_data, blobs of the foreground, or a folder of files in the layout of dl_data. None:
            yolo where there are some, else blobs.
        bounds_m: bounds of the room in metres. None: far around the cameras, above and below.
        tracks: find the offset between the clocks of SEQ's reference and of its videos instead, from the motion in
            these tracks.
        max_offset_s: largest offset that is tried in seconds, in both directions, with --tracks.
    """
    from psotrack import api
    from psotrack.calibration.clocks import reference_offset
    from psotrack.recordings.datasets import open_recording
    from psotrack.recordings.exchange import read_tracks

    recording = open_recording(sequence, bodies=bodies)
    if tracks is not None:
        estimate = read_tracks(tracks, recording=recording)
        with errors_name(f"{tracks} and {recording.folder}"):
            output.result(reference_offset(recording, estimate, max_offset_s=max_offset_s))
        return
    diagnosis = api.doctor(
        recording,
        detections=detections or detections_of(output, recording),
        bounds_m=bounds_m,
        cache=cache_folder(cache),
        jobs=jobs,
        progress=output.report,
    )
    output.result(diagnosis)
    if output.quiet:
        output.say(*map(str, diagnosis.findings), always=True)
    if diagnosis.findings:
        sys.exit(FOUND)
