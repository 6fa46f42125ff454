"""Ctrl-C at any moment ends a command with one line.

Python raises `KeyboardInterrupt` wherever the program is. Two places cannot stand it: the import of jaxlib, whose C++
code crashes, and functions whose exceptions Python drops, such as JAX's callback of the garbage collector.
"""

from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType

#: Time after which a Ctrl-C that came at a bad moment is repeated, seconds.
_AGAIN_S = 0.02


@contextlib.contextmanager
def orderly_interrupts() -> Iterator[None]:
    """Within the block Ctrl-C raises `KeyboardInterrupt`, at the next moment at which this is safe, and once only."""
    handler, hook = signal.getsignal(signal.SIGINT), sys.unraisablehook
    # `nohup` and `&` in scripts start commands with Ctrl-C ignored; only the main thread has signals.
    if handler is not signal.default_int_handler or threading.current_thread() is not threading.main_thread():
        yield
        return

    def dropped(unraisable: sys.UnraisableHookArgs) -> None:
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            signal.signal(signal.SIGINT, _interrupt)
            _repeat()
        else:
            hook(unraisable)

    signal.signal(signal.SIGINT, _interrupt)
    sys.unraisablehook = dropped
    try:
        yield
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        raise
    else:
        signal.signal(signal.SIGINT, handler)
    finally:
        sys.unraisablehook = hook


def _interrupt(number: int, frame: FrameType | None) -> None:
    if _imports_jax(frame):
        _repeat()
        return
    raise KeyboardInterrupt


def _imports_jax(frame: FrameType | None) -> bool:
    """Whether a module of JAX is being imported."""
    importing = False
    while frame is not None:
        importing = importing or frame.f_code.co_filename.startswith("<frozen importlib")
        if importing and str(frame.f_globals.get("__name__")).partition(".")[0] in ("jax", "jaxlib"):
            return True
        frame = frame.f_back
    return False


def _repeat() -> None:
    again = threading.Timer(_AGAIN_S, _thread.interrupt_main)
    again.daemon = True
    again.start()
