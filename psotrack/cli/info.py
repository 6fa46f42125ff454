"""`psotrack info`: what a sequence holds."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.answers import answer
from psotrack.cli.options import FORCE, JSON, SEQUENCE


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
    from psotrack.recordings import describe_sequence, inventory_table

    content = describe_sequence(read_sequence(sequence))
    answer(json_path, content, force)
    if json_path != Path("-"):
        Console().print(inventory_table(content))
