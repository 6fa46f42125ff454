"""`psotrack detect`: detect drones in the videos of a sequence with a neural network."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import (
    CAMERAS,
    DETECTOR_SIZE,
    FORCE,
    JSON,
    QUIET,
    SEQUENCE,
    frames_option,
    usable_recording,
)
from psotrack.cli.output import output_json, print_line, report_to


@click.command()
@SEQUENCE
@click.option(
    "--detector",
    "chosen",
    required=True,
    metavar="MODEL.onnx|NAME",
    help="YOLO network (v5 to v11) that was trained on drones, or the detector that an installed package adds under "
    "NAME.",
)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the detections.")
@click.option(
    "--confidence",
    type=float,
    default=0.25,
    show_default=True,
    help="Smallest score of a detection that is kept.",
)
@click.option(
    "--nms",
    type=float,
    default=0.45,
    show_default=True,
    help="Intersection over union above which two boxes are taken for one drone.",
)
@click.option(
    "--size",
    type=int,
    default=DETECTOR_SIZE,
    show_default=True,
    help="Side of the network's square input, in pixels.",
)
@CAMERAS
@frames_option
@FORCE
@QUIET
@JSON
def detect(
    sequence: Path,
    chosen: str,
    out: Path,
    confidence: float,
    nms: float,
    size: int,
    cameras: str | None,
    num_frames: int | None,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Detect the drones of SEQ in each of its videos with a neural network, as 2D boxes.

    Writes OUT/CAMERA.csv for every camera, in the layout of the dataset's dl_data.

    \b
    Examples:
      psotrack detect data/Simulated_Data/S02_D4_A --detector drones.onnx --out boxes
      psotrack detect data/Real_Data/R12_D4 --detector drones.onnx --out boxes --size 1280 --confidence 0.4
    """
    from psotrack.detection import DetectorSettings, find_detector
    from psotrack.detection import detect_drones as detect_in
    from psotrack.recordings import write_detections
    from psotrack.support import refuse_to_overwrite

    detector = find_detector(chosen, DetectorSettings(confidence, nms, size))
    recording = usable_recording(sequence, cameras, num_frames)
    files = {name: out / f"{name}.csv" for name in recording.videos}
    for path in files.values():
        refuse_to_overwrite(path, force)
    counts: dict[str, int] = {}
    for name, video in recording.videos.items():
        detections = detect_in(detector, name, video, report=report_to(quiet))
        write_detections(files[name], detections)
        counts[name] = len(detections)
    output_json(json_path, {"out": str(out), "frames": recording.num_frames, "detections": counts}, force)
    per_frame = sum(counts.values()) / (len(counts) * recording.num_frames)
    print_line(
        quiet,
        json_path,
        f"{out}: {len(counts)} cameras, {recording.num_frames} frames, {per_frame:.2f} boxes per frame and camera",
    )
