"""The demonstration: a short S02_D4_A from nothing to a table of errors and a picture."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from psotrack.evaluation import evaluate, tables
from psotrack.foreground.silhouettes import SilhouetteSettings
from psotrack.pipeline import track_recording, with_real_time
from psotrack.recordings.datasets import read_sequence
from psotrack.settings import TrackSettings
from psotrack.show.flights import flight_of, record_files, write_tracked
from psotrack.show.overlay import save_picture
from psotrack.simulation import SimulationSettings, simulate
from psotrack.support import Report, atomic_write, no_progress, refuse_files

if TYPE_CHECKING:
    from rich.table import Table

#: Small enough for a laptop to do all in a minute, long enough for paths to be seen.
NAME, NUM_FRAMES, SCALE = "S02_D4_A", 75, 0.5
#: Half the image size needs half the reduction, so that drones have the same number of silhouette pixels.
SILHOUETTES = SilhouetteSettings(reduction=2, working_reduction=1)


@dataclass(frozen=True)
class Demo:
    """What the demonstration shows: tables for the terminal, and where the files are."""

    errors: Table
    stages: Table
    picture: Path
    tracks: Path
    sequence: Path


def run(
    out: Path, *, seed: int = 0, jobs: int | None = None, force: bool = False, report: Report = no_progress
) -> Demo:
    """Simulate, track, evaluate; all files go to `out`.

    After an interruption, the next call keeps the simulated sequence and the silhouettes.

    Raises:
        OutputError: there are results in `out`, or a sequence with another seed, and `force` is not set.
    """
    tracks, picture = out / "tracks.csv", out / "demo.png"
    refuse_files(tracks, *record_files(tracks), picture, force=force)
    began = time.perf_counter()
    folder = simulate(
        NAME,
        out,
        SimulationSettings(NUM_FRAMES, SCALE, seed, masks=False, onboard=False),
        jobs=jobs,
        force=force,
        keep=not force,
        report=report,
    )
    simulated = time.perf_counter()
    recording = read_sequence(folder).usable()
    settings = TrackSettings(seed=seed, silhouettes=SILHOUETTES)
    tracked = track_recording(recording, settings, cache=out / "silhouettes", jobs=jobs, report=report)
    ended = time.perf_counter()
    assert recording.truth is not None, "the simulator writes one"
    evaluation = evaluate(tracked.trajectories, recording.truth)
    tracked = replace(tracked, record=with_real_time(tracked.record, ended - simulated))
    with atomic_write(picture) as picture_file:
        save_picture(picture_file, flight_of(tracked, recording))
        write_tracked(tracks, tracked, folder, force=force)
    seconds = tracked.record["seconds"]
    stages = {
        "simulate": simulated - began,
        "silhouettes": seconds["total"] - sum(seconds[stage] for stage in ("track", "compile", "finish")),
        "compile": seconds["compile"],
        "track": seconds["track"] + seconds["finish"],
        "evaluate, draw": time.perf_counter() - ended,
        "all": time.perf_counter() - began,
    }
    return Demo(
        tables.render(evaluation, title=recording.name), _stage_table(stages), picture, tracks, folder
    )


def _stage_table(seconds: dict[str, float]) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(title="seconds", box=box.SIMPLE_HEAD, title_justify="left")
    for stage in seconds:
        table.add_column(stage, justify="right")
    table.add_row(*(f"{value:.1f}" for value in seconds.values()))
    return table
