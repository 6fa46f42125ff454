"""`psotrack sweep` and `cache`: grids of settings, and what is stored for the next run."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click
from msgspec import Meta

from psotrack.cli.commands import command
from psotrack.cli.options import Cache, Jobs, cache_folder, compiled_folder
from psotrack.cli.output import Output
from psotrack.cli.types import says
from psotrack.errors import SettingsError

if TYPE_CHECKING:
    from psotrack.foreground.silhouettes import CacheEntry


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


@command(without=["progress"])
def cache(
    output: Output,
    *,
    older_than: Annotated[Annotated[float, Meta(ge=0)] | None, says(metavar="DAYS")] = None,
    max_gb: Annotated[Annotated[float, Meta(ge=0)] | None, says(metavar="GB")] = None,
    empty: bool = False,
    cache: Cache = None,
) -> None:
    """List, prune and empty the cache of silhouettes and compiled programs.

    The next run makes anew what is missing or damaged. A running command has read its silhouettes and is not disturbed.
    What psotrack did not put into the folder is left alone.

    \b
    Examples:
      psotrack cache
      psotrack cache --older-than 30 --max-gb 20
      psotrack cache --empty

    Options:
        older_than: remove entries that were not used for DAYS days.
        max_gb: then remove entries until the rest has at most GB gigabytes, those first that were used longest ago.
        empty: remove all entries.
    """
    from psotrack.foreground.silhouettes import choose_to_prune, list_entries, remove_entry

    folder, now_s = cache_folder(cache), time.time()
    entries = list_entries(folder)
    content: dict[str, Any] = {"cache": str(folder), "entries": [_described(each, now_s) for each in entries]}
    if older_than is None and max_gb is None and not empty:
        output.json(content)
        rows = (
            (each.path.name, each.video, f"{each.size_bytes / 1e6:.1f}", f"{_days(each, now_s):.1f}")
            for each in entries
            if each.kind == "silhouettes"
        )
        output.table(("silhouettes", "video", "MB", "days unused"), rows)
        output.say(f"{folder}: {_counted(entries)}")
        return
    max_bytes = None if max_gb is None else 1e9 * max_gb
    chosen = entries if empty else choose_to_prune(entries, now_s, older_than, max_bytes)
    for each in chosen:
        remove_entry(each)
    output.json({**content, "removed": [str(each.path) for each in chosen]})
    output.say(f"{folder}: removed: {_counted(chosen)}")


def _counted(entries: list[CacheEntry]) -> str:
    kinds = [each.kind for each in entries]
    size_mb = sum(each.size_bytes for each in entries) / 1e6
    return f"silhouettes of {kinds.count('silhouettes')} videos, {kinds.count('program')} programs, {size_mb:.1f} MB"


def _days(entry: CacheEntry, now_s: float) -> float:
    return max(0.0, now_s - entry.used_s) / (24 * 3600)


def _described(entry: CacheEntry, now_s: float) -> dict[str, Any]:
    return {
        "path": str(entry.path),
        "kind": entry.kind,
        "video": entry.video,
        "size_bytes": entry.size_bytes,
        "days_unused": round(_days(entry, now_s), 3),
    }
