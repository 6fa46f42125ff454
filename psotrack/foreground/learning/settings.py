"""Settings of a training. Importing this module is fast: `--help` needs the defaults."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from psotrack.support import check_types


class TrainSettings(msgspec.Struct, frozen=True):
    """Settings of a training.

    Attributes:
        validation: names of the sequences for validation, not for training. None: the last sequence.
        from_tracks: whether SEQ/results/tracks.csv says where the drones are, and the foreground which pixels they
            cover; else the masks of simulated sequences say both.
        start: "network", or a file of `psotrack train`: the network that goes on learning. None: one that knows
            nothing.
        per_camera: largest number of frames of each camera that are learned, spread over its video.
        epochs: largest number of epochs; the network of the best one is kept.
        steps: steps of an epoch.
        batch: parts of frames in a step.
        part_px: height and width of the parts, pixels of the reduced frames; a multiple of 8.
        learning_rate: largest learning rate of AdamW.
        patience: number of epochs without a better loss after which the training ends.
        seed: seed of the first network and of all random changes.

    Raises:
        SettingsError: a value is out of range.
    """

    validation: tuple[str, ...] | None = None
    from_tracks: bool = False
    start: str | None = None
    per_camera: Annotated[int, Meta(ge=2)] = 40
    epochs: Annotated[int, Meta(ge=1)] = 20
    steps: Annotated[int, Meta(ge=1)] = 350
    batch: Annotated[int, Meta(ge=1)] = 16
    part_px: Annotated[int, Meta(ge=32, multiple_of=8)] = 192
    learning_rate: Annotated[float, Meta(gt=0)] = 2e-3
    patience: Annotated[int, Meta(ge=1)] = 10
    seed: Annotated[int, Meta(ge=0)] = 0

    def __post_init__(self) -> None:
        check_types(self)
