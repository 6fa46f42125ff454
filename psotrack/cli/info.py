"""`psotrack info`: show the contents of a sequence."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import FORCE, JSON, SEQUENCE
from psotrack.cli.output import output_json


@click.command()
@SEQUENCE
@FORCE
@JSON
def info(sequence: Path, force: bool, json_path: Path | None) -> None:
    """Show what SEQ contains, and check all of its files but the frames of the videos.

    \b
    Example:
      psotrack info data/Simulated_Data/S02_D4_A
    """
    from rich.console import Console

    from psotrack.datasets.dpjait import read_sequence
    from psotrack.recordings import describe_recording, inventory_table

    content = describe_recording(read_sequence(sequence))
    output_json(json_path, content, force)
    if json_path != Path("-"):
        Console().print(inventory_table(content))
