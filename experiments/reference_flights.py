"""Three small flights whose results are known, so that a change of the results is noticed.

    python experiments/reference_flights.py            # compares; exit code 1 if the results changed
    python experiments/reference_flights.py --write    # writes today's numbers (`make reference-flights`)

- `videos`: two drones before four cameras, simulated and tracked from the videos by the defaults: foreground, births,
  swarm, covariances, identities.
- `detections`: boxes by formula with errors, gaps and false alarms, tracked by projection lines: matching, births,
  Kalman filter, covariances.
- `inside out`: a camera in a hand before a wall of markers, of which some have wrong identities: poses, filter,
  smoother.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from psotrack.evaluation import evaluate
from psotrack.foreground.markers import DetectedMarkers
from psotrack.foreground.silhouettes import SilhouetteSettings
from psotrack.geometry import look_at, make_camera, project
from psotrack.inside_out import LocaliseSettings, MarkerMap
from psotrack.inside_out.localising import localise_frames
from psotrack.pipeline import track_recording
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings
from psotrack.simulation import SimulationSettings, change_scenario, scenario, simulate
from psotrack.support import keep_compiled
from psotrack.trajectories import Trajectories

HERE = Path(__file__).resolve().parent
sys.path += [str(HERE), str(HERE / "accuracy")]
import _results
from bat_flights import write_recording
from formula_flights import FPS, SCENES, make_flight

NUMBERS = HERE / "reference_flights.json"
#: Largest change of a number, as a share of it. Seeds of the swarm change the numbers of the first flight by 0.07 %
#: (standard deviation over eight seeds), and rounding on another processor acts like another seed. The other flights
#: have no random numbers: theirs change by the order of sums only.
TOLERANCE = 2e-3
Numbers = dict[str, float]


def from_videos(folder: Path) -> Numbers:
    """Results from videos at 0.4 times the usual size, with silhouettes of half the usual reduction."""
    corners = [(x, y, 2.9) for x, y in ((-4.5, -3.5), (4.5, -3.5), (4.5, 3.5), (-4.5, 3.5))]
    cameras = [{"position_m": list(corner), "target_m": [0.0, 0.0, 1.2]} for corner in corners]
    recipe = change_scenario(scenario("S01_D2_A"), {"cameras": cameras})
    settings = SimulationSettings(num_frames=30, scale=0.4, masks=False, onboard=False)
    simulate(recipe, folder, settings, jobs=1)
    recording = open_recording(folder / "Simulated_Data" / recipe.name)
    silhouettes = SilhouetteSettings(reduction=2, working_reduction=1)
    tracked = track_recording(recording, TrackSettings(silhouettes=silhouettes), cache=folder, jobs=1)
    assert recording.truth is not None
    return numbers_of(tracked.trajectories, recording.truth)


def from_detections(folder: Path) -> Numbers:
    """Results from boxes by formula."""
    made = make_flight(SCENES["indoors, 8 cameras above 4 drones"], 40, seed=3)
    write_recording(made, folder)
    recording = open_recording(folder).usable(videos=False)
    tracked = track_recording(recording, TrackSettings(method="projection-lines"), cache=folder, jobs=1)
    return numbers_of(tracked.trajectories, made.truth)


def numbers_of(found: Trajectories, truth: Trajectories) -> Numbers:
    """Numbers of tracks, beside their reference."""
    errors = evaluate(found, truth).to_dict()
    assert found.covariance_m2 is not None
    assert found.velocity_m_s is not None
    std_m = np.sqrt(np.trace(found.covariance_m2[found.seen], axis1=-2, axis2=-1))
    return {
        "tracks": found.num_drones,
        "places": int(found.seen.sum()),
        "mean error (mm)": 1e3 * errors["mean_error_m"],
        "offset removed (mm)": 1e3 * errors["offset_removed_mean_error_m"],
        "standard deviation (mm)": 1e3 * float(np.mean(std_m)),
        "speed (mm/s)": 1e3 * float(np.mean(np.linalg.norm(found.velocity_m_s[found.seen], axis=-1))),
    }


def inside_out(folder: Path) -> Numbers:
    """Results from markers by formula: 48 on two walls, errors of 0.3 px, and one identity in fifty is wrong."""
    rng = np.random.default_rng(0)
    square_m = 0.1 * np.array([[-1.0, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]])
    places_m = [(0.6 * (i % 8) - 2.1, 3.5 + 0.5 * (i % 2), 0.4 * (i // 8) + 0.7) for i in range(48)]
    marker_map = MarkerMap({i: square_m + place_m for i, place_m in enumerate(places_m)})
    K = np.array([[900.0, 0, 639.5], [0, 900.0, 359.5], [0, 0, 1]])
    frames, true_m = [], []
    for frame in range(25):
        time_s = frame / FPS
        place_m = np.array(
            [0.4 * np.sin(0.8 * time_s), 0.2 * np.sin(1.7 * time_s), 1.6 + 0.1 * np.sin(time_s)]
        )
        R, t_m = look_at(
            place_m.tolist(), (0.5 * np.sin(0.6 * time_s), 3.5, 1.6 + 0.3 * np.sin(1.1 * time_s))
        )
        camera = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1280, 720))
        corners_px = project(camera, marker_map.all_corners_m)[0] + rng.normal(0, 0.3, (48, 4, 2))
        there = ((corners_px > 0) & (corners_px < (1280, 720))).all(axis=(1, 2))
        ids = np.where(rng.random(48) < 0.02, rng.permutation(48), np.arange(48))
        seen = DetectedMarkers(ids, corners_px, np.full(48, 0.3)).select(there)
        frames.append((frame, time_s, seen.of_single_ids()))
        true_m.append(place_m)
    lens = make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=(1280, 720))
    found, numbers = localise_frames(frames, marker_map, lens, LocaliseSettings()), {}
    for name, path in (("filter", found.path), ("smoother", found.smoothed())):
        off_mm = 1e3 * np.linalg.norm((path.position_m - true_m)[path.seen], axis=-1)
        std_m = np.sqrt(np.trace(path.covariance[path.seen][:, :3, :3], axis1=-2, axis2=-1))
        R_world_cam = Rotation.from_quat(path.orientation_wxyz[path.seen], scalar_first=True)
        numbers |= {
            f"{name}: poses": int(path.seen.sum()),
            f"{name}: mean error (mm)": float(np.mean(off_mm)),
            f"{name}: standard deviation (mm)": 1e3 * float(np.mean(std_m)),
            f"{name}: mean turn (mrad)": 1e3 * float(np.mean(R_world_cam.magnitude())),
        }
    return numbers


FLIGHTS: dict[str, Callable[[Path], Numbers]] = {
    "videos": from_videos,
    "detections": from_detections,
    "inside out": inside_out,
}


def changes(stored: dict[str, Numbers], found: dict[str, Numbers]) -> list[str]:
    """One line for each number that is outside of the tolerance."""
    lines = []
    for flight, numbers in found.items():
        for name, value in numbers.items():
            before = stored.get(flight, {}).get(name, np.nan)
            if not abs(value - before) <= TOLERANCE * abs(before):
                lines.append(f"{flight}: {name}: expected {before:g}, found {value:g}")
    return lines


def main() -> None:
    """Track the flights, and compare or write the numbers."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true", help="write today's numbers")
    parser.add_argument("--numbers", type=Path, default=NUMBERS, help="file of the numbers")
    parser.add_argument("--flights", nargs="+", choices=FLIGHTS, default=list(FLIGHTS), help="only these")
    parser.add_argument("--compiled", type=Path, help="folder that keeps compiled programs")
    options = parser.parse_args()
    if options.compiled is not None:
        keep_compiled(options.compiled)
    found = {}
    for name in options.flights:
        with tempfile.TemporaryDirectory() as folder:
            found[name] = FLIGHTS[name](Path(folder))
    today = {"version": _results.tracking_version(), "flights": found}
    if options.write:
        options.numbers.write_text(json.dumps(today, indent=2) + "\n", encoding="utf-8")
        return
    stored = json.loads(options.numbers.read_text(encoding="utf-8"))
    lines = changes(stored["flights"], found)
    remedy = "run `make reference-flights`"
    if lines and stored["version"] == today["version"]:
        remedy = f"if meant, raise the version in {_results.REGISTRY.name}, {remedy} and `make results`"
    if stored["version"] != today["version"]:
        lines.append(f"version of tracking: expected {stored['version']}, found {today['version']}")
    if lines:
        sys.exit("\n".join([*lines, f"reference flights: results changed; {remedy}"]))


if __name__ == "__main__":
    main()
