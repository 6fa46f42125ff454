"""`psotrack sweep` and `psotrack table`: grids of settings, run and remembered, and tables of what came out."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from psotrack.cli.answers import answer, report_to, say
from psotrack.cli.options import CACHE, FORCE, JOBS, JSON, QUIET, cache_folder, compiled_folder
from psotrack.errors import SettingsError

if TYPE_CHECKING:
    from psotrack.sweep import Cell


@click.command()
@click.argument("grid_file", metavar="GRID.toml", type=click.Path(path_type=Path), required=False)
@click.option(
    "--out", type=click.Path(path_type=Path), help="Folder of the results; made if it is not there."
)
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    default=Path("data"),
    show_default=True,
    help="Root folder of the sequences that the grid names.",
)
@click.option("--dry-run", is_flag=True, help="Print the cells, and end.")
@click.option(
    "--status",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Say how far the results in DIR are, and end.",
)
@CACHE
@JOBS
@QUIET
@FORCE
@JSON
def sweep(
    grid_file: Path | None,
    out: Path | None,
    data: Path,
    dry_run: bool,
    status: Path | None,
    cache: Path | None,
    jobs: int | None,
    quiet: bool,
    force: bool,
    json_path: Path | None,
) -> None:
    """Track with every combination of a grid's settings, and keep one row per run.

    Runs of a cell (seeds) are one batch. What is finished stays: the same command again runs only what is not, several
    at once share the work. A cell that fails is kept with its error; the exit code is then 2.

    \b
    Examples:
      psotrack sweep grid.toml --dry-run
      psotrack sweep grid.toml --data data --out results
      psotrack sweep --status results
      psotrack table results --rows particles --columns iterations --value mean_error_m
    """
    if status is not None:
        _status(status, quiet, force, json_path)
        return
    if grid_file is None:
        raise SettingsError("sweep", expected="a GRID.toml, or --status DIR", found="neither")
    from psotrack.sweep import load

    grid = load(grid_file)
    if dry_run:
        _show(grid.cells(), quiet, force, json_path)
        return
    if out is None:
        raise SettingsError("--out", expected="the folder to write to", found="none")
    import jax

    # Before anything touches a device: runs of a batch are shared by as many as there are processors.
    if "XLA_FLAGS" not in os.environ:
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
    from psotrack.compiled import keep_compiled
    from psotrack.sweep.runner import run

    keep_compiled(compiled_folder(cache))
    outcome = run(grid, out, data=data, cache=cache_folder(cache), jobs=jobs, report=report_to(quiet))
    answer(json_path, vars(outcome), force)
    failed = f", {outcome.failed} failed (see {out}/cells/*.error.json)" if outcome.failed else ""
    say(quiet, json_path, f"{out}: {outcome.finished} cells finished now, {outcome.left} before{failed}")
    if outcome.failed:
        sys.exit(2)


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--rows", "rows_by", default="sequence", show_default=True, help="Names with commas between.")
@click.option(
    "--columns", "columns_by", default="method", show_default=True, help="Names with commas between."
)
@click.option("--value", default="mean_error_m", show_default=True, help="Which figure.")
@click.option("--scale", type=float, default=1.0, show_default=True, help="1000 makes mm of m.")
@click.option(
    "--format",
    "layout",
    type=click.Choice(["text", "markdown", "latex", "csv"]),
    default="text",
    show_default=True,
)
def table(folder: Path, rows_by: str, columns_by: str, value: str, scale: float, layout: str) -> None:
    """Show a figure of the results in DIR: mean +- standard deviation over runs.

    \b
    Examples:
      psotrack table results --rows sequence,particles --columns iterations --value mean_error_m --scale 1000
      psotrack table results --columns method --value missed_rate --format latex
    """
    from psotrack.sweep import pivot, render
    from psotrack.sweep.store import Store

    shown = pivot(
        Store(folder).rows(),
        rows_by=[name for name in rows_by.split(",") if name],
        columns_by=[name for name in columns_by.split(",") if name],
        value=value,
        scale=scale,
    )
    click.echo(render(shown, layout).rstrip("\n"))


def _show(cells: tuple[Cell, ...], quiet: bool, force: bool, json_path: Path | None) -> None:
    """The cells of a grid, and how much work they are."""
    from psotrack.sweep.grid import cameras_label

    listed = [
        {
            "sequence": cell.sequence,
            "method": cell.method,
            "cameras": cameras_label(cell.cameras),
            "runs": cell.runs,
            **cell.axes,
        }
        for cell in cells
    ]
    answer(json_path, listed, force)
    for number, cell in enumerate(listed):
        say(quiet, json_path, f"{number:4} " + " ".join(f"{name}={value}" for name, value in cell.items()))
    say(quiet, json_path, f"{len(cells)} cells, {sum(cell.runs for cell in cells)} runs")


def _status(folder: Path, quiet: bool, force: bool, json_path: Path | None) -> None:
    """How far the results in a folder are."""
    from psotrack.sweep.store import Store

    content = Store(folder).status()
    answer(json_path, content, force)
    for failure in content["errors"]:
        say(quiet, json_path, f"failed: {failure}")
    numbers = ", ".join(f"{content[name]} {name}" for name in ("finished", "failed", "claimed"))
    say(quiet, json_path, f"{folder}: {numbers}")
