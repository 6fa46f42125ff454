"""Ctrl-C and SIGTERM: each command ends with one line, a code that shells know, and nothing left.

The tests wait for events: a line of the program, a file, or the end of a process.
"""

import os
import re
import signal
import subprocess
import time

import pytest
from helpers import make_once
from worlds import make_sequence

from psotrack.support import atomic_write

#: Runs `psotrack` as at a terminal: shells start programs in the background with Ctrl-C ignored. The program says when
#: it begins to import the command line, which is when it answers signals.
AT_A_TERMINAL = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from psotrack.__main__ import main

class Announcer:
    def find_spec(self, name, path=None, target=None):
        if name == "psotrack.cli":
            print("imports", flush=True)

sys.meta_path.insert(0, Announcer())
main()
"""
#: Hears Ctrl-C, and runs the function `run` in the place of the command line.
LISTEN = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)"
RUN = "import psotrack.__main__, psotrack.cli; psotrack.cli.main = run; psotrack.__main__.main()"
#: A command that is in a long computation, which is not Python's, while it writes a file.
IN_A_LONG_COMPUTATION = f"""
{LISTEN}

def run(started):
    import jax
    from psotrack.support import atomic_write

    compute = jax.jit(lambda count: jax.lax.fori_loop(0, count, lambda i, x: x * 1.0001, 1.0))
    compute(1)
    with atomic_write(sys.argv[1]) as temporary:
        temporary.write_text("half")
        print("computes", flush=True)
        # Minutes of work in one call.
        compute(2 * 10**9).block_until_ready()

{RUN}
"""
#: A command in a library that raises an error of its own when it is interrupted.
IN_A_LIBRARY = f"""
{LISTEN}
import zipfile

def run(started):
    with zipfile.ZipFile("a.zip", "w") as zipped:
        left_open = zipped.open("half", "w")
        signal.raise_signal(signal.SIGINT)

{RUN}
"""
#: A command that has finished, and gets a signal while Python ends.
AT_THE_END = """
import signal, sys
import psotrack.__main__

class Last:
    def __del__(self, send=signal.raise_signal, number=signal.SIGTERM):
        send(number)

sys.modules["last"] = Last()
psotrack.__main__.main()
"""
#: A command whose worker processes say something when they end.
WITH_NOISY_WORKERS = f"""
import atexit, os, sys, time
from psotrack.support import map_in_processes

def work(task, advance):
    atexit.register(print, "noise", file=sys.stderr, flush=True)
    # One write: with PYTHONUNBUFFERED, print makes two, and the lines of two workers can mix.
    os.write(1, b"works\\n")
    time.sleep(600)

def run(started):
    map_in_processes(work, [1, 2], jobs=2, advance=int)

if __name__ == "__main__":
    {LISTEN}
    {RUN}
"""
#: Presses Ctrl-C in a callback of the garbage collector, which drops exceptions.
UNHEARD = """
import gc, signal, sys

signal.signal(signal.SIGINT, signal.default_int_handler)

def press(phase, info):
    if "psotrack.recordings.datasets.dpjait" in sys.modules:
        gc.callbacks.remove(press)
        signal.raise_signal(signal.SIGINT)

gc.callbacks.append(press)
gc.set_threshold(50)
from psotrack.__main__ import main
main()
"""
CODES = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "terminated")}
#: A command that takes longer has not heard the signal, seconds: many times what it takes on a loaded machine.
FOREVER_S = 120.0


def group_of(process):
    """Processes of the session that a process began, except itself."""
    found = subprocess.run(["pgrep", "-g", f"{process.pid}"], capture_output=True, text=True, check=False)
    return found.stdout.split()


def assert_ends(process, number):
    """Send a signal: the process and those that it has started end, with one line."""
    process.send_signal(number)
    _, err = process.communicate(timeout=FOREVER_S)
    code, word = CODES[number]
    assert process.returncode == code, err
    assert err == f"psotrack: {word}; earlier results are unchanged; run the command again to finish\n"
    end_s = time.monotonic() + FOREVER_S
    while group_of(process) and time.monotonic() < end_s:
        time.sleep(0.05)
    assert group_of(process) == []


@pytest.fixture
def start_track(start_python, tmp_path_factory, tmp_path):
    """Starts `track`, which would replace an earlier result; it has begun to import the command line."""
    # A recording that takes some seconds, which no test changes.
    flight = make_once(
        tmp_path_factory, "recording_of_signals", lambda folder: make_sequence(folder, repeat=8)
    )

    def start(program):
        (tmp_path / "tracks.csv").write_text("earlier")
        words = ("track", flight, "--out", tmp_path / "tracks.csv", "--force", "--cache", tmp_path / "cache")
        process = start_python("-c", program, *words)
        assert process.stdout.readline() == "imports\n"
        return process

    return start


def assert_unchanged(folder):
    assert not list(folder.rglob("*.partial*"))
    assert (folder / "tracks.csv").read_text() == "earlier"


def test_a_command_that_begins_ends_with_one_line(start_track, tmp_path):
    assert_ends(start_track(AT_A_TERMINAL), signal.SIGINT)
    assert_unchanged(tmp_path)


@pytest.mark.slow
def test_a_command_at_work_ends_with_one_line(start_track, tmp_path):
    """Here a shell ignores Ctrl-C, so that only SIGTERM ends the command."""
    process = start_track(AT_A_TERMINAL.replace("signal.default_int_handler", "signal.SIG_IGN"))
    process.send_signal(signal.SIGINT)
    # It is at work as soon as something is in the cache.
    while process.poll() is None and not list(tmp_path.glob("cache/**/*")):
        time.sleep(0.01)
    assert process.poll() is None
    assert_ends(process, signal.SIGTERM)
    assert_unchanged(tmp_path)


def test_a_computation_that_answers_no_signal_is_ended(start_python, tmp_path):
    process = start_python("-c", IN_A_LONG_COMPUTATION, tmp_path / "out.txt")
    assert process.stdout.readline() == "computes\n"
    # A signal before the call is answered by Python: this is many times what comes between the line and the call.
    time.sleep(0.2)
    assert_ends(process, signal.SIGINT)
    assert list(tmp_path.iterdir()) == []


def test_an_error_of_a_library_that_is_interrupted_is_no_traceback(start_python, tmp_path, monkeypatch):
    """Found: "Can't close the ZIP file" in `archive`, after Ctrl-C."""
    monkeypatch.chdir(tmp_path)
    _, err = start_python("-c", IN_A_LIBRARY).communicate(timeout=FOREVER_S)
    assert re.fullmatch(r"psotrack: interrupted; .*\n", err)


def test_a_signal_after_the_end_changes_nothing(start_python):
    """Found: a command whose results were whole ended with code -15 and without a line."""
    process = start_python("-c", AT_THE_END, "--version")
    out, err = process.communicate(timeout=FOREVER_S)
    assert (process.returncode, err) == (0, "")
    assert "version" in out


@pytest.mark.slow
def test_workers_end_without_a_word(start_python, tmp_path):
    """Found: warnings of zarr, in workers that were ended while they made an array."""
    (tmp_path / "noisy.py").write_text(WITH_NOISY_WORKERS)
    process = start_python(tmp_path / "noisy.py")
    assert [process.stdout.readline() for _ in range(2)] == ["works\n"] * 2
    assert_ends(process, signal.SIGTERM)


def test_ctrl_c_in_a_callback_of_the_garbage_collector_ends_the_command(start_python, tmp_path):
    (tmp_path / "cameras_calibration.csv").write_text("cam_name\n")
    process = start_python("-c", UNHEARD, "track", tmp_path, "--out", tmp_path / "tracks.csv")
    out, err = process.communicate(timeout=FOREVER_S)
    assert (process.returncode, out) == (130, "")
    assert re.fullmatch(r"psotrack: interrupted; .*\n", err)


def test_what_a_killed_program_has_left_is_removed_by_the_next_run(tmp_path):
    with atomic_write(tmp_path / "elsewhere" / "tracks.csv") as temporary:
        running = temporary.name
        temporary.touch()
    # Larger than any number of a process.
    left = running.replace(f"-{os.getpid()}-", f"-{2**30}-")
    other = left.replace(".tracks.", ".other.")
    folder = tmp_path / "here"
    folder.mkdir()
    for name in (running, left, other):
        (folder / name).write_text("half")
    with atomic_write(folder / "tracks.csv") as temporary:
        temporary.write_text("whole")
    assert {file.name for file in folder.iterdir()} == {"tracks.csv", running, other}
    assert (folder / "tracks.csv").read_text() == "whole"
