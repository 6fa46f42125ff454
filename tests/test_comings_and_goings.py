"""Drones that come, leave, land and fly out of all but two cameras, from rendered video, nobody saying how many.

Four cameras and a quarter of the image size, so that it runs in a minute; silhouettes that are not reduced keep the
drones as many cells large as at full size. The full scenario is `experiments/accuracy/comings_and_goings.toml`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from psotrack.datasets.dpjait import read_sequence
from psotrack.evaluation import evaluate
from psotrack.geometry import project
from psotrack.pipeline import track_recording
from psotrack.settings import TrackSettings
from psotrack.silhouettes import SilhouetteSettings
from psotrack.simulation import Scenario, SimulationSettings, simulate, write_recording
from psotrack.trajectories import Status, Trajectories

pytestmark = pytest.mark.slow

FPS, NUM_FRAMES = 25.0, 190
FLIES_OUT, COMES, LANDS = DRONES = range(3)
LANDS_S, TAKES_OFF_S = 1.4, 4.8

#: In a hall with a ceiling so high that there is a place which no camera sees.
SCENARIO = {
    "name": "comings_and_goings",
    "hall": "large_hall",
    "cameras": "laboratory_corners",
    "num_frames": NUM_FRAMES,
    "imaging": {"reflections": 0.0, "contact_shadows": False},
    "variation": {"centre_m": 0.0, "period": 0.0},
    "limits": {
        "max_speed_m_s": 3.2,
        "max_acceleration_m_s2": 5.0,
        "max_tilt_deg": 25.0,
        "min_distance_m": 0.8,
        "lower_m": [-5.6, -2.5, 0.1],
        "upper_m": [2.7, 2.5, 5.7],
    },
}


def waypoints(points_m: list[list[float]], speed_m_s: float, hover_s: float) -> dict[str, object]:
    return {"kind": "waypoints", "points_m": points_m, "speed_m_s": speed_m_s, "hover_s": hover_s}


def scenario(folder: Path) -> Scenario:
    """One flies out to where two cameras see it; one comes, goes and comes back; one lands and takes off."""
    place, up = np.array([1.0, 0.2, 0.12]), np.array([0.0, 0.0, 1.0])
    time_s = np.arange(0, NUM_FRAMES / FPS + 0.1, 0.1)
    height_m = 1.1 * (1 - _eased(time_s / LANDS_S)) + 1.2 * _eased((time_s - TAKES_OFF_S) / 1.6)
    write_recording(folder / "landing.csv", time_s, place + height_m[:, None] * up, None)
    drones = {
        FLIES_OUT: ("x_frame", waypoints([[-1.0, 1.3, 1.6], [-5.4, 1.3, 1.9]], 1.7, 0.8)),
        COMES: (
            "camera_drone",
            waypoints([[2.2, -1.3, 5.0], [2.2, -1.3, 1.6], [-1.4, -1.7, 5.0], [0.6, -1.6, 1.5]], 1.7, 0.2),
        ),
        LANDS: ("tall_cross", {"kind": "recording", "file": str(folder / "landing.csv")}),
    }
    # What stands turns no more than it moves: it would never become background.
    rows = [{"model": model, "flight": flight, "yaw_sway_deg": 0.0} for model, flight in drones.values()]
    return msgspec.convert(SCENARIO | {"drones": rows}, Scenario)


def _eased(share: np.ndarray) -> np.ndarray:
    """From rest to rest (the cosine's acceleration is no more than a drone can do)."""
    return (1 - np.cos(np.pi * np.clip(share, 0, 1))) / 2


@dataclass(frozen=True)
class Run:
    """What was tracked, and what is true.

    Attributes:
        truth: of drones that two cameras see or more; NaN where they do not.
        seen_by: (frames, drones), cameras whose images hold the drone's origin.
        at: (frames, tracks, drones), metres.
    """

    trajectories: Trajectories
    truth: Trajectories
    seen_by: np.ndarray
    at: np.ndarray

    def track_of(self, drone: int) -> int:
        """The one track that is ever at a drone."""
        (track,) = np.flatnonzero((self.near(drone) & self.tracked).any(axis=0))
        return int(track)

    def near(self, drone: int) -> np.ndarray:
        """(frames, tracks), within half a metre of it."""
        return self.at[..., drone] < 0.5

    @property
    def tracked(self) -> np.ndarray:
        return self.trajectories.status == Status.TRACKED


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    root = tmp_path_factory.mktemp("comings")
    folder = simulate(scenario(root), root, SimulationSettings(scale=0.25, seed=0, masks=False), jobs=1)
    sequence = read_sequence(folder).usable()
    assert sequence.truth is not None
    # What stands still for a second is background.
    how = SilhouetteSettings(reduction=1, working_reduction=1, min_blob_px=4, learning_rate=0.02)
    tracked = track_recording(sequence, TrackSettings(silhouettes=how), cache=root / "cache", jobs=1)
    cameras, position_m = sequence.rig.cameras, sequence.truth.position_m
    pixels, depth = project(cameras, position_m[:, :, None])
    inside = (pixels >= 0) & (pixels < cameras.image_size_wh) & (depth > 0)[..., None]
    seen_by = inside.all(axis=-1).sum(axis=-1)
    # The dataset says nothing of frame 0.
    seen_by[0] = seen_by[1]
    known_m = np.where(seen_by[..., None] >= 2, position_m, np.nan)
    apart_m = tracked.trajectories.position_m[:, :, None] - position_m[:, None]
    return Run(
        tracked.trajectories,
        replace(sequence.truth, position_m=known_m),
        seen_by,
        np.nan_to_num(np.linalg.norm(apart_m, axis=-1), nan=np.inf),
    )


def test_everyone_is_one_drone_and_nobody_is_invented(run: Run) -> None:
    """Three tracks, each at one drone only, no two at one; and they keep to them."""
    assert run.trajectories.num_drones == len(DRONES)
    assert sorted(run.track_of(drone) for drone in DRONES) == list(DRONES)
    assert evaluate(run.trajectories, run.truth).id_switches == 0
    nobody = run.tracked & (run.at.min(axis=-1) > 0.5)
    # One that flies out of sight at 2 m/s may be said to be there for a few frames more. Measured 0.
    assert nobody.sum() <= 5


def test_a_drone_that_comes_is_tracked_within_a_second(run: Run) -> None:
    """It must be there for ten frames of one chunk of 25, of which its first nine may be those of the chunk before."""
    tracked = run.tracked[:, run.track_of(COMES)]
    first_seen = int(np.argmax(run.seen_by[:, COMES] >= 3))
    assert not tracked[: first_seen - 3].any()
    assert 0 <= int(tracked.argmax()) - first_seen <= 9


def test_a_drone_that_goes_coasts_less_and_less_certain_and_then_is_lost(run: Run) -> None:
    track = run.track_of(COMES)
    status = run.trajectories.status[:, track]
    left, back = _unseen(run)
    assert (status[left - 10 : left - 2] == Status.TRACKED).all()
    coasting = left - 2 + np.flatnonzero(status[left - 2 : back] == Status.COASTING)
    # Half a second, in one piece.
    assert len(coasting) == 12
    assert (np.diff(coasting) == 1).all()
    variance_m2 = np.trace(run.trajectories.covariance_m2[:, track], axis1=-2, axis2=-1)
    assert (np.diff(variance_m2[coasting[0] - 1 : coasting[-1] + 1]) > 0).all()
    assert (status[coasting[-1] + 1 : back - 2] == Status.LOST).all()


def test_a_drone_that_comes_back_is_itself(run: Run) -> None:
    """Unseen for two seconds, half a metre from where it went; the one that is lost meanwhile stood elsewhere."""
    status = run.trajectories.status[:, run.track_of(COMES)]
    left, back = _unseen(run)
    assert (status[back + 9 :] == Status.TRACKED).all()
    assert (run.trajectories.status[left:back, run.track_of(LANDS)] == Status.LOST).any()


def test_a_drone_that_stands_is_swallowed_and_takes_off_as_itself(run: Run) -> None:
    """It is lost while it is background; when it takes off it leaves a hole, which is nobody."""
    status = run.trajectories.status[:, run.track_of(LANDS)]
    landed, flying = int(LANDS_S * FPS), int((TAKES_OFF_S + 1.0) * FPS)
    assert (status[:landed] == Status.TRACKED).all()
    assert (status[landed + 50 : landed + 75] == Status.LOST).all()
    assert (status[flying:] == Status.TRACKED).all()


def test_two_cameras_are_enough_and_the_covariance_says_how_good_they_are(run: Run) -> None:
    track = run.track_of(FLIES_OUT)
    by_two, by_four = (np.flatnonzero(run.seen_by[:, FLIES_OUT] == number) for number in (2, 4))
    assert len(by_two) > 50
    assert run.tracked[by_two, track].mean() > 0.95
    residual_m = run.trajectories.position_m[:, track] - run.truth.position_m[:, FLIES_OUT]
    residual_m -= np.nanmedian(residual_m, axis=0)
    covariance_m2 = run.trajectories.covariance_m2[:, track]
    nees = np.einsum("ni,nij,nj->n", residual_m, np.linalg.inv(covariance_m2), residual_m)
    std_m = np.sqrt(np.trace(covariance_m2, axis1=-2, axis2=-1))
    # Ten metres away and from one side, where a cell is 36 mm wide; before, 14 to 32. Measured 83 mm and 21 mm.
    error_m = np.linalg.norm(residual_m, axis=-1)
    assert np.nanmean(error_m[by_two]) < 0.15
    assert np.nanmean(error_m[by_four]) < 0.04
    # Measured 1.7 times as much.
    assert std_m[by_two].mean() > 1.3 * std_m[by_four].mean()
    # 3 for honest covariances. Two seconds are few samples of errors that last for half of one. Measured 6.9.
    assert nees[by_two].mean() < 14


def _unseen(run: Run) -> tuple[int, int]:
    """The frames in which the drone that comes and goes leaves the sight of two cameras, and is back in it."""
    frames = np.flatnonzero((np.arange(NUM_FRAMES) > 60) & (run.seen_by[:, COMES] < 2))
    return int(frames[0]), int(frames[-1]) + 1
