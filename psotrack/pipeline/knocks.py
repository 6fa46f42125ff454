"""Cameras that are knocked in mid-flight: what the user is told, and the recording without them from then on."""

from __future__ import annotations

import logging
import shlex
from dataclasses import replace
from typing import Any

import numpy as np

from psotrack.geometry import viewpoints
from psotrack.pipeline.inputs import Run
from psotrack.recordings import Recording, Timing
from psotrack.tracking.camera_errors import Knock

logger = logging.getLogger(__name__)

#: A knocked camera is left out if this number of viewpoints is left: new drones need three.
_LEAST_VIEWPOINTS = 3


def without_knocked(run: Run, knock: Knock) -> Recording | None:
    """The recording without the frames of a camera after its knock, with as many instants; None with too few cameras.

    Warns of the knock, and says which of both it is.
    """
    recording = run.recording
    name, timeline = recording.rig.names[knock.camera], recording.timeline()
    rest = np.delete(np.arange(len(recording.rig)), knock.camera)
    enough = len(np.unique(viewpoints(recording.rig.cameras[rest]))) >= _LEAST_VIEWPOINTS
    logger.warning(
        "camera %s%s: it was knocked at frame %d (%.2f s), and shows everything %.0f px off from then on; %s; "
        "see `psotrack doctor %s`",
        name,
        "" if len(rest) > 1 else f", or {recording.rig.names[rest[0]]}",
        knock.frame,
        timeline.time_s[knock.frame],
        np.linalg.norm(knock.shift_px),
        "it is left out there"
        if enough
        else "the covariances contain it, as too few cameras are left without it",
        shlex.quote(f"{recording.folder}"),
    )
    if not enough:
        return None
    shown = timeline.frame[: knock.frame, knock.camera]
    count = int(shown.max(initial=-1)) + 1

    def until_knock(times: Any) -> Any:
        listed_s = None if times.listed_s is None else times.listed_s[:count]
        return replace(times, num_frames=count, listed_s=listed_s)

    cameras = tuple(
        replace(each, times=until_knock(each.times)) if each.name == name else each
        for each in recording.cameras
    )
    return replace(recording, cameras=cameras, timing=Timing(recording.fps, recording.num_frames))
