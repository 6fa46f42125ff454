"""Progress of long work: numeric code calls a counting function and knows nothing about terminals.

A `Report` shows the progress of one stage: `progress_bar` where the reader is (terminal, notebook or log of a script),
`terminal_bar` on a terminal in any case, `progress_lines` as lines of text, and `no_progress` nowhere.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
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
#: Time between two changes of a line in a notebook, seconds.
_REDRAWN_S = 0.2


@contextlib.contextmanager
def no_progress(description: str, total: int) -> Iterator[Advance]:
    """Show no progress: the default of every function that takes a `Report`."""
    yield lambda steps: None


def report_of(progress: bool | Report) -> Report:
    """How functions of the public face show progress: as a function says, or by bars, or not at all."""
    return progress if callable(progress) else progress_bar if progress else no_progress


def progress_bar(description: str, total: int) -> contextlib.AbstractContextManager[Advance]:
    """Show progress where the reader is.

    On a terminal this is a bar on stderr that disappears at the end of the work, in a notebook a line that changes,
    and stays in the saved notebook. Elsewhere, lines on stderr show work that takes longer than `LONG_S`.
    """
    if _in_notebook():
        return _in_a_cell(description, total)
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
    said = _to_stderr if write is None else write

    def report(description: str, total: int) -> contextlib.AbstractContextManager[Advance]:
        return _said(_Stage(description, total, clock), said, _is_line_due, long_s)

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
        self._began_s = self._said_s = clock()
        self.done = self.said_done = 0
        #: Time and steps at the first sentence.
        self._first: tuple[float, int] | None = None

    @property
    def seconds(self) -> float:
        """Time since the stage began, seconds."""
        return self._clock() - self._began_s

    @property
    def silent_s(self) -> float:
        """Time since the last sentence, or since the stage began, seconds."""
        return self._clock() - self._said_s

    def so_far(self) -> str:
        """What is done, the time that it took, and about how long the rest takes.

        The rest is as fast as what followed the first sentence: the first steps may have waited for a compilation.
        """
        spent_s, first = self.seconds, self._first
        self._said_s, self.said_done = self._clock(), self.done
        self._first = first or (spent_s, self.done)
        if not self.total:
            return f"{self._steps()}, {_duration(spent_s)}"
        left = ""
        if first and first[1] < self.done < self.total:
            left_s = (spent_s - first[0]) * (self.total - self.done) / (self.done - first[1])
            left = f", about {_duration(left_s)} left"
        return f"{self._steps()} ({self.done / self.total:.0%}), {_duration(spent_s)}{left}"

    def ended(self, how: str) -> str:
        """What was done, and the time that it took; `how` stands before the time."""
        return f"{self._steps()}{how} {_duration(self.seconds)}"

    def _steps(self) -> str:
        of = f" of {self.total}" if self.total else ""
        return f"{self._description}: {self.done}{of}"


@contextlib.contextmanager
def _said(
    stage: _Stage, say: Callable[[str], None], is_due: Callable[[_Stage], bool], long_s: float
) -> Iterator[Advance]:
    """Say how a stage goes on whenever that is due, and how it ended if that is worth it."""
    lock = threading.Lock()

    def advance(steps: int) -> None:
        with lock:
            stage.done += steps
            if not is_due(stage):
                return
            sentence = stage.so_far()
        say(sentence)

    how = ", stopped after"
    try:
        yield advance
        how = " in"
    finally:
        if stage.said_done or stage.seconds >= long_s:
            say(stage.ended(how))


def _is_line_due(stage: _Stage) -> bool:
    if stage.silent_s < _EVERY_S or 0 < stage.total <= stage.done:
        return False
    share = (stage.done - stage.said_done) / max(stage.total, 1)
    return not stage.said_done or share >= _SHARE or stage.silent_s >= _AT_LATEST_S or not stage.total


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


def _in_a_cell(description: str, total: int) -> contextlib.AbstractContextManager[Advance]:
    """Show progress in the output of a notebook's cell: one line, which changes."""
    from IPython.display import display

    stage = _Stage(description, total)
    handle = display({"text/plain": f"{description}: 0"}, raw=True, display_id=True)

    def say(sentence: str) -> None:
        handle.update({"text/plain": sentence}, raw=True)

    return _said(stage, say, lambda stage: stage.silent_s >= _REDRAWN_S, 0.0)
