"""`--log FILE`: everything that a command says, with times, at the end of a file."""

from __future__ import annotations

import contextlib
import logging
import re
import shlex
import sys
from pathlib import Path
from types import TracebackType

import click

from psotrack import __version__
from psotrack.errors import OutputError, PsotrackError

#: Sentences that a command prints, and stages of its progress, for the log only: they do not pass to other handlers.
said = logging.getLogger("psotrack.said")
said.propagate = False

#: Beginning of a log.
_TIME = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]")


class LogFile:
    """A file that gets warnings, steps of the work, stages of the progress, printed sentences and the error.

    Args:
        path: the file; lines are added at its end.

    Raises:
        OutputError: the file cannot be opened for writing, or is another file than a log.
    """

    def __init__(self, path: Path) -> None:
        if path == Path("-"):
            raise OutputError(path, expected="the path of a log file", found="-; stderr is /dev/stderr")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_file() and not _begins_like_a_log(path):
                # A user who names a file of tracks by mistake must not get lines of a log in it.
                raise OutputError(
                    path,
                    expected="a new file, or a log of psotrack",
                    found="another file, which is unchanged",
                )
            self._handler = _Handler(path, encoding="utf-8")
        except OSError as error:
            found = error.strerror or f"{error}"
            raise OutputError(path, expected="a log file that can be written", found=found) from error
        self._handler.setLevel(logging.INFO)
        self._handler.setFormatter(_Formatter())
        self._steps = logging.getLogger("psotrack")
        self._level = self._steps.level

    def __enter__(self) -> LogFile:
        for logger in (logging.getLogger(), said):
            logger.addHandler(self._handler)
        for logger in (self._steps, said):
            logger.setLevel(logging.INFO)
        said.info("psotrack %s: %s", __version__, shlex.join(["psotrack", *sys.argv[1:]]))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if isinstance(error, click.ClickException):
            said.error("%s", error.format_message())
        elif isinstance(error, PsotrackError):
            said.error("%s", error)
        elif isinstance(error, KeyboardInterrupt):
            said.error("interrupted")
        elif isinstance(error, Exception) and not isinstance(error, click.exceptions.Exit):
            said.error("%s", error, exc_info=error)
        for logger in (logging.getLogger(), said):
            logger.removeHandler(self._handler)
        self._steps.setLevel(self._level)
        # What could not be written was said by the handler.
        with contextlib.suppress(OSError):
            self._handler.close()


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
