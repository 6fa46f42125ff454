"""Types of the values of options."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any

import click

from psotrack.errors import SettingsError
from psotrack.support import ARCHIVE_SUFFIX, whole_number


class Numbers(click.ParamType):
    """`count` numbers with commas between them, such as 0.5,0.5,0.2; any count where `count` is 0."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.name = ",".join(["NUMBER"] * count) or "NUMBER,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Tuple of floats from a string; a value that is not a string is returned as it is."""
        if not isinstance(value, str):
            return value
        try:
            numbers = tuple(float(word) for word in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != (self.count or max(len(numbers), 1)):
            count = f"{self.count} numbers" if self.count else "numbers"
            self.fail(f"expected {count} with commas between them, found {value!r}", param, ctx)
        return numbers


class Names(click.ParamType):
    """Names with commas between them, such as left,right."""

    name = "NAME,NAME..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Tuple of names from a string; a value that is not a string is returned as it is."""
        if not isinstance(value, str):
            return value
        names = tuple(name.strip() for name in value.split(","))
        if not all(names):
            self.fail(f"expected names with commas between them, found {value!r}", param, ctx)
        return names


class Size(click.ParamType):
    """Two whole numbers above 0, such as 1920,1080 or 7x5."""

    name = "W,H"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Pair of integers from a string; a value that is not a string is returned as it is."""
        if not isinstance(value, str):
            return value
        words = value.replace("x", ",").split(",")
        numbers = [whole_number(word) for word in words]
        if len(numbers) != 2 or not all(numbers):
            self.fail(f"expected two whole numbers above 0, such as 1920,1080, found {value!r}", param, ctx)
        return tuple(numbers)


class Distance(click.ParamType):
    """Two cameras and the distance between their centres, such as left,right=4.20."""

    name = "NAME,NAME=METRES"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Names and metres from a string; a value that is not a string is returned as it is."""
        if not isinstance(value, str):
            return value
        names, _, length = value.partition("=")
        cameras = tuple(names.split(","))
        try:
            metres = float(length)
        except ValueError:
            metres = 0.0
        if len(cameras) != 2 or not 0 < metres < float("inf"):
            self.fail(
                f"expected two cameras and metres, such as left,right=4.20, found {value!r}", param, ctx
            )
        return *cameras, metres


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
    from psotrack.cli.archived import opened_archive

    return opened_archive(click.get_current_context(), path)


def change_of(text: str, example: str = "swarm.particles=50") -> tuple[str, Any]:
    """Name and value of `NAME=VALUE`; the value is parsed as TOML, and kept as text if it is not valid TOML."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise SettingsError("--set", expected=f"NAME=VALUE, such as {example}", found=text)
    try:
        return name.strip(), tomllib.loads(f"value = {value}")["value"]
    except ValueError:
        # Not valid TOML, or an integer of thousands of digits.
        return name.strip(), value
