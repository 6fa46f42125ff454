"""What is shown over time: quantities of the drones, their status, and the events."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Float, Int

from psotrack.errors import InputError
from psotrack.evaluation import errors_over_time
from psotrack.show.flights import EventKind, FlightTracks, TrackedFlight, find_events, statuses
from psotrack.show.viewer.entity_log import EntityLog, drone_label, drone_path, shown_rgb
from psotrack.support import COLOURS
from psotrack.trajectories import Status

#: Events that are shown as warnings.
_WARNINGS = {EventKind.LOST, EventKind.SWITCH, EventKind.LEFT_OUT}
#: Colours of tracked, coasting and lost.
_STATUS_RGB = [(60, 160, 90), (230, 170, 40), (200, 60, 60)]


def log_plots(log: EntityLog, flight: TrackedFlight) -> None:
    """Log score, number of cameras, standard deviation, errors, status and events of all tracks."""
    for number, tracks in enumerate(flight.tracks):
        colours = [shown_rgb(colour) for colour in flight.colours(number)]
        for quantity, values in _quantities(tracks).items():
            for drone, name in enumerate(tracks.trajectories.drones):
                _log_line(
                    log,
                    drone_path(f"plots/{quantity}", flight, tracks, name),
                    tracks.trajectories.frame,
                    tracks.trajectories.time_s,
                    values[:, drone],
                    colours[drone],
                    drone_label(flight, tracks, name),
                )
        for drone, name in enumerate(tracks.trajectories.drones):
            log_status_words(log, drone_path("status", flight, tracks, name))
            _log_status(log, drone_path("status", flight, tracks, name), tracks, drone)
        _log_errors(log, flight, tracks, colours)
    if flight.tracks:
        _log_events(log, flight)


def log_status_words(log: EntityLog, path: str) -> None:
    """Log which words a status has, and their colours."""
    words = [each.label for each in Status]
    log.static(path, rr.StateConfiguration(values=words, labels=words, colors=_STATUS_RGB))


def _quantities(tracks: FlightTracks) -> dict[str, Float[np.ndarray, "frames drones"]]:
    """Quantities by name; NaN where a drone is not seen."""
    trajectories = tracks.trajectories
    found = {"score": trajectories.fitness, "cameras": trajectories.num_cameras}
    if trajectories.covariance_m2 is not None:
        variance_m2 = np.trace(trajectories.covariance_m2, axis1=-2, axis2=-1)
        found["deviation_mm"] = 1e3 * np.sqrt(np.maximum(variance_m2, 0.0))
    return {
        name: np.where(trajectories.seen, values, np.nan).astype(np.float64)
        for name, values in found.items()
        if values is not None
    }


def _log_errors(
    log: EntityLog, flight: TrackedFlight, tracks: FlightTracks, colours: Sequence[tuple[int, int, int]]
) -> None:
    if flight.truth is None:
        return
    try:
        errors = errors_over_time(tracks.trajectories, flight.truth)
    except InputError:
        # The reference knows no position at the time of the tracks.
        return
    for number, (drone, of_drone) in enumerate(errors.groupby("drone", observed=True)):
        name = f"{drone}"
        _log_line(
            log,
            drone_path("plots/error_mm", flight, tracks, name),
            of_drone["frame"].to_numpy(np.int64),
            of_drone["time_s"].to_numpy(np.float64),
            1e3 * of_drone["error_m"].to_numpy(np.float64),
            # Drones of the reference are others than those of the tracks.
            colours[0] if len(flight.tracks) > 1 else shown_rgb(COLOURS[number % len(COLOURS)]),
            drone_label(flight, tracks, name),
        )


def _log_status(log: EntityLog, path: str, tracks: FlightTracks, drone: int) -> None:
    status = statuses(tracks.trajectories)[:, drone]
    changes = np.flatnonzero(np.diff(status, prepend=-1))
    words = [Status(int(each)).label for each in status[changes]]
    log.rows(
        path,
        tracks.trajectories.frame[changes],
        tracks.trajectories.time_s[changes],
        lambda rows: rr.StateChange.columns(state=words[rows]),
    )


def _log_line(
    log: EntityLog,
    path: str,
    frame: Int[np.ndarray, " rows"],
    time_s: Float[np.ndarray, " rows"],
    values: Float[np.ndarray, " rows"],
    rgb: tuple[int, int, int],
    name: str,
) -> None:
    log.static(path, rr.SeriesLines(colors=[rgb], names=[name], widths=[1.5]))
    log.rows(path, frame, time_s, lambda rows: rr.Scalars.columns(scalars=values[rows]))


def _log_events(log: EntityLog, flight: TrackedFlight) -> None:
    events = find_events(flight)
    for kind in EventKind:
        of_kind = [event for event in events if event.kind == kind]
        texts = [
            event.text if len(flight.tracks) == 1 else f"{event.tracks}: {event.text}" for event in of_kind
        ]
        level = "WARN" if kind in _WARNINGS else "INFO"
        log.rows(
            f"events/{kind.replace(' ', '_')}",
            np.array([event.frame for event in of_kind], np.int64),
            np.array([event.time_s for event in of_kind], np.float64),
            functools.partial(_sentences, texts, level),
        )


def _sentences(texts: list[str], level: str, rows: slice) -> Any:
    return rr.TextLog.columns(text=texts[rows], level=[level] * len(texts[rows]))
