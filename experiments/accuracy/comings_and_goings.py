"""Tracking of drones that come, leave, land, hover, and are visible to only two cameras.

    python experiments/accuracy/comings_and_goings.py --data data

Simulates `comings_and_goings.toml` if the sequence is missing, and tracks it twice without the number of drones: with
the background of the whole video, and with a background that adapts and absorbs drones that stand still for three
seconds. Writes one row per drone and phase of its flight (CSV), the record (JSON) and a figure (PNG), and prints the
table.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from psotrack.evaluation import evaluate
from psotrack.evaluation.consistency import consistency
from psotrack.foreground.silhouettes import SilhouetteSettings, compute
from psotrack.geometry import project, viewpoints
from psotrack.pipeline import track_runs
from psotrack.recordings import Recording
from psotrack.recordings.datasets import read_sequence
from psotrack.settings import TrackSettings
from psotrack.simulation import SimulationSettings, scenarios, simulate
from psotrack.support import atomic_write
from psotrack.trajectories import Status, Trajectories

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

SCENARIO = Path(__file__).with_suffix(".toml")
BACKGROUNDS = {
    "background of the whole video": SilhouetteSettings(),
    "background that is learned on": SilhouetteSettings(background="mog2", learning_rate=0.01),
}
#: A drone stands still if it is slower than this speed for at least this time, seconds.
STILL_M_S, STILL_S = 0.03, 3.0
#: Largest distance of a track from its drone, metres; a track that is farther from every drone is false.
GATE_M = 0.5
UNSEEN, BY_TWO, STILL, SEEN = "unseen", "seen by two", "still", "seen"
COLOURS = {Status.TRACKED: "tab:green", Status.COASTING: "tab:orange", Status.LOST: "tab:red"}


@dataclass(frozen=True)
class Phase:
    """Consecutive frames of one drone with one kind of visibility.

    Attributes:
        drone: index of the drone.
        word: kind of visibility: `UNSEEN`, `BY_TWO`, `STILL` or `SEEN`.
        first: first frame.
        end: frame after the last frame.
    """

    drone: int
    word: str
    first: int
    end: int


def open_sequence(data: Path) -> Recording:
    """Read the simulated sequence; make it if it is missing."""
    recipe = scenarios.load(SCENARIO)
    folder = data / "seed0" / "Simulated_Data" / recipe.name
    if not folder.exists():
        print(f"simulating {folder}", flush=True)
        simulate(recipe, folder.parents[1], SimulationSettings(masks=False, onboard=False))
    return read_sequence(folder).usable()


def views(recording: Recording, position_m: np.ndarray) -> np.ndarray:
    """(frames, drones), number of viewpoints whose images contain the drone's origin."""
    cameras = recording.rig.cameras
    pixels, depth = project(cameras, position_m[..., None, :])
    inside = ((pixels >= 0) & (pixels < cameras.image_size_wh)).all(axis=-1) & (depth > 0)
    of_viewpoint = viewpoints(cameras)
    return sum(inside[..., of_viewpoint == one].any(axis=-1).astype(int) for one in np.unique(of_viewpoint))


def phases(recording: Recording) -> list[Phase]:
    """Phases of all drones, from the first frame to the last."""
    position_m = _true_positions_m(recording)
    seen = views(recording, position_m)
    words = np.select([seen < 2, seen == 2, _still(position_m, recording.fps)], [UNSEEN, BY_TWO, STILL], SEEN)
    found = []
    for drone, of_drone in enumerate(words.T):
        ends = [*np.flatnonzero(of_drone[1:] != of_drone[:-1]) + 1, len(of_drone)]
        found += [
            Phase(drone, str(of_drone[first]), int(first), int(end))
            for first, end in zip([0, *ends[:-1]], ends, strict=True)
        ]
    return found


def _true_positions_m(recording: Recording) -> np.ndarray:
    """(frames, drones, 3), true positions, metres; frame 0, which the dataset lacks, gets the positions of frame 1."""
    position_m = recording.truth.position_m.copy()
    position_m[0] = position_m[1]
    return position_m


def _still(position_m: np.ndarray, fps: float) -> np.ndarray:
    """(frames, drones), whether a drone stands still, for at least `STILL_S`."""
    slow = np.linalg.norm(np.gradient(position_m, axis=0), axis=-1) * fps < STILL_M_S
    still = np.zeros_like(slow)
    for drone, of_drone in enumerate(slow.T):
        edges = np.flatnonzero(np.diff(of_drone, prepend=False, append=False))
        for first, end in edges.reshape(-1, 2):
            still[first:end, drone] = end - first >= STILL_S * fps
    return still


@dataclass(frozen=True)
class ComparedTracks:
    """Tracks of a run, compared with the true positions.

    Attributes:
        trajectories: the tracks.
        drone: (frames, tracks), index of the drone at the track; of the last drone where the status is not tracked; -1
            for none.
        tracked: (frames, tracks), whether the status is tracked.
        coasting: (frames, tracks), whether the status is coasting.
        residual_m: (frames, tracks, 3), offset from the drone without the median offset of the track, metres; NaN where
            the status is not tracked.
    """

    trajectories: Trajectories
    drone: np.ndarray
    tracked: np.ndarray
    coasting: np.ndarray
    residual_m: np.ndarray


def compare_tracks(trajectories: Trajectories, position_m: np.ndarray) -> ComparedTracks:
    """Compare tracks with the true positions (frames, drones, 3)."""
    status = trajectories.status
    apart_m = trajectories.position_m[:, :, None] - position_m[:, None]
    distance_m = np.nan_to_num(np.linalg.norm(apart_m, axis=-1), nan=np.inf)
    nearest = np.where(distance_m.min(axis=-1) < GATE_M, distance_m.argmin(axis=-1), -1)
    tracked = status == Status.TRACKED
    last = np.maximum.accumulate(np.where(tracked, np.arange(len(tracked))[:, None], -1), axis=0)
    drone = np.where(last >= 0, np.take_along_axis(nearest, np.maximum(last, 0), axis=0), -1)
    residual_m = np.take_along_axis(apart_m, np.maximum(drone, 0)[..., None, None], axis=2)[:, :, 0]
    residual_m[~tracked | (drone < 0)] = np.nan
    for track in np.flatnonzero(np.isfinite(residual_m[..., 0]).any(axis=0)):
        residual_m[:, track] -= np.nanmedian(residual_m[:, track], axis=0)
    return ComparedTracks(trajectories, drone, tracked, status == Status.COASTING, residual_m)


def row(phase: Phase, run: ComparedTracks, fps: float) -> dict[str, Any]:
    """Row of the result for one phase."""
    frames = slice(phase.first, phase.end)
    at = run.drone[frames] == phase.drone
    tracks = at & run.tracked[frames]
    tracked, coasting = tracks.any(axis=1), (at & run.coasting[frames]).any(axis=1)
    residual_m = np.where(tracks[..., None], run.residual_m[frames], np.nan)
    covariance_m2 = run.trajectories.covariance_m2[frames]
    std_mm = 1e3 * np.sqrt(np.trace(covariance_m2, axis1=-2, axis2=-1))
    calibrated = consistency(residual_m, residual_m, covariance_m2)
    return {
        "drone": phase.drone + 1,
        "phase": phase.word,
        "from_s": phase.first / fps,
        "to_s": phase.end / fps,
        "tracks": "+".join(run.trajectories.drones[track] for track in np.flatnonzero(tracks.any(axis=0))),
        "tracked_after_s": float(tracked.argmax() / fps) if tracked.any() else np.nan,
        "tracked_share": float(tracked.mean()),
        "coasting_share": float((coasting & ~tracked).mean()),
        "double_share": float((tracks.sum(axis=1) > 1).mean()),
        "error_mm": 1e3 * _mean(np.linalg.norm(residual_m, axis=-1)[tracks]),
        "std_mm": _mean(std_mm[tracks]),
        "coasting_to_std_mm": max(std_mm[at & run.coasting[frames]].tolist(), default=np.nan),
        "inside_90": calibrated.inside_90_rate,
        "nees": calibrated.mean_nees,
    }


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else np.nan


def summary(recording: Recording, run: ComparedTracks) -> dict[str, Any]:
    """Figures of a whole run, over drones that at least two viewpoints see."""
    truth = recording.truth
    there = views(recording, truth.position_m)[..., None] >= 2
    evaluation = evaluate(
        run.trajectories, replace(truth, position_m=np.where(there, truth.position_m, np.nan))
    )
    false_tracks = run.tracked & (run.drone < 0)
    return {
        "tracks": run.trajectories.num_drones,
        "false_tracks_s": float(false_tracks.sum() / recording.fps),
        "id_switches": evaluation.id_switches,
        "missed_rate": evaluation.missed_rate,
        "mota": evaluation.mota,
        "idf1": evaluation.idf1,
        "hota": evaluation.hota,
        "offset_removed_mean_error_m": evaluation.offset_removed_mean_error_m,
        "offset_removed_inside_90_rate": evaluation.offset_removed_inside_90_rate,
        "offset_removed_mean_nees": evaluation.offset_removed_mean_nees,
    }


def draw(
    runs: dict[str, tuple[ComparedTracks, tuple[Any, ...]]], plan: list[Phase], fps: float, path: Path
) -> None:
    """Draw a row per drone: its phases as a grey line, and below it its tracks in the colours of their status.

    The number of a track stands where the track begins or begins again.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    widths = {UNSEEN: 0.0, BY_TWO: 1.5, STILL: 6.0, SEEN: 3.5}
    drones = 1 + max(phase.drone for phase in plan)
    figure = Figure(figsize=(10, 2.9 * len(runs)), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, (run, arrivals)) in zip(
        figure.subplots(len(runs), 1, sharex=True, squeeze=False)[:, 0], runs.items(), strict=True
    ):
        for phase in plan:
            axes.plot(
                [phase.first / fps, phase.end / fps],
                [phase.drone - 0.2] * 2,
                color="0.7",
                linewidth=widths[phase.word],
                solid_capstyle="butt",
            )
        rows = np.where(run.drone >= 0, run.drone, drones)
        for track, of_track in enumerate(rows.T):
            for status, colour in COLOURS.items():
                at = np.flatnonzero(run.trajectories.status[:, track] == status)
                at = at[np.isfinite(run.trajectories.position_m[at, track, 0])]
                size = 3 if status == Status.LOST else 9
                axes.scatter(at / fps, of_track[at] + 0.12, c=colour, s=size, marker="s", linewidths=0)
            begins = run.tracked[:, track] & ~np.roll(run.tracked[:, track], 1)
            begins[0] = run.tracked[0, track]
            for first in np.flatnonzero(begins).tolist():
                axes.annotate(
                    run.trajectories.drones[track],
                    (first / fps, of_track[first] + 0.12),
                    xytext=(-9, -3),
                    textcoords="offset points",
                    fontsize=8,
                )
        for arrival in arrivals:
            axes.plot(
                arrival["frame"] / fps,
                rows[arrival["frame"], arrival["drone"]] + 0.34,
                marker="^",
                color="tab:blue" if arrival["again"] else "black",
                markersize=6,
            )
        axes.set_yticks(range(drones + 1), [*(f"dron{drone + 1}" for drone in range(drones)), "no drone"])
        axes.set_ylim(drones + 0.6, -0.6)
        axes.set_title(name, fontsize=10)
        axes.grid(visible=True, axis="x", alpha=0.3)
    axes.set_xlabel("s")
    handles = [
        Line2D([], [], color=colour, linewidth=3, label=status.label) for status, colour in COLOURS.items()
    ]
    handles += [
        Line2D([], [], color="0.7", linewidth=width, label=f"drone is {word}")
        for word, width in widths.items()
        if width
    ]
    handles += [
        Line2D([], [], color=colour, marker="^", linewidth=0, label=label)
        for colour, label in (("black", "is new"), ("tab:blue", "is back"))
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110)


def main() -> None:
    """Track with both backgrounds, write and draw the result, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data"), help="the data's root folder")
    parser.add_argument(
        "--cache", type=Path, default=Path("data/silhouettes"), help="folder of the silhouettes"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("experiments/accuracy/results"), help="folder of results"
    )
    parser.add_argument("--picture", type=Path, default=Path("experiments/pictures/comings_and_goings.png"))
    parser.add_argument("--seed", type=int, default=0, help="seed of the swarm")
    options = parser.parse_args()
    started = _results.Run("comings_and_goings")

    recording = open_sequence(options.data)
    position_m, plan = _true_positions_m(recording), phases(recording)
    table, totals, runs = [], {}, {}
    for name, how in BACKGROUNDS.items():
        settings = TrackSettings(seed=options.seed, silhouettes=how)
        (tracked,) = track_runs(recording, compute(recording, how, cache=options.cache), [settings])
        run = compare_tracks(tracked.trajectories, position_m)
        runs[name] = run, tracked.record["arrivals"]
        table += [{"background": name, **row(phase, run, recording.fps)} for phase in plan]
        totals[name] = summary(recording, run)
    frame = pd.DataFrame(table)
    draw(runs, plan, recording.fps, options.picture)
    started.save(options.out, rows=frame, figures={"runs": totals}, files=[options.picture], decimals="%.4g")
    for name, part in frame.groupby("background", sort=False):
        print(f"\n{name}: {json.dumps(totals[name])}")
        print(
            part.drop(columns="background").to_string(index=False, float_format="{:.2f}".format, na_rep="-")
        )


if __name__ == "__main__":
    main()
