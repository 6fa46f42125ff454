"""Run the cells of a grid as tasks of a Dask cluster: on this machine, or on several machines that share a file system.

As without a cluster, workers lock cells in the folder of results and write the cells' rows there. So workers may be
killed, cells may run again, and other runners may work on the same folder.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import secrets
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psotrack.errors import InputError, PsotrackError, SettingsError, install_command
from psotrack.foreground.silhouettes import compute
from psotrack.support import (
    Device,
    Report,
    keep_compiled,
    no_progress,
    processors,
    share_processors,
    use_device,
)
from psotrack.sweep.cells import Cell
from psotrack.sweep.grid_files import Grid
from psotrack.sweep.inputs import Inputs, source_of
from psotrack.sweep.locks import POLL_S
from psotrack.sweep.machine import provenance
from psotrack.sweep.runner import (
    Result,
    SweepOutcome,
    open_store,
    outcome,
    run_cell,
    sort_out,
    store_failure,
)
from psotrack.sweep.store import Store

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)

#: Addresses at which data are encrypted, or stay on this machine.
_SAFE = re.compile(r"(tls|wss|inproc)://.*|(\w+://)?(localhost|127\.[\d.]+|\[::1\])(:\d+)?")


@dataclass(frozen=True)
class Cluster:
    """A Dask cluster for a sweep.

    Attributes:
        address: address of the cluster's scheduler; "local" starts a cluster on this machine for each call.
        workers: number of processes of the local cluster; None is one per processor, or one if `device` is "gpu".
        device: device on which the workers compute; None leaves the choice to JAX.
        say: receives the address at which the scheduler of a local cluster listens.

    Raises:
        SettingsError: `workers` is given for a cluster that is not local.
    """

    address: str = "local"
    workers: int | None = None
    device: Device | None = None
    say: Callable[[str], object] = lambda address: None

    def __post_init__(self) -> None:
        if self.workers is not None and self.address != "local":
            raise SettingsError("--workers", expected="--cluster local", found=f"--cluster {self.address}")


@dataclass(frozen=True)
class _Job:
    """Settings of a sweep that its workers need.

    Attributes:
        out, data, cache: folders, as in `run_on_cluster`.
        device: device on which the workers compute; None leaves the choice to JAX.
        devices: number of JAX devices that share a worker's batches; None is one per processor.
        token: text that differs from sweep to sweep, so that a worker reads files again for each sweep.
    """

    out: Path
    data: Path
    cache: Path
    device: Device | None
    devices: int | None
    token: str


def run_on_cluster(
    grid: Grid,
    out: Path | str,
    *,
    data: Path | str,
    cache: Path | str,
    cluster: Cluster = Cluster(),
    report: Report = no_progress,
) -> SweepOutcome:
    """Run the unfinished cells of a grid as tasks of a cluster; see `runner.run_in_process` for runs without a cluster.

    Args:
        grid: the cells to run.
        out: folder of the results. All workers must see `out`, `data` and `cache` under the same paths.
        data: root folder of the sequences that the grid names.
        cache: folder of the stored silhouettes and of compiled programs.
        cluster: the cluster.
        report: progress bar for the cells that are not finished.

    Raises:
        InputError: a sequence does not exist, or there is no cluster at the address.
        OutputError: the results cannot be written.
        SettingsError: Dask is not installed.
    """
    dask = _distributed()
    out, data, cache = (Path(os.path.abspath(folder)) for folder in (out, data, cache))
    # Each row names the device on which it was made, which may differ from this one.
    origin = {name: value for name, value in provenance().items() if name != "device"} | {"cluster": True}
    store, inputs = open_store(grid, out, data, origin), Inputs(data, cache)
    results, cells = sort_out(grid, inputs, store)
    workers = cluster.workers or (1 if cluster.device == "gpu" else processors())
    devices = max(1, processors() // workers) if cluster.address == "local" else None
    job = _Job(out, data, cache, cluster.device, devices, secrets.token_hex(8))
    with report("sweep", len(cells)) as advance, contextlib.ExitStack() as stack:
        if cells:
            client = stack.enter_context(_client(dask, cluster, workers))
            for result in _results(dask, client, cells, job, inputs, store):
                results.append(result)
                advance(1)
    return outcome(grid, results, store)


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise SettingsError(
            "--cluster", expected="Dask", found="no package distributed", remedy=install_command("dask")
        ) from error
    # At the level INFO, Dask reports every worker that starts and ends.
    logging.getLogger("distributed").setLevel(logging.WARNING)
    # What happens to a worker is in the results of its cells; that it ends slowly is none of the user's business.
    logging.getLogger("distributed.nanny").setLevel(logging.ERROR)
    return distributed


@contextlib.contextmanager
def _client(dask: Any, where: Cluster, workers: int) -> Iterator[Client]:
    address = where.address
    if address == "local":
        with (
            dask.LocalCluster(
                host="127.0.0.1",  # Nobody on the network may send code to the scheduler and the workers.
                n_workers=workers,
                threads_per_worker=1,  # JAX starts threads itself.
                processes=True,
                memory_limit=0,  # Dask sets no limit besides the system's.
                dashboard_address="127.0.0.1:0",  # Any free port: another sweep may use the default port.
                # What happens to a cell is in its result. When Ctrl-C ends the cluster, workers would report their
                # cancelled tasks on the terminal of the sweep.
                silence_logs=logging.CRITICAL,
            ) as cluster,
            dask.Client(cluster) as client,
        ):
            where.say(cluster.scheduler_address)
            yield client
        return
    if not _SAFE.fullmatch(address):
        # Dask runs pickled code of whoever reaches the connection.
        logger.warning(
            "--cluster %s: neither TLS nor this machine; whoever reaches this network can run code in the workers: "
            "use tls://",
            address,
        )
    try:
        client = dask.Client(address)
    except (OSError, ValueError, TypeError) as error:  # TypeError: tls:// without certificates
        why = f"{error}".partition("\n")[0]
        raise InputError("--cluster", expected=f"a Dask scheduler at {address}", found=why) from error
    with client:
        yield client


def _results(
    dask: Any, client: Client, cells: list[Cell], job: _Job, inputs: Inputs, store: Store
) -> Iterator[Result]:
    """Yield the result of each cell when it ends. Each cell waits for its silhouettes, one task per camera."""
    silhouettes: dict[Any, list[Any]] = {}
    futures = {}
    for cell in cells:
        source = source_of(cell)
        if source not in silhouettes:
            cameras = inputs.recording_of(cell).rig.names if cell.settings.needs_silhouettes else ()
            silhouettes[source] = client.map(_make_silhouettes, cameras, cell=cell, job=job, pure=False)
        futures[client.submit(_run, cell, job, silhouettes[source], pure=False)] = cell
    for future in dask.as_completed(futures):
        try:
            yield future.result()
        except dask.KilledWorker as error:
            yield store_failure(futures[future], None, error, store)
        except CancelledError as error:
            remedy = "finished cells are kept, and the same command continues the sweep"
            raise InputError(
                "--cluster", expected="a running scheduler", found="a scheduler that has ended", remedy=remedy
            ) from error


def _make_silhouettes(camera: str, cell: Cell, job: _Job) -> None:
    """A task: store the silhouettes of one camera."""
    # The cells that need the silhouettes report the error.
    with contextlib.suppress(PsotrackError):
        recording = _inputs(job).recording_of(cell).usable([camera], silhouettes=True)
        compute(recording, cell.settings.silhouettes, cache=job.cache, jobs=1)


def _run(cell: Cell, job: _Job, after: list[None]) -> Result:
    """A task: one cell, after its silhouettes."""
    share_processors(job.devices)
    if job.device is not None:
        use_device(job.device)
    keep_compiled(job.cache / "compiled")
    store = Store(job.out)
    while (result := run_cell(cell, _inputs(job), store)).state == "busy":
        time.sleep(POLL_S)
    return result


@lru_cache(maxsize=1)
def _inputs(job: _Job) -> Inputs:
    """Inputs of a worker. Dask's workers may not start processes, so a worker makes silhouettes in its own process."""
    return Inputs(job.data, job.cache, jobs=1)
