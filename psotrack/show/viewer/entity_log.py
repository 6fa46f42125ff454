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

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.show.flights import FlightTracks, TrackedFlight, colour_rgb
from psotrack.show.viewer.camera_images import CameraKey

#: Timelines: seconds of the recording, and numbers of instants.
TIME, FRAME = "time", "frame"
#: Rows that are sent together: Rerun keeps what is sent together in one piece.
_ROWS = 2000
#: How much white is mixed into the colours, because the viewer is dark.
_LIGHTER = 0.25


class EntityLog:
    """Logs values of entities into a recording of Rerun.

    Args:
        stream: the recording of Rerun.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)

    def static(self, path: str, values: Any) -> None:
        """Log values that hold at all times."""
        self._stream.log(path, values, static=True, strict=True)

    def rows(
        self,
        path: str,
        frame: Int[np.ndarray, " rows"],
        time_s: Float[np.ndarray, " rows"],
        columns: Callable[[slice], Any],
    ) -> None:
        """Log values over time, in pieces.

        Args:
            path: path of the entity.
            frame: (rows,), numbers of the instants.
            time_s: (rows,), times of the instants, seconds.
            columns: makes the columns of some of the rows.
        """
        for first in range(0, len(frame), _ROWS):
            rows = slice(first, first + _ROWS)
            times = [
                rr.TimeColumn(TIME, duration=np.asarray(time_s[rows], np.float64)),
                rr.TimeColumn(FRAME, sequence=np.asarray(frame[rows], np.int64)),
            ]
            rr.send_columns(path, times, columns(rows), recording=self._stream, strict=True)

    def rows_where(
        self,
        path: str,
        frame: Int[np.ndarray, " rows"],
        time_s: Float[np.ndarray, " rows"],
        there: Bool[np.ndarray, " rows"],
        columns: Callable[[Int[np.ndarray, " some"]], Any],
    ) -> None:
        """Log one value per row that has a value; at the first row without, the value before goes away.

        Args:
            path: path of the entity.
            frame, time_s: see `rows`.
            there: (rows,), whether a row has a value.
            columns: makes the columns of rows with these numbers, all of which have a value.
        """
        ends = np.diff(there.astype(int), prepend=0) < 0
        logged, values = np.flatnonzero(there | ends), np.flatnonzero(there)
        counts = there[logged].astype(int)
        self.rows(
            path,
            frame[logged],
            time_s[logged],
            lambda rows: columns(values[_part(counts, rows)]).partition(counts[rows]),
        )

    def boxes(
        self,
        path: str,
        frame: Int[np.ndarray, " rows"],
        time_s: Float[np.ndarray, " rows"],
        boxes_px: Sequence[Float[np.ndarray, "_ 4"]],
        rgb: UInt8[np.ndarray, "boxes 3"] | tuple[int, int, int],
        labels: Sequence[str] | None = None,
    ) -> None:
        """Log boxes in images over time.

        Args:
            path: path of the entity.
            frame, time_s: see `rows`.
            boxes_px: the boxes of each row; where a row has none, the boxes of the row before go away.
            rgb: colours of all boxes, or of each box of all rows.
            labels: names of all boxes of all rows; None: no names, and thin lines.
        """
        counts = np.array([len(each) for each in boxes_px], int)
        xyxy = np.concatenate([np.zeros((0, 4)), *boxes_px])
        colours = np.broadcast_to(np.array(rgb, np.uint8), (len(xyxy), 3))

        def columns(rows: slice) -> Any:
            part = _part(counts, rows)
            found = rr.Boxes2D.columns(
                half_sizes=(xyxy[part, 2:] - xyxy[part, :2]) / 2,
                centers=(xyxy[part, 2:] + xyxy[part, :2]) / 2,
                colors=colours[part],
                labels=None if labels is None else list(labels[part]),
            )
            return found.partition(counts[rows])

        radius = -0.75 if labels is None else -1.5  # negative: in pixels of the screen
        self.static(path, rr.Boxes2D.from_fields(radii=[radius], show_labels=labels is not None))
        self.rows(path, frame, time_s, columns)

    def lines(
        self,
        path: str,
        frame: Int[np.ndarray, " rows"],
        time_s: Float[np.ndarray, " rows"],
        lines_px: Sequence[Float[np.ndarray, "_ points 2"]],
        rgb: UInt8[np.ndarray, "lines 3"] | tuple[int, int, int],
        labels: Sequence[str] | None = None,
    ) -> None:
        """Log lines in images over time; the arguments are those of `boxes`."""
        counts = np.array([len(each) for each in lines_px], int)
        lines = [line for each in lines_px for line in each]
        colours = np.broadcast_to(np.array(rgb, np.uint8), (len(lines), 3))

        def columns(rows: slice) -> Any:
            part = _part(counts, rows)
            found = rr.LineStrips2D.columns(
                strips=lines[part],
                colors=colours[part],
                labels=None if labels is None else list(labels[part]),
            )
            return found.partition(counts[rows])

        self.static(path, rr.LineStrips2D.from_fields(radii=[-1.0], show_labels=labels is not None))
        self.rows(path, frame, time_s, columns)


def _part(counts: Int[np.ndarray, " rows"], rows: slice) -> slice:
    """The values of some rows, where each row has a number of values."""
    first = int(counts[: rows.start].sum())
    return slice(first, first + int(counts[rows].sum()))


def part(name: str) -> str:
    """A name as one part of a path."""
    return rr.escape_entity_path_part(name)


def camera_path(camera: CameraKey) -> str:
    """Path of a camera of the rig, or of one on a drone."""
    return f"world/{'onboard' if camera.on_drone else 'cameras'}/{part(camera.name)}"


def tracks_path(root: str, flight: TrackedFlight, tracks: FlightTracks) -> str:
    """Path of what belongs to the tracks of one file."""
    return root if len(flight.tracks) == 1 else f"{root}/{part(tracks.label)}"


def drone_path(root: str, flight: TrackedFlight, tracks: FlightTracks, drone: str) -> str:
    """Path of what belongs to a drone of the tracks of one file."""
    return f"{tracks_path(root, flight, tracks)}/{part(drone)}"


def drone_label(flight: TrackedFlight, tracks: FlightTracks, drone: str) -> str:
    """Name of a drone, with the name of the tracks where there are several."""
    return drone if len(flight.tracks) == 1 else f"{tracks.label} {drone}"


def shown_rgb(colour: str) -> tuple[int, int, int]:
    """A colour #rrggbb as the viewer shows it on its dark background."""
    return colour_rgb(colour, _LIGHTER)
