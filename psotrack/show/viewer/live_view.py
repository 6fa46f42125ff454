"""Rows of a live session in Rerun, as they come."""

from __future__ import annotations

import contextlib
from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Float

from psotrack.recordings import Recording
from psotrack.show.flights import (
    FlightTracks,
    TrackedFlight,
    colour_rgb,
    deviations_mm,
    flight_of,
    statuses,
)
from psotrack.show.viewer.entities import (
    EntityLog,
    Instants,
    instants,
    log_drones,
    log_status,
    log_world,
    shown_rgb,
)
from psotrack.show.viewer.flight_file import APPLICATION, live_blueprint
from psotrack.show.viewer.programs import viewer_program
from psotrack.support import drone_colour, whole_number
from psotrack.trajectories import Trajectories

#: Number of positions in a drone's trail: three seconds at 25 per second.
_TRAIL_ROWS = 75
#: Time that the viewer has for the last rows, seconds.
_LAST_ROWS_S = 2.0


class LiveView:
    """Shows rows as they come, as a context manager; a viewer that was closed costs no rows elsewhere.

    Args:
        recording: the cameras.
        web: serve a page for browsers, instead of a window.

    Attributes:
        page: address of the page; empty for a window.

    Raises:
        OutputError: the viewer cannot start.
    """

    def __init__(self, recording: Recording, *, web: bool = False) -> None:
        self._recording, self._web = recording, web
        self._trails: dict[str, deque[Float[np.ndarray, "3"]]] = {}
        self._status: dict[str, int] = {}
        self._colours: dict[str, str] = {}
        self._num_lines = 0
        self._ends = contextlib.ExitStack()
        self._now = Instants(np.zeros(1, int), np.zeros(1))
        self.page = ""

    def __enter__(self) -> LiveView:
        with contextlib.ExitStack() as stack:
            program = stack.enter_context(viewer_program(web=self._web))
            self.page = program.page
            self._stream = rr.RecordingStream(APPLICATION, send_properties=False)
            self._stream.connect_grpc(program.address)
            stack.callback(self._close)
            self._stream.send_blueprint(live_blueprint())
            self._log = EntityLog(self._stream)
            log_world(self._log, TrackedFlight(self._recording.name, (), self._recording))
            self._ends = stack.pop_all()
        return self

    def write(self, rows: Trajectories) -> None:
        """Show the rows of an instant: what belongs together is one entity, because each costs half a millisecond."""
        (tracks,) = flight_of(rows).tracks
        for name in rows.drones:
            number = whole_number(name)
            number = len(self._colours) if number is None else number
            self._colours.setdefault(name, drone_colour(number))
        tracks = replace(tracks, colours=tuple(self._colours[name] for name in rows.drones))
        self._now = instants(tracks)
        log_drones(self._log, "world/drones", tracks, range(len(rows.drones)))
        log_status(self._log, tracks, self._status)
        self._status |= dict(zip(rows.drones, statuses(rows)[0].tolist(), strict=True))
        self._show_trails(tracks)
        self._show_deviations(rows)

    def _show_trails(self, tracks: FlightTracks) -> None:
        rows, trails = tracks.trajectories, self._trails
        position_m = dict(zip(rows.drones, rows.position_m[0].astype(np.float64), strict=True))
        known = [name for name, at_m in position_m.items() if np.isfinite(at_m).all()]
        self._trails = {name: trails.get(name, deque(maxlen=_TRAIL_ROWS)) for name in known}
        for name, trail in self._trails.items():
            trail.append(position_m[name])
        rgb = shown_rgb(tracks)[0, [rows.drones.index(name) for name in known]]
        strips_m = [np.stack(trail) for trail in self._trails.values()]
        self._show("world/drones/trail", rr.LineStrips3D, len(known), strips=strips_m, colors=rgb)

    def _show_deviations(self, rows: Trajectories) -> None:
        if rows.covariance_m2 is None:
            return
        path, names = "plots/deviation_mm", list(self._colours)
        if len(names) > self._num_lines:
            self._num_lines = len(names)
            colours = [colour_rgb(colour) for colour in self._colours.values()]
            self._stream.log(path, rr.SeriesLines(colors=colours, names=names, widths=[1.5]), static=True)
        values_mm = np.full(len(names), np.nan)
        own_mm = np.where(rows.seen[0], deviations_mm(rows.covariance_m2[0]), np.nan)
        values_mm[[names.index(name) for name in rows.drones]] = own_mm
        self._show(path, rr.Scalars, len(names), scalars=values_mm)

    def show_delay(self, delay_s: float) -> None:
        """Show the delay of the instant whose rows were written last, seconds."""
        self._show("plots/delay_ms", rr.Scalars, 1, scalars=[1e3 * delay_s])

    def _show(self, path: str, kind: Any, count: int, **values: Any) -> None:
        """Show some values of one entity at this instant."""
        self._log.rows(path, self._now, kind, np.array([count]), **values)

    def __exit__(self, *error: object) -> None:
        self._ends.close()

    def _close(self) -> None:
        # The viewer may have been closed.
        with contextlib.suppress(Exception):
            self._stream.flush(timeout_sec=_LAST_ROWS_S)
        self._stream.disconnect()
