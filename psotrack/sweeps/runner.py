"""Run cells of a grid, the missing runs of each as one batch whose rows are stored, here or as tasks of a Dask cluster.

A cluster is on this machine, or on several machines that share a file system. As without a cluster, workers lock cells
in the folder of results and write the cells' rows there. So workers may be killed, cells may run again, and other
runners may work on the same folder.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import secrets
import time
import traceback
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import CancelledError
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec
import numpy as np
import pandas as pd

from psotrack.errors import InputError, OutputError, PsotrackError, SettingsError, install_command
from psotrack.evaluation import Evaluation, evaluate
from psotrack.foreground.silhouettes import compute
from psotrack.pipeline import TrackedRecording, track_runs, with_real_time
from psotrack.settings import flatten
from psotrack.support import (
    POLL_S,
    Device,
    drop_programs_if_many,
    keep_compiled,
    processors,
    share_processors,
    use_device,
)
from psotrack.sweeps.cells import Cell, cell_key, cell_name, describe, input_digest, title
from psotrack.sweeps.inputs import Input, Inputs, provenance, source_of
from psotrack.sweeps.store import Store

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Result:
    """Result of an attempt to run a cell.

    Attributes:
        cell: the cell.
        state: "finished" or "failed" in this attempt, "left" as an earlier run had finished the cell, or "busy" because
            another process works on the cell.
        key: key of the cell's rows; None where the input cannot be read.
        error: why the cell failed; "" if it did not fail.
    """

    cell: Cell
    state: Literal["finished", "failed", "left", "busy"]
    key: str | None
    error: str = ""


def finished_before(cell: Cell, key: str, store: Store) -> Result | None:
    """Result of a cell that is finished already; None if runs are missing."""
    if not set(cell.seeds) <= store.finished_seeds(key):
        return None
    # The runner that finished the cell may have been killed before it removed the record of an earlier failure.
    store.remove_failure(cell_name(cell))
    store.use(key)
    return Result(cell, "left", key)


def run_cell(cell: Cell, inputs: Inputs, store: Store) -> Result:
    """Run a cell's missing runs, unless another process works on the cell; an error is stored as the cell's failure.

    Raises:
        OutputError: the results cannot be written.
    """
    key = None
    try:
        keys = inputs.keys_of(cell)
        key = cell_key(cell, keys)
        with store.lock(key) as locked:
            # Another process may have finished the cell meanwhile.
            result = finished_before(cell, key, store)
            if result is not None:
                return result
            given = inputs.read(cell) if locked else None
            if given is None:
                return Result(cell, "busy", key)
            missing = sorted(set(cell.seeds) - store.finished_seeds(key))
            origin = {"cell": key, "input": input_digest(keys)} | dict(flatten(provenance()))
            store.add(key, _run_seeds(cell, missing, given, origin))
            store.remove_failure(cell_name(cell))
        return Result(cell, "finished", key)
    except OutputError:
        raise
    except Exception as error:
        return store_failure(cell, key, error, store)


def store_failure(cell: Cell, key: str | None, error: Exception, store: Store) -> Result:
    """Store why a cell failed; an error that psotrack does not expect is stored with its traceback."""
    expected = isinstance(error, PsotrackError)
    sentence = f"{error}" if expected else f"{type(error).__name__}: {error}"
    where = {} if expected else {"where": "".join(traceback.format_exception(error))}
    store.add_failure(cell_name(cell), sentence, describe(cell) | where)
    logger.error("%s: %s", title(cell), sentence)
    return Result(cell, "failed", key, sentence)


def _run_seeds(cell: Cell, seeds: list[int], given: Input, origin: Mapping[str, Any]) -> pd.DataFrame:
    """Track and evaluate with each seed: one row per run."""
    # Cells with other shapes need other programs.
    drop_programs_if_many()
    settings = [msgspec.structs.replace(cell.settings, seed=seed) for seed in seeds]
    began = time.perf_counter()
    results = track_runs(given.recording, given.silhouettes, settings)
    total_s = time.perf_counter() - began
    reference = given.reference(cell.settings.rate_hz)
    of_cell = describe(cell) | {"frames": given.recording.num_frames, "num_cameras": len(given.recording.rig)}
    of_batch = {"runs_in_batch": len(seeds), "seconds.batch": total_s}
    rows = []
    for seed, result in zip(seeds, results, strict=True):
        of_run: dict[str, Any] = dict.fromkeys(_METRICS, np.nan) | {"missed_rate": 1.0}
        # A run that finds no drones has missed all drones. All runs have the same columns, so that programs can read
        # all cells as one data set.
        if isinstance(result, InputError):
            of_run["note"] = str(result)
        else:
            evaluation = evaluate(result.trajectories, reference).to_dict()
            of_run |= {name: evaluation[name] for name in _METRICS if evaluation[name] is not None}
            of_run |= {"note": ""} | _times(result, total_s / len(seeds))
        rows.append(of_cell | {"seed": seed} | of_batch | of_run | dict(origin))
    return pd.DataFrame(rows)


#: Figures of the evaluation that are columns of the rows.
_METRICS = [each.name for each in fields(Evaluation) if each.name not in ("frames", "per_drone")]


def _times(result: TrackedRecording, wall_s: float) -> dict[str, float]:
    """How long a run took.

    Args:
        result: result of the run.
        wall_s: the run's part of the seconds of wall clock of all runs.
    """
    seconds = result.record["seconds"]
    # A sweep reads stored silhouettes and starts once for all cells, so neither is in the seconds of a run.
    timed = with_real_time(result.record, wall_s)
    return {
        **{f"seconds.{stage}": value for stage, value in seconds.items()},
        **{name: timed[name] for name in ("real_time_factor", "real_time_factor_running")},
        "track_ms_per_frame": 1e3 * seconds["track"] / result.trajectories.num_frames,
    }


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
