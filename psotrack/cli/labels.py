"""`psotrack labels`: sequences with a reference as a data set that detectors are trained on."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.answers import answer, report_to, say
from psotrack.cli.options import FORCE, JOBS, JSON, QUIET, Numbers


@click.command()
@click.argument(
    "sequences", metavar="SEQ [SEQ ...]", nargs=-1, required=True, type=click.Path(path_type=Path)
)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the data set.")
@click.option(
    "--drone-size",
    "drone_size_m",
    type=Numbers(3),
    required=True,
    metavar="X,Y,Z",
    help="Full lengths in metres, along the drone's axes, or the world's where the reference has no orientations.",
)
@click.option(
    "--offset",
    "offset_m",
    type=Numbers(3),
    default=(0.0, 0.0, 0.0),
    metavar="X,Y,Z",
    help="From the reference's point to the drone's middle, along the same axes.  [default: 0,0,0]",
)
@click.option(
    "--every", type=click.IntRange(min=1), default=1, show_default=True, help="Take each so manieth frame."
)
@click.option(
    "--validation", metavar="NAME,...", help="Sequences to validate on, not to train on.  [default: the last]"
)
@click.option(
    "--min-inside",
    type=float,
    default=0.3,
    show_default=True,
    help="Share of a box that must lie in the image.",
)
@click.option(
    "--max-hidden",
    type=float,
    default=0.7,
    show_default=True,
    help="Share of a box that a nearer drone's may cover.",
)
@JOBS
@FORCE
@QUIET
@JSON
def labels(
    sequences: tuple[Path, ...],
    out: Path,
    drone_size_m: tuple[float, float, float],
    offset_m: tuple[float, float, float],
    every: int,
    validation: str | None,
    min_inside: float,
    max_hidden: float,
    jobs: int | None,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Write a YOLO training set from sequences with a reference.

    Writes OUT/images, OUT/labels (a text file per image, `class cx cy w h`) and OUT/data.yaml. Whole sequences are
    trained or validated on, at least one of each: frames of one flight resemble each other too much.

    \b
    Examples:
      psotrack labels data/Simulated_Data/S0* --out yolo --drone-size 0.43,0.43,0.23 --every 5
      psotrack labels R01_D2 R12_D4 --out yolo --drone-size 0.4,0.4,0.2 --offset 0,0,-0.117 --validation R12_D4
    """
    from psotrack.datasets.dpjait import read_sequence
    from psotrack.detection import DATA_SET, LabelSettings, write_data_set

    counts = write_data_set(
        [read_sequence(sequence) for sequence in sequences],
        out,
        LabelSettings(drone_size_m, offset_m, min_inside, max_hidden),
        validation=validation.split(",") if validation else (),
        every=every,
        force=force,
        jobs=jobs,
        report=report_to(quiet),
    )
    answer(json_path, counts, force)
    shown = "; ".join(f"{part}: {of['images']} images, {of['labels']} labels" for part, of in counts.items())
    say(quiet, json_path, f"{out / DATA_SET}: {shown}")
