"""Types of the values of arguments and options, and what is said of those that several commands have."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from msgspec import Meta

from psotrack.support import ARCHIVE_SUFFIX, whole_number

if TYPE_CHECKING:
    from psotrack.cli.settings import OpenedArchive

#: Key of the archive in the context of a command.
ARCHIVE = "psotrack.archive"
#: Heading of the options that are not about the work itself.
RUNNING = "Running"


def says(**said: Any) -> Meta:
    """What is said of a parameter beside its type, default and description.

    Args:
        **said: `words`, the description; `flag`, the option's name without dashes; `short`, further names; `heading` of
            its part of the help; and arguments of `click.Option` or `click.Argument`, such as `metavar` and `type`.
    """
    return Meta(extra=said)


class Words(click.ParamType):
    """A value that is read from a word.

    Args:
        name: what stands for the value in the help.
        expected: what the word should be, for the message.
        read: reads the word; raises `ValueError` for another word.
    """

    def __init__(self, name: str, expected: str, read: Callable[[str], Any]) -> None:
        self.name, self._expected, self._read = name, expected, read

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The value of a string; a value that is not a string is returned as it is."""
        if not isinstance(value, str):
            return value
        try:
            return self._read(value)
        except ValueError:
            self.fail(f"expected {self._expected}, found {value!r}", param, ctx)


def numbers(count: int) -> Words:
    """`count` numbers with commas between them, such as 0.5,0.5,0.2; any count where `count` is 0."""

    def read(value: str) -> tuple[float, ...]:
        found = tuple(float(word) for word in value.split(","))
        if count and len(found) != count:
            raise ValueError
        return found

    expected = f"{count} numbers" if count else "numbers"
    return Words(",".join(["NUMBER"] * count) or "NUMBER,...", f"{expected} with commas between them", read)


def _names(value: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in value.split(","))
    if not all(names):
        raise ValueError
    return names


def _size(value: str) -> tuple[int, ...]:
    width, height = (whole_number(word) for word in value.replace("x", ",").split(","))
    if not width or not height:
        raise ValueError
    return width, height


def _distance(value: str) -> tuple[str, str, float]:
    names, _, length = value.partition("=")
    first, second = names.split(",")
    metres = float(length)
    if not 0 < metres < float("inf"):
        raise ValueError
    return first, second, metres


NAMES = Words("NAME,NAME...", "names with commas between them", _names)
SIZE = Words("W,H", "two whole numbers above 0, such as 1920,1080", _size)
DISTANCE = Words("NAME,NAME=METRES", "two cameras and metres, such as left,right=4.20", _distance)


class SequencePath(click.Path):
    """Path of a sequence. An archive is unpacked, and its folder is the path until the command ends."""

    name = "sequence"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path; that of a temporary folder with the content of an archive."""
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        return path if ctx is None or ctx.resilient_parsing else opened_sequence(path)


def opened_sequence(path: Path) -> Path:
    """The path of a sequence; that of a temporary folder with the content of an archive."""
    if path.suffix.lower() != ARCHIVE_SUFFIX or path.is_dir():
        return path
    from psotrack.cli.settings import opened_archive

    return opened_archive(click.get_current_context(), path)


def archive_of() -> OpenedArchive | None:
    """The archive that the command was given as SEQ; None for any other recording."""
    return click.get_current_context().meta.get(ARCHIVE)
