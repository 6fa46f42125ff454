"""The accuracy that the README states: simulated sequences, full size, silhouettes from the videos.

    python experiments/accuracy/measure.py --data data
    python experiments/accuracy/measure.py --data data --sequence S02_D4_A --data-seed 1

Simulates each sequence into --data if it is not there, tracks it with three seeds of the swarm for each method, each by
the very command that it prints, and writes one row per run (CSV), with the machine's description beside it (JSON).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import pandas as pd

from psotrack.pipeline import environment

JOINT, HARD = ("--swarm", "joint"), ("--score", "hard")


def effort(particles: int, iterations: int) -> tuple[str, ...]:
    """Flags of the swarm's size."""
    return "--particles", str(particles), "--iterations", str(iterations)


METHODS = {
    "S01_D2_A": {
        "joint 50 x 50": (*JOINT, *effort(50, 50)),
        "joint 50 x 50, the paper's hard one-box score": (*JOINT, *effort(50, 50), *HARD),
        "per drone 30 x 30 (the defaults)": (),
    },
    "S02_D4_A": {
        "joint 100 x 70": (*JOINT, *effort(100, 70)),
        "joint 100 x 70, the paper's hard one-box score": (*JOINT, *effort(100, 70), *HARD),
        "per drone 30 x 20": effort(30, 20),
        "per drone 30 x 30 (the defaults)": (),
    },
    "S04_D10": {
        "per drone 50 x 30": effort(50, 30),
        "joint 100 x 70, the paper's hard one-box score": (*JOINT, *effort(100, 70), *HARD),
    },
}
KEPT = ["mean_error_m", "median_error_m", "p95_error_m", "max_error_m", "offset_removed_mean_error_m"]
KEPT += ["missed_rate", "id_switches", "mota", "idf1", "hota"]


def psotrack(*words: str) -> str:
    """Run the command line as a user would; show the command and return what it printed."""
    print("$ psotrack", *words, flush=True)
    return subprocess.run(
        [sys.executable, "-m", "psotrack", *words], check=True, stdout=subprocess.PIPE, text=True
    ).stdout


def measure(name: str, data: Path, data_seed: int, seeds: int) -> pd.DataFrame:
    """One row per method and seed of the swarm."""
    sequence = data / f"seed{data_seed}" / "Simulated_Data" / name
    if not sequence.exists():
        made = ("--out", str(sequence.parents[1]), "--seed", str(data_seed))
        psotrack("simulate", name, *made, "--no-masks", "--no-onboard")
    rows = []
    for method, flags in METHODS[name].items():
        for seed in range(seeds):
            tracks = str(data / "tracks" / f"{name}-{data_seed}-{len(rows)}.csv")
            psotrack("track", str(sequence), "--out", tracks, "--seed", str(seed), *flags, "--force")
            errors = json.loads(psotrack("evaluate", tracks, str(sequence), "--json", "-"))
            record = json.loads(Path(tracks).with_suffix(".json").read_text())
            rows.append(
                {"sequence": name, "data_seed": data_seed, "method": method, "seed": seed}
                | {key: errors[key] for key in KEPT}
                | {"track_ms_per_frame": 1e3 * record["seconds"]["track"] / record["frames"]}
            )
    return pd.DataFrame(rows)


def main() -> None:
    """Simulate, track, evaluate, and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data"), help="the data's root folder")
    parser.add_argument(
        "--out", type=Path, default=Path("experiments/accuracy/results"), help="folder of results"
    )
    parser.add_argument("--sequence", choices=METHODS, action="append", help="[default: all of them]")
    parser.add_argument("--data-seed", type=int, default=0, help="of the simulated flights")
    parser.add_argument("--seeds", type=int, default=3, help="seeds of the swarm: 0, 1, ...")
    options = parser.parse_args()
    for name in options.sequence or METHODS:
        table = measure(name, options.data, options.data_seed, options.seeds)
        options.out.mkdir(parents=True, exist_ok=True)
        stem = f"{name.lower()}_seed{options.data_seed}"
        table.to_csv(options.out / f"{stem}.csv", index=False, float_format="%.6g")
        (options.out / f"{stem}.json").write_text(json.dumps(environment(), indent=2) + "\n")
        numbers = table.drop(columns=["sequence", "data_seed", "seed"])
        print(f"{name}, flight {options.data_seed}, mean of {options.seeds} seeds")
        means = numbers.groupby("method", sort=False).mean().T
        print(means.to_string(float_format="{:.4f}".format), flush=True)


if __name__ == "__main__":
    main()
