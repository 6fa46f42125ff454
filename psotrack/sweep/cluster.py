"""The cells of a grid as tasks of a Dask cluster: on this machine, or on many that share a file system.

The folder of results stays the truth, as without a cluster: workers claim cells and write their rows. So workers may
die, cells run again, and other runners, with or without a cluster, work on the same folder.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psotrack.errors import InputError, PsotrackError, SettingsError
from psotrack.silhouettes import compute
from psotrack.support import Report, keep_compiled, no_progress
from psotrack.sweep.cells import Cell
from psotrack.sweep.grid_files import Grid
from psotrack.sweep.inputs import Inputs, source_of
from psotrack.sweep.locks import POLL_S
from psotrack.sweep.machine import Device, processors, provenance, share_processors, use_device
from psotrack.sweep.runner import (
    Result,
    SweepOutcome,
    failed,
    finished_before,
    in_order,
    opened,
    outcome_of,
    run_cell,
)
from psotrack.sweep.store import Store

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True)
class _Job:
    """What the workers know of the sweep.

    Attributes:
        out, data, cache, device: as in `run_on_cluster`.
        devices: as which a worker's processors share its batches; None is as many as it may use.
        token: another for each sweep, so that none sees files as they were.
    """

    out: Path
    data: Path
    cache: Path
    device: Device | None
    devices: int | None
    token: str


def run_on_cluster(
    grid: Grid,
    out: Path,
    *,
    data: Path,
    cache: Path,
    address: str = "local",
    workers: int | None = None,
    device: Device | None = None,
    report: Report = no_progress,
) -> SweepOutcome:
    """Run what is not finished, as tasks of a cluster; as `runner.run` otherwise.

    Args:
        grid: what is to be run.
        out: folder of the results, which all workers see under this name, as the next two.
        data: root folder of sequences that the grid names.
        cache: folder of the stored silhouettes and of compiled programs.
        address: of the cluster's scheduler; "local" starts one here, for as long as this takes.
        workers: processes of the local cluster; None is one per processor, or one if `device` is "gpu".
        device: what the workers compute on; None leaves that to JAX.
        report: told of the cells.

    Raises:
        InputError: a sequence is not there, or no cluster at the address.
        OutputError: the results cannot be written.
        SettingsError: Dask is not installed, or `workers` is given for a cluster that is not local.
    """
    if workers is not None and address != "local":
        raise SettingsError("--workers", expected="--cluster local with it", found=f"--cluster {address}")
    dask = _distributed()
    out, data, cache = (Path(os.path.abspath(folder)) for folder in (out, data, cache))
    # Where rows were made they say themselves.
    origin = {name: value for name, value in provenance().items() if name != "device"} | {"cluster": True}
    store, inputs = opened(grid, out, data, origin), Inputs(data, cache)
    results, cells = [], []
    for cell in in_order(grid.cells()):
        result = _known(cell, inputs, store)
        if result is None:
            cells.append(cell)
        else:
            results.append(result)
    local = workers or (1 if device == "gpu" else processors())
    devices = max(1, processors() // local) if address == "local" else None
    job = _Job(out, data, cache, device, devices, secrets.token_hex(8))
    with report("sweep", len(cells) + len(results)) as advance:
        advance(len(results))
        if cells:
            with _client(dask, address, local) as client:
                for result in _done(dask, client, cells, job, inputs, store):
                    results.append(result)
                    advance(1)
    return outcome_of(grid, results)


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        remedy = "install it with `pip install 'psotrack[dask]'`"
        raise SettingsError(
            "--cluster", expected="Dask", found="no package distributed", remedy=remedy
        ) from error
    # Its comings and goings of every worker are not news.
    logging.getLogger("distributed").setLevel(logging.WARNING)
    return distributed


@contextlib.contextmanager
def _client(dask: Any, address: str, workers: int) -> Iterator[Client]:
    if address == "local":
        with (
            dask.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,  # JAX has threads of its own
                processes=True,
                memory_limit=0,  # the system's
                dashboard_address="127.0.0.1:0",  # any port: another sweep may have the usual one
            ) as cluster,
            dask.Client(cluster) as client,
        ):
            yield client
        return
    try:
        client = dask.Client(address)
    except (OSError, ValueError) as error:
        why = f"{error}".partition("\n")[0]
        raise InputError("--cluster", expected=f"a Dask scheduler at {address}", found=why) from error
    with client:
        yield client


def _known(cell: Cell, inputs: Inputs, store: Store) -> Result | None:
    """The result of a cell that needs no worker."""
    try:
        return finished_before(cell, inputs, store)
    except PsotrackError as error:
        return failed(cell, None, error, store)


def _done(
    dask: Any, client: Client, cells: list[Cell], job: _Job, inputs: Inputs, store: Store
) -> Iterator[Result]:
    """What became of the cells, as they are done. Each waits for its silhouettes, which are tasks by camera."""
    silhouettes: dict[Any, list[Any]] = {}
    for cell in cells:
        if source_of(cell) not in silhouettes:
            cameras = inputs.sequence_of(cell).rig.names if cell.settings.needs_silhouettes else ()
            silhouettes[source_of(cell)] = client.map(_make, cameras, cell=cell, job=job, pure=False)
    futures = {
        client.submit(_run, cell, job, silhouettes[source_of(cell)], pure=False): cell for cell in cells
    }
    for future in dask.as_completed(futures):
        try:
            yield future.result()
        except dask.KilledWorker as error:
            yield failed(futures[future], None, error, store)
        except CancelledError as error:
            remedy = "what is finished is kept, and the same command goes on"
            raise InputError(
                "--cluster", expected="its scheduler to stay", found="it gone", remedy=remedy
            ) from error


def _make(camera: str, cell: Cell, job: _Job) -> None:
    """A task: store the silhouettes of one camera. What goes wrong is said by the cells that need them."""
    with contextlib.suppress(PsotrackError):
        sequence = _inputs(job).sequence_of(cell).usable([camera])
        compute(sequence, cell.settings.silhouettes, cache=job.cache, jobs=1)


def _run(cell: Cell, job: _Job, after: list[None]) -> Result:
    """A task: one cell, after its silhouettes."""
    share_processors(job.devices)
    if job.device is not None:
        use_device(job.device)
    keep_compiled(job.cache / "compiled")
    while (result := run_cell(cell, _inputs(job), Store(job.out))).state == "busy":
        time.sleep(POLL_S)
    return result


@lru_cache(maxsize=1)
def _inputs(job: _Job) -> Inputs:
    """A worker's; its processes may have no children, so it makes silhouettes by itself."""
    return Inputs(job.data, job.cache, jobs=1)
