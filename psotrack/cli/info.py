"""`psotrack info`: show the contents of a sequence."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import BODIES, FORCE, JSON, SEQUENCE
from psotrack.cli.output import output_json, print_inventory


@click.command()
@SEQUENCE
@BODIES
@FORCE
@JSON
def info(sequence: Path, bodies: dict[str, tuple[str, ...]], force: bool, json_path: Path | None) -> None:
    """Show what SEQ contains, and check all of its files, of the videos only the last frame.

    SEQ is a recording.toml, a folder that holds one, or a folder of the DPJAIT dataset.

    \b
    Examples:
      psotrack info data/Simulated_Data/S02_D4_A
      psotrack info flight/recording.toml
      psotrack info flight --body cf1=M1,M2,M3,M4
    """
    from psotrack.recordings import check_end, inventory_table
    from psotrack.recordings.datasets import open_recording

    recording = open_recording(sequence, bodies=bodies)
    for video in recording.videos.values():
        check_end(video)
    recording.check_detections(recording.detections or {})
    if recording.marker_corners is not None:
        from psotrack.inside_out import read_marker_table

        read_marker_table(recording.marker_corners)
    content = recording.to_dict()
    output_json(json_path, content, force)
    if json_path != Path("-"):
        print_inventory(inventory_table(content))
