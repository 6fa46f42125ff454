"""Progress of long work: numeric code calls a counting function and knows nothing about terminals."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

#: Function that is called with the number of steps done since the last call.
Advance = Callable[[int], None]

#: Function that opens a progress bar: `with report("track", total) as advance: ... advance(1)`.
Report = Callable[[str, int], contextlib.AbstractContextManager[Advance]]


@contextlib.contextmanager
def no_progress(description: str, total: int) -> Iterator[Advance]:
    """Show no progress: the default of every function that takes a `Report`."""
    yield lambda steps: None


@contextlib.contextmanager
def progress_bar(description: str, total: int) -> Iterator[Advance]:
    """Show a bar on stderr that disappears at the end of the work; show nothing if stderr is not a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda steps: None
        return
    columns = (TextColumn("{task.description:<12}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task(description, total=total)
        yield lambda steps: progress.advance(task, steps)
