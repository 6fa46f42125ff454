"""`psotrack report`: one HTML page about a flight, or a table of a sweep."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from psotrack.cli.options import FORCE, JOBS, out_option, reporting, sequence_argument
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import Command, HelpfulCommand, Option
from psotrack.errors import errors_name


def _table_option(name: str, words: str, **attributes: Any) -> Callable[[Command], Command]:
    return click.option(name, cls=Option, heading="With --table", help=words, **attributes)


@click.command(cls=HelpfulCommand)
@click.argument("source", metavar="SOURCE", type=click.Path(path_type=Path))
@sequence_argument
@out_option("Page to write; it ends in .html.  [default: beside SOURCE, with the same name]")
@click.option(
    "--compare",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="TRACKS",
    help="Further tracks of the same flight to show beside; may be repeated.",
)
@click.option(
    "--no-pictures", is_flag=True, help="Show events without pictures, which need the videos of SEQ."
)
@click.option(
    "--table",
    "layout",
    type=click.Choice(["text", "markdown", "latex", "csv"]),
    is_flag=False,
    flag_value="text",
    help="Print a table of a sweep's results instead: mean +- standard deviation over runs.  [without a value: text]",
)
@_table_option(
    "--rows",
    "Columns of the results, with commas between them, that label the rows.",
    default="sequence",
    show_default=True,
)
@_table_option(
    "--columns",
    "Columns of the results that label the table's columns.  [default: method; sequence if --rows names method]",
)
@_table_option("--value", "Column of the numbers in the table.", default="mean_error_m", show_default=True)
@_table_option(
    "--scale", "Factor of the numbers; 1000 turns m into mm.", type=float, default=1.0, show_default=True
)
@JOBS
@FORCE
@reporting
@pass_output
def report(
    output: Output,
    source: Path,
    sequence: Path | None,
    out: Path | None,
    compare: tuple[Path, ...],
    no_pictures: bool,
    jobs: int | None,
    **table: Any,
) -> None:
    """Write one HTML page about SOURCE, a file of tracks, or print a table of SOURCE, the folder of a sweep.

    With SEQ, the recording of the tracks, which the record beside the tracks names, the page has errors, cameras, and
    pictures of events. The page needs no network and no other file: a browser opens it by a double click.

    In a table of a sweep, the end of a column's name is enough if no other column ends with it: particles is
    settings.swarm.particles.

    \b
    Examples:
      psotrack report my_lab/results/tracks.csv
      psotrack report tracks.csv my_lab --compare lines.csv --out report.html
      psotrack report results --table --rows sequence,particles --columns iterations --scale 1000
    """
    from psotrack import api

    if table["layout"] is not None:
        click.echo(_table(source, **table))
        return
    written = api.report(
        [source, *compare],
        out,
        recording=sequence,
        pictures=not no_pictures,
        jobs=jobs,
        force=output.force,
        progress=output.report,
    )
    output.say(f"{written}")


def _table(folder: Path, layout: str, rows: str, columns: str | None, value: str, scale: float) -> str:
    """A table of the results of a sweep."""
    from psotrack.sweeps import Store, pivot, render_table

    rows_by = [name for name in rows.split(",") if name]
    if columns is None:
        columns = next((name for name in ("method", "sequence") if name not in rows_by), "")
    columns_by = [name for name in columns.split(",") if name]
    with errors_name(folder):
        shown = pivot(Store(folder).rows(), rows_by=rows_by, columns_by=columns_by, value=value, scale=scale)
    return render_table(shown, layout).rstrip("\n")
