"""A trained network as background model: the network tells where drones are, and together with "living" which pixels.

"living" tells contours sharply, but is blind for parts that look like the background and for drones that it has learned
as background, and knows people and leaves as foreground. In and near each box that the network finds, the foreground is
what either of both tells; elsewhere there is none. A box in which "living" sees something too needs less confidence.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from psotrack.foreground.network import FINDING_VERSION, USUAL_CONFIDENCE, findings, model_at
from psotrack.foreground.silhouettes.foreground import OwnBackground, learned_mog2, remove_speckle
from psotrack.foreground.silhouettes.living_background import Living
from psotrack.support import digest_file

#: Pixels count whose probability is at least this share. Those of a smaller one are a rim about the drone, which made
#: errors larger on simulated flights.
_LEAST_SHARE = 0.5
#: Least confidence of a box in which "living" sees more than this share of the pixels; of other boxes it is the usual
#: one. Both were chosen on the clips and flights of `experiments/accuracy/foreground.py`.
_SEEN_CONFIDENCE, _SEEN_SHARE = 0.2, 0.02
#: Pixels this share of a box's length beside the box are its drone's, too.
_MARGIN = 0.2

_Image = UInt8[np.ndarray, "height width 3"]
_Mask = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True)
class NetworkBackground(OwnBackground):
    """A trained network together with the background model "living"; see the module.

    Attributes:
        settings: settings of the foreground; those that `Living` uses.
        model: the file of the network.
    """

    model: Path

    @property
    def key(self) -> Mapping[str, Any]:
        """See `BackgroundModel`."""
        return {
            "network": 6,
            "finding": FINDING_VERSION,
            "model": digest_file(self.model),
            **Living(self.settings).key,
        }

    def masks(
        self, learning: Iterable[tuple[float, _Image]], frames: Iterable[_Image]
    ) -> Iterator[_Mask | None]:
        """See `OwnBackground`."""
        network, settings = model_at(self.model).network, self.settings
        seen = [(weight, np.asarray(image)) for weight, image in learning]
        background = learned_mog2(seen, settings).getBackgroundImage()
        least_px = math.ceil(settings.min_blob_px / settings.working_reduction**2)
        here, there = itertools.tee(frames)
        for image, differs in zip(here, Living(settings).masks(seen, there), strict=True):
            if differs is None:
                yield None
                continue
            share, boxes, confidence = findings(network, image, background, _SEEN_CONFIDENCE)
            seen_too = [
                (differs[part] >= 128).sum() > _SEEN_SHARE * differs[part].size for part in _parts(boxes)
            ]
            counts = (confidence >= USUAL_CONFIDENCE) | np.array(seen_too, bool)
            yield remove_speckle(_foreground(share, differs, boxes[counts]), least_px)


def _parts(boxes: Float[np.ndarray, "found 4"]) -> list[tuple[slice, slice]]:
    """The pixels of boxes, xyxy, as indices of an image."""
    return [np.s_[y0:y1, x0:x1] for x0, y0, x1, y1 in np.maximum(np.round(boxes), 0).astype(int)]


def _foreground(
    share: Float[np.ndarray, "height width"], differs: _Mask, boxes: Float[np.ndarray, "found 4"]
) -> _Mask:
    """The foreground in and near boxes, 0 to 255.

    Args:
        share: probability of "drone" of each pixel.
        differs: foreground by "living".
        boxes: xyxy, pixels.
    """
    margin = np.tile(_MARGIN * (boxes[:, 2:] - boxes[:, :2]) + 1, 2) * [-1, -1, 1, 1]
    told = np.where(share >= _LEAST_SHARE, np.round(255 * share), 0).astype(np.uint8)
    either, kept = np.maximum(differs, told), np.zeros_like(differs)
    for near in _parts(boxes + margin):
        kept[near] = either[near]
    return kept
