"""`psotrack sweep` and `psotrack table`: run grids of settings, store the results, and show tables of the results."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from psotrack.cli.options import (
    CACHE,
    FORCE,
    JOBS,
    JSON,
    cache_folder,
    compiled_folder,
    reporting,
)
from psotrack.cli.output import output_json, print_line, report_to
from psotrack.errors import SettingsError, errors_name
from psotrack.support import Device, Report, refuse_to_overwrite

if TYPE_CHECKING:
    from psotrack.sweep import Cluster, Grid, Inputs, Store, SweepOutcome


@click.command()
@click.argument("grid_file", metavar="GRID.toml", type=click.Path(path_type=Path), required=False)
@click.option(
    "--out", type=click.Path(path_type=Path), help="Folder of the results; it is made if it does not exist."
)
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    default=Path("data"),
    show_default=True,
    help="Root folder of the sequences that the grid names.",
)
@click.option(
    "--dry-run", is_flag=True, help="Print the cells and an estimate of the time without running a cell."
)
@click.option(
    "--status",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Print the numbers of finished, failed and locked cells in DIR and the processes at work; run nothing.",
)
@click.option(
    "--cluster",
    metavar="local|ADDRESS",
    help="Run the cells on a Dask cluster: local starts a cluster on this machine; ADDRESS names a running scheduler.",
)
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Number of processes of --cluster local.  [default: one per processor; one with --device gpu]",
)
@click.option(
    "--device", type=click.Choice(["cpu", "gpu"]), help="Device that computes.  [default: JAX's choice]"
)
@CACHE
@JOBS
@reporting
@FORCE
@JSON
def sweep(
    grid_file: Path | None,
    out: Path | None,
    data: Path,
    dry_run: bool,
    status: Path | None,
    cluster: str | None,
    workers: int | None,
    device: Device | None,
    cache: Path | None,
    jobs: int | None,
    quiet: bool,
    force: bool,
    json_path: Path | None,
) -> None:
    """Track with every combination of a grid's settings, and keep one row per run.

    A cell is one combination of settings; its runs, which differ in their seeds, are tracked as one batch. The same
    command continues an interrupted sweep: finished cells are not run again. Several commands at the same time share
    the work. If a cell fails, its error is stored, the other cells run, and the exit code is 2.

    \b
    Examples:
      psotrack sweep grid.toml --dry-run
      psotrack sweep grid.toml --data data --out results
      psotrack sweep grid.toml --data data --out results --cluster tls://10.0.0.5:8786
      psotrack sweep --status results
      psotrack table results --rows particles --columns iterations --value mean_error_m
    """
    if status is not None:
        _status(status, quiet, force, json_path)
        return
    if grid_file is None:
        raise SettingsError("sweep", expected="GRID.toml or --status DIR", found="neither")
    if workers is not None and cluster is None:
        raise SettingsError("--workers", expected="--cluster local", found="no --cluster")
    from psotrack.sweep import Cluster, read_grid

    where_to_run = None if cluster is None else Cluster(cluster, workers, device)
    grid = read_grid(grid_file)
    if dry_run:
        from psotrack.sweep import Inputs, Store

        inputs = Inputs(data, cache_folder(cache), jobs)
        _show(grid, inputs, Store(out) if out else None, quiet, force, json_path)
        return
    if out is None:
        raise SettingsError("--out", expected="the folder to write to", found="none")
    if json_path not in (None, Path("-")):
        # The error must come before the sweep, which may take hours.
        refuse_to_overwrite(json_path, force)
    if where_to_run is None:
        outcome = _run_here(grid, out, data, cache, jobs, device, report_to(quiet))
    else:
        outcome = _run_on_cluster(grid, out, data, cache, where_to_run, quiet)
    output_json(json_path, outcome.to_dict(), force)
    print_line(quiet, json_path, f"{outcome}")
    if outcome.count("failed"):
        sys.exit(2)


def _run_here(
    grid: Grid,
    out: Path,
    data: Path,
    cache: Path | None,
    jobs: int | None,
    device: Device | None,
    report: Report,
) -> SweepOutcome:
    """Run the cells in this process."""
    from psotrack.support import keep_compiled, share_processors, use_device
    from psotrack.sweep import run_in_process

    share_processors()
    if device is not None:
        use_device(device)
    keep_compiled(compiled_folder(cache))
    return run_in_process(grid, out, data=data, cache=cache_folder(cache), jobs=jobs, report=report)


def _run_on_cluster(
    grid: Grid, out: Path, data: Path, cache: Path | None, cluster: Cluster, quiet: bool
) -> SweepOutcome:
    """Run the cells as tasks of a cluster's workers."""
    from psotrack.support import use_device
    from psotrack.sweep import run_on_cluster

    use_device("cpu")  # This process computes nothing, and must not take a GPU from the workers.

    def say(address: str) -> None:
        if not quiet:
            click.echo(f"the cluster listens at {address}, for programs on this computer only", err=True)

    return run_on_cluster(
        grid, out, data=data, cache=cache_folder(cache), cluster=cluster, report=report_to(quiet), say=say
    )


@click.command()
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "--rows",
    "rows_by",
    default="sequence",
    show_default=True,
    help="Columns of the results, with commas between them, that label the rows.",
)
@click.option(
    "--columns",
    "columns_by",
    help="Columns of the results that label the table's columns.  [default: method; sequence if --rows names method]",
)
@click.option(
    "--value", default="mean_error_m", show_default=True, help="Column of the numbers in the table."
)
@click.option(
    "--scale", type=float, default=1.0, show_default=True, help="Factor of the numbers; 1000 turns m into mm."
)
@click.option(
    "--format",
    "layout",
    type=click.Choice(["text", "markdown", "latex", "csv"]),
    default="text",
    show_default=True,
    help="Format of the table.",
)
def table(folder: Path, rows_by: str, columns_by: str | None, value: str, scale: float, layout: str) -> None:
    """Show a table of the results in DIR: mean +- standard deviation over runs.

    The end of a column's name is enough if no other column ends with it: particles is settings.swarm.particles.

    \b
    Examples:
      psotrack table results --rows sequence,particles --columns iterations --value mean_error_m --scale 1000
      psotrack table results --columns method --value missed_rate --format latex
    """
    from psotrack.sweep import Store, pivot, render_table

    rows = [name for name in rows_by.split(",") if name]
    if columns_by is None:
        columns_by = next((name for name in ("method", "sequence") if name not in rows), "")
    with errors_name(folder):
        shown = pivot(
            Store(folder).rows(),
            rows_by=rows,
            columns_by=[name for name in columns_by.split(",") if name],
            value=value,
            scale=scale,
        )
    click.echo(render_table(shown, layout).rstrip("\n"))


def _show(
    grid: Grid, inputs: Inputs, store: Store | None, quiet: bool, force: bool, json_path: Path | None
) -> None:
    """Print the cells of a grid, and an estimate of the time that they take."""
    from psotrack.sweep import cameras_label, estimate

    cells = grid.cells()
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
    expected = estimate(cells, inputs, store)
    output_json(json_path, {"cells": listed, "estimate": expected.to_dict()}, force)
    for number, cell in enumerate(listed):
        print_line(
            quiet, json_path, f"{number:4} " + " ".join(f"{name}={value}" for name, value in cell.items())
        )
    for fault in expected.faults:
        print_line(quiet, json_path, f"cannot be read: {fault}")
    print_line(quiet, json_path, f"{expected}")


def _status(folder: Path, quiet: bool, force: bool, json_path: Path | None) -> None:
    """Print the numbers of finished, failed and locked cells in a folder, and the processes at work."""
    from psotrack.sweep import Store

    content = Store(folder).status()
    output_json(json_path, content, force)
    for failure in content["errors"]:
        print_line(quiet, json_path, f"failed: {failure}")
    for worker in content["at_work"]:
        print_line(quiet, json_path, f"at work: {worker}")
    words = {"finished": "finished", "failed": "failed", "claimed": "locked"}
    numbers = ", ".join(f"{content[key]} {word}" for key, word in words.items())
    print_line(quiet, json_path, f"{folder}: {numbers}")
