"""Rows of a live session in Rerun, as they come."""

from __future__ import annotations

import contextlib
from collections import deque
from dataclasses import replace
from functools import partial
from types import TracebackType
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Float

from psotrack.recordings import Recording
from psotrack.show.flights import TrackedFlight, flight_of, statuses
from psotrack.show.viewer.entity_log import EntityLog, Instants, instants, part, shown_rgb
from psotrack.show.viewer.flight_file import APPLICATION
from psotrack.show.viewer.layout import live_blueprint
from psotrack.show.viewer.plots import log_quantities, log_status
from psotrack.show.viewer.programs import viewer_program
from psotrack.show.viewer.space import log_drones, log_world
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
        """Show the rows of an instant."""
        (tracks,) = flight_of(rows).tracks
        for name in rows.drones:
            number = whole_number(name)
            number = len(self._colours) if number is None else number
            self._colours.setdefault(name, drone_colour(number))
        tracks = replace(tracks, colours=tuple(self._colours[name] for name in rows.drones))
        self._now = instants(tracks)
        log_drones(self._log, tracks)
        log_quantities(self._log, TrackedFlight("", (), None), tracks, ("deviation_mm",))
        log_status(self._log, tracks, self._status)
        self._status |= dict(zip(rows.drones, statuses(rows)[0].tolist(), strict=True))
        self._show_trails(rows, shown_rgb(tracks)[0].tolist())

    def _show_trails(self, rows: Trajectories, rgb: list[list[int]]) -> None:
        known = dict(zip(rows.drones, np.isfinite(rows.position_m[0]).all(axis=-1).tolist(), strict=True))
        for name in [name for name in self._trails if not known.get(name)]:
            path = f"world/drones/{part(name)}"
            self._log.rows(path, self._now, partial(_only, rr.Clear.columns(is_recursive=[True])))
            del self._trails[name]
        for index, name in enumerate(rows.drones):
            if known[name]:
                trail = self._trails.setdefault(name, deque(maxlen=_TRAIL_ROWS))
                trail.append(rows.position_m[0, index].astype(np.float64))
                line = rr.LineStrips3D.columns(strips=[np.stack(trail)], colors=[rgb[index]])
                self._log.rows(f"world/drones/{part(name)}/trail", self._now, partial(_only, line))

    def show_delay(self, delay_s: float) -> None:
        """Show the delay of the instant whose rows were written last, seconds."""
        self._log.rows(
            "plots/delay_ms", self._now, partial(_only, rr.Scalars.columns(scalars=[1e3 * delay_s]))
        )

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ends.close()

    def _close(self) -> None:
        # The viewer may have been closed.
        with contextlib.suppress(Exception):
            self._stream.flush(timeout_sec=_LAST_ROWS_S)
        self._stream.disconnect()


def _only(columns: Any, _: slice) -> Any:
    """Columns of a single row, for `EntityLog.rows`."""
    return columns
