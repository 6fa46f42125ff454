"""How often the truth of real flights lies in the 90 % ellipsoid, and sightings of a camera left out in its ellipse.

    python experiments/accuracy/accuracy.py real_flights --data data --real real

Flights that other people recorded (OWNER/NAME in --real): wordbomb/PoseFree-GeoLocator (3 cameras, RTK),
cvlab-epfl/multiview_calib (drone_rolex, 5 cameras, GPS) and christofhapp/batflight3D_publication (2 thermal cameras,
GPS). Their cameras' poses are not published: `psotrack calibrate rig` finds them from the drone and its track in
the first half of the flight (the bats' flights: see `bat_flights`). The detections are tracked with defaults; tracks
are kept in DATA/real_flights, because what changes is the covariance.

The truth errs too: the fits of the poses leave 0.4 to 0.6 m along each axis, and `TRUTH_M` is added to the covariance.
The RTK track was logged every 0.1 or 0.2 s and published as if every 1/6 s: its clock is fitted to the pixels, with a
knot every 40 s, and its error is more than RTK's.

A camera is left out of the track, and its sightings are compared with the track's ellipse in its image. The error of
the sighting itself is taken to be the mean of those that are learned of the other cameras.
"""

from __future__ import annotations

import argparse
import json
import pickle
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from bat_flights import read_flight, write_recording
from reference import BATS, psotrack
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from psotrack.evaluation.scores import consistency
from psotrack.geometry import make_camera, make_rig
from psotrack.geometry.rig_files import write_rig
from psotrack.pipeline import Parts, prepare
from psotrack.pipeline.inputs import read_sightings
from psotrack.recordings import Detections, write_detections
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings
from psotrack.tracking.camera_errors import views_of_places, with_camera_errors
from psotrack.tracking.lines import track_detections
from psotrack.trajectories import Status, Trajectories, write_trajectories

REAL_DATA = {"PoseFree": "wordbomb/PoseFree-GeoLocator", "drone_rolex": "cvlab-epfl/multiview_calib"}
#: Standard deviation of the truth along each axis, metres, as the fits of the poses to it show.
TRUTH_M = 0.5
#: Distances beyond which a track, metres, or a sighting, pixels, is not of the drone; frames of a bats' flight.
GATE_M, BAT_GATE_M, GATE_PX, BAT_FRAMES = 10.0, 5.0, 200.0, 1500
#: Side of a drone's box, where only its middle is published, pixels; a 90 % ellipse in two dimensions.
SIDE_PX, INSIDE_90_2D = 10.0, float(2 * np.log(10))
#: The RTK track is followed from here on, on its own clock, seconds: its times before the take-off are far off.
RTK_FROM_S = 60.0
#: The clip of drone_rolex has no stated rate; at this one the drone's accelerations are those of a drone.
ROLEX_FPS = 25.0


@dataclass(frozen=True)
class View:
    """What one camera sees: frames, pixels, lens, image size, frames per second and time of frame 0."""

    frame: np.ndarray
    pixel: np.ndarray
    K: np.ndarray
    dist: np.ndarray
    size_wh: tuple[int, int]
    fps: float
    start_s: float = 0.0

    @property
    def time_s(self) -> np.ndarray:
        """Time of each sighting, seconds."""
        return self.start_s + self.frame / self.fps

    def after(self, time_s: float) -> View:
        """The sightings from a time on."""
        kept = self.time_s >= time_s
        return replace(self, frame=self.frame[kept], pixel=self.pixel[kept])


def posefree(real: Path) -> tuple[dict[str, View], np.ndarray, np.ndarray]:
    """Views, and times and positions of the truth, on the clock of the views."""
    folder = real / REAL_DATA["PoseFree"] / "UAV experiment/UAV_3D_recognition/reconstruction"
    instants = json.loads((folder / "config123_0619.json").read_text())["detection_inputs"][
        "corresponding_frames"
    ]
    place_m = np.loadtxt(folder / "data/dataset/trajectory/0619_fps30_6.txt")
    logged_s = np.arange(len(place_m)) / 6 - RTK_FROM_S
    views, first = {}, []
    for number, instant in enumerate(instants, 1):
        camera = json.loads((folder / f"data/calibration/cam{number}_0619.json").read_text())
        rows = np.loadtxt(folder / f"data/dataset/detections/0619-{number}.txt")
        lens = np.array(camera["K-matrix"]), np.ravel(camera["distCoeff"])
        # The truth's clock shows about 495.6 s at the instant of the corresponding frames.
        start_s = 495.6 - RTK_FROM_S - instant / camera["fps"]
        view = View(rows[:, 0].astype(int), rows[:, 1:], *lens, (1920, 1080), camera["fps"], start_s).after(
            0.0
        )
        views[f"cam{number}"] = view
        # Published heights of cameras and of the track differ by 10 m.
        first.append(_turned_to(view, place_m, logged_s, np.add(camera["location"], (0, 0, 10))))
    knots_s = np.arange(0.0, 420.0, 40.0)

    def errors(x: np.ndarray) -> np.ndarray:
        off = [np.diff(x[18:-2]) / 0.07]
        for number, (view, own_s) in enumerate(zip(views.values(), (0.0, *x[-2:]), strict=True)):
            time_s = view.time_s[::20] + own_s
            shown_m = _at(time_s + np.interp(time_s, knots_s, x[18:-2]), logged_s, place_m)
            pose = x[6 * number : 6 * number + 6]
            pixel, _ = cv2.projectPoints(shown_m, pose[:3], pose[3:], view.K, view.dist)
            off.append((pixel[:, 0] - view.pixel[::20]).ravel() / 8)
        return np.concatenate(off)

    x = np.concatenate([*first, np.zeros(len(knots_s) + 2)])
    scale = [*[0.01, 0.01, 0.01, 1, 1, 1] * 3, *[0.1] * (len(knots_s) + 2)]
    for width in (10.0, 1.0):
        x = least_squares(errors, x, loss="cauchy", f_scale=width, x_scale=scale, max_nfev=60).x
    late_s = dict(zip(views, (0.0, *x[-2:]), strict=True))
    views = {name: replace(view, start_s=view.start_s + late_s[name]) for name, view in views.items()}
    # Times of the views at which the truth's clock shows each logged time.
    fine_s = np.arange(0.0, 420.0, 0.1)
    time_s = np.interp(logged_s, fine_s + np.interp(fine_s, knots_s, x[18:-2]), fine_s)
    during = (time_s > 0) & (time_s < fine_s[-1])
    return views, time_s[during], place_m[during]


def _turned_to(view: View, place_m: np.ndarray, logged_s: np.ndarray, centre_m: np.ndarray) -> np.ndarray:
    """Pose of a camera at a known place that turns it to the drone: rotation vector and translation."""
    rays = np.c_[cv2.undistortPoints(view.pixel[:, None], view.K, view.dist)[:, 0], np.ones(len(view.pixel))]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    ahead = _at(view.time_s, logged_s, place_m) - centre_m
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    weight = np.ones(len(rays))
    for _ in range(10):
        turn, _ = Rotation.align_vectors(rays, ahead, weights=weight)
        weight = (0.01 + np.linalg.norm(turn.apply(ahead) - rays, axis=1)) ** -2
    return np.concatenate([turn.as_rotvec(), -turn.apply(centre_m)])


def rolex(real: Path) -> tuple[dict[str, View], np.ndarray, np.ndarray]:
    """Views, and times and positions of the truth."""
    folder = real / REAL_DATA["drone_rolex"] / "examples/drone_rolex"
    seen, places, lenses = (
        json.loads((folder / f"{name}.json").read_text())
        for name in ("landmarks", "landmarks_global", "intrinsics_rational")
    )
    views = {}
    for name in sorted(seen):
        frame, pixel = np.array(seen[name]["ids"]), np.array(seen[name]["landmarks"])
        lens = np.array(lenses[name]["K"]), np.array(lenses[name]["dist"])
        views[name] = View(frame, pixel, *lens, (3840, 2160), ROLEX_FPS)
    place_m = np.array(places["landmarks_global"]).reshape(-1, 3)
    return views, np.array(places["ids"]) / ROLEX_FPS, place_m - place_m[0]


def _at(time_s: np.ndarray, known_s: np.ndarray, place_m: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(time_s, known_s, axis) for axis in place_m.T], axis=-1)


def make_recording(folder: Path, views: dict[str, View], time_s: np.ndarray, place_m: np.ndarray) -> None:
    """Write detections, reference and `recording.toml` of a flight; its first half calibrates the cameras."""
    folder.mkdir(parents=True, exist_ok=True)
    truth = Trajectories(np.arange(len(time_s)), time_s, ("drone",), place_m[:, None])
    write_trajectories(folder / "truth.csv", truth, force=True)
    pairs, lenses = [], {}
    lines = ["version = 1", 'calibration = "rig.toml"', "[reference]", 'files = ["truth.csv"]']
    for name, view in views.items():
        middle = view.pixel + 0.5
        boxes = np.concatenate([middle - SIDE_PX / 2, middle + SIDE_PX / 2], axis=1)
        write_detections(folder / f"{name}.csv", Detections(view.frame, boxes, np.ones(len(boxes))))
        lines += [f'[cameras."{name}"]', f'detections = "{name}.csv"', f"size = {list(view.size_wh)}"]
        lines += [f"fps = {view.fps}", f"time_offset_s = {float(view.start_s)}"]
        lenses[name] = make_camera(
            R=np.eye(3), t_m=np.zeros(3), K=view.K, dist=view.dist, image_size_wh=view.size_wh
        )
        seen = np.flatnonzero((view.time_s > time_s[0]) & (view.time_s < time_s[len(time_s) // 2]))[::10]
        pairs.append(pd.DataFrame(view.pixel[seen], columns=["x_px", "y_px"]))
        pairs[-1][["x_m", "y_m", "z_m"]] = _at(view.time_s[seen], time_s, place_m)
        pairs[-1].insert(0, "camera", name)
        pairs[-1].insert(1, "point", [f"{name} {frame}" for frame in view.frame[seen]])
    pd.concat(pairs).to_csv(folder / "pairs.csv", index=False)
    write_rig(folder / "lenses.toml", make_rig(lenses), force=True)
    (folder / "recording.toml").write_text("\n".join(lines) + "\n")
    words = ("--pairs", str(folder / "pairs.csv"), "--lenses", str(folder / "lenses.toml"), "--noise", "10")
    refused = psotrack("calibrate", "rig", *words, "--out", str(folder / "rig.toml"), "--force")
    assert not refused, refused


def tracked(folder: Path, name: str, without: str, num_frames: int) -> dict[str, Any]:
    """Tracks of a flight before their covariances are corrected, and what they were made of; kept in a file."""
    kept = folder / f"{name}{'-' if without else ''}{without}.pkl"
    if not kept.exists():
        recording = open_recording(folder / name)
        chosen = [camera for camera in recording.rig.names if camera != without]
        recording = recording.usable(chosen, num_frames, videos=False)
        run = prepare(recording, None, {}, TrackSettings(method="projection-lines"), Parts())
        assert run.sightings is not None
        tracks, places = track_detections(
            run.recording.rig.cameras,
            run.sightings,
            run.settings,
            fps=recording.fps,
            bounds_m=run.volume.bounds_m,
        )
        found = {"tracks": tracks, "places": places, "cameras": run.recording.rig.cameras}
        found |= {"names": recording.rig.names, "fps": recording.fps, "time_s": recording.timeline().time_s}
        kept.write_bytes(pickle.dumps(found | {"settings": run.settings}))
    found = pickle.loads(kept.read_bytes())
    at = np.asarray(found["tracks"].status)[..., None] == Status.TRACKED
    states = (np.asarray(getattr(found["tracks"], each), float) for each in ("position_m", "velocity_m_s"))
    place_m, velocity_m_s = (np.where(at, state, np.nan) for state in states)
    middle_px, weight = found["places"].middle_px, found["places"].weight
    views = views_of_places(found["cameras"], middle_px, weight, place_m, velocity_m_s)
    motion, given = found["settings"].motion, found["settings"].errors
    corrected, errors = with_camera_errors(found["tracks"], views, motion, given, found["fps"])
    covariances_m2 = [corrected.covariance_m2 + each for each in vars(errors.systematic).values()]
    return found | {
        "states": (place_m, velocity_m_s),
        "covariances_m2": covariances_m2,
        "errors": errors.cameras,
    }


def by_truth(folder: Path, name: str, num_frames: int, gate_m: float) -> dict[str, Any]:
    """Errors of a flight's tracks, and how many truths lie in their ellipsoids."""
    found = tracked(folder, name, "", num_frames)
    truth = pd.read_csv(folder / name / "truth.csv").dropna(subset=["x_m"])
    known_s, truth_m = truth.time_s.to_numpy(), truth[["x_m", "y_m", "z_m"]].to_numpy()

    def error_m(offset_s: float) -> np.ndarray:
        time_s = found["time_s"] + offset_s
        error = found["states"][0] - _at(time_s, known_s, truth_m)[:, None]
        inside = (time_s >= known_s[0]) & (time_s <= known_s[-1])
        near = np.linalg.norm(error, axis=-1, keepdims=True) < gate_m
        return np.where(near & inside[:, None, None], error, np.nan)

    def usual_m(offset_s: float) -> float:
        return float(np.nanmedian(np.linalg.norm(error_m(offset_s), axis=-1)))

    off_m = error_m(min(np.arange(-1.0, 1.01, 0.05), key=usual_m))
    truth_m2 = TRUTH_M**2 * np.eye(3)
    covariances_m2 = found["covariances_m2"]
    figures = consistency(
        off_m, off_m - np.nanmean(off_m, axis=0), *(each + truth_m2 for each in covariances_m2)
    )
    distance_m = np.linalg.norm(off_m, axis=-1)
    seen = np.isfinite(distance_m)
    return {
        "flight": name,
        "left_out": "",
        "frames": int(seen.sum()),
        "median_error": float(np.nanmedian(distance_m)),
        "p90_error": float(np.nanpercentile(distance_m, 90)),
        "std_m": float(np.sqrt(np.trace(covariances_m2[0][seen], axis1=-2, axis2=-1).mean())),
        "inside_90": figures.inside_90_rate,
        "centred_inside_90": figures.offset_removed_inside_90_rate,
    }


def by_camera(folder: Path, name: str, without: str, num_frames: int) -> dict[str, Any]:
    """How far a camera that is left out sees the drone from the track, pixels, and how often inside the ellipse."""
    found = tracked(folder, name, without, num_frames)
    place_m, velocity_m_s = found["states"]
    recording = open_recording(folder / name).usable([without], num_frames, videos=False)
    sightings, _ = read_sightings(recording, None, TrackSettings().detections)
    rows = min(len(place_m), sightings.num_frames)
    pixel = np.repeat(sightings.centre_px[:rows, :, 0][:, None], place_m.shape[1], axis=1)
    states = (place_m[:rows], velocity_m_s[:rows])
    exposures = None if sightings.exposures is None else sightings.exposures[:rows]
    view = views_of_places(recording.rig.cameras, pixel, np.ones(pixel.shape), *states, exposures)
    off_px = view.residual_px[:, :, 0]
    seen = np.linalg.norm(off_px, axis=-1) < GATE_PX
    errors = found["errors"]
    own_px2 = np.nanmean(np.square(errors.noise_px)) + np.nanmean(np.square(errors.bias_px))
    J, turn_px = view.jacobian[:, :, 0][seen], view.turn_px[:, :, 0][seen]
    flow_px_s = view.flow_px_s[:, :, 0][seen][..., None]
    total_px2 = J @ found["covariances_m2"][0][:rows][seen] @ J.mT + own_px2 * np.eye(2)
    total_px2 += errors.turn_rad**2 * turn_px @ turn_px.mT + errors.clock_s**2 * flow_px_s @ flow_px_s.mT
    squares = np.vecdot(off_px[seen], np.linalg.solve(total_px2, off_px[seen][..., None])[..., 0])
    distance_px = np.linalg.norm(off_px[seen], axis=-1)
    return {
        "flight": name,
        "left_out": without,
        "frames": int(seen.sum()),
        "median_error": float(np.median(distance_px)),
        "p90_error": float(np.percentile(distance_px, 90)),
        "inside_90": float(np.mean(squares <= INSIDE_90_2D)),
    }


#: Function that reads a flight, frames that are tracked, cameras that are left out in turn, and frames without them.
FLIGHTS = {
    "PoseFree": (posefree, 1500, ("cam1", "cam2", "cam3"), 1500),
    "drone_rolex": (rolex, 1500, ("6-0", "6-1", "6-2"), 800),
}


def add_options(options: argparse.ArgumentParser) -> None:
    """This study has no options of its own."""


def recordings(data: Path, real: Path) -> Iterator[tuple[Path, int, float]]:
    """Folder, number of frames and gate of each flight, metres; makes those that are not there."""
    for name, (read, num_frames, *_) in FLIGHTS.items():
        folder = data / "real_flights" / name
        if not (folder / "recording.toml").exists():
            make_recording(folder, *read(real))
        yield folder, num_frames, GATE_M
    for name, part in BATS.items():
        folder = data / "real_flights" / name.replace(" ", "_")
        if not (folder / "recording.toml").exists():
            flight = read_flight(real, *part[:2], BAT_FRAMES)
            write_recording(flight, folder)
            write_trajectories(folder / "truth.csv", flight.truth, force=True)
        yield folder, BAT_FRAMES, BAT_GATE_M


def rows(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Name and function of each row."""
    for folder, num_frames, gate_m in recordings(options.data, options.real):
        yield folder.name, partial(by_truth, folder.parent, folder.name, num_frames, gate_m)
        *_, left_out, num_left_out = FLIGHTS.get(folder.name, ((), 0))
        for camera in left_out:
            row = partial(by_camera, folder.parent, folder.name, camera, num_left_out)
            yield f"{folder.name} {camera}", row


def show(table: pd.DataFrame, options: argparse.Namespace) -> None:
    """Print the table."""
    print(table.to_string(index=False, float_format="{:.3f}".format, na_rep="-"))
