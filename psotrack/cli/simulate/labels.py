"""`psotrack simulate labels`: write a training set for detectors from sequences with a reference."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import FORCE, JOBS, JSON, out_option, reporting
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import HelpfulCommand
from psotrack.cli.types import Numbers


@click.command(cls=HelpfulCommand)
@click.argument(
    "sequences", metavar="SEQ [SEQ ...]", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@out_option("Folder of the training set.", default=Path("yolo"), show_default=True)
@click.option(
    "--drone-size",
    "drone_size_m",
    type=Numbers(3),
    required=True,
    metavar="X,Y,Z",
    help="Full lengths in metres along the drone's axes; along the world's axes if the reference has no orientations.",
)
@click.option(
    "--offset",
    "offset_m",
    type=Numbers(3),
    default=(0.0, 0.0, 0.0),
    metavar="X,Y,Z",
    help="Vector from the reference's point to the drone's middle, along the same axes, in metres.  [default: 0,0,0]",
)
@click.option(
    "--every",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Step between the frames that are used.",
)
@click.option(
    "--validation",
    metavar="NAME,...",
    help="Sequences for validation, not for training.  [default: the last sequence]",
)
@click.option(
    "--min-inside",
    type=float,
    default=0.3,
    show_default=True,
    help="Smallest share of a box inside the image.",
)
@click.option(
    "--max-hidden",
    type=float,
    default=0.7,
    show_default=True,
    help="Largest share of a box that the box of a nearer drone covers.",
)
@JOBS
@FORCE
@reporting
@JSON
@pass_output
def labels(
    output: Output,
    sequences: tuple[Path, ...],
    out: Path,
    drone_size_m: tuple[float, float, float],
    offset_m: tuple[float, float, float],
    every: int,
    validation: str | None,
    min_inside: float,
    max_hidden: float,
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
    from psotrack.foreground.detection import DATA_SET, LabelSettings, write_data_set
    from psotrack.recordings.datasets import open_recording

    counts = write_data_set(
        [open_recording(sequence) for sequence in sequences],
        out,
        LabelSettings(drone_size_m, offset_m, min_inside, max_hidden, every),
        validation=validation.split(",") if validation else (),
        force=output.force,
        jobs=jobs,
        report=output.report,
    )
    output.json(counts)
    shown = "; ".join(f"{part}: {of['images']} images, {of['labels']} labels" for part, of in counts.items())
    output.say(f"{out / DATA_SET}: {shown}")
