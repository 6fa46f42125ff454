"""What commands print and write: progress, sentences and tables for people, JSON for programs, the log of `--log`."""

from __future__ import annotations

import contextlib
import logging
import re
import shlex
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, runtime_checkable

import click

from psotrack import __version__, trajectories
from psotrack.cli.types import says
from psotrack.errors import OutputError, PsotrackError, SettingsError, system_errors
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


#: Sentences that a command prints, and stages of its progress, for the log only: they do not pass to other handlers.
said = logging.getLogger("psotrack.said")
said.propagate = False

#: Beginning of a log.
_TIME = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]")


@contextlib.contextmanager
def logged(path: Path) -> Iterator[None]:
    """Add warnings, steps of the work, stages of the progress, printed sentences and the error to the end of a file.

    Raises:
        OutputError: the file cannot be opened for writing, or is another file than a log.
    """
    handler, steps = _opened(path), logging.getLogger("psotrack")
    level, loggers = steps.level, (logging.getLogger(), said)
    for logger in loggers:
        logger.addHandler(handler)
    for logger in (steps, said):
        logger.setLevel(logging.INFO)
    try:
        said.info("psotrack %s: %s", __version__, shlex.join(["psotrack", *sys.argv[1:]]))
        yield
    except (PsotrackError, KeyboardInterrupt) as error:
        said.error("%s", f"{error}" or "interrupted")
        raise
    except Exception as error:
        said.exception("%s", error)
        raise
    finally:
        for logger in loggers:
            logger.removeHandler(handler)
        steps.setLevel(level)
        # What could not be written was said by the handler.
        with contextlib.suppress(OSError):
            handler.close()


def _opened(path: Path) -> _Handler:
    if path == Path("-"):
        raise OutputError(path, expected="the path of a log file", found="-; stderr is /dev/stderr")
    with system_errors(path, "a log file that can be written", OutputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_file() and not _begins_like_a_log(path):
            # A user who names a file of tracks by mistake must not get lines of a log in it.
            raise OutputError(
                path, expected="a new file, or a log of psotrack", found="another file, which is unchanged"
            )
        handler = _Handler(path, encoding="utf-8")
    handler.setLevel(logging.INFO)
    handler.setFormatter(_Formatter())
    return handler


def _begins_like_a_log(path: Path) -> bool:
    """Whether a file is empty or begins with the time of a line of a log."""
    with path.open("rb") as file:
        begin = file.read(20)
    return not begin or _TIME.fullmatch(begin) is not None


class _Handler(logging.FileHandler):
    """Says in one line that the file cannot be written any more, and writes no more: the work goes on."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Called by `logging` where a line could not be written."""
        self.setLevel(logging.CRITICAL + 1)
        error = sys.exc_info()[1]
        reason = getattr(error, "strerror", None) or error
        sys.stderr.write(f"psotrack: warning: {self.baseFilename}: {reason}; the log ends here\n")


class _Formatter(logging.Formatter):
    """Local time with its offset from UTC, level and place of a message; no place for sentences that are printed."""

    def format(self, record: logging.LogRecord) -> str:
        """One line; an unexpected error has its traceback below."""
        place = "" if record.name == said.name else f" {record.name}:"
        time = self.formatTime(record, "%Y-%m-%dT%H:%M:%S%z")
        line = f"{time} {record.levelname.lower()}{place} {record.getMessage()}"
        return f"{line}\n{self.formatException(record.exc_info)}" if record.exc_info else line


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

    def table(
        self,
        headings: tuple[str, ...],
        rows: Iterable[tuple[str, ...]],
        title: str = "",
        whole: tuple[str, ...] = (POSITION,),
        least_width: int = 0,
    ) -> None:
        """Print a table, names in the first column and numbers in the others; see `text_table`."""
        if self.shows:
            click.echo(text_table(headings, rows, title, whole, least_width))

    def result(self, result: _Shown) -> None:
        """Write a result as --json says, and print it."""
        self.json(result.to_dict())
        self.say(*f"{result}".splitlines())

    def drones(self, tracks: trajectories.Trajectories, size_m: np.ndarray | None = None) -> None:
        """Print a table of the drones, at most 80 characters wide.

        Args:
            tracks: the tracks of the drones.
            size_m: (drones, 3), learned sizes, metres; None where they are not known.
        """
        if not self.shows:
            return
        columns = trajectories.summary_columns(tracks, size_m)
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
