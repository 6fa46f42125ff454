"""`psotrack silhouettes`: compute and store the silhouettes of a sequence, or write them as masks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psotrack.cli.options import (
    CACHE,
    CAMERAS,
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
from psotrack.foreground.silhouettes import SilhouetteSettings

if TYPE_CHECKING:
    from psotrack.recordings import Recording

#: Image pixels per pixel in which masks are computed: all, because masks are looked at and compared pixel by pixel.
MASKS_REDUCTION = 1


@click.command()
@SEQUENCE
@click.option(
    "--masks",
    "masks_path",
    type=click.Path(path_type=Path),
    metavar="FOLDER|FILE.mp4",
    help="Write the foreground of every frame at the size of the video, 0 to 255, instead of storing silhouettes: as "
    "FOLDER/CAMERA/000000.png and so on, or as one video (.mp4, or .avi without loss).",
)
@click.option(
    "--working-reduction",
    type=int,
    default=None,
    metavar="N",
    help="Image pixels per pixel in which the foreground is computed.  [default: "
    f"{MASKS_REDUCTION} for --masks, else from --drone-px]",
)
@silhouette_options
@CAMERAS
@frames_option
@CACHE
@JOBS
@reporting
@FORCE
@JSON
def silhouettes(
    sequence: Path,
    masks_path: Path | None,
    working_reduction: int | None,
    cameras: str | None,
    num_frames: int | None,
    cache: Path | None,
    jobs: int | None,
    quiet: bool,
    force: bool,
    json_path: Path | None,
    **settings: Any,
) -> None:
    """Compute and store the silhouettes of SEQ, which `track` reads, or write them as images or as a video.

    SEQ may also be a single video or a folder of pictures, without any calibration. CAMERA is the name of the camera in
    the recording, or the name of the video.

    Silhouettes are stored under a key of the video's content, all settings and the background model. A second call
    finds the stored silhouettes; with a changed setting new silhouettes are computed.

    \b
    Examples:
      psotrack silhouettes data/Simulated_Data/S02_D4_A
      psotrack silhouettes data/Simulated_Data/S02_D4_A --frames 100 --json -
      psotrack silhouettes data/Simulated_Data/S02_D4_A --masks masks
      psotrack silhouettes flight.mp4 --masks flight_mask.mp4
      psotrack silhouettes pictures/ --masks masks --background mog2 --min-blob 16
    """
    from psotrack.foreground.silhouettes import compute

    recording = filmed_recording(sequence, cameras, num_frames)
    if masks_path is not None:
        chosen = _settings_of_masks(working_reduction, settings)
        content = _write_masks(recording, masks_path, chosen, jobs, quiet, force)
        output_json(json_path, content, force)
        total = sum(content["masks"].values())
        print_line(quiet, json_path, f"{masks_path}: {total} masks of {len(content['masks'])} cameras")
        return
    if working_reduction is not None:
        settings["working_reduction"] = working_reduction
    where, chosen = cache_folder(cache), SilhouetteSettings(**settings)
    stored = compute(
        recording,
        chosen,
        cache=where,
        jobs=jobs,
        report=report_to(quiet),
    )
    content = {
        "cache": str(where),
        "keys": dict(stored.keys),
        "frames": stored.num_frames,
        "shape": list(stored.shape),
        "seconds": dict(stored.seconds),
    }
    output_json(json_path, content, force)
    made = "made" if any(stored.seconds.values()) else "already there"
    print_line(
        quiet, json_path, f"{len(stored.cameras)} cameras, {stored.num_frames} frames: {made}, in {where}"
    )


def _settings_of_masks(working_reduction: int | None, settings: dict[str, Any]) -> SilhouetteSettings:
    """Settings of masks, whose stored size plays no part."""
    working = MASKS_REDUCTION if working_reduction is None else working_reduction
    return SilhouetteSettings(**{**settings, "working_reduction": working, "reduction": working})


def _write_masks(
    recording: Recording,
    out: Path,
    settings: SilhouetteSettings,
    jobs: int | None,
    quiet: bool,
    force: bool,
) -> dict[str, Any]:
    """Write the masks of all cameras; returns what was written, as JSON."""
    from psotrack.foreground.silhouettes import write_masks

    places = write_masks(recording, settings, out, jobs=jobs, force=force, report=report_to(quiet))
    return {
        "masks": {name: recording.videos[name].num_frames for name in places},
        "files": {name: str(path) for name, path in places.items()},
    }
