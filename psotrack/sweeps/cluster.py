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
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psotrack.errors import InputError, PsotrackError, SettingsError, install_command
from psotrack.foreground.silhouettes import compute
from psotrack.support import Device, keep_compiled, processors, share_processors, use_device
from psotrack.sweeps.cells import Cell
from psotrack.sweeps.inputs import Inputs, source_of
from psotrack.sweeps.locks import POLL_S
from psotrack.sweeps.runner import Result, run_cell, store_failure
from psotrack.sweeps.store import Store

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
        SettingsError: `workers` is given for a cluster that is not local, or Dask is not installed.
    """

    address: str = "local"
    workers: int | None = None
    device: Device | None = None
    say: Callable[[str], object] = lambda address: None

    def __post_init__(self) -> None:
        if self.workers is not None and self.address != "local":
            raise SettingsError("--workers", expected="--cluster local", found=f"--cluster {self.address}")
        _distributed()


@dataclass(frozen=True)
class _Job:
    """Settings of a sweep that its workers need.

    Attributes:
        out, data, cache: folders of the results, the sequences, and the stored silhouettes and programs.
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
    cluster: Cluster, cells: list[Cell], inputs: Inputs, store: Store
) -> Generator[Result, None, None]:
    """Yield the result of each cell when it ends. Each cell waits for its silhouettes, one task per camera.

    Args:
        cluster: the cluster; without cells, it is not needed.
        cells: the cells to run.
        inputs: inputs of the cells; all workers must see its folders, and that of the results, under the same paths.
        store: the results.

    Raises:
        InputError: there is no cluster at the address, or it ends.
        OutputError: the results cannot be written.
    """
    if not cells:
        return
    dask = _distributed()
    workers = cluster.workers or (1 if cluster.device == "gpu" else processors())
    devices = max(1, processors() // workers) if cluster.address == "local" else None
    out, data, cache = (Path(os.path.abspath(each)) for each in (store.folder, inputs.data, inputs.cache))
    job = _Job(out, data, cache, cluster.device, devices, secrets.token_hex(8))
    with _client(dask, cluster, workers) as client:
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
                found = "a scheduler that has ended"
                raise InputError(
                    "--cluster", expected="a running scheduler", found=found, remedy=remedy
                ) from error


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
def _client(dask: Any, cluster: Cluster, workers: int) -> Iterator[Client]:
    address = cluster.address
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
            ) as local,
            dask.Client(local) as client,
        ):
            cluster.say(local.scheduler_address)
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
