"""What commands print and write: progress, sentences and tables for people, JSON for programs.

`Output` holds the options that are about nothing else: --quiet, --force, --json and --progress. A command gets it by
`@pass_output`.
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import click

from psotrack.cli.log_file import said
from psotrack.errors import SettingsError
from psotrack.support import (
    Report,
    atomic_write,
    joined,
    json_text,
    no_progress,
    progress_bar,
    progress_lines,
    refuse_files,
    terminal_bar,
    text_table,
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
_STDOUT = Path("-")


@runtime_checkable
class _Shown(Protocol):
    """What a function of the public face returns: its text is what the command prints."""

    def to_dict(self) -> dict[str, Any]:
        """The content of --json."""


class Output:
    """What a command prints and writes.

    Attributes:
        quiet: whether nothing is printed but errors.
        force: whether existing files are replaced.
        json_path: file of the results as JSON; `-` is stdout, which then gets nothing else; None is no file.
        progress: one of `PROGRESS`.
        started_s: value of `time.perf_counter` when the program started.
    """

    def __init__(self, started_s: float) -> None:
        self.quiet, self.force, self.progress = False, False, "auto"
        self.json_path: Path | None = None
        self.started_s = started_s

    @property
    def shows(self) -> bool:
        """Whether people get sentences and tables on stdout."""
        return not self.quiet and self.json_path != _STDOUT

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
            if self.shows or (always and self.json_path != _STDOUT):
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

    def table(self, headings: tuple[str, ...], rows: Iterable[tuple[str, ...]], title: str = "") -> None:
        """Print a table, names in the first column and numbers in the others."""
        if self.shows:
            click.echo(text_table(headings, rows, title))

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
        if not self.shows:
            return
        from rich import box
        from rich.table import Table
        from rich.text import Text

        from psotrack.trajectories import summary_columns

        columns = summary_columns(tracks, size_m)
        # These two would make the table wider than 80 characters; notebooks show them.
        for heading in ("extent (m)", "speed (m/s)"):
            columns.pop(heading, None)
        table = Table(box=box.HORIZONTALS, show_edge=False, pad_edge=False, padding=(0, 0, 0, 1))
        for heading in columns:
            # Long names are folded; numbers are on one line.
            style = {"min_width": 5} if heading == "drone" else {"justify": "right", "no_wrap": True}
            table.add_column(heading, overflow="fold", **style)
        for row in zip(*columns.values(), strict=True):
            table.add_row(*map(Text, row))
        self.show(table)

    def json(self, content: Any) -> None:
        """Write the results for programs, as --json says; a missing number, NaN, is written as null."""
        if self.json_path == _STDOUT:
            click.echo(json_text(content))
        elif self.json_path is not None:
            refuse_files(self.json_path, force=self.force)
            write_json(self.json_path, content)


def current_output() -> Output:
    """The output of the command that runs."""
    context = click.get_current_context()
    return context.meta.setdefault("psotrack.output", Output(context.find_root().obj or time.perf_counter()))


def pass_output(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command its `Output` as the first argument."""

    @functools.wraps(command)
    def with_output(*args: Any, **options: Any) -> None:
        command(current_output(), *args, **options)

    return with_output


def check_suffix(option: str, path: Path | None, *suffixes: str) -> None:
    """Raise `SettingsError` for a file that ends otherwise than an option wants."""
    if path is not None and path.suffix not in suffixes:
        raise SettingsError(option, expected=f"a file that ends in {' or '.join(suffixes)}", found=path.name)


def write_json(path: str | Path, content: Any) -> None:
    """Write a JSON file, NaN as null; an interruption leaves no partial file."""
    with atomic_write(Path(path)) as temporary:
        temporary.write_text(json_text(content) + "\n", encoding="utf-8")
