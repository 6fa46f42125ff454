"""What the tracks of a run show of its cameras, and the recording for a second pass: clocks that are wrong, and cameras
that are knocked in mid-flight.
"""

from __future__ import annotations

import logging
import shlex
from dataclasses import replace

import numpy as np

from psotrack.calibration.clocks import MAX_OFFSET_FRAMES, CameraClocks, clocks_of_tracks
from psotrack.geometry import viewpoints
from psotrack.pipeline.inputs import Run
from psotrack.recordings import Recording, Timing
from psotrack.settings import BLOBS
from psotrack.tracking.camera_errors import ClockStep, Knock
from psotrack.tracking.matching import from_silhouettes
from psotrack.trajectories import Tracks

logger = logging.getLogger(__name__)

#: Number of instants in which given times of the frames are checked.
CHECKED_INSTANTS = 100
#: Least error of a camera's given times that is worth a warning, as a share of the interval between instants.
CERTAIN_SHARE = 0.3


def estimate_clocks(run: Run, tracks: Tracks, most: int | None = None) -> CameraClocks:
    """Clocks of the cameras, from the tracks of a run and what the cameras show at them.

    Args:
        run: the run.
        tracks: its tracks.
        most: largest number of instants that are used, those in the middle; None for all.
    """
    timeline = run.recording.timeline()
    count = min(most or timeline.num_instants, timeline.num_instants)
    first = (timeline.num_instants - count) // 2
    rows = np.arange(first, first + count)
    shown = run.silhouettes
    if shown is not None and count < timeline.num_instants:  # else they stay on the disk
        shown = shown.part(first, first + count)
    if run.sightings is not None:
        sightings = run.sightings[rows]
        shown = shown if run.settings.detections == BLOBS else None
    else:
        assert shown is not None, "a run has silhouettes or sightings"
        sightings = from_silhouettes(shown)
    part = tracks.with_arrays(lambda _, values: values[rows])
    return clocks_of_tracks(run.recording.rig, sightings, timeline.part(rows), part, shown)


def warn_of_unknown_clocks(clocks: CameraClocks, recording: Recording) -> None:
    """Warn of the cameras whose clocks the tracks do not show."""
    names = [name for name, known in zip(recording.rig.names, clocks.known, strict=True) if not known]
    if names:
        logger.warning(
            "--clocks auto: found no lag of camera %s within %g frames (%.0f ms), as far as it searches: their given "
            "times are used; a larger lag must be in time_offset_s",
            ", ".join(names),
            MAX_OFFSET_FRAMES,
            1e3 * MAX_OFFSET_FRAMES / recording.fps,
        )


def advise_on_clocks(run: Run, tracks: Tracks) -> None:
    """Warn if some instants in the middle show for certain that a camera's given times are wrong."""
    names, rate_hz = run.recording.rig.names, run.recording.fps
    clocks = estimate_clocks(run, tracks, CHECKED_INSTANTS)
    certain = clocks.is_certain(CERTAIN_SHARE / rate_hz)
    if certain.any():
        worst = int(np.where(certain, np.abs(clocks.offset_s), 0.0).argmax())
        logger.warning(
            "camera %s: its video shows the scene %.0f ± %.0f ms %s, against the other cameras; "
            "--clocks auto takes the clocks from the data",
            names[worst],
            1e3 * abs(clocks.late_s[worst]),
            1e3 * clocks.offset_std_s[worst],
            "late" if clocks.late_s[worst] > 0 else "early",
        )


def warn_of_clock_step(run: Run, step: ClockStep) -> None:
    """Warn of a camera whose clock steps during the recording."""
    logger.warning(
        "camera %s: from frame %d (%.2f s) on, its video is %.0f ms %s than before, as if it had %s; --clocks auto "
        "takes the clocks from the data",
        _named(run.recording, step.camera),
        step.frame,
        run.recording.timeline().time_s[step.frame],
        1e3 * abs(step.step_s),
        "earlier" if step.step_s > 0 else "later",
        "lost frames" if step.step_s > 0 else "repeated frames",
    )


def _named(recording: Recording, camera: int) -> str:
    """A camera that changed, or both of two: nothing tells which of them it is."""
    names = recording.rig.names
    return names[camera] if len(names) > 2 else f"{names[camera]}, or {names[1 - camera]}"


def with_clocks(recording: Recording, clocks: CameraClocks) -> Recording:
    """The recording with corrected times of the frames, and with as many instants as before."""
    given = {each.name: each.times for each in recording.placed if each.times is not None}
    times = clocks.corrected(given, recording.rig.names)
    return replace(
        recording,
        cameras=tuple(replace(each, times=times.get(each.name)) for each in recording.cameras),
        timing=Timing(recording.fps, recording.num_frames),
    )


#: A knocked camera is left out if this number of viewpoints is left: new drones need three.
_LEAST_VIEWPOINTS = 3


def without_knocked(run: Run, knock: Knock) -> Recording | None:
    """The recording without the frames of a camera after its knock, with as many instants; None with too few cameras.

    Warns of the knock, and says which of both it is.
    """
    recording = run.given
    name, timeline = recording.rig.names[knock.camera], recording.timeline()
    rest = np.delete(np.arange(len(recording.rig)), knock.camera)
    enough = len(np.unique(viewpoints(recording.rig.cameras[rest]))) >= _LEAST_VIEWPOINTS
    logger.warning(
        "camera %s: it was knocked at frame %d (%.2f s), and shows everything %.0f px off from then on; %s; "
        "see `psotrack doctor %s`",
        _named(recording, knock.camera),
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
    cameras = tuple(each.first(count) if each.name == name else each for each in recording.cameras)
    return replace(recording, cameras=cameras, timing=Timing(recording.fps, recording.num_frames))
