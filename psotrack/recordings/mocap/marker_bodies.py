"""Trajectories of bodies from the markers that they carry: the reference of a motion-capture recording."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psotrack.errors import InputError
from psotrack.recordings.mocap.c3d import Markers
from psotrack.recordings.mocap.marker_cross_poses import (
    CrossPoses,
    complete_markers,
    estimate_poses,
    interpolate_poses,
)
from psotrack.recordings.mocap.marker_crosses import learn_cross
from psotrack.recordings.mocap.marker_groups import drone_markers, is_unlabelled
from psotrack.trajectories import Status, Trajectories

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class MarkerBodies:
    """Drones of a motion-capture recording, and their poses in each of its frames.

    Attributes:
        where: path of the recording, for messages.
        rate_hz: frames per second of the recording.
        num_frames: number of its frames.
        poses: poses of each drone by name; None where the shape of its cross cannot be learned.
    """

    where: Path
    rate_hz: float
    num_frames: int
    poses: Mapping[str, CrossPoses | None]

    def at_own_frames(self) -> Trajectories:
        """Trajectories at the frames of the recording (see `at_frames`)."""
        return self.at_frames(self.rate_hz, self.num_frames)

    def at_frames(self, fps: float, num_frames: int, offset_s: float = 0.0) -> Trajectories:
        """Trajectories at the frames of a video, to which poses are interpolated.

        Args:
            fps: frames per second of the video.
            num_frames: number of frames of the video; the reference is NaN outside of the recording.
            offset_s: time in the recording at the video's frame 0, seconds; above 0 if the recording began first.

        Raises:
            InputError: no body has a pose in any frame.
        """
        frame = np.arange(num_frames)
        position_m = np.full((num_frames, len(self.poses), 3), np.nan)
        orientation_wxyz = np.full((num_frames, len(self.poses), 4), np.nan)
        status = np.full((num_frames, len(self.poses)), int(Status.TRACKED))
        for index, poses in enumerate(self.poses.values()):
            if poses is not None:
                rate_hz = _whole_multiple(self.rate_hz, fps)
                video = interpolate_poses(poses, rate_hz, frame / fps + offset_s)
                position_m[:, index], orientation_wxyz[:, index] = video.position_m, video.orientation_wxyz
                status[video.bridged, index] = Status.COASTING
        unknown = np.isnan(position_m).any(axis=-1)
        if unknown.all():
            expected = "three markers of a drone in some frame of the video"
            raise InputError(self.where, expected=expected, found="none")
        status[unknown] = Status.LOST
        return Trajectories(
            frame,
            frame / fps,
            tuple(self.poses),
            position_m,
            orientation_wxyz=None if np.isnan(orientation_wxyz).all() else orientation_wxyz,
            status=status,
        )


def marker_bodies(
    markers: Markers, where: Path | str, named: Mapping[str, Sequence[str]] | None = None
) -> MarkerBodies:
    """The drones of a motion-capture recording, with their poses.

    The position of a body is the centroid of its whole marker cross, whose shape is learned from the recording. Three
    seen markers determine the pose, and the position does not jump when a marker appears or disappears. A gap is a time
    with fewer markers: gaps up to half a second are bridged and `coasting`; in longer gaps the position is NaN and
    `lost`. Markers that were never seen are ignored. Markers that lost their labels are found by their distances from
    the other markers. Orientations refer to the cross's own frame (`marker_crosses.Cross`); they are unknown if all
    markers lie on a line.

    Args:
        markers: a recording at any rate.
        where: path of the recording, for messages.
        named: labels of the markers by drone, as the user says (see `drone_markers`); None: by the labels.

    Raises:
        NoDronesError: no body of the recording is a drone for certain.
        SettingsError: a named marker does not exist.
    """
    bodies = drone_markers(markers, where, named)
    poses = {name: _body_poses(markers, name, columns, Path(where)) for name, columns in bodies.items()}
    return MarkerBodies(Path(where), markers.rate_hz, len(markers.position_m), poses)


def _body_poses(markers: Markers, name: str, columns: list[int], where: Path) -> CrossPoses | None:
    """Poses of one body in every frame of the recording; None if the shape of its cross cannot be learned."""
    ever_seen = np.isfinite(markers.position_m).all(axis=-1).any(axis=0)
    used = [column for column in columns if ever_seen[column]]
    if len(used) < len(columns):
        _logger.info("%s: %d markers of %s were never seen", where, len(columns) - len(used), name)
    if not used:
        return None
    position_m = markers.position_m[:, used]
    try:
        cross = learn_cross(position_m, name)
    except InputError as error:
        _logger.warning("%s: no reference for %s: %s", where, name, error)
        return None
    unlabelled = [column for column, label in enumerate(markers.labels) if is_unlabelled(label)]
    complete_m = complete_markers(cross, position_m, markers.position_m[:, unlabelled])
    return estimate_poses(cross, complete_m, markers.rate_hz)


def _whole_multiple(rate_hz: float, fps: float) -> float:
    """The exact multiple of the video's rate if the recording's rate is nearly such a multiple, else the rate."""
    stride = round(rate_hz / fps)
    # Stored rates are rounded, so that they may differ from the true rate by 0.1 %.
    return stride * fps if stride and abs(rate_hz / fps - stride) <= 1e-3 * stride else rate_hz
