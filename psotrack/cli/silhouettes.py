"""`psotrack silhouettes`: compute and store the silhouettes of a sequence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from psotrack.cli.options import (
    BACKGROUND,
    CACHE,
    CAMERAS,
    FORCE,
    JOBS,
    JSON,
    QUIET,
    SEQUENCE,
    cache_folder,
    frames_option,
    silhouette_options,
    usable_recording,
)
from psotrack.cli.output import output_json, print_line, report_to
from psotrack.silhouettes import SilhouetteSettings


@click.command()
@SEQUENCE
@silhouette_options
@BACKGROUND
@CAMERAS
@frames_option
@CACHE
@JOBS
@QUIET
@FORCE
@JSON
def silhouettes(
    sequence: Path,
    cameras: str | None,
    num_frames: int | None,
    cache: Path | None,
    jobs: int | None,
    quiet: bool,
    force: bool,
    json_path: Path | None,
    background: str,
    **settings: Any,
) -> None:
    """Compute and store the silhouettes of SEQ, which `track` reads.

    Silhouettes are stored under a key of the video's content, all settings and the background model. A second call
    finds the stored silhouettes; with a changed setting new silhouettes are computed.

    \b
    Examples:
      psotrack silhouettes data/Simulated_Data/S02_D4_A
      psotrack silhouettes data/Simulated_Data/S02_D4_A --shadows drop --json -
    """
    from psotrack.silhouettes import compute, find_background

    where, chosen = cache_folder(cache), SilhouetteSettings(**settings)
    stored = compute(
        usable_recording(sequence, cameras, num_frames),
        chosen,
        cache=where,
        jobs=jobs,
        background=find_background(background, chosen),
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
