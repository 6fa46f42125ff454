"""`psotrack report`: one HTML page about a flight, or a table of a sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import click

from psotrack.cli.commands import command
from psotrack.cli.options import Jobs, SeqOfTracks
from psotrack.cli.output import Output
from psotrack.cli.types import says
from psotrack.errors import errors_name

WITH_TABLE = says(heading="With --table")


@command(without=["json_path"])
def report(
    output: Output,
    source: Path,
    sequence: SeqOfTracks = None,
    *,
    out: Path | None = None,
    compare: Annotated[
        tuple[Path, ...], says(multiple=True, metavar="TRACKS", type=click.Path(path_type=Path))
    ] = (),
    no_pictures: bool = False,
    table: Annotated[
        Literal["text", "markdown", "latex", "csv"] | None, says(is_flag=False, flag_value="text")
    ] = None,
    rows: Annotated[str, WITH_TABLE] = "sequence",
    columns: Annotated[str | None, WITH_TABLE] = None,
    value: Annotated[str, WITH_TABLE] = "mean_error_m",
    scale: Annotated[float, WITH_TABLE] = 1.0,
    jobs: Jobs = None,
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

    Options:
        out: page to write; it ends in .html. None: beside SOURCE, with the same name.
        compare: further tracks of the same flight to show beside; may be repeated.
        no_pictures: show events without pictures, which need the videos of SEQ.
        table: print a table of a sweep's results instead: mean +- standard deviation over runs.  [without a value:
            text]
        rows: columns of the results, with commas between them, that label the rows.
        columns: columns of the results that label the table's columns. None: method; sequence if --rows names method.
        value: column of the numbers in the table.
        scale: factor of the numbers; 1000 turns m into mm.
    """
    from psotrack import api

    if table is not None:
        click.echo(_table(source, table, rows, columns, value, scale))
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
