"""Entities of Rerun: their paths, and the logging of values over time.

    world/cameras/CAMERA        pose and lens; below it image, silhouettes, boxes, ellipses, blobs, detections
    world/drones/DRONE          body, ellipsoid, trail and path; of several files world/drones/FILE/DRONE
    world/truth/DRONE           the reference
    world/onboard/DRONE         the camera on a drone; below it image and markers
    plots/QUANTITY/DRONE        values over time
    status/DRONE                tracked, coasting or lost
    events/KIND                 sentences

Rerun has no lens distortion: marks are drawn in the pixels of the raw images, and frusta are those of K.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from jaxtyping import Float, Int, UInt8

from psotrack.show.flights import FlightTracks, status_rgb, statuses
from psotrack.show.viewer.camera_images import CameraKey

#: Timelines: seconds of the recording, and numbers of instants.
TIME, FRAME = "time", "frame"
#: Rows that are sent together: Rerun keeps what is sent together in one piece.
_ROWS = 2000
#: Grey that is mixed into the colours of predicted drones: it can be read on the dark and on the light theme.
_PALE = 140


class Instants(NamedTuple):
    """Instants at which values are logged.

    Attributes:
        frame: (rows,), numbers of the instants.
        time_s: (rows,), times of the instants, seconds.
    """

    frame: Int[np.ndarray, " rows"]
    time_s: Float[np.ndarray, " rows"]


class EntityLog:
    """Logs values of entities into a recording of Rerun.

    Args:
        stream: the recording of Rerun.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._logged: set[tuple[str, str]] = set()
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)

    def static(self, path: str, values: Any) -> None:
        """Log values that hold at all times; the first ones of a kind count."""
        key = (path, type(values).__name__)
        if key not in self._logged:
            self._logged.add(key)
            self._stream.log(path, values, static=True, strict=True)

    def rows(
        self,
        path: str,
        at: Instants,
        kind: Any,
        counts: Int[np.ndarray, " rows"] | None = None,
        **values: Any,
    ) -> None:
        """Log values over time, in pieces.

        Args:
            path: path of the entity.
            at: the instants of the rows.
            kind: archetype of Rerun.
            counts: (rows,), number of values of each row; a row without values hides those of the row before. None:
                one value per row.
            **values: the values of all rows by the archetype's fields; None for a field that is not logged.
        """
        ends = np.arange(len(at.frame) + 1) if counts is None else np.concatenate([[0], np.cumsum(counts)])
        for first in range(0, len(at.frame), _ROWS):
            rows, own = slice(first, first + _ROWS), ends[first : first + _ROWS + 1]
            part = slice(int(own[0]), int(own[-1]))
            found = kind.columns(
                **{name: each if each is None else each[part] for name, each in values.items()}
            )
            times = [
                rr.TimeColumn(TIME, duration=np.asarray(at.time_s[rows], np.float64)),
                rr.TimeColumn(FRAME, sequence=np.asarray(at.frame[rows], np.int64)),
            ]
            found = found if counts is None else found.partition(np.diff(own))
            rr.send_columns(path, times, found, recording=self._stream, strict=True)

    def boxes(
        self,
        path: str,
        at: Instants,
        counts: Int[np.ndarray, " rows"],
        boxes_px: Float[np.ndarray, "boxes 4"],
        rgb: Any,
        labels: list[str] | None = None,
    ) -> None:
        """Log boxes in images over time, in one colour or in a colour each; without names, they have thin lines."""
        radius = -0.75 if labels is None else -1.5  # negative: in pixels of the screen
        self.static(path, rr.Boxes2D.from_fields(radii=[radius], show_labels=labels is not None))
        centre_px, half_px = (boxes_px[:, 2:] + boxes_px[:, :2]) / 2, (boxes_px[:, 2:] - boxes_px[:, :2]) / 2
        colours = np.broadcast_to(np.array(rgb, np.uint8), (len(boxes_px), 3))
        sides = {"centers": centre_px, "half_sizes": half_px}
        self.rows(path, at, rr.Boxes2D, counts, **sides, colors=colours, labels=labels)

    def lines(
        self,
        path: str,
        at: Instants,
        counts: Int[np.ndarray, " rows"],
        lines_px: Float[np.ndarray, "lines points 2"],
        rgb: Any,
        labels: list[str] | None = None,
    ) -> None:
        """Log lines in images over time, in one colour or in a colour each."""
        self.static(path, rr.LineStrips2D.from_fields(radii=[-1.0], show_labels=labels is not None))
        colours = np.broadcast_to(np.array(rgb, np.uint8), (len(lines_px), 3))
        self.rows(path, at, rr.LineStrips2D, counts, strips=list(lines_px), colors=colours, labels=labels)


def part(name: str) -> str:
    """A name as one part of a path."""
    return rr.escape_entity_path_part(name)


def camera_path(camera: CameraKey) -> str:
    """Path of a camera of the rig, or of one on a drone."""
    return f"world/{'onboard' if camera.on_drone else 'cameras'}/{part(camera.name)}"


def tracks_path(root: str, tracks: FlightTracks) -> str:
    """Path of what belongs to the tracks of one file."""
    return f"{root}/{part(tracks.group)}" if tracks.group else root


def drone_path(root: str, tracks: FlightTracks, drone: str) -> str:
    """Path of what belongs to a drone of the tracks of one file."""
    return f"{tracks_path(root, tracks)}/{part(drone)}"


def instants(tracks: FlightTracks) -> Instants:
    """The instants of tracks."""
    return Instants(tracks.trajectories.frame, tracks.trajectories.time_s)


def shown_rgb(tracks: FlightTracks) -> UInt8[np.ndarray, "frames drones 3"]:
    """Colours of drones by their status, which can be read on the dark and on the light theme."""
    return status_rgb(statuses(tracks.trajectories), tracks.colours, pale=_PALE)
