"""Progress of long work, as a callable that counts, so that no numeric code knows about terminals."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

#: Called with the number of steps that were done since the last call.
Advance = Callable[[int], None]

#: `with report("track", total) as advance: ... advance(1)`: how a function is told whom to report to.
Report = Callable[[str, int], contextlib.AbstractContextManager[Advance]]


@contextlib.contextmanager
def silent(description: str, total: int) -> Iterator[Advance]:
    """Report to nobody: the default of every function that takes a `Report`."""
    yield lambda steps: None


@contextlib.contextmanager
def terminal(description: str, total: int) -> Iterator[Advance]:
    """A bar on stderr that disappears when the work is done; nothing where stderr is no terminal."""
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
