"""`psotrack overlay`: videos with what was found drawn into them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from msgspec import Meta

from psotrack.cli.commands import command
from psotrack.cli.options import Extent, SeqOfTracks, sequence_of
from psotrack.cli.output import Output


@command(without=["json_path"])
def overlay(
    output: Output,
    tracks: Path,
    sequence: SeqOfTracks = None,
    *,
    out: Path | None = None,
    mosaic: bool = False,
    scale: Annotated[float, Meta(gt=0, le=4)] = 1.0,
    extent: Extent,
) -> None:
    """Draw TRACKS into the videos of SEQ: boxes, names, trails, 90 % ellipses and time.

    SEQ is the recording of TRACKS; the record beside TRACKS names it. Finished videos of the same TRACKS are kept, so
    that a run that was interrupted can be continued.

    \b
    Examples:
      psotrack overlay my_lab/results/tracks.csv
      psotrack overlay tracks.csv my_lab --out videos --mosaic
      psotrack overlay tracks.csv my_lab --out videos --cameras cam1,cam2 --scale 0.5

    Options:
        out: folder of the videos, CAMERA.mp4. None: overlay beside TRACKS.
        mosaic: write one video of all cameras with a map from above, mosaic.mp4, instead of a video per camera.
        scale: size of the videos per size of the cameras' videos; the mosaic is 1920 pixels wide.
    """
    from psotrack import api

    written = api.overlay(
        tracks,
        out,
        recording=sequence_of(tracks, sequence),
        cameras=extent.cameras,
        num_frames=extent.num_frames,
        jobs=extent.jobs,
        progress=output.report,
        mosaic=mosaic,
        scale=scale,
        force=output.force,
    )
    output.say(f"{written}")
