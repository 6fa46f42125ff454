"""Events of a flight, to which people want to jump, and the quality of its tracks over time and of each camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.recordings import Recording, view_in_images
from psotrack.show.flights.flight import FlightTracks, TrackedFlight
from psotrack.support import drone_colour
from psotrack.trajectories import Status

if TYPE_CHECKING:
    from pandas import DataFrame

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
    row = min(row, trajectories.num_frames - 1)
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
        row = int(np.searchsorted(trajectories.frame, knock["frame"]))
        yield _event(tracks, row, EventKind.LEFT_OUT, (), f"camera {knock['camera']} was knocked")
    for camera, left_out in tracks.record.left_out.items():
        for first, stop in left_out:
            row = _row_of_frame(tracks, recording, camera, first)
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
        row = int(np.searchsorted(tracks.trajectories.frame, frame))
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


#: Quantities over time: their names with units, and what they mean.
QUANTITIES = {
    "error_mm": ("error (mm)", "Distance of each drone of the reference from its track."),
    "score": ("score", "How well the images fit the position of each drone, from 0 to 1."),
    "deviation_mm": ("std (mm)", "Standard deviation of each position in space, as the run states it."),
    "cameras": ("cameras", "Number of cameras that see each drone."),
}


@dataclass(frozen=True)
class Quantity:
    """A quantity over time, with a line per drone.

    Attributes:
        key: one of `QUANTITIES`.
        frame, time_s: (rows,), numbers and times of the instants, seconds.
        values: (rows, lines), NaN where it is not known.
        names: name of each drone: of the tracks, or of the reference for errors.
        colours: colour of each line, as #rrggbb.
    """

    key: str
    frame: Int[np.ndarray, "rows"]
    time_s: Float[np.ndarray, "rows"]
    values: Float[np.ndarray, "rows lines"]
    names: tuple[str, ...]
    colours: tuple[str, ...]


def quantities(flight: TrackedFlight, tracks: FlightTracks) -> Iterator[Quantity]:
    """The quantities over time that are known of tracks, in the order of `QUANTITIES`."""
    errors, flown = flight.errors(tracks), tracks.trajectories
    if errors is not None:
        table = errors.pivot(index=["frame", "time_s"], columns="drone", values="error_m").sort_index()
        frame, time_s = (table.index.get_level_values(level).to_numpy() for level in ("frame", "time_s"))
        names = tuple(f"{name}" for name in table.columns)
        # Drones of the reference are others than those of the tracks.
        colours = tuple(
            tracks.colours[0] if tracks.group else drone_colour(index) for index in range(len(names))
        )
        yield Quantity("error_mm", frame, time_s, 1e3 * table.to_numpy(float), names, colours)
    deviation_mm = None if flown.covariance_m2 is None else deviations_mm(flown.covariance_m2)
    found = {"score": flown.fitness, "deviation_mm": deviation_mm, "cameras": flown.num_cameras}
    for key, values in found.items():
        if values is not None:
            shown = np.where(flown.seen, values, np.nan).astype(np.float64)
            yield Quantity(key, flown.frame, flown.time_s, shown, flown.drones, tracks.colours)


def deviations_mm(covariance_m2: Float[np.ndarray, "*points 3 3"]) -> Float[np.ndarray, "*points"]:
    """Standard deviations of positions in space, mm: roots of the sums of their variances along the axes."""
    return 1e3 * np.sqrt(np.maximum(np.trace(covariance_m2, axis1=-2, axis2=-1), 0.0))


def camera_quality(tracks: FlightTracks, recording: Recording) -> DataFrame:
    """One row per camera of the recording's rig.

    Returns:
        Columns `camera`; `frames`, fraction of the instants at which the camera has a frame; `in_view`, share of the
        drones' positions that are in its image; `width_px`, median width of the drones' boxes in its image; `noise_px`,
        the noise of the drones' places in its image as the run learned it, root mean square of columns and rows;
        `explained`, share of its detections that are near a track; `left_out`, number of its frames that the run left
        out. NaN where unknown.
    """
    import pandas as pd

    views = view_in_images(recording, tracks.trajectories, tracks.size_m)
    names, record = recording.rig.names, tracks.record
    widths_px = pd.DataFrame((views.boxes_px[..., 2] - views.boxes_px[..., 0]).reshape(-1, len(names)))
    errors = {} if record is None else record.camera_errors.get("cameras", {})
    noise_px = pd.DataFrame(
        [errors.get(name, {}).get("noise_px") or (np.nan, np.nan) for name in names], dtype=float
    )
    explained = {} if record is None else record.explained.get("cameras", {})
    left_out = {} if record is None else record.left_out
    return pd.DataFrame(
        {
            "camera": names,
            "frames": (views.frame >= 0).mean(axis=0),
            "in_view": widths_px.count() / max(int(tracks.trajectories.seen.sum()), 1),
            "width_px": widths_px.median(),
            "noise_px": np.sqrt(noise_px.pow(2).mean(axis=1)),
            "explained": pd.Series([explained.get(name) for name in names], dtype=float),
            "left_out": [sum(stop - first for first, stop in left_out.get(name, ())) for name in names],
        }
    )
