"""Ctrl-C and SIGTERM at any moment end the program within two seconds, with one line.

Python raises `KeyboardInterrupt` wherever the program is, but only between two of its own instructions. Three places
need more. A computation or compilation of JAX answers no signal until it is done: a thread that watches the signals
ends the program for it. The import of jaxlib, whose C++ code crashes, gets the exception afterwards. So do functions
whose exceptions Python drops, such as JAX's callback of the garbage collector.

This module is imported first, and imports nothing that takes time.
"""

from __future__ import annotations

import _thread
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import NoReturn

#: Signals that end the program, and the handlers that Python gives them.
_ANSWERED = (signal.SIGINT, signal.SIGTERM)
_USUAL_HANDLERS = (signal.SIG_DFL, signal.default_int_handler)
#: Time after which a signal that came at a bad moment is repeated, seconds.
_AGAIN_S = 0.02
#: Time that the program has to end in order, seconds. Removing temporary files takes a part of it.
_IN_ORDER_S = 0.8


class Terminated(KeyboardInterrupt):
    """SIGTERM has come: the program ends as after Ctrl-C."""


class _State:
    """What the handlers and the thread that watches know of each other."""

    #: Number of signals that this module repeats by itself.
    repeats = 0
    #: Whether the program may take its time to end.
    unhurried = False


@contextlib.contextmanager
def orderly_interrupts() -> Iterator[None]:
    """Within the block Ctrl-C raises `KeyboardInterrupt` and SIGTERM raises `Terminated`, at the next safe moment.

    A program that has not ended after `_IN_ORDER_S`, or that gets a second signal, is ended at once: its temporary
    files are removed, its worker processes are told to end, and the line is written. After `SystemExit` signals are
    ignored: the program has finished.
    """
    # Only the main thread has signals.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hook = sys.unraisablehook
    # Processes of `multiprocessing` take these options. One of them counts semaphores that an ended program left, and
    # removes them; that is no news.
    sys.warnoptions.append("ignore:resource_tracker:UserWarning")

    def dropped(unraisable: sys.UnraisableHookArgs) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            _repeat(signal.SIGTERM if issubclass(unraisable.exc_type, Terminated) else signal.SIGINT)
        else:
            hook(unraisable)

    # `nohup` and `&` in scripts start commands with Ctrl-C ignored, and such commands go on ignoring it.
    before = {
        number: handler for number in _ANSWERED if (handler := signal.getsignal(number)) in _USUAL_HANDLERS
    }
    for number in before:
        signal.signal(number, _interrupt)
    sys.unraisablehook = dropped
    try:
        with _watched(), _interrupts_behind_errors():
            yield
    except (KeyboardInterrupt, SystemExit):
        # The program ends: its last steps, in which Python has no handlers any more, are not interrupted.
        for number in before:
            signal.signal(number, signal.SIG_IGN)
        raise
    else:
        for number, handler in before.items():
            signal.signal(number, handler)
    finally:
        sys.unraisablehook = hook


@contextlib.contextmanager
def unhurried_end() -> Iterator[None]:
    """Within the block, a program that gets a signal may take its time to end: it has results to write."""
    before, _State.unhurried = _State.unhurried, True
    try:
        yield
    finally:
        _State.unhurried = before


def end(number: int) -> NoReturn:
    """Say that a signal has ended the program, and end the program, with the exit code of a shell: 128 and the number.

    The usual end of the interpreter would wait for a computation of JAX, which cannot be interrupted.
    """
    word = "terminated" if number == signal.SIGTERM else "interrupted"
    # A progress bar may have hidden the cursor and left its line open.
    before = "\r\x1b[K\x1b[?25h" if sys.stderr.isatty() else ""
    for stream, text in (
        (sys.stdout, ""),
        (
            sys.stderr,
            f"{before}psotrack: {word}; earlier results are unchanged; run the command again to finish\n",
        ),
    ):
        with contextlib.suppress(OSError, ValueError):
            stream.write(text)
            stream.flush()
    os._exit(128 + number)


def _interrupt(number: int, frame: FrameType | None) -> None:
    if _imports_jax(frame):
        _repeat(number)
        return
    raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


def _imports_jax(frame: FrameType | None) -> bool:
    """Whether a module of JAX is being imported."""
    importing = False
    while frame is not None:
        importing = importing or frame.f_code.co_filename.startswith("<frozen importlib")
        if importing and str(frame.f_globals.get("__name__")).partition(".")[0] in ("jax", "jaxlib"):
            return True
        frame = frame.f_back
    return False


def _repeat(number: int) -> None:
    def send() -> None:
        _State.repeats += 1
        _thread.interrupt_main(signal.Signals(number))

    again = threading.Timer(_AGAIN_S, send)
    again.daemon = True
    again.start()


@contextlib.contextmanager
def _interrupts_behind_errors() -> Iterator[None]:
    """Raise the interrupt instead of an error that the clean-up of a library raised because of the interrupt."""
    try:
        yield
    except Exception as error:
        behind: BaseException | None = error
        while behind is not None and not isinstance(behind, KeyboardInterrupt):
            behind = behind.__context__
        if behind is None:
            raise
        raise behind from None


@contextlib.contextmanager
def _watched() -> Iterator[None]:
    """A thread reads the signals as they come, also while the main thread is in code that is not Python's."""
    if os.name != "posix":
        yield
        return
    ours, theirs = os.pipe()
    os.set_blocking(theirs, False)
    before = signal.set_wakeup_fd(theirs, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(ours,), daemon=True, name="signals").start()
    try:
        yield
    finally:
        # After an interruption the thread still watches that the end does not take too long.
        if not isinstance(sys.exception(), KeyboardInterrupt):
            signal.set_wakeup_fd(before)
            os.close(theirs)


def _watch(pipe: int) -> None:
    """End the program where it does not end by itself; returns when the other end of the pipe is closed."""
    is_second = False
    while numbers := os.read(pipe, 1):
        number = numbers[0]
        # Libraries may have handlers for other signals.
        if number not in _ANSWERED:
            continue
        if _State.repeats:
            _State.repeats -= 1
            continue
        if _State.unhurried:
            continue
        if is_second:
            _end_now(number)
        is_second = True
        threading.Thread(target=_end_later, args=(number,), daemon=True).start()
    os.close(pipe)


def _end_later(number: int) -> None:
    time.sleep(_IN_ORDER_S)
    if not _State.unhurried:
        _end_now(number)


def _end_now(number: int) -> NoReturn:
    # What was never imported has nothing to end.
    if files := sys.modules.get("psotrack.support.files"):
        files.remove_temporary_files()
    if processes := sys.modules.get("multiprocessing"):
        with contextlib.suppress(Exception):
            for process in processes.active_children():
                process.terminate()
    end(number)
