"""`psotrack live`: drones while the cameras film."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import click

from psotrack.cli.options import (
    CACHE,
    CAMERAS,
    FORCE,
    ITERATIONS,
    JSON,
    LOG,
    MOST_DRONES,
    PARTICLES,
    QUIET,
    SEQUENCE,
    camera_names,
    compiled_folder,
    setting_name,
    silhouette_options,
)
from psotrack.cli.output import output_json, print_line, write_json
from psotrack.cli.run_files import run_file_options
from psotrack.errors import SettingsError
from psotrack.settings import TrackSettings
from psotrack.support import refuse_to_overwrite
from psotrack.support.interrupts import unhurried_end

if TYPE_CHECKING:
    from psotrack.live import LiveResult, LiveSession, RowsOutput
    from psotrack.recordings import Recording
    from psotrack.show.viewer import LiveView

#: Time between two changes of the table on the terminal, seconds.
_SHOWN_S = 0.5


@click.command()
@SEQUENCE
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="File of the tracks; it ends in .csv, which grows row by row, or in .parquet, which appears at the end.",
)
@click.option("--replay", is_flag=True, help="Play the videos of SEQ at their own rate, instead of cameras.")
@click.option(
    "--speed",
    type=click.FloatRange(min=0, min_open=True),
    default=1.0,
    show_default=True,
    help="Seconds of video per second, for --replay.",
)
@click.option(
    "--loops",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="How often the videos are played, for --replay.",
)
@click.option("--seconds", type=click.FloatRange(min=0, min_open=True), help="End after this time.")
@click.option("--lines", is_flag=True, help="Write each row as a line of JSON to stdout.")
@click.option("--udp", metavar="HOST:PORT", help="Send each row as a line of JSON by UDP.")
@click.option(
    "--websocket",
    metavar="[HOST:]PORT",
    help="Send each row as a message of JSON to all clients of a WebSocket server at PORT of this computer. "
    "[default of HOST: 127.0.0.1, which only programs on this computer reach]",
)
@click.option(
    "--record",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Keep what the cameras film in FOLDER, as a recording that can be tracked again.",
)
@click.option(
    "--view",
    "viewer",
    is_flag=False,
    flag_value="window",
    type=click.Choice(["window", "web"]),
    help="Show drones in space and their values over time, in a window of Rerun or on a page for a browser.  [without "
    "a value: window]",
)
@PARTICLES
@ITERATIONS
@click.option("--drones", type=int, metavar="N", help="Number of drones, if it is known.")
@MOST_DRONES
@silhouette_options
@CAMERAS
@CACHE
@FORCE
@run_file_options
@QUIET
@LOG
@JSON
def live(
    sequence: Path,
    out: Path | None,
    replay: bool,
    speed: float,
    loops: int,
    seconds: float | None,
    lines: bool,
    udp: str | None,
    websocket: str | None,
    record: Path | None,
    viewer: str | None,
    most_drones: int,
    cameras: str | None,
    cache: Path | None,
    force: bool,
    quiet: bool,
    json_path: Path | None,
    **settings: Any,
) -> None:
    """Track drones while the cameras of SEQ film: devices and streams, or videos that are replayed.

    SEQ is a recording.toml whose cameras have the number of a device or the address of a stream as `video`. A table on
    the terminal shows the drones, the delay, and what was lost of each camera. Ctrl-C ends the session; all rows so far
    are written. The tracks are those of `psotrack track --causal`, where nothing is lost.

    \b
    Examples:
      psotrack live lab/recording.toml --out tracks.csv
      psotrack live lab/recording.toml --udp 127.0.0.1:9000
      psotrack live lab/recording.toml --websocket 9000
      psotrack live lab/recording.toml --out tracks.csv --record flight
      psotrack live lab/recording.toml --view
      psotrack live data/Simulated_Data/S02_D4_A --replay --out tracks.csv
      psotrack live data/Simulated_Data/S02_D4_A --replay --speed 0.5 --lines | head
    """
    started = click.get_current_context().obj or time.perf_counter()
    from psotrack.live import (
        WAIT_S,
        CameraRecorder,
        LiveSession,
        UdpLines,
        WebSocketLines,
        live_cameras,
        recording_folder,
        write_lines,
    )
    from psotrack.pipeline import warn_of_missing_drones, with_real_time
    from psotrack.recordings.datasets import open_recording
    from psotrack.support import keep_compiled
    from psotrack.trajectories import RowStream

    if out is None and not lines and udp is None and websocket is None and viewer is None:
        expected = "--out FILE, --lines, --udp, --websocket or --view"
        raise SettingsError("--out", expected=expected, found="none of them")
    if out is not None and out.suffix not in {".csv", ".parquet"}:
        raise SettingsError("--out", expected="a file that ends in .csv or .parquet", found=out.name)
    for path in () if out is None else (out, out.with_suffix(".json")):
        refuse_to_overwrite(path, force)
    if viewer is not None:
        _check_viewer(viewer)
    chosen = TrackSettings().changed({setting_name(option): value for option, value in settings.items()})
    keep_compiled(compiled_folder(cache))
    start_s = time.perf_counter() - started
    recording = open_recording(sequence)
    if replay:
        recording = recording.usable(camera_names(cameras))
    used = live_cameras(recording, camera_names(cameras), replay=replay, speed=speed, loops=loops)
    if record is not None:
        used = [replace(each, recorder=CameraRecorder(record, each.name, each.fps)) for each in used]
    first_s = float(recording.timeline().time_s[0]) if replay else 0.0
    session = LiveSession(
        recording,
        used,
        chosen,
        most_drones=most_drones,
        first_s=first_s,
        # In a slow replay everything may take longer.
        wait_s=WAIT_S / min(1.0, speed) if replay else WAIT_S,
    )
    with contextlib.ExitStack() as stack:
        if record is not None:
            names = [camera.name for camera in used]
            stack.enter_context(recording_folder(record, recording, names, force=force))
        outputs: list[RowsOutput] = [partial(write_lines, sys.stdout)] if lines else []
        if udp is not None:
            outputs.append(stack.enter_context(contextlib.closing(UdpLines(udp))).write)
        server = (
            None if websocket is None else stack.enter_context(contextlib.closing(WebSocketLines(websocket)))
        )
        if server is not None:
            outputs.append(server.write)
            if not quiet:
                click.echo(f"rows are sent to clients of {server.address}", err=True)
        if out is not None:
            rows = stack.enter_context(RowStream(out, force=force, record=out.with_suffix(".json")))
            outputs.insert(0, rows.write)
        shown = None if viewer is None else stack.enter_context(_open_view(viewer, recording, quiet or lines))
        outputs += [] if shown is None else [shown.write]
        table = stack.enter_context(_Table(quiet or lines, shown))
        stack.enter_context(_ended_by_ctrl_c(session))

        def show(result: LiveResult) -> None:
            if result.instants == 1:
                stack.enter_context(unhurried_end())
            table.show(result)

        result = session.run(outputs, show, longest_s=seconds or float("inf"))
    warn_of_missing_drones(chosen, len(result.drones))
    report = {"sequence": recording.name, **session.record, **_record(result)}
    if server is not None:
        report["websocket"] = {"clients": server.num_clients}
    report = with_real_time(report, time.perf_counter() - started, start_s=start_s)
    if out is not None:
        write_json(out.with_suffix(".json"), report)
    output_json(json_path, report, force)
    print_line(
        quiet or lines,
        json_path,
        f"{out or 'live'}: {report['drones']} drones, {result.instants} frames, "
        f"delay {1e3 * report['delay_s']['median']:.0f} ms, {result.left_out} frames left out",
    )
    # Said before, while the other outputs went on.
    if result.failed_outputs:
        raise result.failed_outputs[0]


def _check_viewer(viewer: str) -> None:
    from psotrack.show.viewer import check_display, check_installed

    check_installed()
    if viewer == "window":
        check_display()


@contextlib.contextmanager
def _open_view(viewer: str, recording: Recording, quiet: bool) -> Iterator[LiveView]:
    from psotrack.show.viewer import LiveView

    with LiveView(recording, web=viewer == "web") as view:
        if view.page:
            click.echo(view.page, err=quiet)
        yield view


def _record(result: LiveResult) -> dict[str, Any]:
    """What a session has done, fit for JSON, in the words of `psotrack track --causal` where it means the same."""
    import numpy as np

    delay_s = np.array(result.delay_s)
    return {
        "live": True,
        "frames": result.instants,
        "frames_left_out": result.left_out,
        "late_searches": None,
        "camera_frames": {name: dict(vars(each.counts)) for name, each in result.cameras.items()},
        "recorded": {name: dict(vars(counts)) for name, counts in result.recorded.items()},
        "drones": len(result.drones),
        "delay_s": {
            "median": float(np.median(delay_s)),
            "p99": float(np.quantile(delay_s, 0.99)),
            "max": float(delay_s.max()),
        },
        "seconds": {"compile": round(result.compile_s, 4), "session": round(result.seconds, 4)},
    }


class _Table:
    """A table on the terminal; shows nothing where stderr is no terminal. The viewer gets the delay."""

    def __init__(self, hidden: bool, view: LiveView | None) -> None:
        self._hidden, self._shown_s, self._view = hidden, 0.0, view

    def __enter__(self) -> _Table:
        from rich.console import Console
        from rich.live import Live

        console = Console(stderr=True)
        self._hidden = self._hidden or not console.is_terminal
        self._live = None if self._hidden else Live(console=console, auto_refresh=False, transient=True)
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, result: LiveResult) -> None:
        """Show what the session has done so far."""
        if self._view is not None:
            self._view.show_delay(result.delay_s[-1])
        if self._live is None or time.monotonic() - self._shown_s < _SHOWN_S:
            return
        import numpy as np
        from rich.table import Table

        self._shown_s = time.monotonic()
        recent_ms = 1e3 * np.array(result.delay_s[-250:])
        rate_hz = result.instants / max(result.seconds, 1e-3)
        table = Table(
            title=f"{len(result.drones)} drones, {rate_hz:.1f} frames/s, delay {np.median(recent_ms):.0f} ms "
            f"(99 %: {np.quantile(recent_ms, 0.99):.0f}), {result.left_out} left out"
        )
        for column in ("camera", "", "frames", "missing", "late", "twice", "left out", "stops"):
            table.add_column(column, justify="left" if column in ("camera", "") else "right")
        for name, camera in result.cameras.items():
            counts = (f"{value}" for value in vars(camera.counts).values())
            table.add_row(name, "films" if camera.films else "silent", *counts)
        self._live.update(table, refresh=True)


@contextlib.contextmanager
def _ended_by_ctrl_c(session: LiveSession) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the session, instead of the program, as soon as there is a first result."""

    def end(number: int, frame: FrameType | None) -> None:
        earlier = before[signal.Signals(number)]
        if session.result.instants or not callable(earlier):
            session.stop()
        else:
            earlier(number, frame)

    before = {each: signal.signal(each, end) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
