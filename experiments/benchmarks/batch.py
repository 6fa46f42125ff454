"""Time of many runs of a sequence beside the time of one run: the batch axis of `pipeline.track_runs`.

    python experiments/benchmarks/batch.py data/Simulated_Data/S02_D4_A --cache cache

Silhouettes and compiled programs are made before the timing. One run and a batch are timed in turn; each timing ends
when the trajectories are on the host. Prints device, versions, shapes, medians and their ratio.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import jax

from psotrack.datasets.dpjait import read_sequence
from psotrack.pipeline import environment, track_runs
from psotrack.settings import TrackSettings
from psotrack.silhouettes import compute
from psotrack.support import keep_compiled, share_processors

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results


def seconds(call: Callable[[], object]) -> tuple[float, float]:
    """Wall time and processor time of a call, seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - wall, time.process_time() - cpu


def main() -> None:
    """Time one run and a batch, and print the ratio."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path)
    parser.add_argument(
        "--cache", type=Path, required=True, help="folder of silhouettes and compiled programs"
    )
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--particles", type=int, default=50)
    parser.add_argument("--iterations", type=int, default=50)
    parser.add_argument("--swarm", choices=["joint", "per-drone"], default="joint")
    parser.add_argument("--frames", type=int, help="use the first FRAMES frames only")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--results", type=Path, help="write the record into this folder")
    options = parser.parse_args()
    run = _results.Run("batch")
    share_processors()
    keep_compiled(options.cache / "compiled")
    sequence = read_sequence(options.sequence).usable(num_frames=options.frames)
    silhouettes = compute(sequence, TrackSettings().silhouettes, cache=options.cache)
    effort = {
        "swarm.particles": options.particles,
        "swarm.iterations": options.iterations,
        "swarm.kind": options.swarm,
    }
    batch = [TrackSettings(seed=seed).changed(effort) for seed in range(options.runs)]
    calls = {
        "one run": lambda: track_runs(sequence, silhouettes, batch[:1]),
        f"{options.runs} runs": lambda: track_runs(sequence, silhouettes, batch),
    }
    for call in calls.values():
        call()
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for _ in range(options.repeats):
        for name, call in calls.items():
            taken[name].append(seconds(call))
    print(json.dumps(environment() | {"devices": len(jax.devices())}))
    print(f"{sequence.name}: {sequence.num_frames} frames, {len(sequence.rig)} cameras, {effort}")
    print(f"load average {os.getloadavg()[0]:.1f}")
    medians = {
        name: [statistics.median(column) for column in zip(*rows, strict=True)]
        for name, rows in taken.items()
    }
    for name, (wall, cpu) in medians.items():
        print(f"{name:>8}: {wall:7.2f} s, {cpu:7.2f} s of processors")
    one, many = medians.values()
    ratio = statistics.median(many[0] / one[0] for one, many in zip(*taken.values(), strict=True))
    print(f"{options.runs} runs take {ratio:.2f} times as long as one (processors: {many[1] / one[1]:.2f})")
    if options.results:
        figures = {"sequence": sequence.name, "frames": sequence.num_frames, "runs": options.runs, **effort}
        figures |= {"one_s": one[0], "many_s": many[0], "ratio": ratio, "processor_ratio": many[1] / one[1]}
        run.save(options.results, figures=figures)


if __name__ == "__main__":
    main()
