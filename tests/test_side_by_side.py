"""Runs side by side, as an accelerator computes them, against runs one after the other, both on the CPU.

Silhouettes are drawn by casting rays.
"""

import numpy as np
import pytest
from helpers import ROOM_M, draw_coverage, ring_rig, track_settings

from psotrack.identity import postprocess
from psotrack.initiation import InitialState
from psotrack.pipeline import track_runs
from psotrack.recordings import FrameTimes, Recording
from psotrack.silhouettes import Silhouettes
from psotrack.tracking import (
    FoundDrones,
    RunInputs,
    middles_in_cameras,
    track_silhouettes,
    tracker_settings,
)
from psotrack.tracking.devices import computes_side_by_side
from psotrack.trajectories import Status, Trajectories

FPS = 25.0
REDUCTION = 2
NUM_FRAMES = 50
RIG = ring_rig(5, image_size_wh=(480, 360))
SIZE_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]])
EFFORT = {"particles": 20, "iterations": 15}

#: The second drone enters late, so that a chunk is tracked again with more drones.
ENTERS = 8

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
    there = np.isfinite(TRUTH_M).all(axis=-1)
    images = [
        draw_coverage(RIG, positions[visible], SIZE_M[visible], REDUCTION)
        for positions, visible in zip(TRUTH_M, there, strict=True)
    ]
    arrays = tuple(np.moveaxis(np.array(images), 1, 0))
    return Silhouettes(
        RIG.names, dict.fromkeys(RIG.names, "drawn"), REDUCTION, NUM_FRAMES, arrays[0].shape[1:], {}, arrays
    )


def first_drone(size):
    """Initial state of the first drone alone, whose lengths are `size` times the true ones."""
    return InitialState(TRUTH_M[:1, 0], np.array([[0.25, 0.1, 0.05]]), size * SIZE_M[:1], np.array([5.0]))


def run_inputs(start, **settings):
    return RunInputs(start, ROOM_M, tracker_settings(track_settings(**(EFFORT | settings))))


#: Runs of different seeds, sizes and numbers of drones. The first of the tests' two devices gets two runs, the second
#: gets one run in a batch for two.
RUNS = [
    run_inputs(first_drone(1.0), seed=0),
    run_inputs(first_drone(0.85), seed=5),
    run_inputs(first_drone(1.15), seed=2, drones=1, iterations=9, inertia=0.5),
]


def tracked(silhouettes, runs, *, side_by_side):
    """Tracks of each run, with the numbers of the drones after identities were settled."""
    results = track_silhouettes(RIG, silhouettes, runs, fps=FPS, side_by_side=side_by_side)
    settings = track_settings()
    return [
        (tracks, postprocess(tracks, settings.motion, settings.identity, fps=FPS, smoothing=None)[0])
        for tracks, _ in results
    ]


def assert_same_tracks(one, other):
    """The same drones with the same numbers and statuses, at the same places."""
    (tracks, trajectories), (other_tracks, other_trajectories) = one, other
    assert tracks.arrivals == other_tracks.arrivals
    np.testing.assert_array_equal(tracks.status, other_tracks.status)
    np.testing.assert_array_equal(trajectories.status, other_trajectories.status)
    position_m, other_m = trajectories.position_m, other_trajectories.position_m
    distance_m = np.linalg.norm(position_m - other_m, axis=-1)
    seen = trajectories.status == Status.TRACKED
    assert seen.sum() > 0.8 * NUM_FRAMES
    for drone in range(trajectories.num_drones):
        assert np.median(distance_m[seen[:, drone], drone]) <= MEDIAN_M
    # The drones are metres apart: a drone with another number would be no nearer than that in a single frame.
    assert distance_m[seen].max() < SIZE_M.min()
    np.testing.assert_allclose(tracks.sizes.size_m, other_tracks.sizes.size_m, atol=2 * MEDIAN_M)


@pytest.mark.parametrize(("platform", "expected"), [("cpu", False), ("gpu", True), ("tpu", True)])
def test_the_device_decides_how_runs_are_computed(platform, expected):
    """Not the process's default backend: a process with a GPU may compute on its CPU too."""
    assert computes_side_by_side(platform) is expected


# One test, because each worker that ran a part of it would compile the programs again.
@pytest.mark.slow
def test_runs_side_by_side_are_the_runs_one_after_another(silhouettes):
    side_by_side = tracked(silhouettes, RUNS, side_by_side=True)
    one_after_another = tracked(silhouettes, RUNS, side_by_side=False)
    for one, other in zip(side_by_side, one_after_another, strict=True):
        assert_same_tracks(one, other)
    # Two programs were compared: rounding differs in some frame.
    assert (side_by_side[0][0].position_m != one_after_another[0][0].position_m).any()
    # In the batch of two that held this run alone, a copy of the run filled the other place; alone, there is one place.
    number = 1
    (alone,) = tracked(silhouettes, [RUNS[number]], side_by_side=True)
    assert_same_tracks(side_by_side[number], alone)


def found_drones(*, shift_m, drones):
    """Drones beside their true places, as tracks have them; the second one is not found at first."""
    position_m = TRUTH_M[:, :drones] + np.array([shift_m, 0.0, 0.0])
    velocity_m_s = np.gradient(position_m, 1 / FPS, axis=0)
    return FoundDrones(SIZE_M[:drones], position_m, velocity_m_s)


FOUND = [
    found_drones(shift_m=0.0, drones=2),
    found_drones(shift_m=0.02, drones=1),
    found_drones(shift_m=-0.03, drones=2),
]


def middles(silhouettes, runs, **choice):
    found = middles_in_cameras(RIG.cameras, silhouettes, runs, **choice)
    return [(each.middle_px, each.half_px) for each in found]


def test_middles_of_many_runs_are_those_of_each_run_alone(silhouettes):
    together = middles(silhouettes, FOUND)
    for run, of_run in zip(FOUND, together, strict=True):
        np.testing.assert_array_equal(middles(silhouettes, [run])[0], of_run)
        middle_px = of_run[0]
        assert np.isfinite(middle_px).mean() > 0.5
        assert not np.isfinite(middle_px[:ENTERS, 1:]).any()
    # The first and the last run are beside each other: they were not mixed up.
    assert np.nanmax(np.abs(together[0][1] - together[2][1])) > 0.01


def test_middles_side_by_side_are_those_one_after_another(silhouettes):
    side_by_side = middles(silhouettes, FOUND, side_by_side=True)
    for one, other in zip(side_by_side, middles(silhouettes, FOUND, side_by_side=False), strict=True):
        # Float32 of places up to 480 px: rounding is below 1e-4 px, a thousandth of the noise of a camera.
        np.testing.assert_allclose(one, other, atol=1e-3)


@pytest.mark.slow
def test_runs_together_have_the_covariances_and_camera_errors_of_each_run_alone(silhouettes, tmp_path):
    """The errors of the cameras are learned from all runs' middles, which are found together."""
    frame = np.arange(NUM_FRAMES)
    truth = Trajectories(frame, frame / FPS, ("first", "second"), TRUTH_M)
    times = {name: FrameTimes(NUM_FRAMES, FPS) for name in RIG.names}
    bounds_m = tuple(ROOM_M.T.ravel().tolist())
    recording = Recording("drawn", tmp_path, RIG, {}, truth, frame_times=times, bounds_m=bounds_m)
    settings = [
        track_settings(**EFFORT, seed=seed, init="truth", **{"drones.size_m": tuple(SIZE_M[0].tolist())})
        for seed in (0, 5)
    ]
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
