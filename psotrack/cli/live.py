"""`psotrack live`: drones while the cameras film."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import click
from msgspec import Meta

from psotrack.cli.options import CACHE, FORCE, JSON, LOG, QUIET, SEQUENCE, compiled_folder, recording_named
from psotrack.cli.output import Output, check_suffix, pass_output, write_json
from psotrack.cli.records import HelpfulCommand, options_of
from psotrack.cli.settings import config_options, settings_options
from psotrack.errors import SettingsError
from psotrack.settings import TrackSettings
from psotrack.support.interrupts import unhurried_end

if TYPE_CHECKING:
    from psotrack.live import LiveResult, LiveSession, RowsOutput
    from psotrack.recordings import Recording
    from psotrack.show.viewer import LiveView

#: Time between two changes of the table on the terminal, seconds.
_SHOWN_S = 0.5


@dataclass(frozen=True)
class TargetOptions:
    """Where rows go.

    Attributes:
        out: file of the tracks; it ends in .csv, which grows row by row, or in .parquet, which appears at the end.
        lines: write each row as a line of JSON to stdout.
        udp: send each row as a line of JSON by UDP.
        websocket: send each row as a message of JSON to all clients of a WebSocket server at PORT of this computer;
            without HOST, only programs on this computer reach the server.
        record: keep what the cameras film in FOLDER, as a recording that can be tracked again.
    """

    out: Path | None = None
    lines: bool = False
    udp: Annotated[str, Meta(extra={"metavar": "HOST:PORT"})] | None = None
    websocket: Annotated[str, Meta(extra={"metavar": "[HOST:]PORT"})] | None = None
    record: Annotated[Path, Meta(extra={"metavar": "FOLDER"})] | None = None


@dataclass(frozen=True)
class SessionOptions:
    """What is filmed, and how long.

    Attributes:
        seconds: end after this time.
        replay: play the videos of SEQ at their own rate, instead of cameras.
        speed: seconds of video per second, for --replay.
        loops: how often the videos are played, for --replay.
        cameras: use these cameras only; None: all cameras of the calibration.
        most_drones: largest number of drones at one time.
    """

    seconds: Annotated[float, Meta(gt=0)] | None = None
    replay: bool = False
    speed: Annotated[float, Meta(gt=0)] = 1.0
    loops: Annotated[int, Meta(ge=1)] = 1
    cameras: tuple[str, ...] | None = None
    most_drones: Annotated[int, Meta(ge=1, le=1000)] = 16


@click.command(cls=HelpfulCommand)
@SEQUENCE
@options_of(TargetOptions, "targets")
@click.option(
    "--view",
    "viewer",
    is_flag=False,
    flag_value="window",
    type=click.Choice(["window", "web"]),
    help="Show drones in space and their values over time, in a window of Rerun or on a page for a browser.  [without "
    "a value: window]",
)
@options_of(SessionOptions, "chosen", rare=("most_drones",))
@settings_options(
    "swarm.particles",
    "swarm.iterations",
    "drones.count",
    without=["method", "detections", "init", "smooth", "clocks", "rate_hz"],
)
@CACHE
@config_options
@FORCE
@QUIET
@LOG
@JSON
@pass_output
def live(
    output: Output,
    sequence: Path,
    targets: TargetOptions,
    viewer: str | None,
    chosen: SessionOptions,
    cache: Path | None,
    settings: dict[str, Any],
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

    out, record = targets.out, targets.record
    if viewer is None and targets == TargetOptions(record=record):
        expected = "--out FILE, --lines, --udp, --websocket or --view"
        raise SettingsError("--out", expected=expected, found="none of them")
    if out is not None:
        check_suffix("--out", out, ".csv", ".parquet")
        output.refuse(out, out.with_suffix(".json"))
    if viewer is not None:
        _check_viewer(viewer)
    tracking = TrackSettings().changed(settings)
    keep_compiled(compiled_folder(cache))
    start_s = time.perf_counter() - output.started_s
    recording = open_recording(sequence)
    if chosen.replay:
        recording = recording.usable(chosen.cameras)
    used = live_cameras(
        recording, chosen.cameras, replay=chosen.replay, speed=chosen.speed, loops=chosen.loops
    )
    if record is not None:
        used = [replace(each, recorder=CameraRecorder(record, each.name, each.fps)) for each in used]
    first_s = float(recording.timeline().time_s[0]) if chosen.replay else 0.0
    session = LiveSession(
        recording,
        used,
        tracking,
        most_drones=chosen.most_drones,
        first_s=first_s,
        # In a slow replay everything may take longer.
        wait_s=WAIT_S / min(1.0, chosen.speed) if chosen.replay else WAIT_S,
    )
    hidden = output.quiet or targets.lines
    with contextlib.ExitStack() as stack:
        if record is not None:
            names = [camera.name for camera in used]
            stack.enter_context(recording_folder(record, recording, names, force=output.force))
        outputs: list[RowsOutput] = [partial(write_lines, sys.stdout)] if targets.lines else []
        if targets.udp is not None:
            outputs.append(stack.enter_context(contextlib.closing(UdpLines(targets.udp))).write)
        server = None
        if targets.websocket is not None:
            server = stack.enter_context(contextlib.closing(WebSocketLines(targets.websocket)))
            outputs.append(server.write)
            if not output.quiet:
                click.echo(f"rows are sent to clients of {server.address}", err=True)
        if out is not None:
            rows = stack.enter_context(RowStream(out, force=output.force, record=out.with_suffix(".json")))
            outputs.insert(0, rows.write)
        shown = None if viewer is None else stack.enter_context(_open_view(viewer, recording, hidden))
        outputs += [] if shown is None else [shown.write]
        table = stack.enter_context(_Table(hidden, shown))
        stack.enter_context(_ended_by_ctrl_c(session))

        def show(result: LiveResult) -> None:
            if result.instants == 1:
                stack.enter_context(unhurried_end())
            table.show(result)

        result = session.run(outputs, show, longest_s=chosen.seconds or float("inf"))
    warn_of_missing_drones(tracking, len(result.drones))
    report = {"sequence": recording.name, **session.record, **_record(result)}
    if server is not None:
        report["websocket"] = {"clients": server.num_clients}
    if out is not None:
        report["recording"] = recording_named(sequence, out)
    report = with_real_time(report, time.perf_counter() - output.started_s, start_s=start_s)
    if out is not None:
        write_json(out.with_suffix(".json"), report)
    output.json(report)
    if not targets.lines:
        output.say(
            f"{out or 'live'}: {report['drones']} drones, {result.instants} frames, "
            f"delay {1e3 * report['delay_s']['median']:.0f} ms, {result.left_out} frames left out"
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
