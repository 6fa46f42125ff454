"""Clocks of the cameras from a run's tracks: advice where the given times are wrong, and the corrected recording."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from psotrack.clocks import CameraClocks, clocks_of_tracks
from psotrack.correspondence import from_silhouettes
from psotrack.methods import MethodResult, read_sightings
from psotrack.pipeline.preparation import PreparedRun
from psotrack.recordings import Recording
from psotrack.settings import BLOBS, TrackSettings
from psotrack.silhouettes import Silhouettes
from psotrack.trajectories import Trajectories

logger = logging.getLogger(__name__)

#: Number of instants in which given times of the frames are checked.
CHECKED_INSTANTS = 100
#: Least error of a camera's given times that is worth a warning, as a share of the interval between instants.
CERTAIN_SHARE = 0.3


def estimate_clocks(
    recording: Recording, silhouettes: Silhouettes | None, run: PreparedRun, result: MethodResult
) -> CameraClocks:
    """Clocks of the cameras, from the tracks of a run and what the cameras show at them."""
    shown = silhouettes
    if run.detections is not None and run.settings.detections != BLOBS:
        sightings, shown = run.detections.sightings, None
    elif silhouettes is not None:
        sightings = from_silhouettes(silhouettes)
    return clocks_of_tracks(recording.rig, sightings, recording.timeline(), result.tracks, shown)


def advise_on_clocks(
    recording: Recording, silhouettes: Silhouettes | None, settings: TrackSettings, tracked: Trajectories
) -> None:
    """Warn if some instants in the middle show for certain that a camera's given times are wrong."""
    recording = recording.at_rate(settings.rate_hz)
    timeline = recording.timeline()
    first = max(0, (timeline.num_instants - CHECKED_INSTANTS) // 2)
    rows = np.arange(first, min(first + CHECKED_INSTANTS, timeline.num_instants))
    part = None
    if settings.reads_detections or silhouettes is None:
        sightings = read_sightings(recording, None, settings.detections).sightings.in_frames(rows)
    else:
        part = silhouettes.at_instants(timeline.part(rows))
        sightings = from_silhouettes(part)
    tracked = tracked.at_frames(rows)
    shown = replace(tracked, position_m=tracked.position_m + np.array(settings.drones.body_offset_m))
    clocks = clocks_of_tracks(recording.rig, sightings, timeline.part(rows), shown, part)
    certain = clocks.is_certain(CERTAIN_SHARE / timeline.rate_hz)
    if certain.any():
        worst = int(np.where(certain, np.abs(clocks.offset_s), 0.0).argmax())
        logger.warning(
            "camera %s: its video shows the scene %.0f ± %.0f ms %s, against the other cameras; "
            "--clocks auto takes the clocks from the data",
            recording.rig.names[worst],
            1e3 * abs(clocks.late_s[worst]),
            1e3 * clocks.offset_std_s[worst],
            "late" if clocks.late_s[worst] > 0 else "early",
        )


def with_clocks(recording: Recording, clocks: CameraClocks) -> Recording:
    """The recording with corrected times of the frames, and with as many instants as before."""
    times = clocks.corrected(recording.frame_times, recording.rig.names)
    return replace(recording, frame_times=times, rate_hz=recording.fps, num_instants=recording.num_frames)
