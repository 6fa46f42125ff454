"""Many runs of a sequence at once: the seconds of the swarm alone, and of all that is not the swarm.

    make bench-batch                                            # 64 runs beside one run, on the processors
    make bench-gpu                                              # a GPU against two cores; Table 5's grid; equal tracks
    python experiments/benchmarks/many_runs.py batch --runs 10 --repeats 3
    python experiments/benchmarks/many_runs.py gpu --only S02_D4_A --repeats 1
    python experiments/benchmarks/many_runs.py gpu --device cpu --small     # the same code without a GPU, in small

Prints device, versions, shapes and medians, each beside what is to be reached. Sequences are simulated unless they
exist. Silhouettes and compilation are left out of all seconds. Each block of frames is computed twice, with the
swarm's iterations and without: the difference is the swarm's, and what the second time costs is left out, too.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any
from unittest.mock import patch

import jax.numpy as jnp
import numpy as np
import pandas as pd

from psotrack.errors import SettingsError
from psotrack.foreground.silhouettes import Silhouettes, compute
from psotrack.pipeline import results, running, track_runs
from psotrack.recordings import Recording
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings
from psotrack.simulation import SimulationSettings, simulate
from psotrack.support import keep_compiled, measured_compiling, progress_bar, use_device
from psotrack.sweeps import Grid, read_grid, sweep
from psotrack.tracking.swarm import track_silhouettes
from psotrack.tracking.swarm.block import Block, Engine, Job
from psotrack.tracking.swarm.run import SwarmRun
from psotrack.trajectories import Status, Trajectories

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results
from _sequences import simulated

GRID = Path(__file__).resolve().parents[1] / "table5" / "grid.toml"
#: What is to be reached by 64 runs of 250 frames on two cores: seconds of all that is not the swarm.
REST_S = 5.0
#: What is to be reached on a data-centre GPU: seconds of the grid, ratio of throughputs, median distance of tracks.
GRID_S, RATIO, DISTANCE_MM = 60.0, 20.0, 0.5
#: Number of cores with which the device is compared.
CORES = 2
#: The parts of the host's work, and the functions that do it.
HOST = (
    ("births", SwarmRun, "search"),
    ("births", SwarmRun, "plan"),
    ("camera errors", running, "views_of_places"),
    ("camera errors", running, "with_camera_errors"),
    ("identities", results, "postprocess"),
)
NAMES = ("swarm", "blocks without iterations", *dict.fromkeys(name for name, _, _ in HOST))


@dataclass(frozen=True)
class Size:
    """How much is measured.

    Attributes:
        sequence: the sequence of `batch`.
        runs, cpu_runs: runs of a sequence at once, and on the two cores beside a GPU; with the seeds 0, 1, ...
        repeats: timed calls, after one that compiles.
        settings: changes of the default settings.
        simulation: settings of the simulated sequences; empty for the usual sequences.
        grid: what `dataclasses.replace` changes in Table 5's grid.
    """

    sequence: str = "S02_D4_A"
    runs: int = 64
    cpu_runs: int = 8
    repeats: int = 3
    settings: Mapping[str, Any] = field(default_factory=dict)
    simulation: Mapping[str, Any] = field(default_factory=dict)
    grid: Mapping[str, Any] = field(default_factory=dict)

    def folder(self, name: str, data: Path) -> Path:
        """The folder of a simulated sequence, which is made if it is missing."""
        if not self.simulation:
            return simulated(name, data, 0)
        folder = data / "small" / "Simulated_Data" / name
        if not folder.exists():
            settings = SimulationSettings(masks=False, onboard=False, **self.simulation)
            simulate(name, folder.parents[1], settings, report=progress_bar)
        return folder

    def runs_of(self, count: int) -> list[TrackSettings]:
        """Settings of some runs."""
        return [TrackSettings(seed=seed).changed(self.settings) for seed in range(count)]


_SMALL = {"init": "truth", "drones.size_m": [0.5, 0.5, 0.2]}
#: A minute on a CPU, most of it compiling. The grid's runs use the program of the other runs: the same number of
#: particles, and as many at once.
SMALL = Size(
    sequence="S01_D2_A",
    runs=3,
    cpu_runs=2,
    repeats=1,
    settings={**_SMALL, "swarm.particles": 20},
    simulation={"num_frames": 12, "scale": 0.25},
    grid={
        "sequences": ("S01_D2_A",),
        "runs": 3,
        "settings": _SMALL,
        "axes": {"swarm.particles": (20,), "swarm.iterations": (20, 50)},
    },
)


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("mode", choices=["batch", "gpu"])
    parser.add_argument("--data", type=Path, default=Path("data"), help="root folder of the data")
    parser.add_argument("--runs", type=int, help="runs at once; 64 by default")
    parser.add_argument("--repeats", type=int, help="timed calls of the runs; 3 by default")
    parser.add_argument("--small", action="store_true", help="a few runs of a very short sequence")
    parser.add_argument("--json", type=Path, help="write the figures into this file, too, after each part")
    parser.add_argument("--results", type=Path, help="batch: write the record into this folder")
    parser.add_argument("--device", choices=["gpu", "cpu"], default="gpu", help="gpu: what is measured")
    parser.add_argument(
        "--only", nargs="+", metavar="PART", help="gpu: names of sequences, grid; all by default"
    )
    options = parser.parse_args()
    given = {name: value for name in ("runs", "repeats") if (value := getattr(options, name)) is not None}
    if min(given.values(), default=1) < 1:
        parser.error(f"--runs, --repeats: expected at least 1, found {min(given.values())}")
    size = replace(SMALL if options.small else Size(), **given)
    run = _results.Run("batch") if options.results else None
    cache = options.data / "silhouettes"
    if options.mode == "batch":
        figures = compare_with_one_run(size.folder(size.sequence, options.data), cache, size)
        write(options.json, figures)
        if run is not None:
            run.save(options.results, figures=figures)
        return
    try:
        use_device(options.device)
    except SettingsError:
        sys.exit(
            "bench-gpu: no GPU is there; `.venv/bin/python -m pip install -e '.[cuda]'` installs JAX for NVIDIA's, and "
            "`.venv/bin/python experiments/benchmarks/many_runs.py gpu --device cpu --small` runs the same code in "
            "small on a CPU"
        )
    grid = replace(read_grid(GRID), methods={"psotrack": read_grid(GRID).methods["psotrack"]})
    grid = replace(grid, **size.grid)
    parts = options.only or [*grid.sequences, "grid"]
    if unknown := sorted({*parts} - {*grid.sequences, "grid"}):
        parser.error(
            f"--only: expected some of {', '.join(grid.sequences)}, grid, found {', '.join(unknown)}"
        )
    figures = {"machine": _results.machine(), "versions": _results.versions(), "runs": []}
    print(json.dumps(figures), flush=True)
    keep_compiled(cache / "compiled")
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn, initializer=use_two_cores) as cores:
        for part in parts:
            if part == "grid":
                folders = [size.folder(name, options.data) for name in grid.sequences]
                figures["grid"] = time_grid(grid, folders[0].parents[1], cache)
            else:
                folder = size.folder(part, options.data)
                figures["runs"].append(compare_with_two_cores(folder, cache, size, cores))
            write(options.json, figures)


def write(path: Path | None, figures: Mapping[str, Any]) -> None:
    """Write figures as JSON, if a file is wanted."""
    if path is not None:
        path.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


def use_two_cores() -> None:
    """Make this process compute on two cores; called before JAX uses a device."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:CORES])
    use_device("cpu")


@contextmanager
def clock(*, side_by_side: bool | None) -> Iterator[Counter[str]]:
    """Seconds of the parts of all runs that are tracked meanwhile; "aside" are those of the measurement itself.

    Args:
        side_by_side: whether runs are computed side by side; None: on accelerators only.
    """
    seconds: Counter[str] = Counter()
    compute_block = Engine.track

    def timed_block(engine: Engine, jobs: Sequence[Job], block: Block) -> Any:
        began = time.perf_counter()
        with measured_compiling() as compiled_s:
            found = compute_block(engine, jobs, block)
            between, compile_s = time.perf_counter(), compiled_s()
            compute_block(engine, [without_iterations(job) for job in jobs], block)
            aside_s = time.perf_counter() - between
            idle_s = aside_s - (compiled_s() - compile_s)
        seconds.update(
            {
                "compile": compile_s,
                "aside": aside_s,
                "swarm": between - began - compile_s - idle_s,
                "blocks without iterations": idle_s,
            }
        )
        return found

    lock, active, since = Lock(), Counter[str](), {}

    def timed(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """The call; its seconds count once where several threads are in it."""

        def called(*arguments: Any, **named: Any) -> Any:
            with lock:
                active[name] += 1
                if active[name] == 1:
                    since[name] = time.perf_counter()
            try:
                return call(*arguments, **named)
            finally:
                with lock:
                    active[name] -= 1
                    if not active[name]:
                        seconds[name] += time.perf_counter() - since[name]

        return called

    with ExitStack() as stack:
        stack.enter_context(patch.object(Engine, "track", timed_block))
        side = partial(track_silhouettes, side_by_side=side_by_side)
        stack.enter_context(patch.object(running, "track_silhouettes", side))
        for name, owner, function in HOST:
            stack.enter_context(patch.object(owner, function, timed(name, getattr(owner, function))))
        yield seconds


def without_iterations(job: Job) -> Job:
    """The same work, but the swarm evaluates its first particles only."""
    program = job.program
    if program.num_iterations is not None:
        program = replace(program, num_iterations=0)
    return replace(job, params=replace(job.params, num_iterations=jnp.int32(0)), program=program)


def load(folder: Path, cache: Path) -> tuple[Recording, Silhouettes]:
    """A sequence and its silhouettes."""
    recording = open_recording(folder).usable(num_frames=None)
    return recording, compute(recording, TrackSettings().silhouettes, cache=cache)


def time_runs(
    recording: Recording,
    silhouettes: Silhouettes,
    settings: Sequence[TrackSettings],
    *,
    side_by_side: bool | None = None,
) -> tuple[list[Trajectories], dict[str, float]]:
    """Track runs together; their trajectories, and the seconds of each part and in total."""
    with clock(side_by_side=side_by_side) as spent:
        began = time.perf_counter()
        tracked = track_runs(recording, silhouettes, settings)
        total_s = time.perf_counter() - began - spent["aside"] - spent["compile"]
    trajectories = []
    for each in tracked:
        if isinstance(each, Exception):
            raise each
        trajectories.append(each.trajectories)
    parts = {name: spent[name] for name in NAMES}
    parts["other"] = total_s - sum(parts.values())
    return trajectories, {**parts, "not the swarm": total_s - parts["swarm"], "total": total_s}


def compare_with_one_run(folder: Path, cache: Path, size: Size) -> dict[str, Any]:
    """Seconds of one run and of many runs, timed in turn."""
    keep_compiled(cache / "compiled")
    recording, silhouettes = load(folder, cache)
    runs = size.runs_of(size.runs)
    calls = {"one_s": runs[:1], "many_s": runs}
    taken: dict[str, list[dict[str, float]]] = {name: [] for name in calls}
    for repeat in range(1 + size.repeats):
        for name, settings in calls.items():
            _, seconds = time_runs(recording, silhouettes, settings)
            if repeat:
                taken[name].append(seconds)
    medians = pd.DataFrame({name: pd.DataFrame(rows).median() for name, rows in taken.items()})
    shape = [recording.num_frames, len(recording.rig), *silhouettes.shape]
    figures = {
        "sequence": recording.name,
        "frames": recording.num_frames,
        "shape": shape,
        "runs": size.runs,
        "particles": runs[0].swarm.particles,
        "iterations": runs[0].swarm.iterations,
        "repeats": size.repeats,
        **medians.to_dict(),
        "ratio": float(medians["many_s"]["total"] / medians["one_s"]["total"]),
    }
    print(json.dumps({"machine": _results.machine(), "versions": _results.versions()}))
    print(
        f"{recording.name}: silhouettes {shape} (frames, cameras, height, width), {runs[0].swarm}\n"
        f"seconds, medians of {size.repeats}:\n{medians.round(3).to_string()}\n"
        f"{size.runs} runs take {figures['ratio']:.2f} times as long as one; all that is not the swarm takes "
        f"{medians['many_s']['not the swarm']:.2f} s (64 runs of 250 frames on two cores, to reach: {REST_S:g})"
    )
    return figures


def compare_with_two_cores(
    folder: Path, cache: Path, size: Size, cores: ProcessPoolExecutor
) -> dict[str, Any]:
    """Throughput of many runs at once beside that of two cores, and the differences of their tracks."""
    # One after the other, so that neither has to share the cores.
    here, seconds = time_many(folder, cache, size, size.runs, side_by_side=True)
    there, cpu_seconds = cores.submit(time_many, folder, cache, size, size.cpu_runs).result()
    figures = {
        "sequence": folder.name,
        "runs": size.runs,
        "cpu_runs": size.cpu_runs,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "ratio": (cpu_seconds["total"] / size.cpu_runs) / (seconds["total"] / size.runs),
        **differences(here[: size.cpu_runs], there),
    }
    table = pd.DataFrame(
        {f"{size.runs} runs": seconds, f"{size.cpu_runs} runs on {CORES} cores": cpu_seconds}
    )
    print(
        f"\n{folder.name}: seconds, medians of {size.repeats}\n{table.round(3).to_string()}\n"
        f"ratio of throughputs: {figures['ratio']:.2f} (to reach: {RATIO:g})\n"
        f"distance of tracks: {figures['median_mm']:.3f} mm in the median, {figures['p99_mm']:.3f} at 99 % "
        f"(to reach: {DISTANCE_MM:g} in the median)\n"
        f"another identity: {figures['other_identities']} drones, another status: {figures['other_statuses']} of "
        f"{figures['positions']} positions (to reach: none)",
        flush=True,
    )
    return figures


def time_many(
    folder: Path, cache: Path, size: Size, count: int, *, side_by_side: bool | None = None
) -> tuple[list[Trajectories], dict[str, float]]:
    """Trajectories of some runs, and the medians of their seconds, after a call that compiles."""
    keep_compiled(cache / "compiled")
    recording, silhouettes = load(folder, cache)
    timed = [
        time_runs(recording, silhouettes, size.runs_of(count), side_by_side=side_by_side)
        for _ in range(1 + size.repeats)
    ]
    return timed[-1][0], pd.DataFrame([seconds for _, seconds in timed[1:]]).median().to_dict()


def differences(runs: Sequence[Trajectories], others: Sequence[Trajectories]) -> dict[str, Any]:
    """How runs of the device differ from runs of the CPU with the same seeds.

    A drone has another identity if the other run's nearest drone, in the median over the frames in which both are
    tracked, has another number, or if the other run has no such drone.
    """
    distances_m: list[np.ndarray] = []
    other_identities = other_statuses = positions = 0
    for run, other in zip(runs, others, strict=True):
        assert run.status is not None
        assert other.status is not None
        both = min(run.num_drones, other.num_drones)
        other_identities += max(run.num_drones, other.num_drones) - both
        positions += run.status.size
        other_statuses += int((run.status[:, :both] != other.status[:, :both]).sum())
        for drone in range(both):
            apart_m = np.linalg.norm(run.position_m[:, drone, None] - other.position_m, axis=-1)
            seen = (run.status[:, drone, None] == Status.TRACKED) & (other.status == Status.TRACKED)
            medians_m = [
                np.median(of_other[of_both]) if of_both.any() else np.inf
                for of_other, of_both in zip(apart_m.T, seen.T, strict=True)
            ]
            other_identities += int(np.argmin(medians_m) != drone)
            distances_m.append(apart_m[seen[:, drone], drone])
    all_mm = 1e3 * np.concatenate(distances_m)
    return {
        "median_mm": float(np.median(all_mm)),
        "p99_mm": float(np.quantile(all_mm, 0.99)),
        "other_identities": other_identities,
        "other_statuses": other_statuses,
        "positions": positions,
    }


def time_grid(grid: Grid, data: Path, cache: Path) -> dict[str, Any]:
    """Seconds of Table 5's grid, in a second sweep: the first makes the silhouettes and compiles."""
    for _ in range(2):
        with tempfile.TemporaryDirectory() as out, clock(side_by_side=True) as spent:
            began = time.perf_counter()
            rows = sweep(grid, out, data=data, cache=cache).rows()
            total_s = time.perf_counter() - began - spent["aside"] - spent["compile"]
    if rows.attrs["errors"]:
        sys.exit("\n".join(f"bench-gpu: {error}" for error in rows.attrs["errors"]))
    cells = len(grid.cells())
    print(
        f"\nTable 5's grid, {cells} cells x {grid.runs} runs, {', '.join(grid.sequences)}: {total_s:.1f} s, of which "
        f"the swarm {spent['swarm']:.1f} (to reach: {GRID_S:g})",
        flush=True,
    )
    return {"cells": cells, "runs": grid.runs, "total_s": total_s, "swarm_s": spent["swarm"]}


if __name__ == "__main__":
    main()
