"""Events of a flight: what people want to jump to, such as encounters, lost drones and large errors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Bool, Float

from psotrack.recordings import Recording
from psotrack.show.flights.flight import FlightTracks, TrackedFlight
from psotrack.trajectories import Status

#: Shortest time of coasting that is an event, seconds: shorter gaps are usual where drones cover each other.
_LONG_COASTING_S = 0.2
#: Where an event happened whose place is not known.
_NOWHERE_M = np.full(3, np.nan)


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


@dataclass(frozen=True, eq=False)
class Event:
    """An event of a flight.

    Attributes:
        time_s: time of the event, seconds.
        frame: number of the instant.
        kind: kind of the event.
        drones: names of the drones that take part; those of the reference for errors against the reference.
        text: a sentence that says what happened.
        tracks: label of the tracks.
        position_m: where it happened, metres: between the drones, or where a lost drone was last; NaN if unknown.
    """

    time_s: float
    frame: int
    kind: EventKind
    drones: tuple[str, ...]
    text: str
    tracks: str
    position_m: Float[np.ndarray, "3"]


def find_events(flight: TrackedFlight) -> tuple[Event, ...]:
    """The events of all tracks of a flight, in the order of their times.

    Begins, losses and coasting come from the status of the tracks; encounters and cameras that were left out from the
    record; identity switches and the largest error of each drone from the reference.
    """
    found = [
        event
        for tracks in flight.tracks
        for event in (*_of_status(tracks), *_of_record(tracks, flight.recording), *_of_errors(flight, tracks))
    ]
    return tuple(sorted(found, key=lambda event: (event.time_s, event.tracks, event.kind, event.drones)))


def _event(
    tracks: FlightTracks,
    row: int,
    kind: EventKind,
    drones: tuple[str, ...],
    text: str,
    position_m: Float[np.ndarray, "3"] = _NOWHERE_M,
) -> Event:
    trajectories = tracks.trajectories
    at = float(trajectories.time_s[row]), int(trajectories.frame[row])
    return Event(*at, kind, drones, text, tracks.label, np.asarray(position_m, np.float64))


def _of_status(tracks: FlightTracks) -> Iterator[Event]:
    trajectories, last = tracks.trajectories, tracks.trajectories.num_frames - 1
    for drone, name in enumerate(trajectories.drones):
        seen, position_m = trajectories.seen[:, drone], trajectories.position_m[:, drone]
        for number, (start, stop) in enumerate(intervals(seen)):
            if start > 0:
                kind = EventKind.FOUND_AGAIN if number else EventKind.BEGINS
                verb = "is found again" if number else "is first tracked"
                yield _event(tracks, start, kind, (name,), f"drone {name} {verb}", position_m[start])
            if stop <= last:
                text = f"drone {name} is lost"
                yield _event(tracks, stop, EventKind.LOST, (name,), text, position_m[stop - 1])
        if trajectories.status is None:
            continue
        for start, stop in intervals(seen & (trajectories.status[:, drone] == Status.COASTING)):
            lasted_s = float(trajectories.time_s[min(stop, last)] - trajectories.time_s[start])
            if lasted_s >= _LONG_COASTING_S:
                text = f"drone {name} is predicted for {lasted_s:.2f} s, without measurements"
                yield _event(tracks, start, EventKind.COASTING, (name,), text, position_m[start])


def _of_record(tracks: FlightTracks, recording: Recording | None) -> Iterator[Event]:
    if tracks.record is None:
        return
    trajectories = tracks.trajectories
    for met in tracks.record.encounters:
        if met.closest_frame not in trajectories.frame:
            continue
        names = tuple(f"{drone}" for drone in met.drones)
        text = f"drones {names[0]} and {names[1]} meet at {met.distance_m:.2f} m; their labels: {met.outcome}"
        row = int(np.searchsorted(trajectories.frame, met.closest_frame))
        together = [drone for drone, name in enumerate(trajectories.drones) if name in names]
        between_m = trajectories.position_m[row, together].mean(axis=0) if together else _NOWHERE_M
        yield _event(tracks, row, EventKind.MET, names, text, between_m)
    for knock in tracks.record.knocks:
        row = min(int(np.searchsorted(trajectories.frame, knock["frame"])), trajectories.num_frames - 1)
        yield _event(tracks, row, EventKind.LEFT_OUT, (), f"camera {knock['camera']} was knocked")
    for camera, left_out in tracks.record.left_out.items():
        for first, stop in left_out:
            row = min(_row_of_frame(tracks, recording, camera, first), trajectories.num_frames - 1)
            text = f"camera {camera} is left out in {stop - first} frames: foreground is everywhere"
            yield _event(tracks, row, EventKind.LEFT_OUT, (), text)


def _row_of_frame(tracks: FlightTracks, recording: Recording | None, camera: str, number: int) -> int:
    """Row of the tracks at the time of a camera's frame; without the recording, frames count as instants."""
    if recording is None or camera not in recording.exposed or not recording.exposed[camera].num_frames:
        return int(np.searchsorted(tracks.trajectories.frame, number))
    time_s = recording.exposed[camera].time_s
    at_s = time_s[min(number, len(time_s) - 1)]
    return int(np.searchsorted(tracks.trajectories.time_s, at_s - 1e-6))


def _of_errors(flight: TrackedFlight, tracks: FlightTracks) -> Iterator[Event]:
    errors, truth = flight.errors(tracks), flight.truth
    if errors is None or truth is None:
        return

    def happened(kind: EventKind, at: int, text: str) -> Event:
        """An event in a row of the errors."""
        name, frame = f"{errors['drone'].iloc[at]}", int(errors["frame"].iloc[at])
        row = min(int(np.searchsorted(tracks.trajectories.frame, frame)), tracks.trajectories.num_frames - 1)
        place_m = truth.position_m[np.searchsorted(truth.frame, frame), truth.drones.index(name)]
        return _event(tracks, row, kind, (name,), f"{name} {text}", place_m)

    for at in np.flatnonzero(errors["switch"]).tolist():
        yield happened(EventKind.SWITCH, at, "is followed by another track than before")
    known_m = errors["error_m"].dropna()
    for at in known_m.groupby(errors["drone"], observed=True).idxmax():
        text = f"has its largest error, {1e3 * known_m[at]:.0f} mm"
        yield happened(EventKind.LARGEST_ERROR, int(at), text)


def intervals(wanted: Bool[np.ndarray, "frames"]) -> list[tuple[int, int]]:
    """The longest runs of True, as first index and index after the last."""
    edges = np.flatnonzero(np.diff(wanted.astype(np.int8), prepend=0, append=0))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]
