"""What commands print and write: progress, sentences and tables for people, JSON for programs."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, runtime_checkable

import click

from psotrack.cli.log_file import logged, said
from psotrack.cli.types import says
from psotrack.errors import SettingsError
from psotrack.support import (
    POSITION,
    Report,
    joined,
    json_text,
    no_progress,
    progress_bar,
    progress_lines,
    refuse_files,
    terminal_bar,
    text_table,
    write_json,
)

if TYPE_CHECKING:
    import numpy as np

    from psotrack.trajectories import Trajectories

#: Width of a wide table in a file or a pipe, characters.
_WIDE = 200
#: Values of --progress.
PROGRESS: dict[str, Report] = {
    "auto": progress_bar,
    "bar": terminal_bar,
    "lines": progress_lines(),
    "none": no_progress,
}


@runtime_checkable
class _Shown(Protocol):
    """What a function of the public face returns: its text is what the command prints."""

    def to_dict(self) -> dict[str, Any]:
        """The content of --json."""


def _started_s() -> float:
    """Value of `time.perf_counter` when the program started; now where nobody has noted it."""
    context = click.get_current_context(silent=True)
    return (context and context.find_root().obj) or time.perf_counter()


@dataclass(frozen=True)
class Output:
    """What a command prints and writes.

    Attributes:
        force: replace existing files.
        quiet: print no progress and no results, only errors.
        progress: progress on stderr. auto: a bar on a terminal, else lines now and then about work that takes long;
            bar: a bar in any case; lines: lines, and the seconds of each stage; none: nothing.
        log: add warnings, steps, seconds of each stage, results and errors to the end of FILE, with times.
        json_path: write the results as JSON to OUT; - is stdout.
        started_s: value of `time.perf_counter` when the program started.
    """

    force: bool = False
    quiet: Annotated[bool, says(short=["-q"])] = False
    progress: Annotated[Literal["auto", "bar", "lines", "none"], says(envvar="PSOTRACK_PROGRESS")] = "auto"
    log: Annotated[Path, says(metavar="FILE")] | None = None
    json_path: Annotated[Path, says(metavar="OUT")] | None = None
    started_s: float = field(default_factory=_started_s)

    @contextlib.contextmanager
    def opened(self) -> Iterator[Output]:
        """The output during the command, whose sentences and errors go to the log, too.

        Raises:
            OutputError: the file of the log or of the results cannot be written, or must not be replaced.
        """
        with contextlib.nullcontext() if self.log is None else logged(self.log):
            if self.json_path is not None and not self._json_on_stdout:
                refuse_files(self.json_path, force=self.force)
            yield self

    @property
    def _json_on_stdout(self) -> bool:
        """Whether stdout gets the results as JSON, and nothing else."""
        return self.json_path in (Path("-"), Path("/dev/stdout"))

    @property
    def elapsed_s(self) -> float:
        """Time since the program started, seconds."""
        return time.perf_counter() - self.started_s

    @property
    def shows(self) -> bool:
        """Whether people get sentences and tables on stdout."""
        return not self.quiet and not self._json_on_stdout

    @property
    def can_ask(self) -> bool:
        """Whether somebody at a terminal reads questions and answers them."""
        return self.shows and sys.stdin.isatty() and sys.stdout.isatty()

    @property
    def report(self) -> Report:
        """Progress of long work: none with --quiet, else as --progress says; and stages in the log of --log."""
        shown = no_progress if self.quiet else PROGRESS[self.progress]
        return joined(shown, progress_lines(said.info)) if said.handlers else shown

    def refuse(self, *paths: Path | None) -> None:
        """Refuse files that exist already without --force, that cannot be written, or that --json is to write.

        Raises:
            OutputError: a file exists and --force was not given, or is a folder.
            SettingsError: a file is that of --json.
        """
        files = [path for path in paths if path is not None]
        for path in files:
            if path == self.json_path:
                raise SettingsError("--json", expected="another file than --out", found=f"{path} twice")
        refuse_files(*files, force=self.force)

    def say(self, *sentences: str, always: bool = False) -> None:
        """Print sentences, a line each, and log them; with `always` they are printed with --quiet too."""
        for sentence in sentences:
            said.info("%s", sentence)
            if self.shows or (always and not self._json_on_stdout):
                click.echo(sentence)

    def show(self, *shown: object, wide: bool = False) -> None:
        """Print tables and other things of rich; a wide one in its full width where stdout is no terminal."""
        from rich.console import Console

        if self.shows:
            console = Console()
            if wide and not console.is_terminal:
                console = Console(width=max(console.width, _WIDE))
            for each in shown:
                console.print(each)

    def table(
        self,
        headings: tuple[str, ...],
        rows: Iterable[tuple[str, ...]],
        title: str = "",
        whole: tuple[str, ...] = (POSITION,),
    ) -> None:
        """Print a table, names in the first column and numbers in the others; see `text_table`."""
        if self.shows:
            click.echo(text_table(headings, rows, title, whole))

    def result(self, result: _Shown) -> None:
        """Write a result as --json says, and print it."""
        self.json(result.to_dict())
        self.say(*f"{result}".splitlines())

    def drones(self, tracks: Trajectories, size_m: np.ndarray | None = None) -> None:
        """Print a table of the drones, at most 80 characters wide.

        Args:
            tracks: the tracks of the drones.
            size_m: (drones, 3), learned sizes, metres; None where they are not known.
        """
        from psotrack.trajectories import summary_columns

        if not self.shows:
            return
        columns = summary_columns(tracks, size_m)
        # These two would make the table wider than 80 characters; notebooks show them.
        for heading in ("extent (m)", "speed (m/s)"):
            columns.pop(heading, None)
        headings = tuple(columns)
        self.table(headings, zip(*columns.values(), strict=True), whole=headings)

    def json(self, content: Any) -> None:
        """Write the results for programs, as --json says; a missing number, NaN, is written as null."""
        if self._json_on_stdout:
            click.echo(json_text(content))
        elif self.json_path is not None:
            refuse_files(self.json_path, force=self.force)
            write_json(self.json_path, content)


def check_suffix(option: str, path: Path | None, *suffixes: str) -> None:
    """Raise `SettingsError` for a file that ends otherwise than an option wants."""
    if path is not None and path.suffix not in suffixes:
        raise SettingsError(option, expected=f"a file that ends in {' or '.join(suffixes)}", found=path.name)
