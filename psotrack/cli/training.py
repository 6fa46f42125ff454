"""`psotrack train`: a network that finds drones, from recordings whose drones are known."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

from psotrack import support
from psotrack.cli.commands import command
from psotrack.cli.options import Cache, Jobs, cache_folder, compiled_folder
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.types import says
from psotrack.foreground.learning.settings import TrainSettings
from psotrack.foreground.network.names import MODEL_SUFFIX

logger = logging.getLogger(__name__)


@command()
def train(
    output: Output,
    sequences: Annotated[tuple[Path, ...], says(metavar="SEQ [SEQ ...]")],
    *,
    out: Path = Path("drones.model"),
    settings: TrainSettings,
    cache: Cache = None,
    jobs: Jobs = None,
) -> None:
    """Train a network that finds drones, on sequences whose drones are known.

    Simulated sequences have masks of their drones. With --from-tracks the network learns from recordings of your own:
    where SEQ/results/tracks.csv has a drone, the foreground near it is the drone, and all else is not; --start network
    begins with the network that comes with the package, which takes minutes. SEQ may also be the folder of a YOLO data
    set, with its own part for validation.

    The network sees a reduced frame and the learned background of its camera, and tells for each pixel whether the
    pixel shows a drone, and the boxes of the drones. After each epoch a line tells how well it does on the sequences
    for validation, OUT.png shows what it finds in them, and the state is kept: the same command goes on after an
    interruption. OUT is the network of the best epoch; `track --background OUT` and `detect --detector OUT` use it. The
    defaults take an hour on two processors.

    \b
    Examples:
      psotrack train data/Simulated_Data/S0* --out drones.model
      psotrack train data/Simulated_Data/S0* --out drones.model --validation S02_D4_A,S04_D10 --epochs 20
      psotrack train monday tuesday --from-tracks --start network --epochs 4 --steps 100 --out lab.model
      psotrack track my_lab --background drones.model

    Options:
        out: file of the network; it ends in .model.
    """
    from psotrack.foreground import learning

    check_suffix("--out", out, MODEL_SUFFIX)
    output.refuse(out)
    support.keep_compiled(compiled_folder(cache))
    model = learning.train_on_sequences(
        sequences,
        out,
        settings,
        cache=cache_folder(cache),
        jobs=jobs,
        report=output.report,
        say=output.say,
    )
    found = model.card["validation"]
    output.json(dict(model.card))
    output.say(
        f"{out}: best of {len(model.card['epochs'])} epochs is {model.card['best_epoch']}: pixel F "
        f"{found['pixel_f']:.2f}, recall {found['recall']:.2f} at {found['false_per_frame']:.2f} false boxes per frame"
    )
