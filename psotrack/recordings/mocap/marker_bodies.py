"""Trajectories of bodies from the markers that they carry: the reference of a motion-capture recording."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from psotrack.errors import InputError
from psotrack.recordings.mocap.c3d import Markers
from psotrack.recordings.mocap.marker_cross_poses import cross_poses
from psotrack.recordings.mocap.marker_crosses import learn_cross
from psotrack.recordings.mocap.marker_groups import drone_markers
from psotrack.trajectories import Status, Trajectories

_logger = logging.getLogger(__name__)


def marker_bodies(
    markers: Markers, where: Path | str, named: Mapping[str, Sequence[str]] | None = None
) -> Trajectories:
    """The drones of a motion-capture recording, at its frames.

    The position of a body is the centroid of its whole marker cross, whose shape is learned from the recording. Three
    seen markers determine the pose, and the position does not jump when a marker appears or disappears. Labels that do
    not fit the shape are corrected from the distances. A gap is a time with fewer markers, or without labels that fit:
    gaps up to half a second are bridged and `coasting`; in longer gaps the position is NaN and `lost`. Markers that
    were never seen are ignored. Orientations refer to the cross's own frame (`learn_cross`); they are unknown if all
    markers lie on a line.

    Args:
        markers: a recording at any rate.
        where: path of the recording, for messages.
        named: labels of the markers by drone, as the user says (see `drone_markers`); None: by the labels.

    Raises:
        NoDronesError: no body of the recording is a drone for certain.
        InputError: no body has a pose in any frame.
        SettingsError: a named marker does not exist.
    """
    bodies = drone_markers(markers, where, named)
    poses = [_body_poses(markers, name, columns, where) for name, columns in bodies.items()]
    position_m, orientation_wxyz, bridged = (np.stack(each, axis=1) for each in zip(*poses, strict=True))
    if np.isnan(position_m).all():
        raise InputError(where, expected="three markers of a drone in some frame", found="none")
    turned = not np.isnan(orientation_wxyz).all()
    status = np.where(bridged, Status.COASTING, Status.TRACKED)
    return Trajectories(
        markers.frame,
        markers.frame / markers.rate_hz,
        tuple(bodies),
        position_m,
        orientation_wxyz=orientation_wxyz if turned else None,
        status=np.where(np.isnan(position_m).any(axis=-1), Status.LOST, status),
    )


def _body_poses(
    markers: Markers, name: str, columns: list[int], where: Path | str
) -> tuple[Float[np.ndarray, "frames 3"], Float[np.ndarray, "frames 4"], Bool[np.ndarray, "frames"]]:
    """Poses of one body in every frame, and which are bridged; NaN if the shape of its cross cannot be learned."""
    ever_seen = np.isfinite(markers.position_m).all(axis=-1).any(axis=0)
    used = [column for column in columns if ever_seen[column]]
    if len(used) < len(columns):
        _logger.info("%s: %d markers of %s were never seen", where, len(columns) - len(used), name)
    try:
        if used:
            position_m = markers.position_m[:, used]
            return cross_poses(learn_cross(position_m, name), position_m, markers.rate_hz)
    except InputError as error:
        _logger.warning("%s: no reference for %s: %s", where, name, error)
    frames = len(markers.position_m)
    return np.full((frames, 3), np.nan), np.full((frames, 4), np.nan), np.zeros(frames, bool)
