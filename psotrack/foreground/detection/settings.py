"""Settings of detectors and of training data. Importing this module is fast: `--help` needs the defaults."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from psotrack.support import Positive, Share, check_types

#: Layouts of a network's output (see `psotrack.foreground.detection.detector`).
Layout = Literal["v5", "v8", "corners", "middles", "yolox"]


class DetectorSettings(msgspec.Struct, frozen=True):
    """Settings of the detection.

    Attributes:
        confidence: smallest score of a detection that is kept, in (0, 1].
        nms: intersection over union above which two boxes are taken for one drone, in (0, 1]; the one with the higher
            score is kept.
        size: side of the network's square input, in pixels.
        layout: layout of the network's output: "v5", middle and size, confidence of any object and of each class; "v8",
            the same without that of any object; "corners" or "middles", a box, its confidence and class; "yolox",
            as YOLOX exports it. None: told by the output's shape and content.

    Raises:
        SettingsError: a value is out of range.
    """

    confidence: Annotated[float, Meta(gt=0, le=1)] = 0.25
    nms: Annotated[float, Meta(gt=0, le=1)] = 0.45
    size: Annotated[int, Meta(ge=1)] = 640
    layout: Layout | None = None

    def __post_init__(self) -> None:
        check_types(self)


class LabelSettings(msgspec.Struct, frozen=True):
    """Settings of the labels.

    Attributes:
        drone_size_m: full lengths of a drone's box along the body's axes, metres; along the world's axes if the
            reference has no orientations.
        offset_m: vector from the reference's tracked point to the middle of the box, along the same axes, metres.
        min_inside: smallest share of a box that must lie in the image.
        max_hidden: largest share of the visible box that one nearer box may cover.
        every: step between the frames that are used.

    Raises:
        SettingsError: a value is out of range.
    """

    drone_size_m: tuple[Positive, Positive, Positive]
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    min_inside: Share = 0.3
    max_hidden: Share = 0.7
    every: Annotated[int, Meta(ge=1)] = 1

    def __post_init__(self) -> None:
        check_types(self)
