"""The reference table: today's defaults on the flights against which every change of the tracker is judged.

    python experiments/accuracy/accuracy.py reference --data data --real real        # makes the table
    python experiments/accuracy/accuracy.py reference --data data --out after --against experiments/results
    python experiments/accuracy/accuracy.py reference --data data --only S02_D4_A "bats 1:lines"    # some rows only

Flights: three of each of three simulated sequences, three in restless surroundings, one whose drones come and go
(`comings_and_goings.toml`), and, with --real, parts of flights before two cameras. Methods: the swarm, projection lines
on blobs and on detections, and both fused, each with its defaults. --quick takes one flight of each kind. With
--against, each row is compared with the row of another table: a mean error more than 3 % larger, a switch, a missed
drone or a false track more is marked, and the exit code is 1.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from bat_flights import read_flight, write_recording

from psotrack.evaluation import evaluate
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import RESTLESS, SimulationSettings, change_scenario, load, scenario, simulate
from psotrack.support import progress_bar
from psotrack.trajectories import Status, Trajectories, read_trajectories

sys.path.append(str(Path(__file__).resolve().parents[1]))
from _sequences import simulated

METHODS: dict[str, tuple[str, ...]] = {
    "swarm": (),
    "lines on blobs": ("--method", "projection-lines", "--detections", "blobs"),
    "lines on detections": ("--method", "projection-lines"),
    "fused": ("--method", "fused"),
}
SEQUENCES = ("S01_D2_A", "S02_D4_A", "S04_D10")
COMINGS = Path(__file__).with_name("comings_and_goings.toml")
#: Parts of the published flights of bats: name, first frame, number of frames.
BATS = {
    "bats 1": ("Turbine2_Setup5_2022-06-25_21-03", 3000, 450),
    "bats 2": ("Turbine2_Setup6_2022-06-26_20-46", 2000, 450),
    "bats 3": ("Turbine2_Setup4_2022-06-23_21-41", 2000, 450),
}
#: Distance from every drone beyond which a track is false, metres; where the reference is GPS.
GATE_M, GPS_GATE_M = 0.5, 5.0
#: Figures of `evaluate`, by the column of the table.
FIGURES = {
    "missed": "missed_rate",
    "switches": "id_switches",
    "inside_90": "inside_90_rate",
    "centred_inside_90": "offset_removed_inside_90_rate",
}
STAGES = ("decode", "foreground", "track", "compile", "finish", "total")
#: Largest ratio of a mean error to that of the table it is compared with.
WORST_RATIO = 1.03


@dataclass(frozen=True)
class Flight:
    """A recording to track.

    Attributes:
        sequence: folder of the recording.
        methods: names of the methods that fit it.
        seed: seed of the swarm.
        truth: the reference, where the recording's folder has none.
        gate_m: distance from every drone beyond which a track is false, metres.
    """

    sequence: Path
    methods: tuple[str, ...] = tuple(METHODS)
    seed: int = 0
    truth: Trajectories | None = None
    gate_m: float = GATE_M


def flights(data: Path, real: Path | None, quick: bool) -> Iterator[tuple[str, Callable[[], Flight]]]:
    """Name of each flight, and the function that makes the flight ready."""
    for name in SEQUENCES:
        for seed in range(1 if quick else 3):
            yield f"{name} {seed}", partial(_simulated, name, data, seed)
    for seed in range(1, 2 if quick else 4):
        yield f"restless {seed}", partial(_restless, data, seed)
    yield "comings and goings", partial(_comings, data)
    for name in BATS if real is not None else ():
        yield name, partial(_bats, name, data, real)


def _simulated(name: str, data: Path, seed: int) -> Flight:
    return Flight(simulated(name, data, seed), seed=seed)


def _restless(data: Path, seed: int) -> Flight:
    """Four drones, 200 frames at half size, with all that `psotrack simulate --restless` changes."""
    recipe, root = change_scenario(scenario("S02_D4_A"), RESTLESS), data / "restless" / f"restless{seed}"
    settings = SimulationSettings(num_frames=200, scale=0.5, seed=seed, masks=False, onboard=False)
    if not (folder := root / "Simulated_Data" / recipe.name).exists():
        simulate(recipe, root, settings, report=progress_bar)
    return Flight(folder)


def _comings(data: Path) -> Flight:
    recipe, root = load(COMINGS), data / "comings"
    if not (folder := root / "Simulated_Data" / recipe.name).exists():
        settings = SimulationSettings(masks=False, onboard=False)
        simulate(recipe, root, settings, report=progress_bar)
    return Flight(folder)


def _bats(name: str, data: Path, real: Path) -> Flight:
    flight, folder = read_flight(real, *BATS[name]), data / "reference" / name.replace(" ", "_")
    write_recording(flight, folder)
    return Flight(folder, ("lines on detections",), truth=flight.truth, gate_m=GPS_GATE_M)


def psotrack(*words: str) -> str:
    """Run a command of psotrack, after printing the command; returns the error message, empty if there is none."""
    print("$ psotrack", *words, flush=True)
    command = [sys.executable, "-m", "psotrack", *words, "--quiet"]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
    print(done.stderr, end="", flush=True)
    return done.stderr.strip().splitlines()[-1] if done.returncode else ""


def row(name: str, method: str, flight: Flight, data: Path) -> dict[str, Any]:
    """Track a flight by a method; its row of the table."""
    tracks = data / "reference" / "tracks" / f"{name}-{method}.csv".replace(" ", "_")
    tracks.parent.mkdir(parents=True, exist_ok=True)
    where = ("--out", str(tracks), "--cache", str(data / "silhouettes"), "--seed", str(flight.seed))
    refused = psotrack("track", str(flight.sequence), *METHODS[method], *where, "--force")
    if refused:
        note = refused.replace(str(flight.sequence), name)
        return {"flight": name, "method": method, "tracks": 0, "missed": 1.0, "note": note}
    record = json.loads(tracks.with_suffix(".json").read_text())
    found = read_trajectories(tracks)
    truth = open_recording(flight.sequence).truth if flight.truth is None else flight.truth
    there = {"flight": name, "method": method, "tracks": found.num_drones, **_presence(found)}
    figures = {} if truth is None else figures_of(found, truth, flight.gate_m)
    seconds = {f"{stage}_s": record["seconds"].get(stage) for stage in STAGES}
    return there | figures | seconds


def _presence(found: Trajectories) -> dict[str, float]:
    """What can be said without a reference: tracked frames per frame, and the mean score where tracked."""
    tracked = found.status == Status.TRACKED
    fitness = found.fitness[tracked] if found.fitness is not None and tracked.any() else np.array([np.nan])
    return {"tracked_per_frame": float(tracked.sum() / len(tracked)), "fitness": float(np.nanmean(fitness))}


def figures_of(found: Trajectories, truth: Trajectories, gate_m: float) -> dict[str, Any]:
    """Errors beside a reference, and false tracks (see `false_tracks`)."""
    errors = evaluate(found, truth).to_dict()
    mean_m, centred_m = errors["mean_error_m"], errors["offset_removed_mean_error_m"]
    return {
        "mean_mm": None if mean_m is None else 1e3 * mean_m,
        "centred_mm": None if centred_m is None else 1e3 * centred_m,
        **{column: errors[key] for column, key in FIGURES.items()},
        **false_tracks(found, truth, gate_m),
    }


def false_tracks(found: Trajectories, truth: Trajectories, gate_m: float) -> dict[str, Any]:
    """Tracks that are mostly away from all drones, by the gate or more, and the time that tracks are away, seconds."""
    tracked = found.status == Status.TRACKED
    index = np.searchsorted(truth.frame, found.frame)
    seen = np.isin(found.frame, truth.frame)
    apart_m = found.position_m[seen][:, :, None] - truth.position_m[index[seen]][:, None]
    distance_m = np.nan_to_num(np.linalg.norm(apart_m, axis=-1), nan=np.inf).min(axis=-1)
    # The dataset's reference begins at frame 1: no distance is known before.
    false = (distance_m > gate_m) & np.isfinite(distance_m) & tracked[seen]
    mostly = false.sum(axis=0) > 0.5 * np.maximum(tracked[seen].sum(axis=0), 1)
    return {
        "false_tracks": int(mostly.sum()),
        "false_s": float(false.sum() * np.median(np.diff(found.time_s))),
    }


def compared(table: pd.DataFrame, before: pd.DataFrame) -> pd.DataFrame:
    """The rows beside those of another table, with the reasons why a row is worse."""
    keys = ["flight", "method"]
    columns = ["mean_mm", "centred_mm", *FIGURES, "false_tracks"]
    both = table.merge(before, on=keys, suffixes=("", "_before"))
    worse = {
        "mean error": both.mean_mm > WORST_RATIO * both.mean_mm_before,
        "centred error": both.centred_mm > WORST_RATIO * both.centred_mm_before,
        **{word: both[word] > both[f"{word}_before"] for word in ("missed", "switches", "false_tracks")},
    }
    both["worse"] = [
        ", ".join(word for word, rows in worse.items() if rows.iloc[index]) for index in range(len(both))
    ]
    shown = [f"{column}{side}" for column in columns for side in ("_before", "")]
    return both[[*keys, *shown, "worse"]]


def add_options(options: argparse.ArgumentParser) -> None:
    """Options of this study."""
    options.add_argument("--quick", action="store_true", help="one flight of each kind")
    words = {"nargs": "+", "metavar": "FLIGHT[:METHOD]", "default": [""]}
    options.add_argument("--only", **words, help="rows whose names begin so [default: all]")
    options.add_argument("--against", type=Path, metavar="FOLDER", help="compare with FOLDER/reference.csv")


def rows(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Name and function of each row."""
    for name, prepare in flights(options.data, options.real, options.quick):
        if not any(name.startswith(word.split(":")[0]) for word in options.only):
            continue
        flight = prepare()
        for method in flight.methods:
            if any(f"{name}:{method}".startswith(word) for word in options.only):
                yield f"{name}:{method}", partial(row, name, method, flight, options.data)


def show(table: pd.DataFrame, options: argparse.Namespace) -> None:
    """Print the table, and compare it with another one."""
    print(table.to_string(index=False, float_format="{:.3f}".format, na_rep="-"))
    if options.against is not None:
        both = compared(table, pd.read_csv(options.against / "reference.csv"))
        print(both.to_string(index=False, float_format="{:.3f}".format, na_rep="-"))
        if (both.worse != "").any():
            sys.exit(1)
