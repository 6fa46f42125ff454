"""`psotrack sweep`: run grids of settings, and store the results."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import click
from msgspec import Meta

from psotrack.cli.options import (
    CACHE,
    FORCE,
    JOBS,
    JSON,
    cache_folder,
    compiled_folder,
    out_option,
    reporting,
)
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import HelpfulCommand, options_of
from psotrack.errors import SettingsError


@dataclass(frozen=True)
class Where:
    """Where the cells run.

    Attributes:
        cluster: run the cells on a Dask cluster: local starts a cluster on this machine; ADDRESS names a running
            scheduler.
        workers: number of processes of --cluster local; None: one per processor; one with --device gpu.
        device: device that computes; None: JAX's choice.
    """

    cluster: Annotated[str, Meta(extra={"metavar": "local|ADDRESS"})] | None = None
    workers: Annotated[int, Meta(ge=1)] | None = None
    device: Literal["cpu", "gpu"] | None = None


@click.command(cls=HelpfulCommand)
@click.argument("grid_file", metavar="GRID.toml", type=click.Path(path_type=Path), required=False)
@out_option(
    "Folder of the results; it is made if it does not exist.  [default: beside GRID.toml, named GRID_results]"
)
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    default=Path("data"),
    show_default=True,
    help="Root folder of the sequences that the grid names.",
)
@click.option(
    "--dry-run", is_flag=True, help="Print the cells and the number of runs without running a cell."
)
@click.option(
    "--status",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Print the numbers of finished, failed and locked cells in DIR and the processes at work; run nothing.",
)
@options_of(Where, "where")
@CACHE
@JOBS
@reporting
@FORCE
@JSON
@pass_output
def sweep(
    output: Output,
    grid_file: Path | None,
    out: Path | None,
    data: Path,
    dry_run: bool,
    status: Path | None,
    where: Where,
    **running: Any,
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
      psotrack report results --table --rows particles --columns iterations --value mean_error_m
    """
    if status is not None:
        _status(output, status)
        return
    if grid_file is None:
        raise SettingsError("sweep", expected="GRID.toml or --status DIR", found="neither")
    if where.workers is not None and where.cluster is None:
        raise SettingsError("--workers", expected="--cluster local", found="no --cluster")
    from psotrack.support import keep_compiled, share_processors, use_device
    from psotrack.sweeps import Cluster, Inputs, Store, plan, read_grid
    from psotrack.sweeps import sweep as run

    def say(address: str) -> None:
        if not output.quiet:
            click.echo(f"the cluster listens at {address}, for programs on this computer only", err=True)

    cluster, cache = None, cache_folder(running["cache"])
    if where.cluster is not None:
        cluster = Cluster(where.cluster, where.workers, where.device, say)
    grid = read_grid(grid_file)
    out = out or grid_file.with_name(f"{grid_file.stem}_results")
    if dry_run:
        inputs = Inputs(data, cache, running["jobs"])
        output.result(plan(grid, inputs, Store(out)))
        return
    if cluster is not None:
        use_device("cpu")  # This process computes nothing, and must not take a GPU from the workers.
    else:
        share_processors()
        if where.device is not None:
            use_device(where.device)
        keep_compiled(compiled_folder(cache))
    outcome = run(
        grid, out, data=data, cache=cache, jobs=running["jobs"], cluster=cluster, progress=output.report
    )
    output.result(outcome)
    if outcome.count("failed"):
        sys.exit(2)


def _status(output: Output, folder: Path) -> None:
    """Print the numbers of finished, failed and locked cells in a folder, and the processes at work."""
    from psotrack.sweeps import Store

    content = Store(folder).status()
    output.json(content)
    for failure in content["errors"]:
        output.say(f"failed: {failure}")
    for worker in content["at_work"]:
        output.say(f"at work: {worker}")
    words = {"finished": "finished", "failed": "failed", "claimed": "locked"}
    numbers = ", ".join(f"{content[key]} {word}" for key, word in words.items())
    output.say(f"{folder}: {numbers}")
