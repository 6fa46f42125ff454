"""Time of the track stage: psotrack, evosax's PSO on psotrack's fitness, pyswarms on the same fitness in NumPy.

Beside them stand the floor, which is the time of the look-ups in the tables that the score must do and of nothing else
(see `_look_ups`).

Every method is warmed up. Then the methods are timed in turn, repeatedly, so that other load of the machine affects all
methods equally. A timing ends when the result is on the host. `python experiments/benchmarks/track_stage.py --help`.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import _scene
import click
import jax.numpy as jnp
import numpy as np
import pandas as pd
from _look_ups import LookUps
from _numpy_fitness import NumpyFitness
from _peers import Evosax, Problem, PySwarms

from psotrack.foreground.silhouettes import border_cells, summed_area_table
from psotrack.settings import SwarmSettings, TrackSettings
from psotrack.tracking.births import InitialState
from psotrack.tracking.swarm import RunInputs, fitness, on_device, tracker_settings
from psotrack.tracking.swarm.block import Engine, Setting, make_block
from psotrack.tracking.swarm.run import SwarmRun

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

PEERS = ("evosax", "pyswarms")

#: Largest difference between psotrack's fitness, which is float32, and NumPy's; both lie in [0, 1].
TOLERANCE = 1e-5

#: Tracks the silhouettes (frames, cameras, height, width) and returns positions (frames, drones, 3).
Method = Callable[[np.ndarray], np.ndarray]


class Psotrack:
    """psotrack's own tracker: one block of frames, without births."""

    def __init__(self, problem: Problem) -> None:
        borders = border_cells(problem.rig.cameras.image_size_wh, problem.reduction)
        self._setting = Setting(problem.rig, problem.reduction, borders, problem.fps)
        self._engine = Engine(self._setting)
        self._run = SwarmRun(
            self._setting, RunInputs(problem.bounds_m, tracker_settings(problem.settings), problem.start)
        )
        self._starts = self._run.given_starts(problem.start, 0)

    def __call__(self, coverage: np.ndarray) -> np.ndarray:
        """Positions (frames, drones, 3)."""
        block = make_block(self._setting, np.arange(len(coverage)), coverage, None)
        ((_, rows),) = self._engine.track([self._run.job(block, self._starts)], block)
        return np.asarray(rows.position_m)[:, : len(self._starts)]


@dataclass(frozen=True)
class Times:
    """Times of one call per frame, milliseconds, and the mean error of its positions, millimetres."""

    wall_ms: float
    cpu_ms: float
    error_mm: float


@dataclass(frozen=True)
class Timing:
    """Times and error of one method.

    Attributes:
        method: name of the method.
        median_ms, min_ms, max_ms: wall time per frame over the repeats, milliseconds.
        cpu_ms: median processor time per frame, over all threads, milliseconds; hardly changed by other load.
        ratio: median over the repeats of the ratio to the time of the first method in the same repeat.
        mean_error_mm: mean error over frames and drones; shows whether a fast method has converged.
        warm_up_s: time of the first call, which compiles, seconds.
    """

    method: str
    median_ms: float
    min_ms: float
    max_ms: float
    cpu_ms: float
    ratio: float
    mean_error_mm: float
    warm_up_s: float


@click.command(context_settings={"show_default": True})
@click.option("--frames", default=25, type=click.IntRange(2), help="Frames that are tracked.")
@click.option("--repeats", default=5, type=click.IntRange(1), help="Timings of every method.")
@click.option("--particles", default=100, type=click.IntRange(2), help="Particles of the swarm.")
@click.option("--iterations", default=70, type=click.IntRange(1), help="Iterations per frame.")
@click.option("--drones", default=4, type=click.IntRange(1), help="Drones in the room.")
@click.option("--cameras", default=8, type=click.IntRange(2), help="Cameras of 1920 x 1080 pixels.")
@click.option(
    "--results", type=click.Path(path_type=Path), help="Write the result and its record into this folder."
)
def main(repeats: int, results: Path | None, **shapes: int) -> None:
    """Time the track stage of psotrack, evosax and pyswarms on the same silhouettes; print a table."""
    _require_peers()
    run = _results.Run("track_stage")
    frames, particles, iterations = (shapes[name] for name in ("frames", "particles", "iterations"))
    scene = _scene.scene(frames, shapes["drones"], shapes["cameras"])
    coverage = scene.coverage()
    joint, per_drone = (make_problem(scene, particles, iterations, kind) for kind in ("joint", "per-drone"))
    size_m, score = joint.start.size_m, joint.score
    tuned = NumpyFitness(scene.rig.cameras, size_m, score, joint.reduction)
    difference = {"tuned": _check_same_fitness(tuned, joint, scene, coverage[0])}

    look_ups = LookUps(joint, coverage[0])
    methods: dict[str, Method] = {
        "psotrack, joint swarm": Psotrack(joint),
        "psotrack, swarm per drone": Psotrack(per_drone),
        "evosax PSO, psotrack's fitness": Evosax(joint),
        "pyswarms, NumPy fitness tuned by hand": PySwarms(joint, tuned),
    }
    timed = {name: partial(_timed, method, coverage, scene.position_m) for name, method in methods.items()}
    timed["floor: table look-ups alone"] = partial(_timed_look_ups, look_ups, frames)
    header = _header(
        {
            **shapes,
            "repeats": repeats,
            "silhouettes": list(coverage.shape),
            "reduction": _scene.REDUCTION,
            "fitness_difference": difference,
            "look_ups_per_frame": look_ups.per_frame,
        }
    )
    timings = _time(timed, repeats)
    _print(header, timings)
    if results is not None:
        run.save(results, rows=pd.DataFrame([vars(timing) for timing in timings]), figures=header["shapes"])


def _require_peers() -> None:
    missing = []
    for peer in PEERS:
        try:
            version(peer)
        except PackageNotFoundError:
            missing.append(peer)
    if missing:
        click.echo(f"{' and '.join(missing)} not installed; run: pip install '.[bench]'", err=True)
        sys.exit(2)


def make_problem(scene: _scene.Scene, particles: int, iterations: int, kind: str) -> Problem:
    """The scene, tracked by a kind of swarm."""
    settings = TrackSettings(swarm=SwarmSettings(particles=particles, iterations=iterations, kind=kind))
    start = InitialState(
        position_m=scene.position_m[0],
        velocity_m_s=scene.velocity_m_s[0],
        size_m=scene.size_m,
        num_cameras=np.full(len(scene.size_m), float(len(scene.rig))),
    )
    return Problem(scene.rig, _scene.REDUCTION, start, settings, _scene.FPS, _scene.BOUNDS_M)


def _check_same_fitness(
    numpy_fitness: NumpyFitness, problem: Problem, scene: _scene.Scene, silhouettes: np.ndarray
) -> float:
    """Largest difference from psotrack's fitness, at positions near the drones and anywhere, also out of view."""
    generator = np.random.default_rng(0)
    truth = scene.position_m[0]
    near = truth + generator.normal(scale=0.1, size=(500, *truth.shape))
    anywhere = generator.uniform(*(1.5 * problem.bounds_m), size=(500, *truth.shape))
    position = np.concatenate([near, anywhere]).astype(np.float32)

    size_m = jnp.asarray(problem.start.size_m, jnp.float32)
    view = fitness.score_inputs(
        on_device(problem.rig.cameras),
        size_m,
        summed_area_table(jnp.asarray(silhouettes)),
        problem.score,
        reduction=problem.reduction,
    )
    ours = np.asarray(fitness.joint_fitness(view, jnp.asarray(position)))
    difference = float(np.abs(ours - numpy_fitness(numpy_fitness.tables(silhouettes), position)).max())
    if not difference <= TOLERANCE:
        raise click.ClickException(f"the NumPy fitness differs by {difference:g}, more than {TOLERANCE:g}")
    return difference


def _timed(method: Method, coverage: np.ndarray, truth_m: np.ndarray) -> Times:
    """Track once."""
    began, cpu_began = time.perf_counter(), time.process_time()
    found_m = method(coverage)
    wall_s, cpu_s = time.perf_counter() - began, time.process_time() - cpu_began
    error_mm = 1e3 * float(np.linalg.norm(found_m - truth_m, axis=-1).mean())
    return Times(1e3 * wall_s / len(coverage), 1e3 * cpu_s / len(coverage), error_mm)


def _timed_look_ups(look_ups: LookUps, frames: int) -> Times:
    """Do the look-ups once."""
    began, cpu_began = time.perf_counter(), time.process_time()
    look_ups(frames)
    wall_s, cpu_s = time.perf_counter() - began, time.process_time() - cpu_began
    return Times(1e3 * wall_s / frames, 1e3 * cpu_s / frames, float("nan"))


def _time(timed: dict[str, Callable[[], Times]], repeats: int) -> list[Timing]:
    errors_mm, warm_up_s = {}, {}
    for name, run in timed.items():
        began = time.perf_counter()
        errors_mm[name] = run().error_mm
        warm_up_s[name] = time.perf_counter() - began

    names = list(timed)
    times_ms: dict[str, list[float]] = {name: [] for name in names}
    cpu_ms: dict[str, list[float]] = {name: [] for name in names}
    for repeat in range(repeats):
        # Each repeat begins with another method, so that the order of the methods has no effect.
        first = repeat % len(names)
        for name in names[first:] + names[:first]:
            times = timed[name]()
            times_ms[name].append(times.wall_ms)
            cpu_ms[name].append(times.cpu_ms)
    return [
        Timing(
            method=name,
            median_ms=statistics.median(times_ms[name]),
            min_ms=min(times_ms[name]),
            max_ms=max(times_ms[name]),
            cpu_ms=statistics.median(cpu_ms[name]),
            ratio=statistics.median(
                theirs / ours for theirs, ours in zip(times_ms[name], times_ms[names[0]], strict=True)
            ),
            mean_error_mm=errors_mm[name],
            warm_up_s=warm_up_s[name],
        )
        for name in names
    ]


def _header(shapes: dict[str, Any]) -> dict[str, Any]:
    return {**_results.machine(), "versions": _results.versions(), "shapes": shapes}


def _print(header: dict[str, Any], timings: list[Timing]) -> None:
    shapes = header["shapes"]
    versions = ", ".join(f"{name} {number}" for name, number in header["versions"].items())
    frames, cameras, height, width = shapes["silhouettes"]
    reduction = shapes["reduction"]
    print(
        f"{header['device']}, {header['processor']}, {header['processors']} processors, load {header['load_average']}"
    )
    print(versions)
    print(
        f"{shapes['particles']} particles x {shapes['iterations']} iterations, {shapes['drones']} drones, "
        f"{cameras} cameras of {width * reduction} x {height * reduction} pixels at reduction {reduction}, "
        f"{frames} frames, {shapes['repeats']} repeats"
    )
    print(
        f"largest difference of the NumPy fitness from psotrack's: {shapes['fitness_difference']['tuned']:.1e}"
    )
    print(f"the score reads {shapes['look_ups_per_frame'] / 1e6:.1f} million table entries per frame\n")

    columns = ("ms/frame", "min", "max", "CPU ms", "ratio", "error mm", "warm-up s")
    print(f"{'method':38}" + "".join(f"{column:>11}" for column in columns))
    for timing in timings:
        numbers = (
            *(f"{value:.2f}" for value in (timing.median_ms, timing.min_ms, timing.max_ms, timing.cpu_ms)),
            f"{timing.ratio:.2f}",
            "-" if np.isnan(timing.mean_error_mm) else f"{timing.mean_error_mm:.1f}",
            f"{timing.warm_up_s:.1f}",
        )
        print(f"{timing.method:38}" + "".join(f"{number:>11}" for number in numbers))
    (floor,) = (timing for timing in timings if timing.method.startswith("floor"))
    print("\nprocessor time as a multiple of the floor:")
    for timing in timings[:3]:
        print(f"{timing.method:38}{timing.cpu_ms / floor.cpu_ms:>11.2f}")


if __name__ == "__main__":
    main()
