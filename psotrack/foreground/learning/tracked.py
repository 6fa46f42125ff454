"""Where the drones of tracks are in the images of their cameras: labels that no hand has drawn."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from psotrack.errors import InputError
from psotrack.foreground.detection import LabelSettings, label_boxes
from psotrack.recordings import Recording
from psotrack.support import read_json
from psotrack.trajectories import Trajectories, read_trajectories, resample

_SIGNS = np.array(list(product((-0.5, 0.5), repeat=3)))


@dataclass(frozen=True)
class TrackedDrones:
    """Tracks, and the lengths of their drones.

    Attributes:
        tracks: the tracks.
        size_m: (drones, 3), full lengths of the drones along the world's axes, metres.
    """

    tracks: Trajectories
    size_m: Float[np.ndarray, "drones 3"]

    @classmethod
    def read(cls, tracks: Path) -> TrackedDrones:
        """Read tracks, and the drones' lengths from the record beside them.

        Raises:
            InputError: a file cannot be read, or the record has no lengths.
        """
        found, record = read_trajectories(tracks), tracks.with_suffix(".json")
        listed = read_json(record, "the record of the tracks beside it").get("drones")
        sizes = (
            {f"{each['drone']}": each.get("size_m") for each in listed if isinstance(each, dict)}
            if isinstance(listed, list)
            else {}
        )
        size_m = np.array([sizes.get(name) or (np.nan,) * 3 for name in found.drones], float)
        if not found.drones or not np.isfinite(size_m).all():
            remedy = "track again, without --causal"
            raise InputError(record, expected="drones with their lengths", found="none", remedy=remedy)
        return cls(found, size_m)

    def boxes_px(
        self, recording: Recording, camera: str, frame: Int[np.ndarray, "frames"]
    ) -> Float[np.ndarray, "frames drones 4"]:
        """Boxes about the drones in frames of a camera, xyxy in pixels; NaN where the camera does not show a drone."""
        times = recording.by_name[camera].times
        assert times is not None, "a video has times"
        at = resample(self.tracks, frame, times.time_s[frame])
        # Both horizontal lengths are the longer one: the heading is not known.
        wide = self.size_m.copy()
        wide[:, :2] = wide[:, :2].max(axis=1, keepdims=True)
        corners_m = at.position_m[:, :, None] + _SIGNS * wide[:, None]
        settings = LabelSettings(drone_size_m=(1.0, 1.0, 1.0))  # the corners are known
        index = recording.rig.names.index(camera)
        return label_boxes(recording.rig.cameras[index], corners_m, settings)
