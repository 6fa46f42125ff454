"""The score around a drone's true position, for each of the five drone models, beside the paper's hard score.

    python experiments/accuracy/score_landscape.py --data data --out experiments/pictures

Simulates a short sequence with one drone of each model (half size, two seconds), makes its silhouettes as `psotrack
track` does, and draws score_landscape.png: three slices of 0.8 m through the true position, and a curve along x. Prints
the position and the width of the maximum, means over frames.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.optimize import linear_sum_assignment

from psotrack.foreground.silhouettes import SilhouetteSettings, compute
from psotrack.geometry import Camera, make_extents
from psotrack.recordings.datasets import read_sequence
from psotrack.settings import DroneSettings
from psotrack.simulation import Scenario, SimulationSettings, scenario, simulate
from psotrack.simulation.scenarios import Drone, Harmonic, Harmonics, Variation
from psotrack.simulation.world.drones import MODELS
from psotrack.tracking.births import first_drones, room_bounds
from psotrack.tracking.swarm import Score, SoftIoU, on_device
from psotrack.tracking.swarm.fitness import PAPER_SCORE, ScoreInputs, drone_fitness
from psotrack.tracking.swarm.patches import ExpectedDrones, Pyramid, cut, make_pyramid

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

NUM_FRAMES, SCALE = 50, 0.5
#: Cells of 2 x 2 pixels at half the image size show the same detail as cells of 4 x 4 pixels at full size.
SILHOUETTES = SilhouetteSettings(reduction=2)
SCORES = {
    "this score": SoftIoU(),
    "the paper's hard score": PAPER_SCORE,
}
#: Half side and step of a slice, and half side and step of the cube in which the maximum is searched, metres.
HALF_M, STEP_M, SOUGHT_M, FINE_M = 0.4, 0.01, 0.12, 0.005
#: Slices: axis to the right, and axis upwards.
SLICES = ((0, 1), (0, 2), (1, 2))
AXIS = "xyz"
COLOURS = {"this score": "#1a6fb5", "the paper's hard score": "#c2571a"}
INK = "#2b313a"


def recipe() -> Scenario:
    """Scenario with one drone of each model in the laboratory, side by side; each drone swings back and forth."""
    drones = []
    for index, name in enumerate(MODELS):
        swing = Harmonic(
            amplitude_m=(0.1, 0.7, 0.15), period_s=3.6, phase_deg=(0.0, 140.0 * index, 70.0 * index)
        )
        flight = Harmonics(centre_m=(1.05 * (index - 2), 0.0, 1.5), terms=(swing,))
        drones.append(Drone(flight=flight, model=name, yaw_deg=30.0 * index))
    still = Variation(phase_deg=0.0, centre_m=0.0, size=0.0, period=0.0, yaw_deg=0.0)
    base = scenario("S02_D4_A")
    return msgspec.structs.replace(
        base, name="score_landscape", num_frames=NUM_FRAMES, drones=tuple(drones), variation=still
    )


@dataclass(frozen=True)
class Data:
    """Data of the scores; drones are in the order of the models.

    Attributes:
        pyramid: silhouettes of all frames.
        cameras: the cameras.
        truth_m: (frames, drones, 3), true positions, metres.
        size_m: (drones, 3), sizes found in the first frames, metres.
    """

    pyramid: Pyramid
    cameras: Camera
    truth_m: np.ndarray
    size_m: np.ndarray


def load(root: Path) -> Data:
    """Read the sequence and compute its silhouettes and initial sizes; simulate the sequence if it is missing."""
    made = recipe()
    folder = root / "Simulated_Data" / made.name
    if not folder.exists():
        simulate(made, root, SimulationSettings(scale=SCALE, masks=False, onboard=False))
    sequence = read_sequence(folder).usable()
    coverage = compute(sequence, SILHOUETTES, cache=root / "silhouettes")
    images = coverage.read(0, coverage.num_frames)
    found = first_drones(
        sequence.rig,
        coverage,
        fps=sequence.fps,
        bounds_m=room_bounds(sequence.rig),
        max_speed_m_s=6.0,
        drones=DroneSettings(),
    )
    truth = sequence.truth.position_m
    first = truth[np.isfinite(truth).all(axis=(1, 2)).argmax()]
    distance = np.linalg.norm(first[:, None] - found.position_m, axis=-1)
    size_m = found.size_m[linear_sum_assignment(distance)[1]]
    return Data(make_pyramid(images), on_device(sequence.rig.cameras), truth, size_m)


@partial(jax.jit, static_argnames="score")
def scores(
    pyramid: Pyramid,
    cameras: Camera,
    size_m: jax.Array,
    about_m: jax.Array,
    offset_m: jax.Array,
    score: Score,
) -> jax.Array:
    """(places, drones), the score of every drone at its position plus each of the offsets (places, 3)."""
    seen = make_extents(cameras, size_m)
    drones = len(size_m)
    patches, _ = cut(
        pyramid,
        seen,
        ExpectedDrones(
            about_m,
            reach_m=jnp.full(drones, 2**0.5 * HALF_M),
            occluding=None if score.whole_pixels else jnp.ones(drones, bool),
        ),
        reduction=SILHOUETTES.reduction,
        ring=score.ring,
    )
    view = ScoreInputs(seen, patches, score)
    # In batches, because a slice has thousands of places and would not fit into memory.
    places = about_m + offset_m[:, None]
    return jnp.nan_to_num(
        jax.lax.map(lambda position_m: drone_fitness(view, position_m), places, batch_size=500)
    )


def score_about(data: Data, frame: int, offset_m: np.ndarray, score: Score) -> np.ndarray:
    """(..., drones), the score of a frame at the true positions plus offsets (..., 3)."""
    found = scores(
        jax.tree.map(lambda leaf: leaf[frame], data.pyramid),
        data.cameras,
        jnp.asarray(data.size_m, jnp.float32),
        jnp.asarray(data.truth_m[frame], jnp.float32),
        jnp.asarray(offset_m.reshape(-1, 3), jnp.float32),
        score,
    )
    return np.asarray(found).reshape(*offset_m.shape[:-1], -1)


def grid(half_m: float, step_m: float, axes: tuple[int, ...]) -> np.ndarray:
    """(n, ..., 3), offsets on a grid along the given axes; the offset along other axes is 0."""
    line = np.arange(-round(half_m / step_m), round(half_m / step_m) + 1) * step_m
    offset_m = np.zeros((*[len(line)] * len(axes), 3))
    for axis, values in zip(axes, np.meshgrid(*[line] * len(axes), indexing="ij"), strict=True):
        offset_m[..., axis] = values
    return offset_m


def widths_m(curve: np.ndarray, share: float) -> float:
    """Half of the length over which a curve is at least a share of its maximum."""
    return (curve >= share * curve.max()).sum() * STEP_M / 2


def summary(data: Data, frames: range) -> pd.DataFrame:
    """One row per model and score, means over frames."""
    cube = grid(SOUGHT_M, FINE_M, (0, 1, 2)).reshape(-1, 3)
    rows = []
    for label, score in SCORES.items():
        best = np.zeros((len(frames), len(MODELS), 3))
        half, top = np.zeros((2, len(frames), len(MODELS)))
        for row, frame in enumerate(frames):
            found = score_about(data, frame, cube, score)
            for drone in range(len(MODELS)):
                # Several places may have the best score: their mean counts.
                best[row, drone] = cube[found[:, drone] == found[:, drone].max()].mean(axis=0)
            for axis in range(3):
                curve = score_about(data, frame, grid(HALF_M, STEP_M, (axis,)), score)
                for drone in range(len(MODELS)):
                    half[row, drone] += widths_m(curve[:, drone], 0.5) / 3
                    top[row, drone] += widths_m(curve[:, drone], 0.98) / 3
        moved = best - np.median(best, axis=0)
        for drone, name in enumerate(MODELS):
            rows.append(
                {
                    "model": name,
                    "score": label,
                    "maximum to truth, mm": 1e3 * np.linalg.norm(best[:, drone], axis=-1).mean(),
                    "median offset out, mm": 1e3 * np.linalg.norm(moved[:, drone], axis=-1).mean(),
                    "half-width at 98 %, mm": 1e3 * top[:, drone].mean(),
                    "half-width at half height, mm": 1e3 * half[:, drone].mean(),
                }
            )
    return pd.DataFrame(rows).sort_values(
        "model", key=lambda names: names.map(list(MODELS).index), kind="stable"
    )


def draw(data: Data, frame: int) -> Figure:
    """Draw a row per model: slices of both scores, and curves of both along x."""
    count = len(SLICES)
    figure = Figure(figsize=(15.0, 10.4), layout="constrained")
    panels = figure.subplots(
        len(MODELS), 2 * count + 1, width_ratios=[1.0] * 2 * count + [1.5], squeeze=False
    )
    line_m = grid(HALF_M, STEP_M, (0,))
    for half, (label, score) in enumerate(SCORES.items()):
        images = [score_about(data, frame, grid(HALF_M, STEP_M, axes), score) for axes in SLICES]
        curve = score_about(data, frame, line_m, score)
        for drone in range(len(MODELS)):
            highest = max(image[..., drone].max() for image in images)
            for column, (axes, image) in enumerate(zip(SLICES, images, strict=True)):
                panel = panels[drone, count * half + column]
                draw_slice(panel, image[..., drone] / highest, axes)
                if drone == 0:
                    panel.set_title(f"{label}\n" if column == 1 else "\n", fontsize=12, color=COLOURS[label])
            panels[drone, -1].plot(line_m[:, 0], curve[:, drone], color=COLOURS[label], label=label)
    for drone, name in enumerate(MODELS):
        width, _, height = 100 * data.size_m[drone]
        panels[drone, 0].text(
            -0.37, 0.35, f"{name}\n{width:.0f} x {height:.0f} cm", color="white", fontsize=9, va="top"
        )
        axes = panels[drone, -1]
        axes.axvline(0, color=INK, linewidth=0.8)
        axes.set(xlim=(-HALF_M, HALF_M), ylim=(0, 0.6), xticks=(-0.4, -0.2, 0, 0.2, 0.4))
        axes.tick_params(labelsize=8, labelbottom=drone == len(MODELS) - 1)
        axes.grid(alpha=0.3)
    panels[0, -1].set_title("score along x", fontsize=12, color=INK)
    panels[0, -1].legend(fontsize=8, loc="upper right")
    panels[-1, -1].set_xlabel("x, m", fontsize=9)
    return figure


def draw_slice(panel: Axes, image: np.ndarray, axes: tuple[int, int]) -> None:
    """Draw one slice in shares of the highest score; a cross is the true position, a ring the slice's maximum."""
    edge = HALF_M + STEP_M / 2
    panel.imshow(image.T, origin="lower", extent=(-edge, edge, -edge, edge), vmin=0, vmax=1, cmap="viridis")
    line = np.linspace(-HALF_M, HALF_M, len(image))
    panel.contour(line, line, image.T, levels=(0.5, 0.9, 0.98), colors="white", linewidths=(0.6, 0.6, 0.9))
    best = np.argwhere(image == image.max()).mean(axis=0) * STEP_M - HALF_M
    panel.plot(0, 0, "+", color="white", markersize=10, markeredgewidth=1.2)
    panel.plot(*best, "o", color="none", markeredgecolor="#ff4d4d", markersize=8, markeredgewidth=1.5)
    panel.set(xticks=(-0.4, 0.4), yticks=(-0.4, 0.4))
    panel.tick_params(labelsize=7)
    panel.set_xlabel(f"{AXIS[axes[0]]}, m", fontsize=8, labelpad=-7)
    panel.set_ylabel(f"{AXIS[axes[1]]}, m", fontsize=8, labelpad=-14)


def main() -> None:
    """Simulate the sequence, draw the picture, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the sequence")
    parser.add_argument(
        "--out", type=Path, default=Path("experiments/pictures"), help="folder of the picture"
    )
    parser.add_argument(
        "--results", type=Path, default=Path(__file__).parent / "results", help="folder of the record"
    )
    options = parser.parse_args()
    run = _results.Run("score_landscape")
    data = load(options.data)
    path = options.out / "score_landscape.png"
    draw(data, NUM_FRAMES // 2).savefig(path, dpi=80)
    print(path)
    table = summary(data, range(5, NUM_FRAMES, 5))
    run.save(options.results, rows=table, files=[path])
    print(table.to_string(index=False, float_format="{:.0f}".format))


if __name__ == "__main__":
    main()
