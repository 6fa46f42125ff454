"""Trajectories of bodies from the markers that they carry: the reference of a motion-capture recording.

Which markers are a drone's is said by the user, by their labels, or by being rigid.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from psotrack.errors import InputError, SettingsError
from psotrack.recordings.mocap.c3d import Markers
from psotrack.recordings.mocap.marker_crosses import cross_poses, learn_cross
from psotrack.trajectories import Status, Trajectories

_logger = logging.getLogger(__name__)
#: Start of the name of a body that is a drone for certain, as in the dataset.
_DRONE = "dron"
#: Largest spread of the distance of two markers of a rigid body over time, metres; noise spreads it by 1 mm or less, a
#: walking person by centimetres.
_RIGID_M = 0.005
#: Standard deviations per median absolute deviation of normal noise. The median ignores swapped labels.
_STD_PER_MAD = 1.4826
#: Largest distance of two markers of a drone, metres, and numbers of markers that a drone carries. A person who stands
#: still is rigid too, but is larger or carries more markers.
_LARGEST_M = 1.5
_FEWEST, _MOST = 3, 20
#: Number of frames in which distances are looked at.
_FRAMES = 2000
#: Number of labels that a message shows of one body, and of each of several bodies.
_SHOWN, _SHOWN_OF_MANY = 6, 2


class NoDronesError(InputError):
    """A motion-capture recording shows no body that is a drone for certain."""


def drone_markers(
    markers: Markers, where: Path | str, named: Mapping[str, Sequence[str]] | None = None
) -> dict[str, list[int]]:
    """Indices of the markers by drone.

    A label `Dron4:Dron41` is that of a marker of the body `Dron4`; without colons, all markers are one body. Bodies
    called dron... are drones. Without such a body, the rigid bodies are drones, unless another body of the recording
    is none: nothing says then whether a rigid body is a drone, or a box that a person carries. Labels of unidentified
    markers start with a star; these markers belong to no body.

    Args:
        markers: the recording.
        where: path of the recording, for messages.
        named: labels of the markers by drone, as the user says; `boite:` stands for all markers of the body `boite`.
            None or empty: by the labels, as above.

    Returns:
        Indices by name. Names by labels are in lower case, as in the dataset, and sorted by their numbers.

    Raises:
        NoDronesError: no body is a drone, or it is not certain.
        SettingsError: a named marker does not exist.
    """
    if named:
        return {name: _named_markers(markers, where, name, labels) for name, labels in named.items()}
    bodies = _bodies(markers.labels)
    drones = {name: columns for name, columns in bodies.items() if name.startswith(_DRONE)}
    if drones:
        return _sorted(drones)
    if not bodies:
        bodies = {"dron1": [index for index, label in enumerate(markers.labels) if not is_unlabelled(label)]}
    faults = {name: _fault(markers, columns) for name, columns in bodies.items()}
    rigid = {name: columns for name, columns in bodies.items() if not faults[name]}
    others = [name for name, fault in faults.items() if fault and len(bodies[name]) >= _FEWEST]
    if not rigid or others:
        most = _SHOWN if len(bodies) == 1 else _SHOWN_OF_MANY
        found = "; ".join(
            f"{name}, {faults[name] or 'rigid'} ({_shown(markers, columns, most)})"
            for name, columns in bodies.items()
        )
        if not any(bodies.values()):
            found = f"unidentified markers only ({_shown(markers, range(len(markers.labels)))})"
        raise NoDronesError(
            where,
            expected=f"drones, rigid bodies of {_FEWEST} to {_MOST} markers",
            found=found,
            remedy="say which markers are a drone's with --body NAME=LABEL,LABEL or [reference.bodies], or leave "
            "the file out",
        )
    _logger.warning(
        "%s: no body is called %s...; taken for drones, because their markers are rigid: %s",
        where, _DRONE, "; ".join(f"{name} ({_shown(markers, columns)})" for name, columns in rigid.items()),
    )  # fmt: skip
    return _sorted(rigid)


def is_unlabelled(label: str) -> bool:
    """Whether a label is that of an unidentified marker."""
    return label.rpartition(":")[2].startswith("*")


def _named_markers(markers: Markers, where: Path | str, name: str, labels: Sequence[str]) -> list[int]:
    """Indices of the markers that the user names; a label may leave out the body before its colon."""
    columns: list[int] = []
    known = {index: each for index, each in enumerate(markers.labels) if not is_unlabelled(each)}
    for label in labels:
        whole = label.endswith(":")
        if whole:
            fitting = [index for index, each in known.items() if each.lower().startswith(label.lower())]
        else:
            fitting = [index for index, each in enumerate(markers.labels) if each == label]
            own = [index for index, each in enumerate(markers.labels) if each.rpartition(":")[2] == label]
            fitting = fitting or own
        if not fitting or (len(fitting) > 1 and not whole):
            expected, found = f"labels of {', '.join(known.values())}", repr(label)
            if fitting:
                expected, found = f"one marker called {label!r}", f"{len(fitting)}"
            raise SettingsError(f"body {name}, {where}", expected=expected, found=found)
        columns += [index for index in fitting if index not in columns]
    fault = _fault(markers, columns)
    if fault:
        _logger.warning("%s: body %s is %s (%s)", where, name, fault, _shown(markers, columns))
    return columns


def _bodies(labels: Sequence[str]) -> dict[str, list[int]]:
    """Indices of the markers by body, whose name stands before the colon of a label."""
    bodies: dict[str, list[int]] = {}
    for index, label in enumerate(labels):
        body, colon, _ = label.rpartition(":")
        if colon and not is_unlabelled(label):
            bodies.setdefault(body.strip().lower(), []).append(index)
    return bodies


def _fault(markers: Markers, columns: Sequence[int]) -> str:
    """Why markers are no drone's for certain, in words; empty where they can be a drone's."""
    position_m = markers.position_m[:: max(1, len(markers.position_m) // _FRAMES)][:, columns]
    seen = np.isfinite(position_m).all(axis=-1).any(axis=0)
    if not _FEWEST <= seen.sum() <= _MOST:
        return f"{seen.sum()} markers"
    first, second = np.triu_indices(int(seen.sum()), 1)
    position_m = position_m[:, seen]
    distance_m = np.linalg.norm(position_m[:, first] - position_m[:, second], axis=-1)
    distance_m = distance_m[:, np.isfinite(distance_m).sum(axis=0) > 1]
    if not distance_m.size:
        return "seen together in one frame at most"
    median_m = np.nanmedian(distance_m, axis=0)
    spread_m = _STD_PER_MAD * np.nanmedian(np.abs(distance_m - median_m), axis=0).max()
    if spread_m > _RIGID_M:
        return f"not rigid, distances vary by {1e3 * spread_m:.0f} mm"
    return f"{median_m.max():.1f} m large" if median_m.max() > _LARGEST_M else ""


def _shown(markers: Markers, columns: Sequence[int], most: int = _SHOWN) -> str:
    labels = [markers.labels[column] for column in columns]
    return ", ".join(labels[:most]) + (f" and {len(labels) - most} more" if len(labels) > most else "")


def _sorted(bodies: Mapping[str, list[int]]) -> dict[str, list[int]]:
    """Bodies by their numbers, so that `dron2` comes before `dron10`."""
    return dict(
        sorted(
            bodies.items(),
            key=lambda item: [(int(part or 0), word) for word, part in re.findall(r"(\D*)(\d*)", item[0])],
        )
    )


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
    try:
        if used:
            position_m = markers.position_m[:, used]
            return cross_poses(learn_cross(position_m, name), position_m, markers.rate_hz)
    except InputError as error:
        _logger.warning("%s: no reference for %s: %s", where, name, error)
    frames = len(markers.position_m)
    return np.full((frames, 3), np.nan), np.full((frames, 4), np.nan), np.zeros(frames, bool)
