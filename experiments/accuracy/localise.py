"""A camera in a hand, with a global and with a rolling shutter: poses, covariances, line times and maps of markers.

    python experiments/accuracy/accuracy.py localise --data data
    python experiments/accuracy/accuracy.py localise --data data --seeds 1 --frames 90
    python experiments/accuracy/accuracy.py localise --data data --picture picture.png

A camera is carried by hand through the laboratory: sinusoids from slow walking to tremor at 7 Hz. The simulator draws
every row at its own time, with lens distortion, motion blur of 1/200 s, noise, JPEG 60 and an automatic exposure that
swings between 0.3 and 2. Cases: a global shutter, and a rolling shutter of 20 ms whose line time is given, estimated,
or left out on purpose (`--readout 0`). Truths: the pose when the middle row is exposed. The videos are kept in
DATA/localise and drawn once.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.geometry import Camera
from psotrack.inside_out import (
    BuiltMap,
    CameraPath,
    LocaliseSettings,
    MarkerMap,
    RollingShutter,
    build_map,
    find_sightings,
    localise_video,
    open_source,
)
from psotrack.inside_out.mapping.sightings import MarkerSightings, outward
from psotrack.recordings import VideoWriter, probe
from psotrack.simulation import build, change_scenario, scenario, write_recorded_flight
from psotrack.simulation.imaging.renderer import OnboardRenderer, lens, onboard_poses
from psotrack.simulation.scene import Scene

SIZE_WH, FPS, READOUT_S = (1280, 720), 30.0, 0.020
#: Frequencies of the hand's motion, hertz, and its amplitudes, metres and radians, along and about each axis.
_FREQUENCY_HZ = np.array([0.2, 0.6, 1.5, 3.0, 7.0])
_MOVE_M = np.array([0.35, 0.08, 0.015, 0.003, 0.0007])
_TURN_RAD = np.radians([12.0, 4.0, 1.2, 0.35, 0.1])
#: Insets of all markers' sides, and their differences among markers, that the covariance of a map allows for, standard
#: deviations in pixels; and number of maps with drawn insets.
INSET_STD_PX, INSET_DRAWS = (0.05, 0.02), 4
#: Names of the cases, readouts of the videos in seconds, and the shutters that are given; None is estimated.
CASES = (
    ("global", 0.0, None),
    ("given", READOUT_S, RollingShutter(READOUT_S / SIZE_WH[1])),
    ("estimated", READOUT_S, None),
    ("left out", READOUT_S, RollingShutter(0.0)),
)


@dataclass(frozen=True)
class Clip:
    """A drawn video of one hand's motion.

    Attributes:
        video: the video.
        camera: intrinsics of the camera.
        marker_map: the markers of the room.
        position_m, orientation_wxyz: (frames, 3) and (frames, 4), true poses when the middle rows are exposed.
    """

    video: Path
    camera: Camera
    marker_map: MarkerMap
    position_m: Float[np.ndarray, "frames 3"]
    orientation_wxyz: Float[np.ndarray, "frames 4"]


def hand_motion(
    seed: int, time_s: Float[np.ndarray, "times"]
) -> tuple[Float[np.ndarray, "times 3"], Float[np.ndarray, "times 4"]]:
    """Positions and orientations, body to world, of a camera in a hand."""
    rng = np.random.default_rng(seed)
    frequency = _FREQUENCY_HZ * rng.uniform(0.85, 1.15, (6, 5))
    wave = np.sin(2 * np.pi * frequency * time_s[:, None, None] + rng.uniform(0, 2 * np.pi, (6, 5)))
    towards_wall = Rotation.from_rotvec([0.0, 0.0, np.pi / 2])
    turn = towards_wall * Rotation.from_rotvec(wave[:, 3:] @ _TURN_RAD)
    return np.array([0.0, 0.8, 1.7]) + wave[:, :3] @ _MOVE_M, turn.as_quat(scalar_first=True)


def draw(folder: Path, seed: int, frames: int, readout_s: float) -> Clip:
    """Draw the video of one hand's motion, if the folder does not have it."""
    name = f"hand{seed}_{frames}_{1e3 * readout_s:g}ms"
    sampled_s = np.arange(-0.2, frames / FPS + 0.2, 1 / 200)
    flight = sampled_s + 0.2, *hand_motion(seed, sampled_s)
    scene = _scene(folder / f"hand{seed}_{frames}.csv", flight, seed, frames, readout_s)
    video = folder / f"{name}.avi"
    if not video.exists():
        artist = OnboardRenderer(scene, 0)
        with VideoWriter(video, FPS, SIZE_WH) as writer:
            for frame in range(frames):
                writer.write(artist.frame(frame))
    corners_m = scene.room.marker_corners_m
    return Clip(video, lens(scene), MarkerMap(dict(corners_m)), *onboard_poses(scene, 0, frames))


def _scene(
    path: Path, flight: tuple[np.ndarray, np.ndarray, np.ndarray], seed: int, frames: int, readout_s: float
) -> Scene:
    """The laboratory with a camera on a recorded flight: times, positions and orientations."""
    write_recorded_flight(path, *flight)
    recipe = change_scenario(
        scenario("S02_D4_A"),
        {
            "drones": [{"flight": {"kind": "recording", "file": str(path), "start_s": 0.2}}],
            "num_frames": frames,
            "fps": FPS,
            "limits.max_speed_m_s": 10.0,
            "limits.max_acceleration_m_s2": 100.0,
            "limits.max_tilt_deg": 80.0,
            "imaging.jpeg_quality": 60,
            "onboard": {
                "image_size_wh": SIZE_WH,
                "fov_deg": (92.45, 60.83),
                "pitch_deg": 12.0,
                "shutter_s": 1 / 200,
                "distortion": (-0.1, 0.03, 0.0005, -0.0004),
                "exposure": (0.3, 2.0),
                "line_time_s": readout_s / SIZE_WH[1],
            },
        },
    )
    return build(recipe, seed=seed)


def errors(path: CameraPath, clip: Clip) -> dict[str, float]:
    """Errors of a path, and shares of the truths in the 90 % ellipsoids of position and pose."""
    seen = path.seen
    off_m = clip.position_m[path.frame[seen]] - path.position_m[seen]
    turned = Rotation.from_quat(path.orientation_wxyz[seen], scalar_first=True).inv() * Rotation.from_quat(
        clip.orientation_wxyz[path.frame[seen]], scalar_first=True
    )
    off = np.concatenate([off_m, turned.as_rotvec()], axis=1)
    covariance = path.covariance[seen]
    inside = {}
    for name, size in (("position", 3), ("pose", 6)):
        part = off[:, :size]
        squares = np.einsum("ni,nij,nj->n", part, np.linalg.inv(covariance[:, :size, :size]), part)
        inside[name] = float(np.mean(squares < chi2.ppf(0.9, size)))
    distance_mm = 1e3 * np.linalg.norm(off_m, axis=1)
    return {
        "median_mm": float(np.median(distance_mm)),
        "p99_mm": float(np.percentile(distance_mm, 99)),
        "turn_median_deg": float(np.degrees(np.median(turned.magnitude()))),
        "in_90_position": inside["position"],
        "in_90_pose": inside["pose"],
        "seen": float(seen.mean()),
    }


def poses_of(
    clip: Clip, shutter: RollingShutter | None, smoothed: bool, about: dict[str, Any]
) -> dict[str, Any]:
    """Errors of the filter or of the smoother, and the line time."""
    settings = LocaliseSettings(shutter=shutter)
    began = time.perf_counter()
    found = localise_video(open_source(clip.video), clip.marker_map, clip.camera, settings)
    wall_s = time.perf_counter() - began
    return {
        **about,
        "estimate": "smoother" if smoothed else "filter",
        **errors(found.smoothed() if smoothed else found.path, clip),
        "line_time_us": 1e6 * found.shutter.line_time_s,
        "line_time_std_us": 1e6 * found.shutter.std_s,
        "frames_per_second": found.raw.num_frames / wall_s,
    }


def map_of(clip: Clip, about: dict[str, Any]) -> dict[str, Any]:
    """Errors of a map from the video of one hand's motion, given its most seen marker.

    Its covariance allows for a camera that encodes light by another power than assumed, which finds the sides of all
    markers too far inside or outside. The simulated camera has no such error. Therefore the share of the truths in the
    ellipsoids comes from several maps, with insets that are drawn as the covariance states them.
    """
    sightings = find_sightings([(probe(clip.video), clip.camera)])
    ids, counts = np.unique(sightings.marker, return_counts=True)
    known = int(ids[counts.argmax()])
    built = build_map(sightings, {known: clip.marker_map.corners_m[known]})
    off_m, inside_as_drawn = _off_map(built, clip)
    inside = []
    for number in range(INSET_DRAWS):
        moved = _with_insets(sightings, np.random.default_rng(number))
        again = build_map(moved, {known: clip.marker_map.corners_m[known]})
        inside += _off_map(again, clip)[1].tolist()
    off_mm = 1e3 * np.linalg.norm(off_m, axis=-1)
    return {
        **about,
        "estimate": "map",
        "median_mm": float(np.median(off_mm)),
        "p99_mm": float(np.percentile(off_mm, 99)),
        "in_90_position": float(np.mean(inside)),
        "in_90_without_insets": float(np.mean(inside_as_drawn)),
        "markers": len(off_m),
    }


def _off_map(
    built: BuiltMap, clip: Clip
) -> tuple[Float[np.ndarray, "markers 4 3"], Bool[np.ndarray, " markers"]]:
    """Errors of the corners, metres, of markers in ten frames and more, and whether their centres are in 90 %."""
    chosen = np.flatnonzero(~built.known & (built.sightings >= 10))
    ids = built.ids[chosen].tolist()
    off_m = built.marker_map.corners_of(ids) - clip.marker_map.corners_of(ids)
    centre_m = off_m.mean(axis=1)
    whitened = np.linalg.solve(built.covariance[chosen, :3, :3], centre_m[..., None])[..., 0]
    return off_m, (centre_m * whitened).sum(axis=1) < chi2.ppf(0.9, 3)


def _with_insets(sightings: MarkerSightings, rng: np.random.Generator) -> MarkerSightings:
    """The sightings by a camera of another power, with insets that differ a little among markers."""
    common_px, apart_px = INSET_STD_PX
    inset_px = common_px * rng.normal() + apart_px * rng.normal(size=sightings.marker.max() + 1)
    moved_px = inset_px[sightings.marker, None, None] * outward(sightings)
    return replace(sightings, corners_px=sightings.corners_px - moved_px)


def picture(path: Path, folder: Path, frames: int) -> None:
    """Draw a frame of a fast pan with both shutters, and the errors of the smoothed positions over time."""
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(9, 5), layout="constrained")
    grid = figure.add_gridspec(2, 2)
    sampled_s = np.arange(0, 1.0, 1 / 200)
    turn = Rotation.from_rotvec(np.outer(np.pi / 2 + 4.0 * (sampled_s - 0.5), [0, 0, 1]))
    pan = np.broadcast_to([0.0, 0.8, 1.7], (len(sampled_s), 3)), turn.as_quat(scalar_first=True)
    for column, (name, readout_s) in enumerate(
        (("global shutter", 0.0), ("rolling shutter, 20 ms", READOUT_S))
    ):
        scene = _scene(folder / "pan.csv", (sampled_s, *pan), 0, 16, readout_s)
        axes = figure.add_subplot(grid[0, column])
        axes.imshow(OnboardRenderer(scene, 0).frame(15)[..., ::-1])
        axes.set_title(f"{name}, pan of 230 degrees per second", fontsize=9)
        axes.axis("off")
    axes = figure.add_subplot(grid[1, :])
    for case, readout_s, shutter in CASES:
        clip = draw(folder, 0, frames, readout_s)
        found = localise_video(
            open_source(clip.video), clip.marker_map, clip.camera, LocaliseSettings(shutter=shutter)
        )
        smoothed = found.smoothed()
        off_mm = 1e3 * np.linalg.norm(smoothed.position_m - clip.position_m, axis=1)
        axes.semilogy(smoothed.time_s, off_mm, label=case, linewidth=1.0)
    axes.set_xlabel("time (s)")
    axes.set_ylabel("error of the position (mm)")
    axes.legend(fontsize=8, ncols=4)
    figure.savefig(path, dpi=110)


def add_options(options: argparse.ArgumentParser) -> None:
    """Options of this study."""
    options.add_argument("--seeds", type=int, default=3, help="number of motions")
    options.add_argument("--frames", type=int, default=150, help="frames of each video")
    options.add_argument("--picture", type=Path, help="draw this picture too, from the first motion")


def rows(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Name and function of each row."""
    folder = options.data / "localise"
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(options.seeds):
        for case, readout_s, shutter in CASES:
            clip = draw(folder, seed, options.frames, readout_s)
            for smoothed in (False, True):
                name = f"{case} {seed} {smoothed}"
                yield name, partial(poses_of, clip, shutter, smoothed, {"case": case, "seed": seed})
            if shutter is None:
                yield f"{case} {seed} map", partial(map_of, clip, {"case": case, "seed": seed})


def show(table: pd.DataFrame, options: argparse.Namespace) -> None:
    """Print the table, and draw the picture."""
    print(table.to_string(index=False, float_format="{:.3f}".format, na_rep="-"))
    if options.picture is not None:
        picture(options.picture, options.data / "localise", options.frames)
