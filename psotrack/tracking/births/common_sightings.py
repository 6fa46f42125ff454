"""How often the detections of different cameras meet in a place: the first thing to know where no drone is found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psotrack.foreground.silhouettes import Silhouettes
from psotrack.geometry import Rig, viewpoints
from psotrack.tracking.matching import Sightings, from_silhouettes, match, wide_bounds

#: Largest number of frames that are looked at, and of detections per image: the largest ones count.
_FRAMES, _MOST_SIGHTINGS = 60, 12


@dataclass(frozen=True)
class CommonSightings:
    """In how many frames detections of different cameras meet.

    Attributes:
        seen: number of frames in which at least two viewpoints have detections.
        met: number of these frames in which detections of enough viewpoints meet (three where three have the place in
            view, else two).
    """

    seen: int
    met: int


def count_common(rig: Rig, found: Sightings | Silhouettes) -> CommonSightings:
    """Count the frames in which detections of different cameras meet, of at most 60 frames.

    Args:
        rig: the cameras.
        found: detections, or silhouettes whose blobs are the detections.
    """
    viewpoint, wide_m = viewpoints(rig.cameras), wide_bounds(rig)
    seen = met = 0
    spread = np.linspace(0, found.num_frames - 1, min(found.num_frames, _FRAMES))
    for frame in np.unique(spread.round().astype(int)).tolist():
        if isinstance(found, Sightings):
            sightings = found[frame]
        else:
            sightings = from_silhouettes(found, first=frame, stop=frame + 1)[0]
        view = sightings.largest(_MOST_SIGHTINGS)
        if len(np.unique(viewpoint[np.isfinite(view.noise_px).any(axis=-1)])) < 2:
            continue
        seen += 1
        met += bool(len(match(rig.cameras, view.centre_px, view.noise_px, bounds_m=wide_m).position_m))
    return CommonSightings(seen, met)
