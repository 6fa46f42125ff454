"""`psotrack sweep`: run grids of settings, and store the results."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import click
from msgspec import Meta

from psotrack.cli.commands import command
from psotrack.cli.options import Cache, Jobs, cache_folder, compiled_folder
from psotrack.cli.output import Output
from psotrack.cli.types import says
from psotrack.errors import SettingsError


@command()
def sweep(
    output: Output,
    grid_file: Annotated[Path | None, says(metavar="[GRID.toml]")] = None,
    *,
    out: Path | None = None,
    data: Path = Path("data"),
    dry_run: bool = False,
    status: Annotated[Path | None, says(metavar="DIR")] = None,
    cluster: Annotated[str | None, says(metavar="local|ADDRESS")] = None,
    workers: Annotated[int, Meta(ge=1)] | None = None,
    device: Literal["cpu", "gpu"] | None = None,
    cache: Cache = None,
    jobs: Jobs = None,
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

    Options:
        out: folder of the results; it is made if it does not exist. None: beside GRID.toml, named GRID_results.
        data: root folder of the sequences that the grid names.
        dry_run: print the cells and the number of runs without running a cell.
        status: print the numbers of finished, failed and locked cells in DIR and the processes at work; run nothing.
        cluster: run the cells on a Dask cluster: local starts a cluster on this machine; ADDRESS names a running
            scheduler.
        workers: number of processes of --cluster local. None: one per processor; one with --device gpu.
        device: device that computes. None: JAX's choice.
    """
    if status is not None:
        _status(output, status)
        return
    if grid_file is None:
        raise SettingsError("sweep", expected="GRID.toml or --status DIR", found="neither")
    if workers is not None and cluster is None:
        raise SettingsError("--workers", expected="--cluster local", found="no --cluster")
    from psotrack import sweeps
    from psotrack.support import keep_compiled, share_processors, use_device

    def say(address: str) -> None:
        if not output.quiet:
            click.echo(f"the cluster listens at {address}, for programs on this computer only", err=True)

    cache = cache_folder(cache)
    grid = sweeps.read_grid(grid_file)
    out = out or grid_file.with_name(f"{grid_file.stem}_results")
    if dry_run:
        inputs = sweeps.Inputs(data, cache, jobs)
        output.result(sweeps.plan(grid, inputs, sweeps.Store(out)))
        return
    if cluster is not None:
        use_device("cpu")  # This process computes nothing, and must not take a GPU from the workers.
    else:
        share_processors()
        if device is not None:
            use_device(device)
        keep_compiled(compiled_folder(cache))
    at = None if cluster is None else sweeps.Cluster(cluster, workers, device, say)
    outcome = sweeps.sweep(grid, out, data=data, cache=cache, jobs=jobs, cluster=at, progress=output.report)
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
