"""`psotrack detect`: drones in videos as 2D boxes, by a neural network or as blobs of foreground."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from msgspec.structs import replace

from psotrack.cli.options import (
    CACHE,
    CAMERAS,
    DETECTOR_SIZE,
    FORCE,
    JOBS,
    JSON,
    SEQUENCE,
    cache_folder,
    filmed_recording,
    frames_option,
    reporting,
    silhouette_options,
)
from psotrack.cli.output import output_json, print_line, report_to
from psotrack.errors import SettingsError
from psotrack.foreground.silhouettes import SilhouetteSettings

if TYPE_CHECKING:
    from psotrack.recordings import Detections, Recording


@click.command()
@SEQUENCE
@click.option(
    "--detector",
    "chosen",
    metavar="MODEL.onnx|NAME",
    help="YOLO network (v5 to v11) that was trained on drones, or the detector that an installed package adds under "
    "NAME.",
)
@click.option(
    "--blobs", is_flag=True, help="Write the blobs of foreground instead of a network's detections."
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
@silhouette_options
@CAMERAS
@frames_option
@CACHE
@JOBS
@FORCE
@reporting
@JSON
def detect(
    sequence: Path,
    chosen: str | None,
    blobs: bool,
    out: Path,
    confidence: float,
    nms: float,
    size: int,
    cameras: str | None,
    num_frames: int | None,
    cache: Path | None,
    jobs: int | None,
    force: bool,
    quiet: bool,
    json_path: Path | None,
    **settings: Any,
) -> None:
    """Detect the drones of SEQ in each of its videos as 2D boxes: with a neural network, or as blobs of foreground.

    Writes OUT/CAMERA.csv for every camera, in the layout of the dataset's dl_data; `track --detections OUT` reads them.
    SEQ may also be a single video or a folder of pictures, without any calibration; CAMERA is then its name.

    --blobs takes what moves in a still image, as `track --detections blobs` does; the options of `psotrack silhouettes`
    apply, but boxes end at pixels of the image that the background model sees, unless --reduction is given. The others
    are those of the network.

    \b
    Examples:
      psotrack detect data/Simulated_Data/S02_D4_A --detector drones.onnx --out boxes
      psotrack detect data/Real_Data/R12_D4 --detector drones.onnx --out boxes --size 1280 --confidence 0.4
      psotrack detect data/Simulated_Data/S02_D4_A --blobs --out boxes
      psotrack detect flight.mp4 --blobs --out boxes
      psotrack detect pictures/ --blobs --out boxes --min-blob 16
    """
    from psotrack.recordings import write_detections
    from psotrack.support import check_file_name, refuse_to_overwrite

    if blobs == (chosen is not None):
        raise SettingsError(
            "detect", expected="--detector MODEL.onnx or --blobs", found="both" if blobs else "neither"
        )
    recording = filmed_recording(sequence, cameras, num_frames)
    files = {name: out / f"{check_file_name(name, sequence)}.csv" for name in recording.videos}
    for path in files.values():
        refuse_to_overwrite(path, force)
    counts: dict[str, int] = {}
    found = (
        _by_blobs(recording, SilhouetteSettings(**settings), cache, jobs, quiet)
        if chosen is None
        else _by_network(recording, chosen, confidence, nms, size, quiet)
    )
    for name, detections in found:
        write_detections(files[name], detections)
        counts[name] = len(detections)
    frames = sum(video.num_frames for video in recording.videos.values())
    output_json(json_path, {"out": str(out), "frames": recording.num_frames, "detections": counts}, force)
    per_frame = sum(counts.values()) / frames
    print_line(
        quiet,
        json_path,
        f"{out}: {len(counts)} cameras, {recording.num_frames} frames, {per_frame:.2f} boxes per frame and camera",
    )


def _by_network(
    recording: Recording, chosen: str, confidence: float, nms: float, size: int, quiet: bool
) -> Any:
    """Detections of each camera by a network, one camera after the other."""
    from psotrack.foreground.detection import DetectorSettings, detect_drones, find_detector

    detector = find_detector(chosen, DetectorSettings(confidence, nms, size))
    for name, video in recording.videos.items():
        yield name, detect_drones(detector, name, video, report=report_to(quiet))


def _by_blobs(
    recording: Recording,
    settings: SilhouetteSettings,
    cache: Path | None,
    jobs: int | None,
    quiet: bool,
) -> list[tuple[str, Detections]]:
    """Detections of each camera by the blobs of its silhouettes."""
    from psotrack.foreground.silhouettes import blob_detections, compute

    sizes_wh = [video.image_size_wh for video in recording.videos.values()]
    if settings.reduction is None:
        # The boxes are as fine as the images allow, not as coarse as the tracker can do with.
        working = settings.scaled(sizes_wh).working_reduction
        settings = replace(settings, reduction=working, working_reduction=working)
    made = compute(recording, settings, cache=cache_folder(cache), jobs=jobs, report=report_to(quiet))
    sizes = np.array([recording.videos[name].image_size_wh for name in made.cameras], float)
    return list(blob_detections(made, sizes, report_to(quiet)).items())
