"""Tracks as C3D (see `recordings.c3d`): one point per drone, in millimetres, in every frame from frame 0 on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from psotrack.errors import InputError
from psotrack.recordings import Recording
from psotrack.recordings.exchange.camera_boxes import Footage
from psotrack.recordings.exchange.timed_paths import interval_s
from psotrack.recordings.mocap import Markers, read_c3d, write_c3d
from psotrack.support import Report
from psotrack.trajectories import Trajectories

#: Rates that differ by less than this share are one rate: C3D has float32.
_ONE_RATE = 1e-3


def write_c3d_tracks(
    path: Path, trajectories: Trajectories, footage: Footage | None, report: Report
) -> list[str]:
    """Write one point per drone; frames in which a drone is not seen have a residual of -1.

    Raises:
        InputError: no drone is ever seen.
        SettingsError: there are more frames than the format can hold.
        OutputError: the file cannot be written.
    """
    if not trajectories.seen.any():
        raise InputError("tracks", expected="a drone that is seen in some frame", found="none")
    frames = int(trajectories.frame[-1]) + 1
    position_m = np.full((frames, trajectories.num_drones, 3), np.nan)
    position_m[trajectories.frame] = np.where(trajectories.seen[..., None], trajectories.position_m, np.nan)
    write_c3d(path, Markers(trajectories.drones, position_m, 1 / interval_s(trajectories)))
    return []


def read_c3d_tracks(path: Path, recording: Recording | None) -> Trajectories:
    """Each point of the file as a drone; frame k of the file is instant k of the recording, if it has the same rate.

    Raises:
        InputError: the file cannot be read, or two points have one label.
    """
    markers = read_c3d(path)
    labels = [label for label in markers.labels if markers.labels.count(label) > 1]
    if labels:
        raise InputError(path, expected="points with different labels", found=f"{labels[0]} twice")
    frame = markers.frame
    read = Trajectories(frame, frame / markers.rate_hz, markers.labels, markers.position_m)
    if recording is None or abs(markers.rate_hz / recording.fps - 1) > _ONE_RATE:
        return read
    time_s = recording.timeline().time_s
    read = read.at_frames(frame[frame < len(time_s)])
    return replace(read, time_s=time_s[read.frame].astype(np.float64))
