"""How commands answer: progress, sentences and tables for people, JSON for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

from psotrack.errors import SettingsError
from psotrack.support import Report, atomic_write, no_progress, progress_bar, refuse_to_overwrite

#: Heading of places in a table.
PLACE = "centre (m)"


def report_to(quiet: bool) -> Report:
    """Whom long work reports to."""
    return no_progress if quiet else progress_bar


def say(quiet: bool, json_path: Path | None, sentence: str) -> None:
    """One sentence on stdout, unless that is silent or taken by JSON."""
    if not quiet and json_path != Path("-"):
        click.echo(sentence)


def show(
    quiet: bool, json_path: Path | None, headings: tuple[str, ...], rows: Iterable[tuple[str, ...]]
) -> None:
    """A table of names and numbers on stdout, where `say` would say something; places stay on one line."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    if quiet or json_path == Path("-"):
        return
    table = Table(box=box.HORIZONTALS, show_edge=False)
    for index, heading in enumerate(headings):
        table.add_column(heading, justify="right" if index else "left", no_wrap=heading == PLACE)
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def known(value: float) -> float | None:
    """A number as JSON has it: null for none."""
    return float(value) if math.isfinite(value) else None


def in_words(values: Iterable[float], digits: int) -> str:
    """Numbers with spaces between them."""
    return " ".join(f"{value:.{digits}f}" for value in values)


def check_outputs(out: Path | None, json_path: Path | None, force: bool) -> None:
    """Refuse, before any work, a table that is no CSV, files that are there, and one file for both."""
    if out is not None and out.suffix != ".csv":
        raise SettingsError("--out", expected="a file that ends in .csv", found=out.name)
    for path in (out, json_path):
        if path is not None and path != Path("-"):
            refuse_to_overwrite(path, force)
    if out is not None and json_path == out:
        raise SettingsError("--json", expected="another file than --out", found=f"{out} twice")


def answer(json_path: Path | None, content: Any, force: bool) -> None:
    """The answer for programs: on stdout, or in a file that was not there."""
    if json_path == Path("-"):
        click.echo(json.dumps(content, indent=2, allow_nan=False))
    elif json_path is not None:
        refuse_to_overwrite(json_path, force)
        write_json(json_path, content)


def write_json(path: Path, content: Any) -> None:
    """Write a JSON file whole."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
