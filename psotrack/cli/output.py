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

from psotrack.cli.log_file import said
from psotrack.errors import SettingsError
from psotrack.support import (
    Report,
    atomic_write,
    joined,
    no_progress,
    progress_bar,
    progress_lines,
    refuse_to_overwrite,
    terminal_bar,
)

if TYPE_CHECKING:
    import numpy as np
    from rich.table import Table

    from psotrack.trajectories import Trajectories

#: Heading of a column of positions; `print_table` keeps each of its cells on one line.
POSITION = "centre (m)"
#: Width of an inventory in a file or a pipe, characters.
_WIDE = 200


#: Values of --progress.
PROGRESS: dict[str, Report] = {
    "auto": progress_bar,
    "bar": terminal_bar,
    "lines": progress_lines(),
    "none": no_progress,
}
#: Key of the value of --progress in `click.Context.meta`.
CHOSEN_PROGRESS = "psotrack.progress"


def report_to(quiet: bool) -> Report:
    """Progress display for long work: none with --quiet, else as --progress says; and stages in the log of --log."""
    context = click.get_current_context(silent=True)
    chosen = "auto" if context is None else context.meta.get(CHOSEN_PROGRESS, "auto")
    shown = no_progress if quiet else PROGRESS[chosen]
    return joined(shown, progress_lines(said.info)) if said.handlers else shown


def print_inventory(table: Table) -> None:
    """Print a table; in its full width where the output is no terminal."""
    from rich.console import Console

    console = Console()
    Console(width=None if console.is_terminal else max(console.width, _WIDE)).print(table)


def print_line(quiet: bool, json_path: Path | None, sentence: str) -> None:
    """Print a sentence on stdout, and log it; print nothing with --quiet or if stdout takes the JSON."""
    said.info("%s", sentence)
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


def print_drones(
    quiet: bool, json_path: Path | None, tracks: Trajectories, size_m: np.ndarray | None = None
) -> None:
    """Print a table of the drones, at most 80 characters wide; see `print_line`.

    Args:
        quiet: --quiet.
        json_path: --json.
        tracks: the tracks of the drones.
        size_m: (drones, 3), learned sizes, metres; None where they are not known.
    """
    if quiet or json_path == Path("-"):
        return
    from rich import box
    from rich.console import Console
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
    Console().print(table)


def finite_or_none(value: float) -> float | None:
    """The number, or None (null in JSON) for NaN and infinities."""
    return float(value) if math.isfinite(value) else None


def format_numbers(values: Iterable[float], digits: int) -> str:
    """Numbers with `digits` decimals and spaces between them."""
    return " ".join(f"{value:.{digits}f}" for value in values)


def check_outputs(out: Path | None, json_path: Path | None, force: bool) -> None:
    """Check the output files before any work; the option `--json` itself checks that its file can be written.

    Raises:
        SettingsError: `out` is not a CSV file, or `json_path` is the same file.
        OutputError: `out` exists and `force` is not set, or it cannot be written.
    """
    if out is not None and out.suffix != ".csv":
        raise SettingsError("--out", expected="a file that ends in .csv", found=out.name)
    if out is not None:
        refuse_to_overwrite(out, force)
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
