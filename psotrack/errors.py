"""Exceptions with messages for users.

Every message is one line: the place, what was expected there, what was found, and what to do about it. The command
line prints the message and exits with code 2; a program can catch `PsotrackError`.
"""

from __future__ import annotations

import os


class PsotrackError(Exception):
    """Base class of all exceptions that psotrack raises on purpose.

    Args:
        where: the file, setting or other place of the fault; the message begins with it.
        expected: noun phrase for what should be at the place.
        found: noun phrase for what is there instead.
        remedy: what the user can do; the end of the message.
    """

    def __init__(self, where: object, *, expected: str, found: str, remedy: str = "") -> None:
        place = os.fspath(where) if isinstance(where, os.PathLike) else str(where)
        message = f"{place}: expected {expected}, found {found}"
        super().__init__(f"{message}; {remedy}" if remedy else message)

    def __reduce__(self) -> tuple[object, ...]:
        # Worker processes send errors by pickle, which by default calls __init__ with the message as only argument.
        return _unpickled, (type(self), str(self))


class InputError(PsotrackError):
    """An input file or folder cannot be used."""


class SettingsError(PsotrackError):
    """A setting has a value that is not allowed."""


class OutputError(PsotrackError):
    """A result cannot be written. An older result at the same path is unchanged."""


def _unpickled(kind: type[PsotrackError], message: str) -> PsotrackError:
    return kind.__new__(kind, message)


def check_positive(name: str, value: float, remedy: str = "") -> None:
    """Raise `SettingsError` unless `value` is a finite number above 0.

    Args:
        name: name of the setting, for the message.
        value: value of the setting.
        remedy: what the user can do, for the message.
    """
    if not 0 < value < float("inf"):
        raise SettingsError(name, expected="a number above 0", found=f"{value:g}", remedy=remedy)
