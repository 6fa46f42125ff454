"""`--log FILE`: everything that a command says, with times, at the end of a file."""

from __future__ import annotations

import contextlib
import logging
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

from psotrack import __version__
from psotrack.errors import OutputError, PsotrackError

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
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_file() and not _begins_like_a_log(path):
            # A user who names a file of tracks by mistake must not get lines of a log in it.
            expected, found = "a new file, or a log of psotrack", "another file, which is unchanged"
            raise OutputError(path, expected=expected, found=found)
        handler = _Handler(path, encoding="utf-8")
    except OSError as error:
        found = error.strerror or f"{error}"
        raise OutputError(path, expected="a log file that can be written", found=found) from error
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
