"""Three small flights whose results are known, so that a change of the results is noticed.

    python experiments/reference_flights.py            # compares; exit code 1 if a number is outside of its tolerance
    python experiments/reference_flights.py --write    # writes today's numbers (`make reference-flights`)

- `videos`: four drones before four cameras, simulated and tracked from the videos by the defaults: foreground, births,
  swarm, covariances, identities.
- `detections`: boxes by formula with errors, gaps and false alarms, tracked by projection lines: matching, births,
  Kalman filter, covariances.
- `inside out`: a drawn video of markers by a camera in a hand with a rolling shutter: marker detection, poses, filter,
  smoother.

A tolerance is a share of the number. The second and third flight have no random numbers and compute in double
precision; their results differ among processors by the order of sums, and 0.1 % is far more than that. The swarm of the
first is chaotic: rounding on another processor acts like another seed, so that the tolerance is four standard
deviations over seeds (--seeds 10 prints them).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from psotrack.evaluation import evaluate
from psotrack.foreground.silhouettes import SilhouetteSettings
from psotrack.inside_out import LocaliseSettings, localise_video, open_source
from psotrack.pipeline import track_recording
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings
from psotrack.simulation import SimulationSettings, simulate
from psotrack.trajectories import Trajectories

HERE = Path(__file__).resolve().parent
sys.path += [str(HERE), str(HERE / "accuracy")]
import _results
import localise
from bat_flights import RealFlight, write_recording
from formula_flights import FPS, SCENES, make_flight

NUMBERS = HERE / "reference_flights.json"
CAMERAS = ["cam1i", "cam3i", "cam5i", "cam7i"]
Numbers = dict[str, float]
#: Tolerance of each number, as a share of it.
SUMS = 1e-3
TOLERANCES = {"videos": {}, "detections": {}, "inside out": {}}


def from_videos(folder: Path, seed: int = 0) -> Numbers:
    """Results from videos at half the size, and silhouettes of the usual number of cells."""
    root = folder / "videos"
    if not root.exists():
        settings = SimulationSettings(num_frames=60, scale=0.4, masks=False, onboard=False)
        simulate("S02_D4_A", root, settings, jobs=1)
    recording = open_recording(root / "Simulated_Data" / "S02_D4_A").usable(CAMERAS)
    silhouettes = SilhouetteSettings(reduction=2, working_reduction=1)
    settings = TrackSettings(seed=seed, silhouettes=silhouettes)
    found = track_recording(recording, settings, cache=folder / "cache", jobs=1).trajectories
    return numbers_of(found, recording.truth)


def from_detections(folder: Path) -> Numbers:
    """Results from boxes by formula."""
    made = make_flight(SCENES["indoors, 8 cameras above 4 drones"], 80, seed=3)
    write_recording(RealFlight(made.rig, made.detections, made.truth, FPS), folder / "boxes")
    recording = open_recording(folder / "boxes").usable(videos=False)
    settings = TrackSettings(method="projection-lines")
    found = track_recording(recording, settings, cache=folder / "cache", jobs=1).trajectories
    return numbers_of(found, made.truth)


def numbers_of(found: Trajectories, truth: Trajectories) -> Numbers:
    """Numbers of tracks, beside their reference."""
    errors = evaluate(found, truth).to_dict()
    assert found.covariance_m2 is not None
    std_m = np.sqrt(np.trace(found.covariance_m2[found.seen], axis1=-2, axis2=-1))
    velocity_m_s = np.linalg.norm(found.velocity_m_s[found.seen], axis=-1)
    return {
        "tracks": found.num_drones,
        "seen": int(found.seen.sum()),
        "mean_error_mm": 1e3 * errors["mean_error_m"],
        "centred_error_mm": 1e3 * errors["offset_removed_mean_error_m"],
        "std_mm": 1e3 * float(np.mean(std_m)),
        "speed_mm_s": 1e3 * float(np.mean(velocity_m_s)),
    }


def inside_out(folder: Path) -> Numbers:
    """Results from a video of markers."""
    (folder / "hand").mkdir(exist_ok=True)
    clip = localise.draw(folder / "hand", 0, 20, localise.READOUT_S)
    found = localise_video(open_source(clip.video), clip.marker_map, clip.camera, LocaliseSettings())
    numbers: Numbers = {"line_time_us": 1e6 * found.shutter.line_time_s}
    for name, path in (("filter", found.path), ("smoother", found.smoothed())):
        off_mm = 1e3 * np.linalg.norm((path.position_m - clip.position_m)[path.seen], axis=-1)
        std_m = np.sqrt(np.trace(path.covariance[path.seen][:, :3, :3], axis1=-2, axis2=-1))
        numbers |= {
            f"{name} seen": int(path.seen.sum()),
            f"{name} error_mm": float(np.mean(off_mm)),
            f"{name} std_mm": 1e3 * float(np.mean(std_m)),
        }
    return numbers


FLIGHTS: dict[str, Callable[[Path], Numbers]] = {
    "videos": from_videos,
    "detections": from_detections,
    "inside out": inside_out,
}

if __name__ == "__main__":
    import time
    with tempfile.TemporaryDirectory() as d:
        for n,f in FLIGHTS.items():
            b=time.time(); print(n, f(Path(d)), time.time()-b, flush=True)
        for s in range(1,8):
            b=time.time(); print(s, from_videos(Path(d), s), time.time()-b, flush=True)
