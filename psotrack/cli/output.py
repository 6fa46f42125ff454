"""Output of the commands: progress, sentences and tables for people, JSON for programs.

Most functions take the values of three options: `quiet` (--quiet), `json_path` (--json; `-` is stdout) and `force`
(--force).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psotrack.errors import SettingsError
from psotrack.support import Report, atomic_write, no_progress, progress_bar, refuse_to_overwrite

if TYPE_CHECKING:
    from rich.table import Table

#: Heading of a column of positions; `print_table` keeps each of its cells on one line.
POSITION = "centre (m)"
#: Width of an inventory in a file or a pipe, characters.
_WIDE = 200


def report_to(quiet: bool) -> Report:
    """Progress display for long work: none with --quiet, else a bar on stderr."""
    return no_progress if quiet else progress_bar


def print_inventory(table: Table) -> None:
    """Print a table; in its full width where the output is no terminal."""
    from rich.console import Console

    console = Console()
    Console(width=None if console.is_terminal else max(console.width, _WIDE)).print(table)


def print_line(quiet: bool, json_path: Path | None, sentence: str) -> None:
    """Print a sentence on stdout; nothing with --quiet or if stdout takes the JSON."""
    if not quiet and json_path != Path("-"):
        click.echo(sentence)


def print_table(
    quiet: bool, json_path: Path | None, headings: tuple[str, ...], rows: Iterable[tuple[str, ...]]
) -> None:
    """Print a table on stdout, names in the first column and numbers in the others; see `print_line`."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    if quiet or json_path == Path("-"):
        return
    table = Table(box=box.HORIZONTALS, show_edge=False)
    for index, heading in enumerate(headings):
        table.add_column(heading, justify="right" if index else "left", no_wrap=heading == POSITION)
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def finite_or_none(value: float) -> float | None:
    """The number, or None (null in JSON) for NaN and infinities."""
    return float(value) if math.isfinite(value) else None


def format_numbers(values: Iterable[float], digits: int) -> str:
    """Numbers with `digits` decimals and spaces between them."""
    return " ".join(f"{value:.{digits}f}" for value in values)


def check_outputs(out: Path | None, json_path: Path | None, force: bool) -> None:
    """Check the output files before any work.

    Raises:
        SettingsError: `out` is not a CSV file, or `json_path` is the same file.
        OutputError: a file exists and `force` is not set.
    """
    if out is not None and out.suffix != ".csv":
        raise SettingsError("--out", expected="a file that ends in .csv", found=out.name)
    for path in (out, json_path):
        if path is not None and path != Path("-"):
            refuse_to_overwrite(path, force)
    if out is not None and json_path == out:
        raise SettingsError("--json", expected="another file than --out", found=f"{out} twice")


def output_json(json_path: Path | None, content: Any, force: bool) -> None:
    """Write JSON for programs, to stdout or to a new file; a missing number, NaN, is written as null.

    Raises:
        OutputError: the file exists and `force` is not set.
    """
    if json_path == Path("-"):
        click.echo(_json_text(content))
    elif json_path is not None:
        refuse_to_overwrite(json_path, force)
        write_json(json_path, content)


def write_json(path: str | Path, content: Any) -> None:
    """Write a JSON file, NaN as null; an interruption leaves no partial file."""
    with atomic_write(Path(path)) as temporary:
        temporary.write_text(_json_text(content) + "\n", encoding="utf-8")


def _json_text(content: Any) -> str:
    """The content as JSON. JSON has no NaN: a missing number is null. Infinite numbers are an error of the caller."""
    return json.dumps(_with_null(content), indent=2, allow_nan=False)


def _with_null(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _with_null(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_with_null(value) for value in content]
    return None if isinstance(content, float) and math.isnan(content) else content
