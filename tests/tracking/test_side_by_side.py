"""Runs of a batch: one after the other as on a CPU, and side by side as on an accelerator, both on the CPU.

Silhouettes are drawn by casting rays.
"""

from dataclasses import fields

import numpy as np
import pytest
from helpers import ROOM_M, cameras_of, drawn_silhouettes, ring_rig, track_settings

from psotrack.pipeline import track_runs
from psotrack.recordings import FrameTimes, Recording, Reference
from psotrack.tracking.births import InitialState
from psotrack.tracking.identity import postprocess
from psotrack.tracking.swarm import RunInputs, track_silhouettes, tracker_settings
from psotrack.trajectories import ARRAYS, Status, Trajectories

pytestmark = pytest.mark.slow

FPS = 25.0
REDUCTION = 2
NUM_FRAMES = 60
RIG = ring_rig(5, image_size_wh=(480, 360))
SIZE_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]])
EFFORT = {"particles": 20, "iterations": 15}

#: The second drone enters late, so that blocks are tracked again, with more drones.
ENTERS = 20

#: Rounding changes which particle is the best, and then the whole search. The vertex of the score, to which each search
#: converges, stays the same: to a fortieth of a silhouette's cell, which is 2 cm.
MEDIAN_M = 0.5e-3


def paths():
    """(frames, 2, 3) positions; NaN where there is no drone."""
    time_s = np.arange(NUM_FRAMES)[:, None] / FPS
    first = np.array([-0.9, -0.6, 1.2]) + time_s * [0.25, 0.1, 0.05]
    second = np.array([0.9, 0.9, 0.9]) + time_s * [-0.1, 0.05, 0.05]
    truth = np.stack([first, second], axis=1)
    truth[:ENTERS, 1] = np.nan
    return truth


TRUTH_M = paths()


@pytest.fixture(scope="module")
def silhouettes():
    return drawn_silhouettes(RIG, TRUTH_M, SIZE_M, REDUCTION)


def first_drone(size):
    """Initial state of the first drone alone, whose lengths are `size` times the true ones."""
    return InitialState(TRUTH_M[:1, 0], np.array([[0.25, 0.1, 0.05]]), size * SIZE_M[:1], np.array([5.0]))


def run_inputs(given, **settings):
    return RunInputs(ROOM_M, tracker_settings(track_settings(**(EFFORT | settings))), given)


#: Runs of different seeds, sizes and numbers of drones, of which one finds all its drones itself.
RUNS = [
    run_inputs(None, seed=0),
    run_inputs(first_drone(0.85), seed=5),
    run_inputs(first_drone(1.15), seed=2, drones=1, iterations=9, inertia=0.5),
]


def tracked(silhouettes, runs, *, side_by_side):
    return track_silhouettes(RIG, silhouettes, runs, fps=FPS, side_by_side=side_by_side)


@pytest.fixture(scope="module")
def one_after_another(silhouettes):
    return tracked(silhouettes, RUNS, side_by_side=False)


@pytest.mark.parametrize("run", range(len(RUNS)))
def test_a_run_of_a_batch_has_the_bytes_of_the_run_alone(silhouettes, one_after_another, run):
    ((alone, alone_places),) = tracked(silhouettes, [RUNS[run]], side_by_side=False)
    tracks, places = one_after_another[run]
    for name in (*ARRAYS, "size_m", "size_frames"):
        assert getattr(tracks, name).tobytes() == getattr(alone, name).tobytes(), name
    for each in fields(places):
        assert getattr(places, each.name).tobytes() == getattr(alone_places, each.name).tobytes(), each.name
    assert tracks.arrivals == alone.arrivals
    assert (tracks.position_m[5] != one_after_another[run - 1][0].position_m[5, : tracks.num_drones]).any()


def test_runs_side_by_side_are_the_runs_one_after_another(silhouettes, one_after_another):
    side_by_side = tracked(silhouettes, RUNS, side_by_side=True)
    for (one, one_places), (other, other_places) in zip(side_by_side, one_after_another, strict=True):
        assert_same_tracks(one, other)
        # A place follows its drone, by at most 120 px / m.
        off_px = np.abs(one_places.middle_px - other_places.middle_px)
        assert np.nanmedian(off_px) < 120 * MEDIAN_M
    # Two programs were compared: rounding differs in some frame.
    assert (side_by_side[0][0].position_m != one_after_another[0][0].position_m).any()
    ((alone, _),) = tracked(silhouettes, RUNS[1:2], side_by_side=True)
    assert_same_tracks(side_by_side[1][0], alone)


def assert_same_tracks(one, other):
    """The same drones with the same numbers and statuses, at the same places."""
    assert one.arrivals == other.arrivals
    np.testing.assert_array_equal(one.status, other.status)
    settings = track_settings()
    settled, expected = (
        postprocess(each, settings.motion, settings.identity, fps=FPS, smoothing=None)[0]
        for each in (one, other)
    )
    np.testing.assert_array_equal(settled.status, expected.status)
    distance_m = np.linalg.norm(settled.position_m - expected.position_m, axis=-1)
    seen = settled.status == Status.TRACKED
    assert seen.sum() > 0.8 * NUM_FRAMES
    for drone in range(settled.num_drones):
        assert np.median(distance_m[seen[:, drone], drone]) <= MEDIAN_M
    # The drones are metres apart: a drone with another number would be no nearer than that in a single frame.
    assert distance_m[seen].max() < SIZE_M.min()
    np.testing.assert_allclose(one.size_m, other.size_m, atol=2 * MEDIAN_M)


def test_runs_together_have_the_covariances_and_camera_errors_of_each_run_alone(silhouettes, tmp_path):
    """The errors of the cameras are learned from each run's middles."""
    frame = np.arange(NUM_FRAMES)
    truth = Trajectories(frame, frame / FPS, ("first", "second"), TRUTH_M)
    times = {name: FrameTimes(NUM_FRAMES, FPS) for name in RIG.names}
    bounds_m = tuple(ROOM_M.T.ravel().tolist())
    recording = Recording(
        "drawn", tmp_path, cameras_of(RIG, times=times), Reference(truth), bounds_m=bounds_m
    )
    size_m = {"drones.size_m": tuple(SIZE_M[0].tolist())}
    settings = [track_settings(**EFFORT, seed=seed, init="truth", **size_m) for seed in (0, 5)]
    together = track_runs(recording, silhouettes, settings)
    for one, of_run in zip(settings, together, strict=True):
        (alone,) = track_runs(recording, silhouettes, [one])
        for name in ("position_m", "covariance_m2", "relative_covariance_m2"):
            np.testing.assert_array_equal(
                getattr(of_run.trajectories, name), getattr(alone.trajectories, name)
            )
        assert of_run.record["camera_errors"] == alone.record["camera_errors"]
    # Each run has its own errors: other seeds place the drones by other roundings.
    assert together[0].record["camera_errors"] != together[1].record["camera_errors"]
