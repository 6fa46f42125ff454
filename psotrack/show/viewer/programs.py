"""The programs of Rerun: its window, and its server for browsers. Both listen on this computer only."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from psotrack.errors import OutputError, SettingsError, install_command
from psotrack.support.interrupts import unhurried_end

_HOST = "127.0.0.1"
#: `python -m rerun_cli` ends with exit code 0 after an error.
_START = "import sys; from rerun_cli.__main__ import main; sys.exit(main())"
#: Time that a program of Rerun has to start, and to end, seconds.
_START_S, _END_S = 30.0, 0.5
#: Time between two looks whether a program has ended, seconds.
_LOOK_S = 0.1
#: Levels of Rerun's log at which it says where it listens, and nothing else.
_SAYS_WHERE = "off,re_grpc_server=info,re_sdk::web_viewer=info"
#: Fraction of the memory up to which the server keeps a flight.
_MEMORY = "75%"
_WITHOUT_WINDOW = (
    "`psotrack view --save FLIGHT.rrd` or `--web`, and `psotrack live --view web`, need no screen"
)


@dataclass(frozen=True)
class ViewerProgram:
    """A program of Rerun that runs.

    Attributes:
        process: the process.
        address: address to which flights can be sent.
        page: address of the page for a browser; empty for a window.
        log: file with what the program says.
    """

    process: subprocess.Popen[bytes]
    address: str
    page: str
    log: Path


def check_installed() -> None:
    """Raise `SettingsError` where Rerun is not installed; call before anything else of this room.

    Rerun writes no lines of its own about errors from then on, unless the user has set the level of its log.
    """
    os.environ.setdefault("RUST_LOG", "off")
    try:
        for name in ("rerun", "rerun_cli"):
            importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise SettingsError(
            "the viewer",
            expected="the package rerun-sdk",
            found="that it is not installed",
            remedy=install_command("view"),
        ) from error


def check_display() -> None:
    """Raise `OutputError` where no window can open, because there is no screen."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise OutputError(
            "the viewer",
            expected="a screen",
            found="neither DISPLAY nor WAYLAND_DISPLAY",
            remedy=_WITHOUT_WINDOW,
        )


def show_window(path: Path) -> None:
    """Show a file of Rerun in a window, until the window is closed or Ctrl-C is pressed.

    Raises:
        OutputError: the window cannot be opened.
    """
    with viewer_program(path) as program:
        _wait(program)


def show_in_browser(path: Path, say: Callable[[str], None]) -> None:
    """Serve a file of Rerun to browsers on this computer, until Ctrl-C is pressed.

    Args:
        path: the file.
        say: receives the address of the page.

    Raises:
        OutputError: the server cannot start.
    """
    with viewer_program(path, web=True) as program:
        say(program.page)
        _wait(program)


@contextlib.contextmanager
def viewer_program(path: Path | None = None, *, web: bool = False) -> Iterator[ViewerProgram]:
    """A program of Rerun that shows a file or what is sent to it, and ends with the block.

    Args:
        path: the file; None: flights are sent to the program's address.
        web: serve a page for browsers, instead of a window.

    Raises:
        OutputError: the program cannot start.
    """
    # Port 0 is one that the system chooses; a port that was looked for beforehand may be taken meanwhile.
    arguments = ["--bind", _HOST, "--port", "0", "--server-memory-limit", _MEMORY]
    if web:
        arguments += ["--serve-web", "--web-viewer-port", "0"]
    arguments += ["--expect-data-soon"] if path is None and not web else []
    arguments += [] if path is None else [str(path)]
    with tempfile.TemporaryDirectory(prefix="psotrack-") as folder:
        log = Path(folder) / "viewer.log"
        with log.open("wb") as said:
            # A session of its own: Ctrl-C shall reach this program alone, which then ends the other.
            process = subprocess.Popen(
                [sys.executable, "-c", _START, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
                env=os.environ | {"RUST_LOG": _SAYS_WHERE, "NO_COLOR": "1"},
                start_new_session=True,
            )
        try:
            address = _address(process, log, "--connect ([^ `]+)")
            page = _address(process, log, r"connect at (\S+)") if web else ""
            yield ViewerProgram(process, address, page, log)
        finally:
            # The other program must not outlive this one.
            with unhurried_end():
                _end(process)


def _address(process: subprocess.Popen[bytes], log: Path, pattern: str) -> str:
    """An address at which a program says that it listens, as soon as its log has it."""
    end_s = time.monotonic() + _START_S
    while (found := re.search(pattern, _said(log))) is None:
        _check_runs(process, log)
        if time.monotonic() > end_s:
            raise _failed(f"no address after {_START_S:.0f} s")
        time.sleep(_LOOK_S)
    return found[1]


def _said(log: Path) -> str:
    return log.read_text("utf-8", errors="replace")


def _wait(program: ViewerProgram) -> None:
    """Wait until the program or Ctrl-C ends."""
    with contextlib.suppress(KeyboardInterrupt):
        while program.process.poll() is None:
            time.sleep(_LOOK_S)
        _check_runs(program.process, program.log)


def _check_runs(process: subprocess.Popen[bytes], log: Path) -> None:
    """Raise `OutputError` where a program has ended with an error."""
    if process.poll():
        lines = _said(log).splitlines()
        errors = [line for line in lines if line.startswith("Error")] or lines or ["no message"]
        # Sources of Rerun are named before the last colon.
        raise _failed(errors[-1].removeprefix("Error: ").rpartition(": ")[2])


def _failed(found: str) -> OutputError:
    return OutputError(
        "the viewer", expected="Rerun to start", found=found.rstrip("."), remedy=_WITHOUT_WINDOW
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a program and the program that it has started."""
    # The second signal also ends the program that the first, ended one has started; mostly nothing is left by then.
    for number in (signal.SIGTERM, None):
        with contextlib.suppress(OSError):
            if not hasattr(os, "killpg"):
                process.kill()
            else:
                os.killpg(process.pid, number or signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_END_S)
