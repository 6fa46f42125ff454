"""Progress of long work: numeric code calls a counting function and knows nothing about terminals.

A `Report` shows the progress of one stage: `progress_bar` where the reader is (terminal, notebook or log of a script),
`terminal_bar` on a terminal in any case, `progress_lines` as lines of text, and `no_progress` nowhere.
"""

from __future__ import annotations

import contextlib
import functools
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
#: Least fraction of the stage between two lines about it, unless `_AT_LATEST_S` have passed.
_FRACTION = 0.1
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
    say = _to_stderr if write is None else write
    return functools.partial(_said, say=say, every_s=_EVERY_S, least=_FRACTION, long_s=long_s, clock=clock)


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


@contextlib.contextmanager
def _said(
    description: str,
    total: int,
    say: Callable[[str], None],
    *,
    every_s: float,
    least: float = 0.0,
    long_s: float = 0.0,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Advance]:
    """Say in sentences how a stage goes on, and how it ended if it took `long_s`; 0 steps are an unknown number.

    A sentence comes `every_s`, if the fraction `least` of the stage was done since the one before, or
    `_AT_LATEST_S` have passed. The rest is as fast as what followed the first sentence: the first steps may have waited
    for a compilation.
    """
    lock, began_s, done, of = threading.Lock(), clock(), 0, f" of {total}" if total else ""
    #: Time and steps of each sentence.
    said: list[tuple[float, int]] = []

    def sentence(now_s: float) -> str | None:
        """What is done, the time that it took, and about how long the rest takes; None if it is not due."""
        before_s, before = said[-1] if said else (began_s, 0)
        silent_s, is_enough = now_s - before_s, not total or done - before >= least * total
        if silent_s < every_s or 0 < total <= done or not (is_enough or not said or silent_s >= _AT_LATEST_S):
            return None
        said.append((now_s, done))
        fraction, left = f" ({done / total:.0%})" if total else "", ""
        if total and said[0][1] < done and len(said) > 1:
            left_s = (now_s - said[0][0]) * (total - done) / (done - said[0][1])
            left = f", about {_duration(left_s)} left"
        return f"{description}: {done}{of}{fraction}, {_duration(now_s - began_s)}{left}"

    def advance(steps: int) -> None:
        nonlocal done
        with lock:
            done += steps
            words = sentence(clock())
        if words is not None:
            say(words)

    how = ", stopped after"
    try:
        yield advance
        how = " in"
    finally:
        spent_s = clock() - began_s
        if said or spent_s >= long_s:
            say(f"{description}: {done}{of}{how} {_duration(spent_s)}")


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

    handle = display({"text/plain": f"{description}: 0"}, raw=True, display_id=True)

    def say(sentence: str) -> None:
        handle.update({"text/plain": sentence}, raw=True)

    return _said(description, total, say, every_s=_REDRAWN_S)
