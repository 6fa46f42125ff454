"""Exceptions with messages for users.

Every message is one line: the place, what was expected there, what was found, and what to do about it. The command
line prints the message and exits with code 2; a program can catch `PsotrackError`.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

#: Longest message, characters: 300 with `psotrack: ` before the message. The folder of the place does not count,
#: wherever it stands in the message. What follows a long name has `_SHORTEST` characters all the same.
LONGEST_MESSAGE = 290
_SHORTEST = 150


def install_command(extra: str) -> str:
    """What to type to install an extra of the package, such as `view`."""
    return f"pip install '.[{extra}]' in the checkout of psotrack"


class PsotrackError(Exception):
    """Base class of all exceptions that psotrack raises on purpose.

    Args:
        where: the file, setting or other place of the fault; the message begins with it.
        expected: noun phrase for what should be at the place.
        found: noun phrase for what is there instead.
        remedy: what the user can do; the end of the message.

    A message is one line: what cannot be printed is written as an escape sequence, and the longest part is cut where
    the message would be longer than `LONGEST_MESSAGE`.
    """

    def __init__(self, where: object, *, expected: str, found: str, remedy: str = "") -> None:
        place = _on_one_line(os.fspath(where) if isinstance(where, os.PathLike) else str(where))
        parts = [_on_one_line(part) for part in (expected, found, remedy)]
        # After the name of an archive, the place has the path of a file in the archive.
        folder = os.path.dirname(place.partition(": ")[0])
        room = max(LONGEST_MESSAGE - len(f"{place[len(folder) :]}: expected , found ; "), _SHORTEST)
        if folder:
            room += len(folder) * sum(part.count(folder) for part in parts)
        expected, found, remedy = _shortened(parts, room)
        message = f"{place}: expected {expected}, found {found}"
        super().__init__(f"{message}; {remedy}" if remedy else message)

    def within(self, path: object) -> PsotrackError:
        """The same error with the name of a file before the message."""
        return _unpickled(type(self), f"{os.fspath(path) if isinstance(path, os.PathLike) else path}, {self}")

    def __reduce__(self) -> tuple[object, ...]:
        # Worker processes send errors by pickle, which by default calls __init__ with the message as only argument.
        return _unpickled, (type(self), str(self))


class InputError(PsotrackError):
    """An input file or folder cannot be used."""


class SettingsError(PsotrackError):
    """A setting has a value that is not allowed."""


class OutputError(PsotrackError):
    """A result cannot be written. An older result at the same path is unchanged."""


def _on_one_line(text: str) -> str:
    """The text with spaces for line ends, and escape sequences for what cannot be printed."""
    if text.isprintable():
        return text
    words = " ".join(text.split())
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in words)


def _shortened(parts: list[str], length: int) -> list[str]:
    """The parts, of which the longest are cut until all together have at most `length` characters."""
    while (over := sum(map(len, parts)) - length) > 0:
        longest = max(range(len(parts)), key=lambda index: len(parts[index]))
        kept = max(len(parts[longest]) - over - len(" ..."), length // len(parts) - len(" ..."))
        parts = [f"{part[:kept]} ..." if index == longest else part for index, part in enumerate(parts)]
    return parts


def _unpickled(kind: type[PsotrackError], message: str) -> PsotrackError:
    return kind.__new__(kind, message)


def one_short_line(text: str, remedy: str = "") -> str:
    """A message of another library as one line that is no longer than `LONGEST_MESSAGE` with a remedy after it."""
    (text,) = _shortened([_on_one_line(text)], LONGEST_MESSAGE - len(remedy))
    return f"{text}{remedy}"


@contextlib.contextmanager
def errors_name(path: object) -> Iterator[None]:
    """Errors of the block that do not name a file, because they are about its content, begin with its name.

    An error of an output is about another file.
    """
    try:
        yield
    except PsotrackError as error:
        if isinstance(error, OutputError) or str(path) in str(error):
            raise
        raise error.within(path) from error


@contextlib.contextmanager
def system_errors(
    where: object, expected: str, kind: type[PsotrackError] = InputError, remedy: str = ""
) -> Iterator[None]:
    """Errors of the operating system in the block become errors about a file, folder or address."""
    try:
        yield
    except OSError as error:
        found = f"{error.strerror or error}".lower()
        raise kind(where, expected=expected, found=found, remedy=remedy) from error


def check_positive(name: str, value: float, remedy: str = "") -> None:
    """Raise `SettingsError` unless `value` is a finite number above 0.

    Args:
        name: name of the setting, for the message.
        value: value of the setting.
        remedy: what the user can do, for the message.
    """
    if not 0 < value < float("inf"):
        raise SettingsError(name, expected="a number above 0", found=f"{value:g}", remedy=remedy)
