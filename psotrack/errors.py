"""The errors that users see, and the one sentence that each of them is made of.

Every message says where the trouble is, what was expected, what was found, and what to do. The command line
prints it as one line and exits with code 2; a program can catch `PsotrackError`.
"""

from __future__ import annotations

import os


class PsotrackError(Exception):
    """Root of all errors that psotrack raises on purpose."""

    def __init__(self, where: object, *, expected: str, found: str, remedy: str = "") -> None:
        sentence = f"{_place(where)}: expected {expected}, found {found}"
        super().__init__(f"{sentence}; {remedy}" if remedy else sentence)

    def __reduce__(self) -> tuple[object, ...]:
        # Pickling brings errors out of worker processes, and would call __init__ with the sentence alone.
        return _restored, (type(self), str(self))


class InputError(PsotrackError):
    """A file or folder that was given cannot be used."""


class SettingsError(PsotrackError):
    """A setting has a value that makes no sense."""


class OutputError(PsotrackError):
    """A result could not be written; what was there before is untouched."""


def _restored(kind: type[PsotrackError], sentence: str) -> PsotrackError:
    return kind.__new__(kind, sentence)


def _place(where: object) -> str:
    return os.fspath(where) if isinstance(where, os.PathLike) else str(where)


def check_positive(name: str, value: float, remedy: str = "") -> None:
    """Raise `SettingsError` unless `value` is a finite number above 0."""
    if not 0 < value < float("inf"):
        raise SettingsError(name, expected="a number above 0", found=f"{value:g}", remedy=remedy)
