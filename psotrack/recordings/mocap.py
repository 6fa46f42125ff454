"""Motion capture: the markers of a C3D file, and the bodies that carry them.

C3D is the format of https://www.c3d.org, read and written by ezc3d (Michaud & Begon 2021). A marker that was
not seen has a residual of -1 or, in the DPJAIT recordings, exact zeros for coordinates; here it is NaN.
"""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
from jaxtyping import Float

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.recordings.marker_cross_poses import (
    CrossPoses,
    complete_markers,
    estimate_poses,
    interpolate_poses,
)
from psotrack.recordings.marker_crosses import learn_cross
from psotrack.support import atomic_write
from psotrack.trajectories import Status, Trajectories

_logger = logging.getLogger(__name__)
_METRES = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "dm": 0.1, "m": 1.0, "in": 0.0254, "ft": 0.3048}
_BLOCK_BYTES = 512
_INTEL = 84
_MOST_FRAMES = 2**16 - 1


@dataclass(frozen=True)
class Markers:
    """Marker positions over the frames of a recording.

    Attributes:
        labels: one per marker; `Dron4:Dron41` is a marker of the body `Dron4`, `*12` one that was not recognised.
        position_m: (frames, markers, 3), world, metres; NaN where a marker was not seen.
        rate_hz: frames per second.
    """

    labels: tuple[str, ...]
    position_m: Float[np.ndarray, "frames markers 3"]
    rate_hz: float

    def __post_init__(self) -> None:
        if self.position_m.shape[1:] != (len(self.labels), 3):
            raise SettingsError(
                "markers",
                expected=f"positions of shape (frames, {len(self.labels)}, 3)",
                found=f"{self.position_m.shape}",
            )


def read_c3d(path: Path) -> Markers:
    """The markers of a C3D file, in metres.

    Raises:
        InputError: the file cannot be read, ends early, has no markers, or its unit is unknown.
    """
    try:
        content = ezc3d.c3d(str(path))
        promised = _promised_frames(path)
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        found = f"one that ezc3d cannot read ({error})" if path.exists() else "no such file"
        raise InputError(path, expected="a C3D file", found=found) from error
    parameters = content["parameters"]["POINT"]
    points = content["data"]["points"][:3].transpose(2, 1, 0)
    labels = _labels(parameters)[: points.shape[1]]
    if not labels or not len(points):
        raise InputError(path, expected="markers over time", found=f"{len(labels)} in {len(points)} frames")
    if len(points) < promised:
        raise InputError(
            path,
            expected=f"{promised} frames as its header says",
            found=f"{len(points)}",
            remedy="the file is cut short: copy it anew",
        )
    unit = "".join(parameters["UNITS"]["value"][:1]).strip()
    if unit.lower() not in _METRES:
        raise InputError(path, expected=f"a unit of {', '.join(_METRES)}", found=repr(unit))
    rate_hz = float(parameters["RATE"]["value"][0])
    if not 0 < rate_hz < np.inf:
        raise InputError(path, expected="a rate above 0 Hz", found=f"{rate_hz:g}")
    residuals = content["data"]["meta_points"]["residuals"][0].T
    seen = (residuals >= 0) & np.isfinite(points).all(axis=-1) & (points != 0).any(axis=-1)
    return Markers(labels, np.where(seen[..., None], points * _METRES[unit.lower()], np.nan), rate_hz)


def write_c3d(path: Path, markers: Markers) -> None:
    """Write markers in millimetres as float32, which holds 1 micrometre in a hall; unseen ones as zeros.

    Raises:
        SettingsError: there are more frames than the header can count.
        OutputError: the file cannot be written.
    """
    num_frames, num_markers, _ = markers.position_m.shape
    if num_frames > _MOST_FRAMES:
        raise SettingsError(
            "markers", expected=f"at most {_MOST_FRAMES} frames in a C3D file", found=f"{num_frames}"
        )
    content = ezc3d.c3d()
    parameters = content["parameters"]["POINT"]
    parameters["UNITS"]["value"] = ["mm"]
    parameters["RATE"]["value"] = [markers.rate_hz]
    parameters["LABELS"]["value"] = list(markers.labels)
    points = np.ones((4, num_markers, num_frames))
    points[:3] = np.nan_to_num(markers.position_m / _METRES["mm"]).transpose(2, 1, 0)
    content["data"]["points"] = points
    with atomic_write(path) as temporary:
        content.write(str(temporary))
        # ezc3d says nothing when the disk is full.
        expected_bytes = num_frames * num_markers * 4 * 4
        if not temporary.is_file() or temporary.stat().st_size < expected_bytes:
            raise OutputError(path, expected="to write it", found="less than all of it written")


def body_trajectories(
    markers: Markers, *, fps: float, num_frames: int, where: Path, offset_s: float = 0.0
) -> Trajectories:
    """The bodies at the frames of a video.

    A body's position is the centroid of its whole cross, as its shape is learned from the recording: three markers
    are enough to place it, and it does not jump when one comes or goes. Where fewer are seen for more than half a
    second it is NaN, and `lost`; shorter gaps are bridged, and `coasting`. A marker that was never seen does not
    count; one that lost its label is found again by its distances from the others. Orientations are those of the
    cross's own frame (`crosses.Cross`); there are none where markers lie on a line.

    Args:
        markers: a recording at any rate; between its frames, poses are interpolated.
        fps: frames per second of the video.
        num_frames: frames of the video; the reference is NaN where there is no recording.
        where: the file, for messages.
        offset_s: time in the recording at the video's frame 0; above 0 where the recording began first.

    Raises:
        InputError: no body is ever placed.
    """
    frame = np.arange(num_frames)
    bodies = _bodies(markers.labels)
    position_m = np.full((num_frames, len(bodies), 3), np.nan)
    orientation_wxyz = np.full((num_frames, len(bodies), 4), np.nan)
    status = np.full((num_frames, len(bodies)), int(Status.TRACKED))
    for index, (name, columns) in enumerate(bodies.items()):
        found = _body_poses(markers, name, columns, where)
        if found is not None:
            rate_hz = _whole_multiple(markers.rate_hz, fps)
            video = interpolate_poses(found, rate_hz, frame / fps + offset_s)
            position_m[:, index], orientation_wxyz[:, index] = video.position_m, video.orientation_wxyz
            status[video.bridged, index] = Status.COASTING
    unknown = np.isnan(position_m).any(axis=-1)
    if unknown.all():
        raise InputError(where, expected="three markers of a drone in some frame of the video", found="none")
    status[unknown] = Status.LOST
    return Trajectories(
        frame,
        frame / fps,
        tuple(bodies),
        position_m,
        orientation_wxyz=None if np.isnan(orientation_wxyz).all() else orientation_wxyz,
        status=status,
    )


def _body_poses(markers: Markers, name: str, columns: list[int], where: Path) -> CrossPoses | None:
    """The poses of one body in every frame of the recording; None where its markers make no shape."""
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
    unlabelled = [column for column, label in enumerate(markers.labels) if _is_unlabelled(label)]
    return estimate_poses(
        cross, complete_markers(cross, position_m, markers.position_m[:, unlabelled]), markers.rate_hz
    )


def _whole_multiple(rate_hz: float, fps: float) -> float:
    """The rate, or the whole multiple of the video's that it was before both were rounded."""
    stride = round(rate_hz / fps)
    # 0.1 % is what rates that are rounded when they are stored differ by.
    return stride * fps if stride and abs(rate_hz / fps - stride) <= 1e-3 * stride else rate_hz


def _is_unlabelled(label: str) -> bool:
    return label.rpartition(":")[2].startswith("*")


def _labels(parameters: Mapping[str, Any]) -> tuple[str, ...]:
    """All of them: a parameter holds 255, the next ones are in LABELS2 and so on."""
    names = ["LABELS", *(f"LABELS{number}" for number in range(2, 257))]
    return tuple(label for name in names if name in parameters for label in parameters[name]["value"])


def _bodies(labels: tuple[str, ...]) -> dict[str, list[int]]:
    """The markers' indices by body, in the order of their numbers; lower case, as the dataset's files are.

    What stands before the colon is the body. Where no label has one, there is one drone; markers that were
    not recognised start with a star and belong to none.
    """
    bodies: dict[str, list[int]] = {}
    for index, label in enumerate(labels):
        body, colon, _ = label.rpartition(":")
        if colon and not _is_unlabelled(label):
            bodies.setdefault(body.strip().lower(), []).append(index)
    if not bodies:
        bodies = {"dron1": [index for index, label in enumerate(labels) if not _is_unlabelled(label)]}
    drones = {name: columns for name, columns in bodies.items() if name.startswith("dron")} or bodies
    return dict(sorted(drones.items(), key=lambda item: _natural(item[0])))


def _natural(name: str) -> list[tuple[int, str]]:
    """A sorting key that puts `dron2` before `dron10`."""
    return [(int(part or 0), word) for word, part in re.findall(r"(\D*)(\d*)", name)]


def _promised_frames(path: Path) -> int:
    """Number of frames that the header promises: ezc3d reads what is there and does not complain about less.

    0 where it cannot be told, in files of other processors than Intel's.
    """
    with path.open("rb") as file:
        header = file.read(_BLOCK_BYTES)
        parameter_block, first, last = struct.unpack("<B5xHH", header[:10])
        file.seek((parameter_block - 1) * _BLOCK_BYTES + 3)
        return last - first + 1 if file.read(1) == bytes([_INTEL]) else 0
