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
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click
from msgspec import Meta

from psotrack import pipeline, support, trajectories
from psotrack.cli.commands import command
from psotrack.cli.options import Cache, Cameras, MostDrones, Seq, compiled_folder, recording_named
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.settings import TrackingSettings
from psotrack.cli.types import says
from psotrack.errors import SettingsError
from psotrack.recordings import datasets
from psotrack.settings import TrackSettings
from psotrack.show import viewer
from psotrack.support import write_json
from psotrack.support.interrupts import unhurried_end

if TYPE_CHECKING:
    from rich.table import Table

    from psotrack.live import LiveResult, LiveSession

#: Time between two changes of the table on the terminal, seconds.
_SHOWN_S = 0.5


@command(without=["progress"])
def live(
    output: Output,
    sequence: Seq,
    *,
    out: Path | None = None,
    lines: bool = False,
    udp: Annotated[str | None, says(metavar="HOST:PORT")] = None,
    websocket: Annotated[str | None, says(metavar="[HOST:]PORT")] = None,
    record: Annotated[Path | None, says(metavar="FOLDER")] = None,
    view: Annotated[Literal["window", "web"] | None, says(is_flag=False, flag_value="window")] = None,
    seconds: Annotated[float, Meta(gt=0)] | None = None,
    replay: bool = False,
    speed: Annotated[float, Meta(gt=0)] = 1.0,
    loops: Annotated[int, Meta(ge=1)] = 1,
    cameras: Cameras = None,
    most_drones: MostDrones = 16,
    settings: Annotated[
        dict[str, Any],
        TrackingSettings(
            usual=("swarm.particles", "swarm.iterations", "drones.count"),
            without=("method", "detections", "init", "smooth", "clocks", "rate_hz"),
        ),
    ],
    cache: Cache = None,
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

    Options:
        out: file of the tracks, which grows row by row; it ends in .csv.
        lines: write each row as a line of JSON to stdout.
        udp: send each row as a line of JSON by UDP.
        websocket: send each row as a message of JSON to all clients of a WebSocket server at PORT of this computer;
            without HOST, only programs on this computer reach the server.
        record: keep what the cameras film in FOLDER, as a recording that can be tracked again.
        view: show drones in space and their values over time, in a window of Rerun or on a page for a browser.
            [without a value: window]
        seconds: end after this time.
        replay: play the videos of SEQ at their own rate, instead of cameras.
        speed: seconds of video per second, for --replay.
        loops: how often the videos are played, for --replay.
        most_drones: largest number of drones at one time.
    """
    from rich.console import Console
    from rich.live import Live

    from psotrack import live as filming

    if not (out or lines or udp or websocket or view):
        raise SettingsError(
            "--out", expected="--out FILE, --lines, --udp, --websocket or --view", found="none of them"
        )
    if out is not None:
        check_suffix("--out", out, ".csv")
        output.refuse(out, out.with_suffix(".json"))
    if view is not None:
        viewer.check_installed()
        if view == "window":
            viewer.check_display()
    support.start_server("psotrack.live.front_end")
    tracking = TrackSettings().changed(settings)
    support.keep_compiled(compiled_folder(cache))
    start_s = output.elapsed_s
    recording = datasets.open_recording(sequence)
    if replay:
        recording = recording.usable(cameras)
    used = filming.live_cameras(recording, cameras, replay=replay, speed=speed, loops=loops)
    if record is not None:
        used = [replace(each, recorder=filming.CameraRecorder(record, each.name, each.fps)) for each in used]
    session = filming.LiveSession(
        recording,
        used,
        tracking,
        most_drones=most_drones,
        first_s=float(recording.timeline().time_s[0]) if replay else 0.0,
        # In a slow replay everything may take longer.
        wait_s=filming.WAIT_S / min(1.0, speed) if replay else filming.WAIT_S,
    )
    hidden = output.quiet or lines
    with contextlib.ExitStack() as stack:
        if record is not None:
            names = [camera.name for camera in used]
            stack.enter_context(filming.recording_folder(record, recording, names, force=output.force))
        outputs: list[filming.RowsOutput] = []
        if out is not None:
            rows = stack.enter_context(
                trajectories.RowStream(out, force=output.force, record=out.with_suffix(".json"))
            )
            outputs.append(rows.write)
        if lines:
            outputs.append(partial(filming.write_lines, sys.stdout))
        if udp is not None:
            outputs.append(stack.enter_context(contextlib.closing(filming.UdpLines(udp))).write)
        server = None
        if websocket is not None:
            server = stack.enter_context(contextlib.closing(filming.WebSocketLines(websocket)))
            outputs.append(server.write)
            if not output.quiet:
                click.echo(f"rows are sent to clients of {server.address}", err=True)
        shown = None
        if view is not None:
            shown = stack.enter_context(viewer.LiveView(recording, web=view == "web"))
            outputs.append(shown.write)
            if shown.page:
                click.echo(shown.page, err=hidden)
        console, changed_s = Console(stderr=True), 0.0
        table = None
        if console.is_terminal and not hidden:
            table = stack.enter_context(Live(console=console, auto_refresh=False, transient=True))
        stack.enter_context(_ended_by_ctrl_c(session))

        def show(result: LiveResult) -> None:
            nonlocal changed_s
            if result.instants == 1:
                stack.enter_context(unhurried_end())
            if shown is not None:
                shown.show_delay(result.delay_s[-1])
            if table is not None and time.monotonic() - changed_s > _SHOWN_S:
                changed_s = time.monotonic()
                table.update(_table(result), refresh=True)

        result = session.run(outputs, show, longest_s=seconds or float("inf"))
    pipeline.warn_of_missing_drones(tracking, len(result.drones))
    report = {"sequence": recording.name, **session.record, **_record(result)}
    if server is not None:
        report["websocket"] = {"clients": server.num_clients}
    if out is not None:
        report["recording"] = recording_named(sequence, out)
    report = pipeline.with_real_time(report, output.elapsed_s, start_s=start_s)
    if out is not None:
        write_json(out.with_suffix(".json"), report)
    output.json(report)
    if not lines:
        output.say(
            f"{out or 'live'}: {report['drones']} drones, {result.instants} frames, "
            f"delay {1e3 * report['delay_s']['median']:.0f} ms, {result.left_out} frames left out"
        )
    # Said before, while the other outputs went on.
    if result.failed_outputs:
        raise result.failed_outputs[0]


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


def _table(result: LiveResult) -> Table:
    """What the session has done so far."""
    import numpy as np
    from rich.table import Table

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
    return table


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
