"""`psotrack detect`: what each camera shows of drones, as boxes, as stored silhouettes or as masks."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from msgspec.structs import replace

from psotrack.cli.commands import OptionGroup, command
from psotrack.cli.options import Extent, Seq, beside, filmed_recording
from psotrack.cli.output import Output
from psotrack.cli.settings import TrackingSettings
from psotrack.cli.types import says
from psotrack.errors import SettingsError
from psotrack.foreground.detection import DetectorSettings
from psotrack.foreground.silhouettes import SilhouetteSettings
from psotrack.settings import TrackSettings

if TYPE_CHECKING:
    from psotrack.recordings import Recording

logger = logging.getLogger(__name__)

#: Image pixels per pixel in which masks are computed: all, because masks are looked at and compared pixel by pixel.
MASKS_REDUCTION = 1


@dataclass(frozen=True)
class DetectOptions:
    """What is written.

    Attributes:
        detector: YOLO network (v5 to v11) that was trained on drones, or the detector that an installed package adds
            under NAME.
        blobs: write the blobs of foreground instead of a network's detections.
        silhouettes: compute and store the silhouettes, which `track` reads.
        masks: write the foreground of every frame at the size of the video, 0 to 255: as FOLDER/CAMERA/000000.png and
            so on, or as one video (.mp4, or .avi without loss).
    """

    detector: Annotated[str | None, says(metavar="MODEL.onnx|NAME")] = None
    blobs: bool = False
    silhouettes: bool = False
    masks: Annotated[Path | None, says(metavar="FOLDER|FILE.mp4")] = None


@command()
def detect(
    output: Output,
    sequence: Seq,
    *,
    what: DetectOptions,
    out: Path | None = None,
    network: Annotated[DetectorSettings, OptionGroup("With --detector")],
    settings: Annotated[
        dict[str, Any],
        TrackingSettings(
            usual=("silhouettes.background", "silhouettes.drone_px"), part="silhouettes.", files=False
        ),
    ],
    extent: Extent,
) -> None:
    """Detect the drones of SEQ in each of its videos as 2D boxes: with a neural network, or as blobs of foreground.

    Writes OUT/CAMERA.csv for every camera, in the layout of the dataset's dl_data; `track --detections OUT` reads them.
    SEQ may also be a single video or a folder of pictures, without any calibration; CAMERA is then its name.

    --blobs takes what moves in a still image, as `track --detections blobs` does; boxes end at pixels of the image that
    the background model sees, unless --reduction is given. --silhouettes and --masks write the foreground itself.
    Silhouettes are stored under a key of the video's content, all settings and the background model: a second call
    finds them.

    \b
    Examples:
      psotrack detect my_lab --blobs
      psotrack detect my_lab --detector drones.onnx --out boxes --size 1280 --confidence 0.4
      psotrack detect pictures/ --blobs --out boxes --min-blob 16
      psotrack detect my_lab --silhouettes --frames 100 --json -
      psotrack detect flight.mp4 --masks flight_mask.mp4

    Options:
        out: folder of the detections. None: SEQ/results/detections.
    """
    wanted = {f"--{name}": value for name, value in vars(what).items()}
    given = [name for name, value in wanted.items() if value]
    if len(given) != 1:
        found = " and ".join(given) or "none of them"
        raise SettingsError("detect", expected=f"one of {', '.join(wanted)}", found=found)
    recording = filmed_recording(sequence, extent)
    if what.masks is not None:
        _write_masks(output, recording, what.masks, settings, extent)
    elif what.silhouettes:
        _store(output, recording, _silhouettes(settings), extent)
    elif what.blobs:
        _write(output, sequence, recording, out, _by_blobs(output, recording, _silhouettes(settings), extent))
    else:
        _write(output, sequence, recording, out, _by_network(output, recording, f"{what.detector}", network))


def _silhouettes(settings: dict[str, Any]) -> SilhouetteSettings:
    return TrackSettings().changed(settings).silhouettes


def _write(output: Output, sequence: Path, recording: Recording, out: Path | None, found: Any) -> None:
    """Write the boxes of each camera as they are found."""
    from psotrack.recordings import write_detections
    from psotrack.support import check_file_name

    out = out or beside(sequence, "detections")
    files = {name: out / f"{check_file_name(name, sequence)}.csv" for name in recording.videos}
    output.refuse(*files.values())
    counts: dict[str, int] = {}
    for name, detections in found:
        write_detections(files[name], detections)
        counts[name] = len(detections)
    if not any(counts.values()):
        logger.warning(
            "%s: not a box in the whole recording; does --detector find drones, at its --size?", out
        )
    frames = sum(video.num_frames for video in recording.videos.values())
    output.json({"out": str(out), "frames": recording.num_frames, "detections": counts})
    per_frame = sum(counts.values()) / frames
    output.say(
        f"{out}: {len(counts)} cameras, {recording.num_frames} frames, {per_frame:.2f} boxes per frame and camera"
    )


def _by_network(output: Output, recording: Recording, chosen: str, network: DetectorSettings) -> Any:
    """Detections of each camera by a network, one camera after the other."""
    from psotrack.foreground.detection import detect_drones, find_detector

    detector = find_detector(chosen, network)
    for name, video in recording.videos.items():
        yield name, detect_drones(detector, name, video, report=output.report)


def _by_blobs(output: Output, recording: Recording, settings: SilhouetteSettings, extent: Extent) -> Any:
    """Detections of each camera by the blobs of its silhouettes."""
    import numpy as np

    from psotrack.foreground.silhouettes import blob_detections, compute

    sizes_wh = [video.image_size_wh for video in recording.videos.values()]
    if settings.reduction is None:
        # The boxes are as fine as the images allow, not as coarse as the tracker can do with.
        working = settings.scaled(sizes_wh).working_reduction
        settings = replace(settings, reduction=working, working_reduction=working)
    made = compute(recording, settings, cache=extent.silhouettes, jobs=extent.jobs, report=output.report)
    sizes = np.array([recording.videos[name].image_size_wh for name in made.cameras], float)
    yield from blob_detections(made, sizes, output.report).items()


def _store(output: Output, recording: Recording, settings: SilhouetteSettings, extent: Extent) -> None:
    """Compute and store silhouettes."""
    from psotrack.foreground.silhouettes import compute

    where = extent.silhouettes
    stored = compute(recording, settings, cache=where, jobs=extent.jobs, report=output.report)
    output.json(
        {
            "cache": str(where),
            "keys": dict(stored.keys),
            "frames": stored.num_frames,
            "shape": list(stored.shape),
            "seconds": dict(stored.seconds),
        }
    )
    made = "made" if any(stored.seconds.values()) else "already there"
    output.say(f"{len(stored.cameras)} cameras, {stored.num_frames} frames: {made}, in {where}")


def _write_masks(
    output: Output, recording: Recording, out: Path, settings: dict[str, Any], extent: Extent
) -> None:
    """Write the masks of all cameras, whose stored size plays no part."""
    from psotrack.foreground.silhouettes import write_masks

    working = settings.get("silhouettes.working_reduction", MASKS_REDUCTION)
    sizes = {"silhouettes.working_reduction": working, "silhouettes.reduction": working}
    places = write_masks(
        recording,
        _silhouettes(settings | sizes),
        out,
        jobs=extent.jobs,
        force=output.force,
        report=output.report,
    )
    frames = {name: recording.videos[name].num_frames for name in places}
    output.json({"masks": frames, "files": {name: str(path) for name, path in places.items()}})
    output.say(f"{out}: {sum(frames.values())} masks of {len(places)} cameras")
