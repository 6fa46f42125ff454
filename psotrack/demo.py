"""The demonstration: a short S02_D4_A from nothing to a table of errors and a picture."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from psotrack.evaluation import evaluate, plots, tables
from psotrack.foreground.silhouettes import SilhouetteSettings
from psotrack.geometry import make_extents, project_boxes
from psotrack.pipeline import TrackedRecording, track_recording
from psotrack.recordings import Recording, read_frames
from psotrack.recordings.datasets import read_sequence
from psotrack.settings import TrackSettings
from psotrack.simulation import SimulationSettings, simulate
from psotrack.support import Report, atomic_write, atomic_write_all, no_progress, refuse_to_overwrite
from psotrack.tracking.swarm import on_device
from psotrack.trajectories import write_trajectories

if TYPE_CHECKING:
    from rich.table import Table

#: Small enough for a laptop to do all in a minute, long enough for paths to be seen.
NAME, NUM_FRAMES, SCALE = "S02_D4_A", 75, 0.5
#: Half the image size needs half the reduction, so that drones have the same number of silhouette pixels.
SILHOUETTES = SilhouetteSettings(reduction=2, working_reduction=1)
SHOWN_CAMERAS = 4


@dataclass(frozen=True)
class Demo:
    """What the demonstration shows: tables for the terminal, and where the picture is."""

    errors: Table
    stages: Table
    picture: Path


def run(
    out: Path, *, seed: int = 0, jobs: int | None = None, force: bool = False, report: Report = no_progress
) -> Demo:
    """Simulate, track, evaluate; all files go to `out`.

    After an interruption, the next call keeps the simulated sequence and the silhouettes.

    Raises:
        OutputError: there are results in `out`, or a sequence with another seed, and `force` is not set.
    """
    tracks, picture = out / "tracks.csv", out / "demo.png"
    for path in (tracks, picture):
        refuse_to_overwrite(path, force)
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
    with atomic_write_all(tracks, picture) as (tracks_file, picture_file):
        write_trajectories(tracks_file, tracked.trajectories)
        save_picture(picture_file, recording, tracked)
    seconds = tracked.record["seconds"]
    stages = {
        "simulate": simulated - began,
        "silhouettes": seconds["total"] - sum(seconds[stage] for stage in ("track", "compile", "finish")),
        "compile": seconds["compile"],
        "track": seconds["track"] + seconds["finish"],
        "evaluate, draw": time.perf_counter() - ended,
        "all": time.perf_counter() - began,
    }
    return Demo(tables.render(evaluation, title=recording.name), _stage_table(stages), picture)


def save_picture(
    path: Path, recording: Recording, tracked: TrackedRecording, frame: int | None = None
) -> None:
    """Save frames of four cameras with the tracked boxes, beside the paths in 3D, as PNG.

    Args:
        path: path of the picture.
        recording: recording with a reference.
        tracked: what was tracked in it.
        frame: number of the shown frame; None takes the middle frame.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    frame = tracked.trajectories.num_frames // 2 if frame is None else frame
    assert recording.truth is not None
    xyxy_px = _boxes(recording, tracked, frame)
    colours = plots.colours_of_estimates(tracked.trajectories, recording.truth)
    figure = Figure(figsize=(16, 5.6))
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, left=0.005, right=0.55, bottom=0.01, top=0.95, wspace=0.03, hspace=0.12)
    for shown, name in enumerate(recording.rig.names[:SHOWN_CAMERAS]):
        axes = figure.add_subplot(grid[shown // 2, shown % 2])
        axes.imshow(_frame_of(recording, name, frame))
        for drone, colour in enumerate(colours):
            # Edges of pixels are half a pixel from their centres, which is what the axes count.
            x0, y0, x1, y1 = xyxy_px[drone, shown] - 0.5
            axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=colour, linewidth=1.6))
        axes.set_title(f"{name}, frame {frame}", fontsize=9)
        axes.set_axis_off()
    paths = figure.add_axes((0.56, 0.0, 0.42, 0.88), projection="3d")
    plots.draw_trajectories(paths, tracked.trajectories, recording.truth)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=120)


def _boxes(
    recording: Recording, tracked: TrackedRecording, frame: int
) -> Float[np.ndarray, "drones cameras 4"]:
    cameras = on_device(recording.rig.cameras)
    seen = make_extents(cameras, np.asarray(tracked.size_m, np.float32))
    position: Float[np.ndarray, "drones 3"] = tracked.trajectories.position_m[frame].astype(np.float32)
    return np.asarray(project_boxes(seen, position).xyxy)


def _frame_of(recording: Recording, camera: str, frame: int) -> UInt8[np.ndarray, "height width 3"]:
    for index, image in enumerate(read_frames(recording.videos[camera])):
        if index == frame:
            return image[:, :, ::-1]
    raise AssertionError("expected a frame of every camera, found fewer frames")


def _stage_table(seconds: dict[str, float]) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(title="seconds", box=box.SIMPLE_HEAD, title_justify="left")
    for stage in seconds:
        table.add_column(stage, justify="right")
    table.add_row(*(f"{value:.1f}" for value in seconds.values()))
    return table
