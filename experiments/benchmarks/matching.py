"""Time of matching detections over cameras in a simulated room; detections have noise, and some are missed or false.

Runs in one process. To use one core, set OMP_NUM_THREADS=1 and OPENBLAS_NUM_THREADS=1. Options: `matching.py --help`.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import click
import numpy as np
from jaxtyping import Float

from psotrack.geometry import Rig, look_at, make_camera, make_rig, project
from psotrack.tracking.matching import Matches, match

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

#: Corners of the room, and smallest distance of a drone from the walls, metres.
_BOUNDS_M, _MARGIN_M = np.array([[-5.0, -4.0, 0.0], [5.0, 4.0, 4.0]]), 0.5
_SIZE_WH, _FOCAL_PX = (1920, 1080), 1000.0
#: Smallest distance of two drones, and largest error of a found drone, metres.
_LEAST_APART_M, _FOUND_M = 0.5, 0.1


@click.command(context_settings={"show_default": True})
@click.option("--drones", default=10, type=click.IntRange(1), help="Drones in the room.")
@click.option("--cameras", default=8, type=click.IntRange(3), help="Cameras on the walls.")
@click.option(
    "--detections",
    default=12,
    type=click.IntRange(1),
    help="Detections per camera, false detections included.",
)
@click.option("--noise", "noise_px", default=2.0, help="Standard deviation of a detection, pixels.")
@click.option(
    "--missed", default=0.1, type=click.FloatRange(0, 1), help="Share of drones that a camera misses."
)
@click.option("--frames", default=100, type=click.IntRange(1), help="Number of scenes.")
@click.option(
    "--repeats", default=5, type=click.IntRange(1), help="Timings of every scene; the smallest counts."
)
@click.option("--seed", default=0, help="Seed of the scenes.")
@click.option(
    "--results", type=click.Path(path_type=Path), help="Write the result and its record into this folder."
)
def main(  # noqa: PLR0913  # A click command has one parameter per option.
    drones: int,
    cameras: int,
    detections: int,
    noise_px: float,
    missed: float,
    frames: int,
    repeats: int,
    seed: int,
    results: Path | None,
) -> None:
    """Time matching without predictions; print milliseconds per frame and the share of drones that were found."""
    run = _results.Run("matching")
    rig = _rig(cameras)
    rng = np.random.default_rng(seed)
    least_ms, found, false, error_m = [], 0, 0, []
    for _ in range(frames):
        truth = _draw_positions_m(drones, rng)
        points = _detections(rig, truth, detections, noise_px, missed, rng)
        noise = np.full(points.shape[:2], noise_px)
        times, matches = zip(*(_timed(rig, points, noise) for _ in range(repeats)), strict=True)
        least_ms.append(1e3 * min(times))
        distance = np.linalg.norm(matches[0].position_m[:, None] - truth, axis=-1)
        there = distance.min(axis=0, initial=np.inf) < _FOUND_M
        found += int(there.sum())
        false += len(distance) - int(there.sum())
        error_m += distance.min(axis=0, initial=np.inf)[there].tolist()
    click.echo(f"{drones} drones, {cameras} cameras, {detections} detections each, noise {noise_px:g} px")
    click.echo(
        f"ms per frame: median {np.median(least_ms):.2f}, mean {np.mean(least_ms):.2f}, "
        f"most {np.max(least_ms):.2f}"
    )
    click.echo(
        f"found {found / (frames * drones):.4f} within {_FOUND_M:g} m, false {false / frames:.3f} per frame, "
        f"mean error {1e3 * np.mean(error_m):.1f} mm"
    )
    if results is not None:
        figures = {"drones": drones, "cameras": cameras, "detections": detections, "noise_px": noise_px}
        figures |= {"median_ms": float(np.median(least_ms)), "max_ms": float(np.max(least_ms))}
        figures |= {"found_rate": found / (frames * drones), "mean_error_m": float(np.mean(error_m))}
        run.save(results, figures=figures)


def _timed(
    rig: Rig,
    points: Float[np.ndarray, "cameras detections 2"],
    noise: Float[np.ndarray, "cameras detections"],
) -> tuple[float, Matches]:
    start = time.perf_counter()
    matches = match(rig.cameras, points, noise, bounds_m=_BOUNDS_M)
    return time.perf_counter() - start, matches


def _rig(count: int) -> Rig:
    """Cameras on an ellipse through the corners of the room, each a little higher than the camera before."""
    cameras = {}
    for i in range(count):
        angle = 2 * np.pi * (i + 0.5) / count
        R, t_m = look_at((7 * np.cos(angle), 6 * np.sin(angle), 2.5 + 0.2 * i), (0.0, 0.0, 1.8))
        K = np.array([[_FOCAL_PX, 0, 959.5], [0, _FOCAL_PX, 539.5], [0, 0, 1]])
        cameras[f"c{i}"] = make_camera(
            R=R, t_m=t_m, K=K, image_size_wh=_SIZE_WH, dist=(-0.1, 0.02, 5e-4, -3e-4, 0.0)
        )
    return make_rig(cameras)


def _draw_positions_m(count: int, rng: np.random.Generator) -> Float[np.ndarray, "drones 3"]:
    points = np.empty((0, 3))
    while len(points) < count:
        point = rng.uniform(_BOUNDS_M[0] + _MARGIN_M, _BOUNDS_M[1] - _MARGIN_M)
        if np.linalg.norm(points - point, axis=-1).min(initial=np.inf) > _LEAST_APART_M:
            points = np.vstack([points, point])
    return points


def _detections(
    rig: Rig,
    drones: Float[np.ndarray, "drones 3"],
    count: int,
    noise_px: float,
    missed: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "cameras count 2"]:
    """(cameras, count, 2): drones that are not missed, also outside the image, and false detections."""
    points = []
    for pixels in project(rig.cameras, drones[:, None])[0].swapaxes(0, 1):
        seen = pixels[rng.random(len(drones)) >= missed][:count]
        false = rng.uniform((0, 0), _SIZE_WH, (count - len(seen), 2))
        points.append(rng.permutation(np.vstack([seen + noise_px * rng.standard_normal(seen.shape), false])))
    return np.stack(points)


if __name__ == "__main__":
    main()
