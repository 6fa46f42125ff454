"""Entities of Rerun: their paths, the logging of values over time, and what is in the world and in plots.

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

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from jaxtyping import Float, Int, UInt8
from scipy.spatial.transform import Rotation

from psotrack.inside_out import MarkerMap, read_marker_table
from psotrack.show.flights import (
    EventKind,
    FlightTracks,
    TrackedFlight,
    colour_rgb,
    ellipsoids_90,
    find_events,
    intervals,
    quantities,
    status_rgb,
    statuses,
)
from psotrack.show.viewer.camera_images import CameraKey
from psotrack.trajectories import Status

_Counts = Int[np.ndarray, " rows"]
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

    frame: _Counts
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

    def rows(self, path: str, at: Instants, kind: Any, counts: _Counts | None = None, **values: Any) -> None:
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

    def marks(
        self, path: str, at: Instants, kind: Any, counts: _Counts, rgb: Any, radius_px: float, **values: Any
    ) -> None:
        """Log marks in images over time, in one colour or in a colour each; see `rows`.

        Args:
            path, at, kind, counts, **values: as for `rows`.
            rgb: the colour, or a colour of each mark.
            radius_px: half the width of the lines, pixels of the screen.
        """
        has_labels = values.get("labels") is not None
        self.static(path, kind.from_fields(radii=[-radius_px], show_labels=has_labels))
        colours = np.broadcast_to(np.array(rgb, np.uint8), (int(counts.sum()), 3))
        self.rows(path, at, kind, counts, colors=colours, **values)


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


MARKER_RGB = (255, 90, 200)
_GREY_RGB = (110, 110, 110)
_TRUTH_RGBA = (128, 128, 128, 200)
#: Opacity of the whole path of a drone, 0 to 255: the trail is in front of it.
_PATH_OPACITY = 110
#: Distance of the images from the cameras, metres.
_IMAGE_DISTANCE_M = 1.0


def log_world(log: EntityLog, flight: TrackedFlight) -> None:
    """Log what does not move: cameras, bounds and markers."""
    log.static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    recording = flight.recording
    if recording is None:
        return
    for index, name in enumerate(recording.rig.names):
        camera = recording.rig.cameras[index]
        T_world_cam = np.linalg.inv(np.asarray(camera.T_cam_world, np.float64))
        path = camera_path(CameraKey(name))
        log.static(path, rr.Transform3D(translation=T_world_cam[:3, 3], mat3x3=T_world_cam[:3, :3]))
        log.static(path, pinhole(np.asarray(camera.K), np.asarray(camera.image_size_wh), _IMAGE_DISTANCE_M))
    if recording.bounds_m is not None:
        low, high = np.array(recording.bounds_m).reshape(3, 2).T
        bounds = rr.Boxes3D(centers=[(low + high) / 2], half_sizes=[(high - low) / 2], colors=[_GREY_RGB])
        log.static("world/bounds", bounds)
    table = None if recording.marker_corners is None else read_marker_table(recording.marker_corners)
    if isinstance(table, MarkerMap):
        outlines_m = table.all_corners_m[:, [0, 1, 2, 3, 0]]
        log.static("world/markers", rr.LineStrips3D(outlines_m, colors=[MARKER_RGB], radii=[0.004]))


def log_flight(log: EntityLog, flight: TrackedFlight) -> None:
    """Log the drones of all tracks with their trails and paths, and the reference."""
    for tracks in flight.tracks:
        for drone, name in enumerate(tracks.trajectories.drones):
            path = drone_path("world/drones", tracks, name)
            log_drones(log, path, tracks, [drone])
            _log_path(log, tracks, drone, path)
    truth = flight.truth
    for drone, name in enumerate(() if truth is None else truth.drones):
        assert truth is not None
        position_m, path = truth.position_m[:, drone], f"world/truth/{part(name)}"
        known = np.isfinite(position_m).all(axis=-1)
        log.static(f"{path}/point", rr.Points3D.from_fields(colors=[_TRUTH_RGBA], radii=[0.03]))
        at = Instants(truth.frame, truth.time_s)
        log.rows(f"{path}/point", at, rr.Points3D, known.astype(int), positions=position_m[known])
        log.static(f"{path}/path", rr.LineStrips3D([position_m[known]], colors=[_TRUTH_RGBA], radii=[0.004]))


def log_drones(log: EntityLog, path: str, tracks: FlightTracks, drones: Sequence[int]) -> None:
    """Log the bodies and ellipsoids of some drones as one entity.

    Args:
        log: receives the values.
        path: path of the entity.
        tracks: the tracks.
        drones: indices of the drones.
    """
    flown, at = tracks.trajectories, instants(tracks)
    position_m, status = flown.position_m[:, drones], statuses(flown)[:, drones]
    rgb, half_m = shown_rgb(tracks)[:, drones], np.broadcast_to(tracks.size_m[drones] / 2, position_m.shape)
    known = np.isfinite(position_m).all(axis=-1)
    names = [tracks.names[drones[each]] for each in np.nonzero(known)[1].tolist()]
    labels = [
        name if each == Status.TRACKED else f"{name} {Status(each).label}"
        for name, each in zip(names, status[known].tolist(), strict=True)
    ]
    shapes = {"centers": position_m[known], "half_sizes": half_m[known], "colors": rgb[known]}
    log.rows(f"{path}/body", at, rr.Boxes3D, known.sum(axis=1), **shapes, labels=labels)
    if flown.covariance_m2 is None:
        return
    half_m, turn = ellipsoids_90(flown.covariance_m2[:, drones])
    # The ellipsoid of a lost drone grows to the size of the room.
    shown = known & np.isfinite(half_m).all(axis=-1) & (status != Status.LOST)
    turned = Rotation.from_matrix(turn[shown]).as_quat()
    # A large ellipsoid must not hide what is behind.
    fill = rr.components.FillMode.TransparentFillMajorWireframe
    log.static(f"{path}/ellipsoid", rr.Ellipsoids3D.from_fields(fill_mode=fill))
    shapes = {"centers": position_m[shown], "half_sizes": half_m[shown], "colors": rgb[shown]}
    log.rows(f"{path}/ellipsoid", at, rr.Ellipsoids3D, shown.sum(axis=1), **shapes, quaternions=turned)


def pinhole(K: Float[np.ndarray, "3 3"], image_size_wh: np.ndarray, distance_m: float) -> rr.Pinhole:
    """A lens without distortion.

    Args:
        K: (3, 3), intrinsics, pixels.
        image_size_wh: (2,), width and height, pixels.
        distance_m: distance of the image from the camera in the view of space, metres.
    """
    shifted = np.array(K, np.float64)
    # Pixel centres are at whole numbers in K, and half a pixel further in Rerun.
    shifted[:2, 2] += 0.5
    width, height = (int(side) for side in image_size_wh)
    return rr.Pinhole(
        image_from_camera=shifted,
        width=width,
        height=height,
        image_plane_distance=distance_m,
        color=_GREY_RGB,
    )


def _log_path(log: EntityLog, tracks: FlightTracks, drone: int, path: str) -> None:
    """Log the trail of a drone, from each row before to this one, and the whole path where it is not lost."""
    position_m, rgb = tracks.trajectories.position_m[:, drone], shown_rgb(tracks)[:, drone]
    known = np.isfinite(position_m).all(axis=-1)
    follows = known & np.roll(known, 1) & (np.arange(len(known)) > 0)
    strips_m = np.stack([np.roll(position_m, 1, axis=0), position_m], axis=1)[follows]
    lines = {"strips": strips_m, "colors": rgb[follows]}
    log.rows(f"{path}/trail", instants(tracks), rr.LineStrips3D, follows.astype(int), **lines)
    flown = intervals(known & (statuses(tracks.trajectories)[:, drone] != Status.LOST))
    own = (*colour_rgb(tracks.colours[drone]), _PATH_OPACITY)
    whole_m = [position_m[start:stop] for start, stop in flown]
    log.static(f"{path}/path", rr.LineStrips3D(whole_m, colors=[own], radii=[0.006]))


#: Events that are shown as warnings.
_WARNINGS = {EventKind.LOST, EventKind.SWITCH, EventKind.LEFT_OUT}
#: Colours of tracked, coasting and lost.
_STATUS_RGB = [(60, 160, 90), (230, 170, 40), (200, 60, 60)]


def log_plots(log: EntityLog, flight: TrackedFlight) -> None:
    """Log the quantities, the status and the events of all tracks."""
    for tracks in flight.tracks:
        _log_quantities(log, flight, tracks)
        log_status(log, tracks)
    if flight.tracks:
        _log_events(log, flight)


def _log_quantities(log: EntityLog, flight: TrackedFlight, tracks: FlightTracks) -> None:
    """Log a line of each quantity per drone."""
    for quantity in quantities(flight, tracks):
        at = Instants(quantity.frame, quantity.time_s)
        for name, colour, values in zip(quantity.names, quantity.colours, quantity.values.T, strict=True):
            path, shown = drone_path(f"plots/{quantity.key}", tracks, name), f"{tracks.group} {name}".strip()
            log.static(path, rr.SeriesLines(colors=[colour_rgb(colour)], names=[shown], widths=[1.5]))
            log.rows(path, at, rr.Scalars, scalars=values)


def log_status(log: EntityLog, tracks: FlightTracks, before: Mapping[str, int] = {}) -> None:
    """Log each change of a drone's status.

    Args:
        log: receives the changes.
        tracks: the tracks.
        before: status before the first row by the drones' names.
    """
    words = [each.label for each in Status]
    for drone, name in enumerate(tracks.trajectories.drones):
        path, status = drone_path("status", tracks, name), statuses(tracks.trajectories)[:, drone]
        changes = np.flatnonzero(np.diff(status, prepend=before.get(name, -1)))
        if not len(changes):
            continue
        log.static(path, rr.StateConfiguration(values=words, labels=words, colors=_STATUS_RGB))
        at = Instants(*(part[changes] for part in instants(tracks)))
        log.rows(path, at, rr.StateChange, state=[words[each] for each in status[changes]])


def _log_events(log: EntityLog, flight: TrackedFlight) -> None:
    events = find_events(flight)
    several = len(flight.tracks) > 1
    for kind in EventKind:
        own = [event for event in events if event.kind == kind]
        texts = [f"{event.tracks}: {event.text}" if several else event.text for event in own]
        at = Instants(
            np.array([event.frame for event in own], int), np.array([event.time_s for event in own], float)
        )
        level = ["WARN" if kind in _WARNINGS else "INFO"] * len(own)
        log.rows(f"events/{kind.replace(' ', '_')}", at, rr.TextLog, text=texts, level=level)
