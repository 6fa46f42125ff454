"""How late the video of each camera shows the scene."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from psotrack.calibration.clocks import camera_offsets
from psotrack.calibration.doctor.common_points import CommonPoints
from psotrack.geometry import Rig

#: Number of empty frames between two runs, so that velocities of one run (`camera_offsets`) do not use another run.
_GAP_FRAMES = 15


def measure_lags(
    rig: Rig, points: CommonPoints, fps: float
) -> tuple[Float[np.ndarray, "cameras"], Float[np.ndarray, "cameras"]]:
    """Lags of the cameras' videos behind their median, and standard deviations, frames; NaN if nothing moves.

    A video with a positive lag k is late: its frame i shows what the other videos show in frame i - k.
    """
    nothing = np.full((2, len(rig)), np.nan)
    tracks_px = _tracks(points)
    if len(rig) < 2 or not np.isfinite(tracks_px).any():
        return nothing[0], nothing[1]
    clocks = camera_offsets(rig, tracks_px, fps)
    # The known part of the differences in time is no fault.
    seen = points.seen
    lag = clocks.late_frames + (seen * points.offset_frames).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    return lag - np.median(lag), clocks.std_frames


def _tracks(points: CommonPoints) -> Float[np.ndarray, "frames bodies cameras 2"]:
    """Sightings of the pieces as tracks, with a gap between runs of frames."""
    frames = np.unique(points.frame)
    row = np.cumsum(np.diff(frames, prepend=frames[:1]).clip(0, _GAP_FRAMES))
    place = np.zeros(len(points.run), int)
    for run in np.unique(points.run):
        of_run = np.flatnonzero(points.run == run)
        place[of_run] = np.arange(len(of_run))
    shape = (int(row[-1]) + 1 if len(row) else 1, int(place.max(initial=0)) + 1)
    tracks_px = np.full((*shape, *points.centre_px.shape[1:]), np.nan)
    tracks_px[row[np.searchsorted(frames, points.frame)], place[points.piece]] = points.centre_px
    return tracks_px
