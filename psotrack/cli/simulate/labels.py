"""`psotrack simulate labels`: write a training set for detectors from sequences with a reference."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import JOBS, out_option, running
from psotrack.cli.output import Output
from psotrack.cli.records import HelpfulCommand, options_of
from psotrack.cli.types import Names
from psotrack.foreground.detection import LabelSettings


@click.command(cls=HelpfulCommand)
@click.argument(
    "sequences", metavar="SEQ [SEQ ...]", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@out_option("Folder of the training set.", default=Path("yolo"), show_default=True)
@options_of(LabelSettings, "settings")
@click.option(
    "--validation",
    type=Names(),
    help="Sequences for validation, not for training.  [default: the last sequence]",
)
@JOBS
@running()
def labels(
    output: Output,
    sequences: tuple[Path, ...],
    out: Path,
    settings: LabelSettings,
    validation: tuple[str, ...] | None,
    jobs: int | None,
) -> None:
    """Write a YOLO training set from sequences with a reference.

    Writes OUT/images, OUT/labels (a text file per image, `class cx cy w h`) and OUT/data.yaml. Every
    sequence is used either for training or for validation, because frames of one flight resemble each other too much.
    At least two sequences are needed.

    \b
    Examples:
      psotrack simulate labels data/Simulated_Data/S0* --out yolo --drone-size 0.43,0.43,0.23 --every 5
      psotrack simulate labels R01_D2 R12_D4 --out yolo --drone-size 0.4,0.4,0.2 --offset 0,0,-0.117 --validation R12_D4
    """
    from psotrack.foreground.detection import DATA_SET, write_data_set
    from psotrack.recordings.datasets import open_recording

    counts = write_data_set(
        [open_recording(sequence) for sequence in sequences],
        out,
        settings,
        validation=validation or (),
        force=output.force,
        jobs=jobs,
        report=output.report,
    )
    output.json(counts)
    shown = "; ".join(f"{part}: {of['images']} images, {of['labels']} labels" for part, of in counts.items())
    output.say(f"{out / DATA_SET}: {shown}")
