"""`psotrack simulate labels`: write a training set for detectors from sequences with a reference."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from psotrack.cli.commands import command
from psotrack.cli.options import Jobs
from psotrack.cli.output import Output
from psotrack.cli.types import says
from psotrack.foreground.detection import LabelSettings


@command()
def labels(
    output: Output,
    sequences: Annotated[tuple[Path, ...], says(metavar="SEQ [SEQ ...]")],
    *,
    out: Path = Path("yolo"),
    settings: LabelSettings,
    validation: tuple[str, ...] | None = None,
    jobs: Jobs = None,
) -> None:
    """Write a YOLO training set from sequences with a reference.

    Writes OUT/images, OUT/labels (a text file per image, `class cx cy w h`) and OUT/data.yaml. Every
    sequence is used either for training or for validation, because frames of one flight resemble each other too much.
    At least two sequences are needed.

    \b
    Examples:
      psotrack simulate labels data/Simulated_Data/S0* --out yolo --drone-size 0.43,0.43,0.23 --every 5
      psotrack simulate labels R01_D2 R12_D4 --out yolo --drone-size 0.4,0.4,0.2 --offset 0,0,-0.117 --validation R12_D4

    Options:
        out: folder of the training set.
        validation: sequences for validation, not for training. None: the last sequence.
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
