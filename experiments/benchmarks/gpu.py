"""A GPU against two cores of the same machine: Table 5's grid, many runs at once, equal tracks, background subtraction.

    make bench-gpu                                              # needs a GPU; simulates the sequences unless they exist
    python experiments/benchmarks/gpu.py --only S02_D4_A mog2 --repeats 1   # parts of it
    python experiments/benchmarks/gpu.py --device cpu --small   # the same code in small, on a machine without a GPU

Prints device, versions, shapes and medians, each beside what is to be reached:

- the grid of Table 5, by psotrack's method: 27 cells of ten runs, after silhouettes and compilation;
- many runs of a sequence at once, against the throughput of two cores, in a process that may use two cores;
- the distance of the tracks from those of the CPU with the same settings and seeds, and how many drones have another
  number and how many positions another status;
- MOG2 in JAX, the upload of the frames included, against OpenCV's on two cores.

Compilation is left out of all seconds. The device's part of them goes from the upload of a chunk of silhouettes to the
end of its tracks. The track stage is this and the search for new tracks between the chunks. The rest is the host's, one
run after the other: it looks for the volume and the drones, learns the cameras' errors, settles identities and smooths.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from psotrack.datasets import open_recording
from psotrack.errors import InputError, SettingsError
from psotrack.pipeline import track_runs
from psotrack.settings import TrackSettings
from psotrack.silhouettes import compute
from psotrack.silhouettes.mog2_jax import Mog2Params, mog2_init, mog2_step
from psotrack.simulation import SimulationSettings, simulate
from psotrack.support import keep_compiled, progress_bar, share_processors, use_device
from psotrack.sweep import read_grid, sweep
from psotrack.tracking import chunks
from psotrack.tracking.batch import BatchResult, track_batch
from psotrack.trajectories import Status, Trajectories

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results
from _sequences import simulated

GRID = Path(__file__).resolve().parents[1] / "table5" / "grid.toml"
#: Number of cores with which the device is compared.
CORES = 2
#: What is to be reached on a data-centre GPU: seconds of the grid, ratio of throughputs, median distance of tracks.
GRID_S, RATIO, DISTANCE_MM = 60.0, 20.0, 0.5
LEARNING_RATE = 0.02


@dataclass(frozen=True)
class Size:
    """How much is measured.

    Attributes:
        runs, cpu_runs: runs of a sequence at once on the device and on two cores, with the seeds 0, 1, ...
        repeats: timed calls, after one that compiles.
        settings: changes of the default settings.
        simulation: settings of the simulated sequences; empty for the usual sequences.
        grid: what `dataclasses.replace` changes in Table 5's grid.
        images: shape of the images of the background subtraction: frames, cameras, height, width.
    """

    runs: int = 64
    cpu_runs: int = 8
    repeats: int = 3
    settings: Mapping[str, Any] = field(default_factory=dict)
    simulation: Mapping[str, Any] = field(default_factory=dict)
    grid: Mapping[str, Any] = field(default_factory=dict)
    images: tuple[int, int, int, int] = (100, 8, 270, 480)


#: A minute on a CPU, most of it compiling: two drones, twelve frames, images of a quarter of the size. The grid's runs
#: use the program of the other runs: the same number of particles, and as many at once.
SMALL = Size(
    runs=3,
    cpu_runs=2,
    repeats=1,
    settings={"init": "truth", "drones.size_m": (0.5, 0.5, 0.2), "swarm.particles": 20},
    simulation={"num_frames": 12, "scale": 0.25},
    grid={
        "sequences": ("S01_D2_A",),
        "runs": 3,
        "settings": {"init": "truth", "drones.size_m": [0.5, 0.5, 0.2]},
        "axes": {"swarm.particles": (20,), "swarm.iterations": (20, 50)},
    },
    images=(10, 2, 54, 96),
)


@dataclass
class TimedBatches:
    """`track_batch`, whose seconds are added up.

    Attributes:
        side_by_side: as in `track_batch`.
        seconds: seconds of all calls, summed over the threads of all devices.
    """

    side_by_side: bool | None
    seconds: float = 0.0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __call__(self, *arguments: Any, **named: Any) -> list[BatchResult]:
        """Track a chunk, and wait for the result."""
        began = time.perf_counter()
        result = track_batch(*arguments, **named | {"side_by_side": self.side_by_side})
        result = jax.block_until_ready(result)
        with self._lock:
            self.seconds += time.perf_counter() - began
        return result


@dataclass(frozen=True)
class Timed:
    """Trajectories of some runs, and medians of the seconds of all runs together.

    Attributes:
        trajectories: the trajectories of each run.
        total_s: seconds of the whole call.
        track_s: seconds of the track stage.
        device_s: seconds of the device; not meaningful for several devices.
    """

    trajectories: list[Trajectories]
    total_s: float
    track_s: float
    device_s: float


def main() -> None:
    """Measure everything, and print it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", choices=["gpu", "cpu"], default="gpu")
    parser.add_argument("--small", action="store_true", help="a few runs of a very short sequence")
    parser.add_argument("--data", type=Path, default=Path("data"), help="root folder of the data")
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="PART",
        help="some parts in this order: names of sequences (many runs at once), grid, mog2; all by default",
    )
    parser.add_argument("--repeats", type=int, help="timed calls of the runs; 3 by default")
    parser.add_argument("--json", type=Path, help="write the figures into this file, too, after each part")
    options = parser.parse_args()
    try:
        use_device(options.device)
    except SettingsError:
        sys.exit(
            "bench-gpu: no GPU is there; `.venv/bin/python -m pip install -e '.[cuda]'` installs JAX for NVIDIA's, and "
            "`.venv/bin/python experiments/benchmarks/gpu.py --device cpu --small` runs the same code in small on a CPU"
        )
    size = SMALL if options.small else Size()
    if options.repeats is not None:
        if options.repeats < 1:
            parser.error(f"--repeats: expected at least 1, found {options.repeats}")
        size = replace(size, repeats=options.repeats)
    sequences = list(_grid(size).sequences)
    parts = options.only or [*sequences, "grid", "mog2"]
    if unknown := sorted({*parts} - {*sequences, "grid", "mog2"}):
        parser.error(
            f"--only: expected some of {', '.join(sequences)}, grid, mog2, found {', '.join(unknown)}"
        )
    cache = options.data / "silhouettes"
    keep_compiled(cache / "compiled")
    # On a CPU the same program as on a GPU, which a CPU would not choose itself.
    batches = TimedBatches(side_by_side=True)
    figures: dict[str, Any] = {
        "machine": _results.machine(),
        "versions": _results.versions(),
        "repeats": size.repeats,
        "runs": [],
    }
    print(json.dumps(figures), flush=True)
    spawn = multiprocessing.get_context("spawn")
    with (
        patch.object(chunks, "track_batch", batches),
        ProcessPoolExecutor(1, mp_context=spawn, initializer=_use_two_cores, initargs=(cache,)) as cores,
    ):
        for part in parts:
            if part == "grid":
                folders = [folder_of(name, options.data, size) for name in sequences]
                figures["grid"] = time_grid(folders[0].parents[1], cache, size, batches)
            elif part == "mog2":
                figures["mog2"] = compare_mog2(size, cores)
            else:
                folder = folder_of(part, options.data, size)
                figures["runs"].append(compare_runs(folder, cache, size, batches, cores))
            if options.json:
                options.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


def _use_two_cores(cache: Path) -> None:
    """Make this process compute on two cores, one JAX device each; called before JAX uses a device."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:CORES])
    cv2.setNumThreads(CORES)
    share_processors(CORES)
    use_device("cpu")
    keep_compiled(cache / "compiled")


def folder_of(name: str, data: Path, size: Size) -> Path:
    """The folder of a simulated sequence, which is made if it is missing."""
    if not size.simulation:
        return simulated(name, data, 0)
    folder = data / "small" / "Simulated_Data" / name
    if not folder.exists():
        settings = SimulationSettings(masks=False, onboard=False, **size.simulation)
        simulate(name, folder.parents[1], settings, report=progress_bar)
    return folder


def compare_runs(
    folder: Path, cache: Path, size: Size, batches: TimedBatches, cores: ProcessPoolExecutor
) -> dict[str, Any]:
    """Throughput of many runs at once beside that of two cores, and the differences of their tracks."""
    recording = open_recording(folder).usable(num_frames=None)
    silhouettes = compute(recording, TrackSettings().silhouettes, cache=cache)
    shape = (recording.num_frames, len(recording.rig), *silhouettes.shape)
    # One after the other, so that neither has to share the cores.
    here = time_runs(folder, cache, size.runs, size, batches)
    there = cores.submit(_time_runs_on_cores, folder, cache, size).result()
    swarm, share = TrackSettings().changed(size.settings).swarm, size.cpu_runs / size.runs
    figures = {
        "sequence": recording.name,
        "shape": shape,
        "runs": size.runs,
        "cpu_runs": size.cpu_runs,
        "total_s": here.total_s,
        "track_s": here.track_s,
        "device_s": here.device_s,
        "cpu_total_s": there.total_s,
        "cpu_track_s": there.track_s,
        "frames_per_s": recording.num_frames * size.runs / here.total_s,
        "ratio": there.total_s / (here.total_s * share),
        "ratio_track": there.track_s / (here.track_s * share),
        **differences(here.trajectories[: size.cpu_runs], there.trajectories),
    }
    print(
        f"\n{recording.name}: silhouettes {shape} (frames, cameras, height, width), {swarm}\n"
        f"{size.runs} runs at once:       {here.total_s:8.2f} s, track stage {here.track_s:.2f}, of which the device "
        f"{here.device_s:.2f}\n"
        f"{size.cpu_runs} runs on {CORES} cores:     {there.total_s:8.2f} s, track stage {there.track_s:.2f}\n"
        f"ratio of throughputs:  {figures['ratio']:8.2f}, of the track stage {figures['ratio_track']:.2f} "
        f"(to reach: {RATIO:g})\n"
        f"distance of tracks:    {figures['median_mm']:8.3f} mm in the median, {figures['p99_mm']:.3f} at 99 % "
        f"(to reach: {DISTANCE_MM:g} in the median)\n"
        f"another identity:      {figures['other_identities']:8d} drones, another status: "
        f"{figures['other_statuses']} of {figures['positions']} positions (to reach: none)",
        flush=True,
    )
    return figures


def time_runs(folder: Path, cache: Path, runs: int, size: Size, batches: TimedBatches) -> Timed:
    """Time runs of a sequence with the seeds 0, 1, ..., after a call that compiles."""
    recording = open_recording(folder).usable(num_frames=None)
    silhouettes = compute(recording, TrackSettings().silhouettes, cache=cache)
    settings = [TrackSettings(seed=seed).changed(size.settings) for seed in range(runs)]
    seconds: list[tuple[float, float, float]] = []
    for _ in range(1 + size.repeats):
        batches.seconds, began = 0.0, time.perf_counter()
        results = track_runs(recording, silhouettes, settings)
        total_s = time.perf_counter() - began
        found = []
        for result in results:
            if isinstance(result, InputError):
                raise result
            found.append(result)
        # The seconds of a run are its share of those of all runs.
        track_s, compile_s = (
            sum(result.record["seconds"][stage] for result in found) for stage in ("track", "compile")
        )
        seconds.append((total_s - compile_s, track_s, batches.seconds - compile_s))
    # The first call compiles. Later calls count a chunk without iterations as compilation, for each program.
    medians = [statistics.median(column) for column in zip(*seconds[1:], strict=True)]
    return Timed([result.trajectories for result in found], *medians)


def _time_runs_on_cores(folder: Path, cache: Path, size: Size) -> Timed:
    """`time_runs` in the process that may use two cores."""
    batches = TimedBatches(side_by_side=None)
    with patch.object(chunks, "track_batch", batches):
        return time_runs(folder, cache, size.cpu_runs, size, batches)


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
            seen = run.status[:, drone] == Status.TRACKED
            apart_m = np.linalg.norm(run.position_m[seen, drone, None] - other.position_m[seen], axis=-1)
            apart_m[other.status[seen] != Status.TRACKED] = np.nan
            known = np.isfinite(apart_m)
            median_m = [
                np.median(column[finite]) if finite.any() else np.inf
                for column, finite in zip(apart_m.T, known.T, strict=True)
            ]
            other_identities += int(np.argmin(median_m) != drone)
            distances_m.append(apart_m[known[:, drone], drone])
    all_mm = 1e3 * np.concatenate(distances_m)
    return {
        "median_mm": float(np.median(all_mm)),
        "p99_mm": float(np.quantile(all_mm, 0.99)),
        "other_identities": other_identities,
        "other_statuses": other_statuses,
        "positions": positions,
    }


def _grid(size: Size) -> Any:
    """Table 5's grid, with psotrack's method alone."""
    grid = read_grid(GRID)
    return replace(grid, **{"methods": {"psotrack": grid.methods["psotrack"]}, **size.grid})


def time_grid(data: Path, cache: Path, size: Size, batches: TimedBatches) -> dict[str, Any]:
    """Seconds of Table 5's grid, in a second sweep: the first makes the silhouettes and compiles."""
    grid = _grid(size)
    for _ in range(2):
        with tempfile.TemporaryDirectory() as out:
            batches.seconds, began = 0.0, time.perf_counter()
            rows = sweep(grid, out, data=data, cache=cache)
            total_s = time.perf_counter() - began
    if rows.attrs["errors"]:
        sys.exit("\n".join(f"bench-gpu: {error}" for error in rows.attrs["errors"]))
    compile_s = float(rows["seconds.compile"].sum())
    cells = len(grid.cells())
    figures = {
        "cells": cells,
        "runs": grid.runs,
        "sequences": list(grid.sequences),
        "total_s": total_s - compile_s,
        "device_s": batches.seconds - compile_s,
        "compile_s": compile_s,
    }
    print(
        f"\nTable 5's grid, {cells} cells x {grid.runs} runs, {', '.join(grid.sequences)}: "
        f"{figures['total_s']:.1f} s, of which the device {figures['device_s']:.1f} (to reach: {GRID_S:g})",
        flush=True,
    )
    return figures


def compare_mog2(size: Size, cores: ProcessPoolExecutor) -> dict[str, Any]:
    """Frames per second of MOG2 in JAX, the upload included, and of OpenCV's, summed over the cameras."""
    images = _images(size.images)
    num_images = images.shape[0] * images.shape[1]
    step = jax.jit(jax.vmap(mog2_step, in_axes=(0, 0, None)))
    state = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (images.shape[1], *leaf.shape)), mog2_init(*images.shape[2:4])
    )
    params = Mog2Params(LEARNING_RATE)

    def run(collect: Callable[[jax.Array], Any]) -> list[Any]:
        mixtures, collected = state, []
        for image in images:
            mixtures, labels = step(mixtures, image, params)
            collected.append(collect(labels))
        jax.block_until_ready((mixtures, collected))
        return collected

    labels = run(np.asarray)
    seconds: dict[str, list[float]] = {"labels stay on the device": [], "labels are brought back": []}
    for _ in range(max(size.repeats, 3)):
        for taken, collect in zip(seconds.values(), (lambda given: given, np.asarray), strict=True):
            began = time.perf_counter()
            run(collect)
            taken.append(time.perf_counter() - began)
    opencv_s, expected = cores.submit(_time_opencv, size).result()
    per_s = {name: num_images / statistics.median(taken) for name, taken in seconds.items()}
    figures = {
        "shape": size.images,
        "frames_per_s": per_s,
        "opencv_frames_per_s": num_images / opencv_s,
        "same_labels": float(np.mean(np.array(labels) == expected)),
    }
    print(
        f"\nMOG2, images {size.images} (frames, cameras, height, width), frames of one camera per second:\n"
        + "\n".join(f"JAX, {name}: {value:10.0f}" for name, value in per_s.items())
        + f"\nOpenCV, {CORES} cores:                {figures['opencv_frames_per_s']:10.0f}\n"
        f"pixels with the same label:     {figures['same_labels']:10.5f}",
        flush=True,
    )
    return figures


def _time_opencv(size: Size) -> tuple[float, np.ndarray]:
    """Median seconds of OpenCV's MOG2, and its labels of all images."""
    images, taken = _images(size.images), []
    for _ in range(max(size.repeats, 3)):
        models = [cv2.createBackgroundSubtractorMOG2(detectShadows=True) for _ in range(images.shape[1])]
        began = time.perf_counter()
        labels = [
            [
                model.apply(image, learningRate=LEARNING_RATE)
                for model, image in zip(models, frame, strict=True)
            ]
            for frame in images
        ]
        taken.append(time.perf_counter() - began)
    return statistics.median(taken), np.array(labels)


def _images(shape: tuple[int, int, int, int]) -> np.ndarray:
    """(frames, cameras, height, width, 3) uint8: a background with noise, and a dark square that moves."""
    num_frames, num_cameras, height, width = shape
    rng = np.random.default_rng(0)
    background = rng.integers(40, 216, (num_cameras, height, width, 3))
    images = np.empty((num_frames, num_cameras, height, width, 3), np.uint8)
    side = height // 6
    for number, image in enumerate(images):
        noisy = background + rng.normal(0, 2, background.shape)
        left = 3 * number % (width - side)
        noisy[:, side : 2 * side, left : left + side] = 20
        image[...] = noisy.clip(0, 255).round()
    return images


if __name__ == "__main__":
    main()
