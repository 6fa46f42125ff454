"""Flights that other people recorded: psotrack's defaults beside a plain baseline of eighty lines.

    python experiments/accuracy/accuracy.py baseline --data data --real real

The flights of `real_flights`, by their detections. The baseline does what a laboratory writes on its own: it undistorts
the detections, matches those of two cameras whose lines of sight meet, triangulates them with all cameras that agree
(DLT), and links the nearest places of successive frames. It is given the gates, in pixels and m/s, with the largest
MOTA of a grid for each flight; psotrack is told nothing. The truth is GPS or RTK, which errs by half a metre and more:
pairs count within 5 m (bats' flights) or 10 m. Instants at which fewer than two cameras have a detection do not count.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import real_flights
from association import score
from jaxtyping import Float
from reference import psotrack
from scipy.optimize import linear_sum_assignment

from psotrack.geometry import Camera
from psotrack.pipeline.inputs import read_sightings
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings
from psotrack.tracking.matching import Sightings
from psotrack.trajectories import read_trajectories

#: Gates of the baseline: distance of a detection from the place's image, pixels, and speed, m/s.
GATES = tuple(itertools.product((5.0, 10.0, 20.0, 40.0), (10.0, 20.0)))
#: A track of the baseline ends after this time without a place, and is none with fewer places.
MOST_UNSEEN_S, LEAST_PLACES = 1.0, 5
#: Errors in time that are tried between the clocks of the truth and of the cameras, seconds.
OFFSETS_S = np.arange(-1.0, 1.01, 0.05)

_Pixels = list[Float[np.ndarray, "boxes 2"]]
_Places = list[Float[np.ndarray, "3"]]


class Baseline:
    """Places of detections, and tracks of places.

    Args:
        P: (cameras, 3, 4), projections onto images without distortion.
        gate_px: largest distance of a detection from the image of its place.
        speed_m_s: largest speed.
        fps: instants per second.
    """

    def __init__(
        self, P: Float[np.ndarray, "cameras 3 4"], gate_px: float, speed_m_s: float, fps: float
    ) -> None:
        self._P, self._gate_px, self._speed_m_s, self._fps = P, gate_px, speed_m_s, fps

    def track(self, instants: list[_Pixels]) -> Float[np.ndarray, "instants tracks 3"]:
        """Positions, NaN where a track has none; links the nearest places, of all tracks together."""
        tracks: list[dict[int, np.ndarray]] = []
        for instant, pixels in enumerate(instants):
            places = self._places(pixels)
            going = [one for one in tracks if instant - max(one) <= MOST_UNSEEN_S * self._fps]
            free = set(range(len(places)))
            if going and places:
                last_m = np.array([one[max(one)] for one in going])
                step_m = np.linalg.norm(last_m[:, None] - np.array(places), axis=-1)
                reach_m = [self._speed_m_s * (instant - max(one)) / self._fps for one in going]
                cost = np.where(step_m <= np.array(reach_m)[:, None], step_m, 1e6)
                for row, column in zip(*linear_sum_assignment(cost), strict=True):
                    if cost[row, column] < 1e6:
                        going[row][instant] = places[column]
                        free.remove(column)
            tracks += [{instant: places[column]} for column in free]
        kept = [one for one in tracks if len(one) >= LEAST_PLACES]
        found_m = np.full((len(instants), len(kept), 3), np.nan)
        for number, one in enumerate(kept):
            found_m[list(one), number] = list(one.values())
        return found_m

    def _places(self, pixels: _Pixels) -> _Places:
        """Those that most detections agree on first; a detection belongs to one place."""
        found: list[tuple[int, float, dict[int, int]]] = []
        for first, second in itertools.combinations(range(len(pixels)), 2):
            for pair in itertools.product(range(len(pixels[first])), range(len(pixels[second]))):
                chosen = dict(zip((first, second), pair, strict=True))
                off_px = self._errors_px(pixels, self._triangulated(pixels, chosen))
                agreeing = {
                    camera: int(off.argmin())
                    for camera, off in enumerate(off_px)
                    if off.min(initial=np.inf) < self._gate_px
                }
                error_px = sum(off_px[camera][box] for camera, box in agreeing.items())
                if chosen.items() <= agreeing.items():
                    found.append((-len(agreeing), float(error_px), agreeing))
        places: _Places = []
        taken: set[tuple[int, int]] = set()
        for _, _, agreeing in sorted(found, key=lambda one: one[:2]):
            if not taken & set(agreeing.items()):
                taken |= set(agreeing.items())
                places.append(self._triangulated(pixels, agreeing))
        return places

    def _errors_px(self, pixels: _Pixels, place_m: Float[np.ndarray, "3"]) -> list[np.ndarray]:
        """Distances of each camera's detections from the image of a place; infinite behind the camera."""
        image = self._P @ np.append(place_m, 1.0)
        image_px = np.where(image[:, 2:] > 0, image[:, :2] / image[:, 2:], np.inf)
        return [np.linalg.norm(each - centre, axis=-1) for each, centre in zip(pixels, image_px, strict=True)]

    def _triangulated(self, pixels: _Pixels, chosen: dict[int, int]) -> Float[np.ndarray, "3"]:
        """The direct linear transformation (Hartley and Zisserman, section 12.2)."""
        rows = [
            pixels[camera][box][axis] * self._P[camera, 2] - self._P[camera, axis]
            for camera, box in chosen.items()
            for axis in (0, 1)
        ]
        x = np.linalg.svd(np.array(rows))[2][-1]
        return x[:3] / x[3]


def undistorted(sightings: Sightings, cameras: Camera) -> list[_Pixels]:
    """Middles of each camera's detections in each instant, in an image without distortion."""
    instants: list[_Pixels] = []
    lenses = [
        (np.asarray(K, float), np.asarray(dist, float))
        for K, dist in zip(cameras.K, cameras.dist, strict=True)
    ]
    for view in sightings.centre_px:
        seen = [np.asarray(pixels[np.isfinite(pixels).all(axis=-1)], float) for pixels in view]
        instants.append(
            [
                cv2.undistortPoints(pixels[:, None], K, dist, P=K)[:, 0] if len(pixels) else pixels
                for pixels, (K, dist) in zip(seen, lenses, strict=True)
            ]
        )
    return instants


def figures(
    tracks_m: Float[np.ndarray, "instants tracks 3"],
    time_s: Float[np.ndarray, "instants"],
    folder: Path,
    counts: Float[np.ndarray, "instants"],
    gate_m: float,
) -> dict[str, float]:
    """Figures of one method, with the offset in time at which its errors are smallest."""
    truth = pd.read_csv(folder / "truth.csv").dropna(subset=["x_m"])
    known_s, known_m = truth.time_s.to_numpy(), truth[["x_m", "y_m", "z_m"]].to_numpy()

    def compared(offset_s: float) -> tuple[np.ndarray, np.ndarray]:
        at_s = time_s + offset_s
        truth_m = np.stack([np.interp(at_s, known_s, axis) for axis in known_m.T], axis=-1)
        truth_m[(at_s < known_s[0]) | (at_s > known_s[-1]) | ~counts] = np.nan
        distance_m = np.linalg.norm(tracks_m - truth_m[:, None], axis=-1)
        return truth_m, distance_m[distance_m < gate_m]

    def usual_m(offset_s: float) -> float:
        near_m = compared(offset_s)[1]
        return float(np.median(near_m)) if near_m.size else np.inf

    truth_m, near_m = compared(min(OFFSETS_S, key=usual_m))
    errors = {"median_m": float(np.median(near_m)), "p90_m": float(np.percentile(near_m, 90))}
    return score(tracks_m, truth_m[:, None], gate_m) | errors


def row(folder: Path, method: str, num_frames: int, gate_m: float) -> dict[str, Any]:
    """Figures of a method on one flight."""
    recording = open_recording(folder).usable(None, num_frames, videos=False)
    sightings, _ = read_sightings(recording, None, TrackSettings().detections)
    instants = undistorted(sightings, recording.rig.cameras)
    time_s = recording.timeline().time_s
    counts = np.array([sum(len(pixels) > 0 for pixels in view) >= 2 for view in instants])

    def judged(tracks_m: np.ndarray, how: str = "") -> dict[str, Any]:
        found = figures(tracks_m, time_s, folder, counts, gate_m)
        return {"flight": folder.name, "method": method, **found, "how": how}

    if method == "psotrack":
        words = ("--method", "projection-lines", "--frames", f"{num_frames}", "--force", "--quiet")
        refused = psotrack("track", str(folder), "--out", str(folder / "tracks.csv"), *words)
        assert not refused, refused
        found = read_trajectories(folder / "tracks.csv", fps=recording.fps)
        tracks_m = np.full((len(time_s), found.num_drones, 3), np.nan)
        tracks_m[found.frame] = np.where(found.seen[..., None], found.position_m, np.nan)
        return judged(tracks_m)
    cameras = recording.rig.cameras
    P = np.asarray(cameras.K, float) @ np.asarray(cameras.T_cam_world, float)[:, :3]
    tried = [
        judged(Baseline(P, *gates, recording.fps).track(instants), "{:g} px, {:g} m/s".format(*gates))
        for gates in GATES
    ]
    return max(tried, key=lambda one: one["mota"])


def add_options(options: argparse.ArgumentParser) -> None:
    """This study has no options of its own."""


def rows(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Name and function of each row."""
    for folder, num_frames, gate_m in real_flights.recordings(options.data, options.real):
        for method in ("psotrack", "baseline"):
            yield f"{folder.name} {method}", partial(row, folder, method, num_frames, gate_m)


def show(table: pd.DataFrame, options: argparse.Namespace) -> None:
    """Print the table."""
    print(table.to_string(index=False, float_format="{:.3f}".format))
