"""A trained network as detector of boxes."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import UInt8

from psotrack.foreground.detection.detector import FoundBoxes, usable_boxes
from psotrack.foreground.detection.settings import DetectorSettings
from psotrack.foreground.network import FINDING_VERSION, findings, model_at
from psotrack.foreground.silhouettes import ForegroundSettings, learned_mog2, learning_step, reduce_frame
from psotrack.recordings import VideoInfo, read_frames
from psotrack.support import digest_file

_Image = UInt8[np.ndarray, "height width 3"]


class NetworkDetector:
    """A trained network as detector.

    Args:
        model: the file of the network.
        settings: settings of the detection; a frame is reduced by the whole number that makes its longer side at most
            `size` pixels long.

    Raises:
        InputError: the file cannot be read, or is no network of this version.
    """

    def __init__(self, model: Path | str, settings: DetectorSettings) -> None:
        self.model, self.settings = Path(model), settings
        self._network = model_at(self.model).network
        self._background: _Image | None = None

    @property
    def key(self) -> Mapping[str, Any]:
        """See `Detector`."""
        settings = msgspec.to_builtins(self.settings)
        return {"finding": FINDING_VERSION, "model": digest_file(self.model), "settings": settings}

    def of_video(self, video: VideoInfo) -> NetworkDetector:
        """The detector for the frames of one video, whose background it learns."""
        settings = self._reduction(video.image_size_wh)
        step = learning_step(video.num_frames, settings)
        learning = ((1.0, reduce_frame(frame, settings)) for frame in read_frames(video, step))
        detector = copy.copy(self)
        detector._background = learned_mog2(learning, settings).getBackgroundImage()
        return detector

    def boxes(self, bgr: _Image) -> FoundBoxes:
        """See `Detector`."""
        height, width = bgr.shape[:2]
        settings = self._reduction((width, height))
        image = reduce_frame(bgr, settings)
        _, boxes, confidence = findings(self._network, image, self._background, self.settings.confidence)
        return usable_boxes(boxes * settings.working_reduction, confidence, bgr.shape, self.settings)

    def _reduction(self, image_size_wh: tuple[int, int]) -> ForegroundSettings:
        factor = max(1, math.ceil(max(image_size_wh) / self.settings.size))
        return ForegroundSettings(reduction=factor, working_reduction=factor)
