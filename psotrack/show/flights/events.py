"""Events of a flight: what people want to jump to, such as encounters, lost drones and large errors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float

from psotrack.errors import InputError
from psotrack.evaluation import errors_over_time
from psotrack.recordings import Recording
from psotrack.show.flights.flight import FlightTracks, TrackedFlight
from psotrack.trajectories import Status, Trajectories

#: Shortest time of coasting that is an event, seconds: shorter gaps are usual where drones cover each other.
_LONG_COASTING_S = 0.2


class EventKind(StrEnum):
    """Kinds of events, in the words that people read."""

    BEGINS = "begins"
    LOST = "lost"
    FOUND_AGAIN = "found again"
    COASTING = "coasting"
    MET = "met"
    SWITCH = "identity switch"
    LARGEST_ERROR = "largest error"
    LEFT_OUT = "camera left out"


@dataclass(frozen=True)
class Event:
    """An event of a flight.

    Attributes:
        time_s: time of the event, seconds.
        frame: number of the instant.
        kind: kind of the event.
        drones: names of the drones that take part; those of the reference for errors against the reference.
        text: a sentence that says what happened.
        tracks: label of the tracks.
        position_m: where it happened, metres: between the drones, or where a lost drone was last; None if unknown.
    """

    time_s: float
    frame: int
    kind: EventKind
    drones: tuple[str, ...]
    text: str
    tracks: str
    position_m: tuple[float, float, float] | None = None


def find_events(flight: TrackedFlight) -> tuple[Event, ...]:
    """The events of all tracks of a flight, in the order of their times.

    Begins, losses and coasting come from the status of the tracks; encounters and cameras that were left out from the
    record; identity switches and the largest error of each drone from the reference.
    """
    found: list[Event] = []
    for tracks in flight.tracks:
        found += _of_status(tracks)
        found += _of_record(tracks, flight.recording)
        if flight.truth is not None:
            found += _of_errors(tracks, flight.truth)
    return tuple(sorted(found, key=lambda event: (event.time_s, event.tracks, event.kind, event.drones)))


def _of_status(tracks: FlightTracks) -> Iterator[Event]:
    trajectories = tracks.trajectories
    for drone, name in enumerate(trajectories.drones):
        seen = trajectories.seen[:, drone]
        for number, (start, stop) in enumerate(intervals(seen)):
            if start > 0:
                kind = EventKind.FOUND_AGAIN if number else EventKind.BEGINS
                verb = "is found again" if number else "is first tracked"
                position_m = trajectories.position_m[start, drone]
                yield _event(tracks, start, kind, (name,), f"drone {name} {verb}", position_m)
            if stop < trajectories.num_frames:
                position_m = trajectories.position_m[stop - 1, drone]
                yield _event(tracks, stop, EventKind.LOST, (name,), f"drone {name} is lost", position_m)
        if trajectories.status is None:
            continue
        for start, stop in intervals(seen & (trajectories.status[:, drone] == Status.COASTING)):
            end = min(stop, trajectories.num_frames - 1)
            lasted_s = float(trajectories.time_s[end] - trajectories.time_s[start])
            if lasted_s >= _LONG_COASTING_S:
                text = f"drone {name} is predicted for {lasted_s:.2f} s, without measurements"
                position_m = trajectories.position_m[start, drone]
                yield _event(tracks, start, EventKind.COASTING, (name,), text, position_m)


def _of_record(tracks: FlightTracks, recording: Recording | None) -> Iterator[Event]:
    if tracks.record is None:
        return
    frame = tracks.trajectories.frame
    for met in tracks.record.encounters:
        if met.closest_frame not in frame:
            continue
        names = tuple(f"{drone}" for drone in met.drones)
        text = f"drones {names[0]} and {names[1]} meet at {met.distance_m:.2f} m; their labels: {met.outcome}"
        row = int(np.searchsorted(frame, met.closest_frame))
        together = [drone for drone, name in enumerate(tracks.trajectories.drones) if name in names]
        position_m = tracks.trajectories.position_m[row, together].mean(axis=0) if together else None
        yield _event(tracks, row, EventKind.MET, names, text, position_m)
    for camera, left_out in tracks.record.left_out.items():
        for first, stop in left_out:
            row = min(_row_of_frame(tracks, recording, camera, first), len(frame) - 1)
            text = f"camera {camera} is left out in {stop - first} frames: foreground is everywhere"
            yield _event(tracks, row, EventKind.LEFT_OUT, (), text, None)


def _row_of_frame(tracks: FlightTracks, recording: Recording | None, camera: str, number: int) -> int:
    """Row of the tracks at the time of a camera's frame; without the recording, frames count as instants."""
    if recording is None or camera not in recording.exposed or not recording.exposed[camera].num_frames:
        return int(np.searchsorted(tracks.trajectories.frame, number))
    time_s = recording.exposed[camera].time_s
    at_s = time_s[min(number, len(time_s) - 1)]
    return int(np.searchsorted(tracks.trajectories.time_s, at_s - 1e-6))


def _of_errors(tracks: FlightTracks, truth: Trajectories) -> Iterator[Event]:
    try:
        errors = errors_over_time(tracks.trajectories, truth)
    except InputError:
        # The reference begins after the tracks end, or knows no position: there is nothing to compare.
        return
    rows = np.searchsorted(tracks.trajectories.frame, errors["frame"].to_numpy())
    rows = np.minimum(rows, tracks.trajectories.num_frames - 1)
    names, error_m = errors["drone"].to_numpy(object), errors["error_m"].to_numpy(float)
    for switched in np.flatnonzero(errors["switch"].to_numpy(bool)):
        name = f"{names[switched]}"
        text = f"{name} is followed by another track than before"
        position_m = _position_m(truth, name, int(errors["frame"].iloc[switched]))
        yield _event(tracks, int(rows[switched]), EventKind.SWITCH, (name,), text, position_m)
    for name in dict.fromkeys(names):
        own_m = np.where((names == name) & np.isfinite(error_m), error_m, -1.0)
        largest = int(own_m.argmax())
        if own_m[largest] >= 0:
            text = f"{name} has its largest error, {1e3 * own_m[largest]:.0f} mm"
            position_m = _position_m(truth, name, int(errors["frame"].iloc[largest]))
            yield _event(tracks, int(rows[largest]), EventKind.LARGEST_ERROR, (f"{name}",), text, position_m)


def _position_m(truth: Trajectories, drone: str, frame: int) -> Float[np.ndarray, "3"]:
    """Position of a drone of the reference in a frame that the reference has."""
    return truth.position_m[np.searchsorted(truth.frame, frame), truth.drones.index(drone)]


def _event(
    tracks: FlightTracks,
    row: int,
    kind: EventKind,
    drones: tuple[str, ...],
    text: str,
    position_m: Float[np.ndarray, "3"] | None,
) -> Event:
    trajectories = tracks.trajectories
    known = position_m is not None and bool(np.isfinite(position_m).all())
    return Event(
        time_s=float(trajectories.time_s[row]),
        frame=int(trajectories.frame[row]),
        kind=kind,
        drones=drones,
        text=text,
        tracks=tracks.label,
        position_m=tuple(float(part) for part in position_m) if known else None,  # type: ignore[arg-type,union-attr]
    )


def intervals(wanted: Bool[np.ndarray, "frames"]) -> list[tuple[int, int]]:
    """The longest runs of True, as first index and index after the last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wanted, [False]]).astype(np.int8)))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]
