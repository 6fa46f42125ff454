"""A trained network as background model: the probability that a pixel shows a drone is the foreground."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from psotrack.foreground.network import findings, model_at
from psotrack.foreground.silhouettes.foreground import OwnBackground, learned_mog2, remove_speckle
from psotrack.foreground.silhouettes.lighting import compare, light_of
from psotrack.support import digest_file

#: Probabilities below this share are no foreground: they are everywhere, and mean nothing.
_LEAST_SHARE = 0.1

_Image = UInt8[np.ndarray, "height width 3"]
_Mask = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True)
class NetworkBackground(OwnBackground):
    """A trained network as background model: each pixel has the probability that it shows a drone.

    Attributes:
        settings: settings of the foreground; `working_reduction`, `num_learning_frames` and `min_blob_px` are used.
        model: the file of the network.
    """

    model: Path

    @property
    def key(self) -> Mapping[str, Any]:
        """See `BackgroundModel`."""
        used = ("working_reduction", "num_learning_frames", "min_blob_px")
        settings = {name: getattr(self.settings, name) for name in used}
        return {"network": 1, "model": digest_file(self.model), **settings}

    def masks(
        self, learning: Iterable[tuple[float, _Image]], frames: Iterable[_Image]
    ) -> Iterator[_Mask | None]:
        """See `OwnBackground`."""
        network, settings = model_at(self.model).network, self.settings
        background = learned_mog2(learning, settings).getBackgroundImage()
        least_px = math.ceil(settings.min_blob_px / settings.working_reduction**2)
        light = light_of(background)
        for image in frames:
            if math.isinf(compare(image, light).log_gain):
                yield None
                continue
            share, _, _ = findings(network, image, background)
            mask = np.where(share >= _LEAST_SHARE, np.round(255 * share), 0).astype(np.uint8)
            yield remove_speckle(mask, least_px)
