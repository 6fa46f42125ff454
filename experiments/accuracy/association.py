"""Detections without labels: psotrack's defaults beside Stone Soup's GNN and JPDA, each at its best of a grid.

    pip install '.[bench]'
    python experiments/accuracy/accuracy.py association --data data [--real real] [--seeds 20 21] [--quick]

Flights by a formula (`formula_flights`) and, where --real names a folder of public repositories, parts of real flights
(`bat_flights`). Of each flight psotrack is given the rig and the detections as files, with `psotrack track SEQ --method
projection-lines` and no further option. Stone Soup is given points in space (`stone_soup`), and the bounds and the
speed that psotrack found; of all parameters of its grid the ones with the largest MOTA of this flight count.

Recall and precision are shares of pairs within a gate (0.5 m; 5 m where the reference is GPS), identity changes as in
CLEAR MOT. Frames without a reference do not count.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import stone_soup
from bat_flights import RealFlight, read_flight, write_recording
from formula_flights import FPS, SCENES, make_flight
from jaxtyping import Float
from reference import BATS

from psotrack.tracking.births import FlightVolume, flight_volume, moving_points
from psotrack.tracking.matching import Sightings, from_detections
from psotrack.trajectories import read_trajectories
from psotrack.trajectories.association import GATE_M, identity_switches, partners_per_frame

REAL_GATE_M = 5.0


def score(
    tracks_m: Float[np.ndarray, "frames tracks 3"],
    truth_m: Float[np.ndarray, "frames drones 3"],
    gate_m: float,
) -> dict[str, float]:
    """Recall, precision, identity changes and MOTA."""
    known = np.isfinite(truth_m).all(axis=-1)
    distance_m = np.linalg.norm(truth_m[:, :, None] - tracks_m[:, None], axis=-1)
    partner = partners_per_frame(distance_m * GATE_M / gate_m, keep=True)
    there = np.isfinite(tracks_m).all(axis=-1)
    matched = (partner >= 0).sum()
    # Of a drone whose place is unknown in a frame, one track in this frame may be right.
    spare = np.minimum((there.sum(axis=1) - (partner >= 0).sum(axis=1)).clip(0), (~known).sum(axis=1))
    found = there.sum() - spare.sum()
    changes = int(identity_switches(partner).sum())
    return {
        "recall": float(matched / known.sum()),
        "precision": float(matched / max(found, 1)),
        "id_changes": changes,
        "mota": float(1 - ((known.sum() - matched) + (found - matched) + changes) / known.sum()),
        "tracks": int(there.any(axis=0).sum()),
    }


def by_psotrack(flight: RealFlight, folder: Path) -> Float[np.ndarray, "frames tracks 3"]:
    """Tracks of the command with its defaults."""
    write_recording(flight, folder)
    words = ["track", str(folder), "--out", str(folder / "tracks.csv"), "--method", "projection-lines"]
    subprocess.run([sys.executable, "-m", "psotrack", *words, "--force", "--quiet"], check=True)
    found = read_trajectories(folder / "tracks.csv", fps=flight.fps)
    tracks_m = np.full((flight.truth.num_frames, found.num_drones, 3), np.nan)
    row = found.frame[found.frame < len(tracks_m)]
    tracks_m[row] = np.where(found.seen[..., None], found.position_m, np.nan)[: len(row)]
    return tracks_m


class StoneSoupInputs:
    """What Stone Soup is given of a flight: points in space, the bounds and the speed that psotrack found."""

    def __init__(self, flight: RealFlight) -> None:
        self.flight = flight

    @cached_property
    def sightings(self) -> Sightings:
        """All detections."""
        return from_detections(self.flight.detections, self.flight.rig, self.flight.truth.num_frames)

    @cached_property
    def volume(self) -> FlightVolume:
        """Bounds and speed limit."""
        moving = moving_points(self.flight.rig, self.sightings, self.flight.fps)
        return flight_volume(self.flight.rig, moving)

    @cached_property
    def points(self) -> dict[int | None, stone_soup.Points]:
        """Points by the smallest number of views; a rig of two cameras has one such number."""
        numbers: tuple[int | None, ...] = (2,) if len(self.flight.rig) == 2 else (None, 2)
        rig, bounds_m = self.flight.rig, self.volume.bounds_m
        return {views: stone_soup.points_of(rig, self.sightings, bounds_m, views) for views in numbers}


def by_stone_soup(
    inputs: StoneSoupInputs, associator: str, gate_m: float, quick: bool
) -> tuple[dict[str, float], stone_soup.Grid]:
    """The best figures of the grid, and the parameters that gave them."""
    speed_m_s = inputs.volume.max_speed_m_s / 3
    tried = []
    for how in stone_soup.grid(associator)[:: 4 if quick else 1]:
        if how.min_views in inputs.points:
            tracks_m = stone_soup.track(inputs.points[how.min_views], inputs.flight.fps, speed_m_s, how)
            tried.append((score(tracks_m, inputs.flight.truth.position_m, gate_m), how))
    return max(tried, key=lambda one: one[0]["mota"])


def rows_of(
    name: str, seed: int, flight: RealFlight, gate_m: float, data: Path, quick: bool
) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """One row per method."""
    inputs = StoneSoupInputs(flight)

    def row(method: str) -> dict[str, Any]:
        began = time.perf_counter()
        how = ""
        if method == "psotrack":
            folder = data / "association" / f"{name.replace(' ', '_').replace(',', '')}-{seed}"
            figures = score(by_psotrack(flight, folder), flight.truth.position_m, gate_m)
        else:
            figures, best = by_stone_soup(inputs, method, gate_m, quick)
            how = f"{best}"
        seconds = time.perf_counter() - began
        return {"flight": name, "seed": seed, "method": method, **figures, "seconds": seconds, "how": how}

    for method in ("psotrack", "GNN", "JPDA"):
        yield f"{name} {seed} {method}", lambda method=method: row(method)


def add_options(options: argparse.ArgumentParser) -> None:
    """Options of this study."""
    options.add_argument("--seeds", type=int, nargs="+", default=[20, 21, 22], help="seeds of the flights")
    options.add_argument(
        "--scenes", nargs="+", default=[""], help="words that are in the names of the scenes"
    )
    options.add_argument("--quick", action="store_true", help="one short flight, and a quarter of the grid")


def rows(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Name and function of each row."""
    names = [name for name in SCENES if any(word in name for word in options.scenes)]
    for seed in options.seeds[: 1 if options.quick else None]:
        for name in names[: 1 if options.quick else None]:
            made = make_flight(SCENES[name], 50 if options.quick else 250, seed)
            flight = RealFlight(made.rig, made.detections, made.truth, FPS)
            yield from rows_of(name, seed, flight, GATE_M, options.data, options.quick)
    for name, part in BATS.items() if options.real else ():
        flight = read_flight(options.real, *part)
        yield from rows_of(name, 0, flight, REAL_GATE_M, options.data, options.quick)


def show(table: pd.DataFrame, options: argparse.Namespace) -> None:
    """Print the means."""
    means = table.groupby(["flight", "method"], sort=False)[
        ["recall", "precision", "id_changes", "mota"]
    ].mean()
    print(means.to_string(float_format="{:.3f}".format))
