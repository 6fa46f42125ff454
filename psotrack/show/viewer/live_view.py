"""Rows of a live session in Rerun, as they come."""

from __future__ import annotations

import contextlib
from collections import deque
from types import TracebackType

import numpy as np
import rerun as rr
from jaxtyping import Float

from psotrack.recordings import Recording
from psotrack.show.flights import USUAL_SIZE_M, TrackedFlight, ellipsoids_90, status_rgb
from psotrack.show.viewer.entity_log import FRAME, TIME, EntityLog, part, shown_rgb
from psotrack.show.viewer.flight_file import APPLICATION
from psotrack.show.viewer.layout import live_blueprint
from psotrack.show.viewer.plots import log_status_words
from psotrack.show.viewer.programs import viewer_program
from psotrack.show.viewer.space import ELLIPSOID_FILL, log_world, quaternions_xyzw, status_label
from psotrack.support import COLOURS, whole_number
from psotrack.trajectories import Status, Trajectories

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
        self._colours: dict[str, tuple[int, int, int]] = {}
        self._ends = contextlib.ExitStack()
        self.page = ""

    def __enter__(self) -> LiveView:
        with contextlib.ExitStack() as stack:
            program = stack.enter_context(viewer_program(web=self._web))
            self.page = program.page
            self._stream = rr.RecordingStream(APPLICATION, send_properties=False)
            self._stream.connect_grpc(program.address)
            stack.callback(self._close)
            self._stream.send_blueprint(live_blueprint())
            self._entities = EntityLog(self._stream)
            log_world(self._entities, TrackedFlight(self._recording.name, (), self._recording))
            self._ends = stack.pop_all()
        return self

    def write(self, rows: Trajectories) -> None:
        """Show the rows of an instant."""
        self._stream.set_time(TIME, duration=float(rows.time_s[0]))
        self._stream.set_time(FRAME, sequence=int(rows.frame[0]))
        for name in self._trails.keys() - set(rows.drones):
            self._log(f"world/drones/{part(name)}", rr.Clear(recursive=True))
            del self._trails[name]
        for index, name in enumerate(rows.drones):
            status = int(rows.status[0, index]) if rows.status is not None else int(Status.TRACKED)
            if name not in self._colours:
                self._begin(name)
            if status != self._status.get(name):
                self._log(f"status/{part(name)}", rr.StateChange(state=Status(status).label))
                self._status[name] = status
            position_m = rows.position_m[0, index].astype(np.float64)
            path = f"world/drones/{part(name)}"
            if not np.isfinite(position_m).all():
                self._log(path, rr.Clear(recursive=True))
                continue
            trail = self._trails.setdefault(name, deque(maxlen=_TRAIL_ROWS))
            trail.append(position_m)
            rgb = [status_rgb(status, self._colours[name])]
            label = status_label(name, status)
            half_m = np.array(USUAL_SIZE_M) / 2
            self._log(
                f"{path}/body",
                rr.Boxes3D(centers=[position_m], half_sizes=[half_m], colors=rgb, labels=[label]),
            )
            self._log(f"{path}/trail", rr.LineStrips3D([np.stack(trail)], colors=rgb))
            self._log(f"plots/height_m/{part(name)}", rr.Scalars(position_m[2]))
            if status == Status.LOST:
                self._log(f"{path}/ellipsoid", rr.Clear(recursive=False))
            elif rows.covariance_m2 is not None and np.isfinite(rows.covariance_m2[0, index]).all():
                covariance_m2 = rows.covariance_m2[0, index].astype(np.float64)
                ellipsoid = ellipsoids_90(covariance_m2)
                self._log(
                    f"{path}/ellipsoid",
                    rr.Ellipsoids3D(
                        centers=[position_m],
                        half_sizes=[ellipsoid.half_axes_m],
                        quaternions=quaternions_xyzw(ellipsoid.rotation[None]),
                        colors=rgb,
                        fill_mode=ELLIPSOID_FILL,
                    ),
                )
                deviation_mm = 1e3 * float(np.sqrt(np.trace(covariance_m2)))
                self._log(f"plots/deviation_mm/{part(name)}", rr.Scalars(deviation_mm))

    def _begin(self, name: str) -> None:
        """Choose the colour of a drone that is seen for the first time, and log how its status and its lines look."""
        number = whole_number(name)
        number = len(self._colours) if number is None else number
        self._colours[name] = shown_rgb(COLOURS[number % len(COLOURS)])
        log_status_words(self._entities, f"status/{part(name)}")
        for quantity in ("height_m", "deviation_mm"):
            line = rr.SeriesLines(colors=[self._colours[name]], names=[name], widths=[1.5])
            self._entities.static(f"plots/{quantity}/{part(name)}", line)

    def show_delay(self, delay_s: float) -> None:
        """Show the delay of the instant whose rows were written last, seconds."""
        self._log("plots/delay_ms", rr.Scalars(1e3 * delay_s))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ends.close()

    def _log(self, path: str, values: rr.AsComponents) -> None:
        self._stream.log(path, values)

    def _close(self) -> None:
        # The viewer may have been closed.
        with contextlib.suppress(Exception):
            self._stream.flush(timeout_sec=_LAST_ROWS_S)
        self._stream.disconnect()
