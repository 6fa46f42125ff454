"""How often true positions lie in the 90 % ellipsoid: sound rigs, turned rigs, late clocks, labels whose noise lasts.

    python experiments/accuracy/accuracy.py covariances --draws 8

Synthetic labels of drones on smooth paths before the rig of a simulated sequence, whose truth is known exactly, are
tracked by the projection lines. An error that lasts is one draw for a whole run: the mean over draws counts, not the
share of one run.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.evaluation.scores import consistency
from psotrack.geometry import Rig, project
from psotrack.settings import TrackSettings
from psotrack.simulation import build, scenario
from psotrack.tracking.camera_errors import views_of_places, with_camera_errors
from psotrack.tracking.lines import track_detections
from psotrack.tracking.matching import NOISE_PX, NOISE_SHARE, Sightings
from psotrack.trajectories import Status

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
        stated.cameras, sightings, settings, fps=FPS, bounds_m=np.array([[-4.0, -4.0, 0.0], [4.0, 4.0, 4.0]])
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
        "rig": f"{len(rig)} cameras",
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


def add_options(options: argparse.ArgumentParser) -> None:
    """Options of this study."""
    options.add_argument("--draws", type=int, default=8, help="rigs of each case")
    options.add_argument("--frames", type=int, default=100, help="number of frames")


def rows(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Name and function of each row."""
    rig = build(scenario(LABELLED)).rig
    for cameras, names in RIGS.items():
        chosen = rig if names is None else rig.select(names)
        for case in LABELS:
            for seed in range(options.draws):
                yield f"{cameras} {case} {seed}", partial(labelled, chosen, case, seed, options.frames)


def show(table: pd.DataFrame, options: argparse.Namespace) -> None:
    """Print the mean shares."""
    means = table.drop(columns="draw").groupby(["rig", "case"], sort=False).mean()
    print(means.to_string(float_format="{:.3f}".format))
