"""How often true positions lie in the 90 % ellipsoid: sound rigs, turned rigs, late clocks, labels whose noise lasts.

    python experiments/accuracy/covariances.py --data data
    python experiments/accuracy/covariances.py --data data --videos       # simulated videos as well, hours
    python experiments/accuracy/covariances.py --data data --quick        # few frames, two draws

Synthetic labels of drones on smooth paths before the rig of a simulated sequence, whose truth is known exactly, are
tracked by the projection lines.

With --videos, simulated sequences with perturbed rigs and clocks are also tracked from their videos. Their drones'
origins are not the middles of their silhouettes, so a drone's offset in the run of the sound rig is subtracted from the
errors of all runs (`inside_90_rate`), or each run's own offset (`offset_removed_inside_90_rate`). Their cameras are
late by 0 to half a frame. No residual shows what all cameras are late by, so the truth of these runs is late by a
quarter of a frame.

An error that lasts is one draw for a whole run: the mean over draws counts, not the share of one run.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import _runs
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.evaluation import evaluate
from psotrack.evaluation.consistency import consistency
from psotrack.foreground.silhouettes import Silhouettes
from psotrack.geometry import Rig, project
from psotrack.pipeline import track_runs
from psotrack.recordings import Recording
from psotrack.settings import TrackSettings
from psotrack.simulation import build, scenario
from psotrack.sweeps import Perturbation, perturb
from psotrack.tracking.camera_errors import views_of_places, with_camera_errors
from psotrack.tracking.lines import track_detections
from psotrack.tracking.matching import NOISE_PX, NOISE_SHARE, Sightings
from psotrack.trajectories import Status, Trajectories

SEQUENCES = ("S01_D2_A", "S02_D4_A")
#: Methods that are tracked from videos, and their settings.
METHODS: dict[str, dict[str, Any]] = {
    "swarm": {},
    "projection lines": {"method": "projection-lines", "detections": "blobs"},
    "fused": {"method": "fused", "detections": "blobs"},
}
#: Perturbations of sequences; the clocks are late by 0 to half a frame.
CASES: dict[str, dict[str, float]] = {
    "sound": {},
    "turned 0.1 degrees": {"extrinsics_deg": 0.1},
    "turned 0.3 degrees": {"extrinsics_deg": 0.3},
    "clocks half a frame off": {"clock_frames": 0.5},
}
#: Errors of synthetic labels: turn of the cameras, degrees; clocks off by at most, frames; standard deviation, pixels;
#: share of the variance that fades, and over how many frames.
LABELS = {
    "sound": (0.0, 0.0, 1.0, 0.0, 1),
    "turned 0.1 degrees": (0.1, 0.0, 1.0, 0.0, 1),
    "turned 0.3 degrees": (0.3, 0.0, 1.0, 0.0, 1),
    "clocks half a frame off": (0.0, 0.5, 1.0, 0.0, 1),
    "3 px, 70 % for 10 frames": (0.0, 0.0, 3.0, 0.7, 10),
    "3 px, 70 % for 25 frames": (0.0, 0.0, 3.0, 0.7, 25),
}
FPS = 25.0
NUM_LABELLED = 3
#: Subsets of the rig that see the synthetic labels.
RIGS = {8: None, 4: ["cam1", "cam3", "cam5", "cam7"], 3: ["cam1", "cam3", "cam5"], 2: ["cam1", "cam3"]}
#: Sequence whose rig sees the synthetic labels.
LABELLED = "S02_D4_A"


def offsets(estimate: Trajectories, truth: Trajectories) -> dict[str, list[float]]:
    """Each drone's mean error in its body, metres."""
    return {each.drone: list(each.offset_m or ()) for each in evaluate(estimate, truth).per_drone}


def without_offsets(truth: Trajectories, offset_m: dict[str, list[float]]) -> Trajectories:
    """The reference at the points that the tracks of the sound rig follow."""
    assert truth.orientation_wxyz is not None
    position_m = truth.position_m.copy()
    for drone, name in enumerate(truth.drones):
        turned = np.isfinite(truth.orientation_wxyz[:, drone]).all(axis=-1)
        rotation = Rotation.from_quat(truth.orientation_wxyz[turned, drone], scalar_first=True)
        position_m[turned, drone] += rotation.apply(offset_m[name])
    return replace(truth, position_m=position_m)


def tracked_sequences(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """The rows of the simulated sequences: a name, and a function that computes the row."""
    for sequence in SEQUENCES[-1:] if options.quick else SEQUENCES:
        recording, silhouettes = _runs.open_sequence(sequence, options.data)
        if options.frames is not None:
            recording, silhouettes = first_frames(recording, silhouettes, options.frames)
        assert recording.truth is not None
        for method in METHODS:
            sound = tracked(recording, silhouettes, method, Perturbation())
            truth = without_offsets(recording.truth, offsets(sound, recording.truth))
            for case, changes in CASES.items():
                for draw in range(options.draws if changes else 1):
                    perturbation = Perturbation(draw=draw, **changes)
                    shown = late(truth, perturbation.clock_frames / 2)
                    compute = partial(row, recording, silhouettes, method, perturbation, shown)
                    name = f"{sequence} {method} {case} {draw}"
                    yield (
                        name,
                        lambda named=(sequence, method, case, draw), compute=compute: {
                            **dict(zip(("sequence", "method", "case", "draw"), named, strict=True)),
                            **compute(),
                        },
                    )


def late(truth: Trajectories, frames: float) -> Trajectories:
    """The reference that is late by a share of a frame."""
    before_m = np.concatenate([truth.position_m[:1], truth.position_m[:-1]])
    return replace(truth, position_m=(1 - frames) * truth.position_m + frames * before_m)


def first_frames(
    recording: Recording, silhouettes: Silhouettes, num_frames: int
) -> tuple[Recording, Silhouettes]:
    """The first frames of a recording, and their silhouettes in memory."""
    arrays = tuple(np.asarray(array[:num_frames]) for array in silhouettes.arrays)
    return recording.usable(None, num_frames), replace(silhouettes, arrays=arrays, num_frames=num_frames)


def tracked(
    recording: Recording, silhouettes: Silhouettes, method: str, perturbation: Perturbation
) -> Trajectories:
    """The tracks of one method on a perturbed recording."""
    changed, its_silhouettes = perturb(recording, silhouettes, perturbation, None)
    (result,) = track_runs(changed, its_silhouettes, [TrackSettings().changed(METHODS[method])])
    if isinstance(result, Exception):
        raise result
    return result.trajectories


def row(
    recording: Recording,
    silhouettes: Silhouettes,
    method: str,
    perturbation: Perturbation,
    truth: Trajectories,
) -> dict[str, Any]:
    """Figures of one run against the reference at the tracked points."""
    estimate = tracked(recording, silhouettes, method, perturbation)
    figures = evaluate(estimate, truth).to_dict()
    kept = ("mean_error_m", "inside_90_rate", "mean_nees", "offset_removed_inside_90_rate", "missed_rate")
    assert estimate.covariance_m2 is not None
    return {key: figures[key] for key in kept} | {"std_m": mean_std_m(estimate.covariance_m2[estimate.seen])}


def mean_std_m(covariance_m2: Float[np.ndarray, "*points 3 3"]) -> float:
    """Root mean square of the stated distance errors, metres."""
    return float(np.sqrt(np.nanmean(np.trace(covariance_m2, axis1=-2, axis2=-1))))


def labelled(rig: Rig, case: str, seed: int, num_frames: int) -> dict[str, Any]:
    """Figures of the projection lines on synthetic labels."""
    turn_deg, late_frames, noise_px, share, fading_frames = LABELS[case]
    rng = np.random.default_rng(seed)
    truth_m, velocity_m_s = paths(rng, num_frames)
    late_s = rng.uniform(-late_frames, late_frames, len(rig)) / FPS
    shown_m = truth_m[:, :, None] - velocity_m_s[:, :, None] * late_s[:, None]
    centre_px, depth_m = project(rig.cameras, shown_m)
    centre_px += noise_px * correlated(rng, centre_px.shape, share, fading_frames)
    inside = ((centre_px > 0) & (centre_px < rig.cameras.image_size_wh)).all(axis=-1) & (depth_m > 0.1)
    side_px = 0.4 * rig.cameras.K[:, 0, 0] / depth_m
    arrays = (centre_px, np.repeat(side_px[..., None], 2, axis=-1), NOISE_PX + NOISE_SHARE * side_px)
    sightings = Sightings(
        *(
            np.where(inside.reshape(*inside.shape, *[1] * (each.ndim - 3)), each, np.nan).swapaxes(1, 2)
            for each in arrays
        )
    )
    stated = turned(rig, turn_deg, rng)
    settings = TrackSettings()
    tracks, places = track_detections(
        stated.cameras,
        sightings,
        settings,
        fps=FPS,
        bounds_m=np.array([[-4.0, -4.0, 0.0], [4.0, 4.0, 4.0]]),
    )
    found = (tracks.status == Status.TRACKED)[..., None]
    position_m = np.where(found, tracks.position_m, np.nan)
    views = views_of_places(stated.cameras, places.middle_px, places.weight, position_m, tracks.velocity_m_s)
    corrected, errors = with_camera_errors(tracks, views, settings.motion, settings.errors, FPS)
    partner = np.nanmedian(np.linalg.norm(position_m[:, :, None] - truth_m[:, None], axis=-1), axis=0).argmin(
        axis=1
    )
    error_m = position_m - truth_m[:, partner]
    covariance_m2 = corrected.covariance_m2 + errors.systematic.absolute_m2
    figures = consistency(error_m, error_m, covariance_m2)
    return {
        "sequence": f"{len(rig)} cameras",
        "method": "labels, projection lines",
        "case": case,
        "draw": seed,
        "mean_error_m": float(np.nanmean(np.linalg.norm(error_m, axis=-1))),
        "inside_90_rate": figures.inside_90_rate,
        "mean_nees": figures.mean_nees,
        "std_m": mean_std_m(covariance_m2[found[..., 0]]),
    }


def paths(
    rng: np.random.Generator, num_frames: int
) -> tuple[Float[np.ndarray, "frames drones 3"], Float[np.ndarray, "frames drones 3"]]:
    """Smooth paths in the middle of the room at about 1 m/s, and their velocities."""
    time_s = np.arange(num_frames)[:, None, None] / FPS
    path = np.zeros((num_frames, NUM_LABELLED, 3))
    for _ in range(3):
        rate, phase = rng.uniform(0.3, 1.5, path.shape[1:]), rng.uniform(0, 2 * np.pi, path.shape[1:])
        path += np.array([0.6, 0.6, 0.3]) * np.sin(rate * time_s + phase)
    return path + np.array([0.0, 0.0, 1.5]), np.gradient(path, 1 / FPS, axis=0)


def correlated(rng: np.random.Generator, shape: tuple[int, ...], share: float, frames: float) -> np.ndarray:
    """Errors of variance 1, a share of which fades exponentially over some frames, the rest white."""
    decay = np.exp(-1 / frames)
    fading = rng.normal(size=shape)
    for frame in range(1, shape[0]):
        fading[frame] = decay * fading[frame - 1] + np.sqrt(1 - decay**2) * fading[frame]
    return np.sqrt(share) * fading + np.sqrt(1 - share) * rng.normal(size=shape)


def turned(rig: Rig, angle_deg: float, rng: np.random.Generator) -> Rig:
    """The rig with each camera turned about its centre by an angle, about a random axis."""
    T_cam_world = rig.cameras.T_cam_world.copy()
    for camera in range(len(rig)):
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis))
        T_cam_world[camera, :3] = turn.as_matrix() @ T_cam_world[camera, :3]
    return replace(rig, cameras=replace(rig.cameras, T_cam_world=T_cam_world))


def labelled_rows(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """The rows of the synthetic labels: a name, and a function that computes the row."""
    rig = build(scenario(LABELLED)).rig
    for cameras, names in RIGS.items():
        chosen = rig if names is None else rig.select(names)
        for case in LABELS:
            for seed in range(2 if options.quick else options.label_draws):
                name = f"labels {cameras} {case} {seed}"
                yield name, partial(labelled, chosen, case, seed, options.frames or 100)


def main() -> None:
    """Track, evaluate, and print the mean shares."""
    parser = _runs.parser(__doc__)
    parser.add_argument("--frames", type=int, help="number of frames  [default: all; of labels 100]")
    parser.add_argument("--draws", type=int, default=4, help="perturbed rigs of each case")
    parser.add_argument("--label-draws", type=int, default=8, help="rigs of each case with synthetic labels")
    parser.add_argument("--videos", action="store_true", help="simulated videos as well")
    parser.add_argument("--quick", action="store_true", help="one sequence, 100 frames, two draws")
    options = parser.parse_args()
    if options.quick:
        options.frames, options.draws = options.frames or 100, min(options.draws, 2)
    run = _runs.start("covariances")

    def rows() -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
        yield from labelled_rows(options)
        if options.videos:
            yield from tracked_sequences(options)

    table = _runs.save_rows(run, rows(), options.data, options.out)
    means = table.drop(columns="draw").groupby(["method", "sequence", "case"], sort=False).mean()
    print(means.to_string(float_format="{:.3f}".format))


if __name__ == "__main__":
    main()
