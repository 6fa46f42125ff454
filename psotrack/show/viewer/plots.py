"""What is shown over time: quantities of the drones, their status, and the events."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import rerun as rr

from psotrack.show.flights import (
    EventKind,
    FlightTracks,
    TrackedFlight,
    colour_rgb,
    find_events,
    quantities,
    statuses,
)
from psotrack.show.viewer.entity_log import EntityLog, Instants, drone_path, instants
from psotrack.trajectories import Status

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
