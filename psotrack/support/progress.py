"""Progress of long work: numeric code calls a counting function and knows nothing about terminals.

A `Report` shows the progress of one stage: `progress_bar` where the reader is (terminal, notebook or log of a script),
`terminal_bar` on a terminal in any case, `progress_lines` as lines of text, and `no_progress` nowhere.
"""

from __future__ import annotations

import contextlib
import html
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator

#: Function that is called with the number of steps done since the last call.
Advance = Callable[[int], None]

#: Function that opens a progress bar: `with report("track", total) as advance: ... advance(1)`.
Report = Callable[[str, int], contextlib.AbstractContextManager[Advance]]

#: Shortest stage for which `progress_bar` writes lines where there is neither a terminal nor a notebook, seconds.
LONG_S = 20.0
#: Least time between two lines about a stage, and the time after which a line comes in any case, seconds.
_EVERY_S, _AT_LATEST_S = 20.0, 300.0
#: Least share of the stage between two lines about it, unless `_AT_LATEST_S` have passed.
_SHARE = 0.1
#: Time between two changes of a bar in a notebook, seconds.
_REDRAWN_S = 0.2


@contextlib.contextmanager
def no_progress(description: str, total: int) -> Iterator[Advance]:
    """Show no progress: the default of every function that takes a `Report`."""
    yield lambda steps: None


def progress_bar(description: str, total: int) -> contextlib.AbstractContextManager[Advance]:
    """Show progress where the reader is.

    On a terminal this is a bar on stderr that disappears at the end of the work, in a notebook a bar that stays in the
    saved notebook as one line. Elsewhere, lines on stderr show work that takes longer than `LONG_S`.
    """
    if _in_notebook():
        return _notebook_bar(description, total)
    from rich.console import Console

    if Console(stderr=True).is_terminal:
        return terminal_bar(description, total)
    return progress_lines(long_s=LONG_S)(description, total)


@contextlib.contextmanager
def terminal_bar(description: str, total: int) -> Iterator[Advance]:
    """Show a bar on stderr, terminal or not, that disappears at the end of the work."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description:<12}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True, force_terminal=True)
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(description, total=total)
        yield lambda steps: progress.advance(task, steps)


def progress_lines(
    write: Callable[[str], None] | None = None,
    *,
    long_s: float = 0.0,
    clock: Callable[[], float] = time.monotonic,
) -> Report:
    """A report in lines of text: the first after 20 s, at most ten more, and one at the end of a stage.

    Later lines come after 20 s or a tenth of the stage, whichever is later, but at the latest after five minutes.

    Args:
        write: takes a line without its end; None writes it to stderr.
        long_s: shortest stage whose end is written, seconds.
        clock: time that only increases, seconds.
    """
    write = _to_stderr if write is None else write

    @contextlib.contextmanager
    def report(description: str, total: int) -> Iterator[Advance]:
        stage = _Stage(description, total, clock)
        lock, written_s, written_done = threading.Lock(), clock(), 0

        def advance(steps: int) -> None:
            nonlocal written_s, written_done
            with lock:
                stage.done += steps
                since_s, share = clock() - written_s, (stage.done - written_done) / max(total, 1)
                is_due = not written_done or share >= _SHARE or since_s >= _AT_LATEST_S or not total
                if since_s < _EVERY_S or not is_due or 0 < total <= stage.done:
                    return
                written_s, written_done = clock(), stage.done
            write(stage.so_far())

        try:
            yield advance
        except BaseException:
            if written_done or stage.seconds >= long_s:
                write(stage.stopped())
            raise
        if written_done or stage.seconds >= long_s:
            write(stage.finished())

    return report


def joined(*reports: Report) -> Report:
    """A report that shows the progress in several ways at once."""

    @contextlib.contextmanager
    def report(description: str, total: int) -> Iterator[Advance]:
        with contextlib.ExitStack() as stack:
            advances = [stack.enter_context(each(description, total)) for each in reports]

            def advance(steps: int) -> None:
                for each in advances:
                    each(steps)

            yield advance

    return report


class _Stage:
    """The steps of one stage that are done, and sentences about them; a stage of 0 steps has an unknown number."""

    def __init__(self, description: str, total: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._description, self.total, self._clock = description, total, clock
        self._began_s = clock()
        self.done = 0

    @property
    def seconds(self) -> float:
        """Time since the stage began, seconds."""
        return self._clock() - self._began_s

    def so_far(self) -> str:
        """What is done, the time that it took, and about how long the rest takes."""
        if not self.total:
            return f"{self._description}: {self.done}, {_duration(self.seconds)}"
        left_s = self.seconds * (self.total - self.done) / max(self.done, 1)
        left = f", about {_duration(left_s)} left" if 0 < self.done < self.total else ""
        return f"{self._steps()} ({self.done / self.total:.0%}), {_duration(self.seconds)}{left}"

    def finished(self) -> str:
        """What was done, and the time that it took."""
        return f"{self._steps()} in {_duration(self.seconds)}"

    def stopped(self) -> str:
        """What was done until an error or Ctrl-C ended the stage."""
        return f"{self._steps()}, stopped after {_duration(self.seconds)}"

    def _steps(self) -> str:
        of = f" of {self.total}" if self.total else ""
        return f"{self._description}: {self.done}{of}"


def _duration(seconds: float) -> str:
    """A time in words: 3.2 s, 45 s, 12 min, 2 h 5 min."""
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


def _to_stderr(line: str) -> None:
    sys.stderr.write(f"psotrack: {line}\n")
    sys.stderr.flush()


def _in_notebook() -> bool:
    """Whether this is the kernel of a notebook. A program that did not import IPython is none."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


@contextlib.contextmanager
def _notebook_bar(description: str, total: int) -> Iterator[Advance]:
    """Show a bar in the output of a notebook's cell: one output, which changes, and is one line at the end."""
    from IPython.display import display, update_display

    stage, name = _Stage(description, total), uuid.uuid4().hex
    drawn_s = 0.0

    def shown(text: str, *, ended: bool = False) -> dict[str, str]:
        # A bar without a value moves: it is for a stage of unknown length that goes on.
        steps = (min(stage.done, total), total) if total else (1, 1)
        value = f' value="{steps[0]}" max="{steps[1]}"' if total or ended else ""
        bar = f'<progress{value} style="width: 12em; vertical-align: middle"></progress>'
        return {"text/plain": text, "text/html": f"<div>{bar} {html.escape(text)}</div>"}

    def advance(steps: int) -> None:
        nonlocal drawn_s
        stage.done += steps
        if time.monotonic() - drawn_s >= _REDRAWN_S:
            drawn_s = time.monotonic()
            update_display(shown(stage.so_far()), raw=True, display_id=name)

    display(shown(stage.so_far()), raw=True, display_id=name)
    try:
        yield advance
    except BaseException:
        update_display(shown(stage.stopped(), ended=True), raw=True, display_id=name)
        raise
    update_display(shown(stage.finished(), ended=True), raw=True, display_id=name)
