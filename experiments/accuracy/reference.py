"""The reference table: today's defaults on the flights against which every change of the tracker is judged.

    python experiments/accuracy/reference.py --data data --real real                   # makes the table
    python experiments/accuracy/reference.py --data data --real real --out after --against experiments/accuracy/results
    python experiments/accuracy/reference.py --data data --only S02_D4_A "bats 1:lines"    # some rows only

Flights: three of each of three simulated sequences, three in restless surroundings, one whose drones come and go, and,
where --real names a folder of public repositories (OWNER/NAME), recordings that other people made. Methods: the swarm,
projection lines on blobs and on detections, and both fused, each with its defaults. The same command continues an
interrupted run. With --against, each row is compared with the row of another table: a mean error more than 3 % larger,
a switch, a missed drone or a false track more is marked, and the exit code is 1.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import _runs
import numpy as np
import pandas as pd
from bat_flights import read_flight, write_recording
from comings_and_goings import open_sequence
from restless import false_tracks, made

from psotrack.evaluation import evaluate
from psotrack.recordings.datasets import open_recording
from psotrack.trajectories import Status, Trajectories, read_trajectories

METHODS: dict[str, tuple[str, ...]] = {
    "swarm": (),
    "lines on blobs": ("--method", "projection-lines", "--detections", "blobs"),
    "lines on detections": ("--method", "projection-lines"),
    "fused": ("--method", "fused"),
}
WITHOUT_DETECTIONS = ("swarm", "lines on blobs")
SEEDS = (0, 1, 2)
SEQUENCES = ("S01_D2_A", "S02_D4_A", "S04_D10")
#: Parts of the published flights of bats: name, first frame, number of frames; and the errors of GPS, metres.
BATS = {
    "bats 1": ("Turbine2_Setup5_2022-06-25_21-03", 3000, 450),
    "bats 2": ("Turbine2_Setup6_2022-06-26_20-46", 2000, 450),
    "bats 3": ("Turbine2_Setup4_2022-06-23_21-41", 2000, 450),
}
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


def flights(data: Path, real: Path | None) -> Iterator[tuple[str, partial[Flight]]]:
    """Name of each flight, and the function that makes the flight ready."""
    for name in SEQUENCES:
        for seed in SEEDS:
            yield f"{name} {seed}", partial(_simulated, name, data, seed)
    for seed in (1, 2, 3):
        yield f"restless {seed}", partial(_restless, data, seed)
    yield "comings and goings", partial(_comings, data)
    if real is not None:
        for name in BATS:
            yield name, partial(_bats, name, data, real)
        yield "hand", partial(_hand, data, real)
        yield "mouse", partial(_mouse, data, real)


def _simulated(name: str, data: Path, seed: int) -> Flight:
    return Flight(_runs.simulated(name, data, seed), seed=seed)


def _restless(data: Path, seed: int) -> Flight:
    return Flight(made(data, "restless", seed))


def _comings(data: Path) -> Flight:
    return Flight(open_sequence(data).folder)


def _bats(name: str, data: Path, real: Path) -> Flight:
    flight, folder = read_flight(real, *BATS[name]), data / "reference" / name.replace(" ", "_")
    write_recording(flight, folder)
    return Flight(folder, ("lines on detections",), truth=flight.truth, gate_m=GPS_GATE_M)


def _hand(data: Path, real: Path) -> Flight:
    """Two cameras about a hand, of TemugeB/handpose3d; lengths are in an arbitrary unit, taken for centimetres."""
    source, folder = real / "TemugeB/handpose3d", data / "reference/hand"
    videos = {f"cam{number}": source / f"media/cam{number}_test.mp4" for number in range(2)}
    words = ("--units", "cm", "--size", "720,720")
    return Flight(_copied(folder, source / "camera_parameters/c0.dat", videos, words), WITHOUT_DETECTIONS)


def _mouse(data: Path, real: Path) -> Flight:
    """Three cameras about a mouse, of talmolab/sleap-anipose; the pose of the fourth is a copy of another one."""
    source = real / "talmolab/sleap-anipose/tests/data/minimal_session"
    folder = data / "reference/mouse"
    videos = {name: source / name / f"minimal_{name}.mp4" for name in ("back", "mid", "top")}
    return Flight(_copied(folder, source / "calibration.toml", videos, ("--units", "mm")), WITHOUT_DETECTIONS)


def _copied(folder: Path, calibration: Path, videos: dict[str, Path], words: tuple[str, ...]) -> Path:
    """A folder with a recording of these videos and this calibration."""
    if not (folder / "recording.toml").exists():
        folder.mkdir(parents=True, exist_ok=True)
        for name, video in videos.items():
            shutil.copy(video, folder / f"{name}{video.suffix}")
        psotrack("calibrate", "convert", str(calibration), str(folder / "rig.toml"), *words, "--force")
        psotrack("init", str(folder), "--calibration", str(folder / "rig.toml"))
    return folder


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
    where = ("--out", str(tracks), "--cache", str(_runs.cache_folder(data)), "--seed", str(flight.seed))
    refused = psotrack("track", str(flight.sequence), *METHODS[method], *where, "--force")
    if refused:
        note = refused.replace(str(flight.sequence), name)
        return {"flight": name, "method": method, "tracks": 0, "missed": 1.0, "note": note}
    record = json.loads(tracks.with_suffix(".json").read_text())
    found = read_trajectories(tracks)
    truth = open_recording(flight.sequence).truth if flight.truth is None else flight.truth
    there = {"flight": name, "method": method, "tracks": found.num_drones, **_presence(found)}
    figures = {} if truth is None else _figures(found, truth, flight.gate_m)
    seconds = {f"{stage}_s": record["seconds"].get(stage) for stage in STAGES}
    return there | figures | seconds


def _presence(found: Trajectories) -> dict[str, float]:
    """What can be said without a reference: tracked frames per frame, and the mean score where tracked."""
    tracked = found.status == Status.TRACKED
    fitness = found.fitness[tracked] if found.fitness is not None and tracked.any() else np.array([np.nan])
    return {"tracked_per_frame": float(tracked.sum() / len(tracked)), "fitness": float(np.nanmean(fitness))}


def _figures(found: Trajectories, truth: Trajectories, gate_m: float) -> dict[str, Any]:
    errors = evaluate(found, truth).to_dict()
    mean_m, centred_m = errors["mean_error_m"], errors["offset_removed_mean_error_m"]
    return {
        "mean_mm": None if mean_m is None else 1e3 * mean_m,
        "centred_mm": None if centred_m is None else 1e3 * centred_m,
        **{column: errors[key] for column, key in FIGURES.items()},
        **false_tracks(found, truth, gate_m),
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


def main() -> None:
    """Track all flights by all methods, write the table, and compare it."""
    parser = _runs.parser(__doc__)
    parser.add_argument("--real", type=Path, help="folder of the real recordings, as OWNER/NAME")
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="FLIGHT[:METHOD]",
        default=[""],
        help="rows whose names begin so [default: all]",
    )
    parser.add_argument("--against", type=Path, metavar="FOLDER", help="compare with FOLDER/reference.csv")
    options = parser.parse_args()
    run = _runs.start("reference")
    rows = (
        (f"{name}:{method}", partial(row, name, method, flight, options.data))
        for name, prepare in flights(options.data, options.real)
        if any(name.startswith(word.split(":")[0]) for word in options.only)
        for flight in [prepare()]
        for method in flight.methods
        if any(f"{name}:{method}".startswith(word) for word in options.only)
    )
    table = _runs.save_rows(run, rows, options.data, options.out)
    if table.empty:
        parser.error(f"--only: expected names of rows, such as 'S01_D2_A 0:swarm', found {options.only}")
    print(table.to_string(index=False, float_format="{:.3f}".format, na_rep="-"))
    if options.against is not None:
        both = compared(table, pd.read_csv(options.against / "reference.csv"))
        print(both.to_string(index=False, float_format="{:.3f}".format, na_rep="-"))
        if (both.worse != "").any():
            sys.exit(1)


if __name__ == "__main__":
    main()
