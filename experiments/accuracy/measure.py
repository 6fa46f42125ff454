"""Accuracy table of the README: simulated sequences of full size, silhouettes from the videos.

    python experiments/accuracy/measure.py --data data

Simulates three flights of each sequence into --data unless they exist, tracks them with each method, writes one row per
run, and prints its commands. The same command continues an interrupted study.
"""

from __future__ import annotations

import json
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import _runs

JOINT, HARD = ("--swarm", "joint"), ("--score", "hard")


def effort(particles: int, iterations: int) -> tuple[str, ...]:
    """Options for the size of the swarm."""
    return "--particles", str(particles), "--iterations", str(iterations)


#: Methods that use detections; the swarm inside "fused" has the default settings.
OTHERS = {"projection lines": ("--method", "projection-lines"), "fused": ("--method", "fused")}
METHODS = {
    "S01_D2_A": {
        "joint 50 x 50": (*JOINT, *effort(50, 50)),
        "joint 50 x 50, the paper's hard one-box score": (*JOINT, *effort(50, 50), *HARD),
        "per drone 30 x 30 (the defaults)": (),
        **OTHERS,
    },
    "S02_D4_A": {
        "joint 100 x 70": (*JOINT, *effort(100, 70)),
        "joint 100 x 70, the paper's hard one-box score": (*JOINT, *effort(100, 70), *HARD),
        "per drone 30 x 20": effort(30, 20),
        "per drone 30 x 30 (the defaults)": (),
        **OTHERS,
    },
    "S04_D10": {
        "per drone 50 x 30": effort(50, 30),
        "joint 100 x 70, the paper's hard one-box score": (*JOINT, *effort(100, 70), *HARD),
        **OTHERS,
    },
}
KEPT = ["mean_error_m", "median_error_m", "p95_error_m", "max_error_m", "offset_removed_mean_error_m"]
KEPT += ["offset_removed_inside_90_rate", "missed_rate", "id_switches", "mota", "idf1", "hota"]


def psotrack(*words: str) -> str:
    """Run a command of psotrack; print the command and return its output."""
    print("$ psotrack", *words, flush=True)
    return subprocess.run(
        [sys.executable, "-m", "psotrack", *words], check=True, stdout=subprocess.PIPE, text=True
    ).stdout


def measured(name: str, method: str, seed: int, data: Path) -> dict[str, Any]:
    """Track and evaluate one flight with one method; returns the row of the result."""
    sequence = str(_runs.simulated(name, data, seed))
    number = list(METHODS[name]).index(method)
    tracks = data / "tracks" / f"{name}-{seed}-{number}.csv"
    effort = (*METHODS[name][method], "--seed", str(seed), "--cache", str(_runs.cache_folder(data)))
    psotrack("track", sequence, "--out", str(tracks), *effort, "--force", "--quiet")
    errors = json.loads(psotrack("evaluate", str(tracks), sequence, "--json", "-"))
    record = json.loads(tracks.with_suffix(".json").read_text())
    row = {"sequence": name, "method": method, "seed": seed} | {key: errors[key] for key in KEPT}
    return row | {"track_ms_per_frame": 1e3 * record["seconds"]["track"] / record["frames"]}


def main() -> None:
    """Simulate, track, evaluate, and print the table."""
    parser = _runs.parser(__doc__)
    parser.add_argument("--sequence", choices=METHODS, action="append", help="[default: all]")
    parser.add_argument(
        "--method", choices=sorted({one for of in METHODS.values() for one in of}), action="append"
    )
    parser.add_argument("--seeds", type=int, default=3, help="seeds of flight and swarm: 0, 1, ...")
    options = parser.parse_args()
    run = _runs.start("measure")
    rows = (
        (f"{name} {method} {seed}", partial(measured, name, method, seed, options.data))
        for seed in range(options.seeds)
        for name in options.sequence or METHODS
        for method in METHODS[name]
        if not options.method or method in options.method
    )
    table = _runs.save_rows(run, rows, options.data, options.out)
    means = table.drop(columns="seed").groupby(["sequence", "method"], sort=False).mean()
    print(f"mean of {options.seeds} flights", means.T.to_string(float_format="{:.4f}".format), sep="\n")


if __name__ == "__main__":
    main()
