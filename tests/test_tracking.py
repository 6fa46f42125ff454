"""Tracking a whole recording chunk by chunk: drones enter, leave and return. Silhouettes are drawn by casting rays."""

import contextlib
import threading
from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers import ROOM_M, draw_coverage, ring_rig, track_settings

from psotrack.identity import postprocess
from psotrack.initiation import InitialState, StartSource, complete_initial_state, find_initial_state
from psotrack.settings import DroneSettings
from psotrack.silhouettes import Silhouettes
from psotrack.tracking import RunInputs, track_silhouettes, tracker_settings
from psotrack.trajectories import Status
from psotrack.trajectories.tracks import ARRAYS

FPS = 25.0
REDUCTION = 2
NUM_FRAMES = 130
RIG = ring_rig(5, image_size_wh=(480, 360))
SIZE_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]])
#: A cell of a silhouette is 2 px; at 4 m and a focal length of 390 px that is 2 cm.
CELL_M = 0.02
EFFORT = {"particles": 20, "iterations": 15}
SETTINGS = track_settings(**EFFORT)

#: The first drone is away for a while and comes back elsewhere; the second enters late.
AWAY = slice(45, 90)
ENTERS = 31


def paths():
    """(frames, 2, 3) positions; NaN where there is no drone."""
    time_s = np.arange(NUM_FRAMES)[:, None] / FPS
    first = np.array([-0.9, -0.6, 1.2]) + time_s * [0.25, 0.1, 0.05]
    first[AWAY.stop :] += [0.3, -0.9, 0.2]
    second = np.array([0.9, 0.9, 0.9]) + time_s * [-0.1, 0.05, 0.05]
    truth = np.stack([first, second], axis=1)
    truth[AWAY, 0] = np.nan
    truth[:ENTERS, 1] = np.nan
    return truth


TRUTH_M = paths()
NO_DRONES = InitialState(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
FIRST = InitialState(TRUTH_M[:1, 0], np.array([[0.25, 0.1, 0.05]]), SIZE_M[:1], np.array([5.0]))


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


def run_inputs(start, **settings):
    return RunInputs(start, ROOM_M, tracker_settings(track_settings(**(EFFORT | settings))))


def track(silhouettes, start, **settings):
    ((tracks, _),) = track_silhouettes(RIG, silhouettes, [run_inputs(start, **settings)], fps=FPS)
    return tracks, trajectories_of(tracks)


def trajectories_of(tracks, *, smoothed=False):
    return postprocess(
        tracks,
        SETTINGS.motion,
        SETTINGS.identity,
        fps=FPS,
        smoothing=SETTINGS.motion if smoothed else None,
    )[0]


@pytest.fixture(scope="module")
def batch(silhouettes, optimised):
    """Three runs in one batch, with different seeds, numbers of drones and initial states."""
    starts = [FIRST, FIRST, NO_DRONES]
    changes = [{"seed": 0}, {"seed": 5, "drones": 1}, {"seed": 2, "iterations": 4, "inertia": 0.5}]
    runs = [run_inputs(start, **change) for start, change in zip(starts, changes, strict=True)]
    return list(zip(runs, track_silhouettes(RIG, silhouettes, runs, fps=FPS), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("run", range(3))
def test_a_run_of_a_batch_is_the_run_alone(batch, silhouettes, run):
    """The bits do not depend on the device of the run and on the other runs of the batch."""
    assert len(jax.devices()) == 2
    inputs, (tracked, _) = batch[run]
    ((alone, _),) = track_silhouettes(RIG, silhouettes, [inputs], fps=FPS)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(tracked, name), getattr(alone, name), err_msg=name)
    for name, value in vars(tracked.sizes).items():
        np.testing.assert_array_equal(value, getattr(alone.sizes, name), err_msg=name)
    assert tracked.arrivals == alone.arrivals


@pytest.mark.slow
def test_an_interrupt_stops_all_devices(silhouettes):
    """The first device's share raises; the shares of the other devices stop after their present chunk."""
    begun, raised = [], threading.Event()

    class Slow(Silhouettes):
        """Silhouettes that the threads of other devices read only after the first device has raised."""

        def read(self, start, stop):
            if threading.current_thread() is not threading.main_thread():
                assert raised.wait(300)
                begun.append(start)
            return super().read(start, stop)

    @contextlib.contextmanager
    def report(description, total):
        raised.set()
        raise KeyboardInterrupt
        yield

    slow = Slow(**vars(silhouettes))
    runs = [run_inputs(FIRST, seed=seed) for seed in range(2)]
    with pytest.raises(KeyboardInterrupt):
        track_silhouettes(RIG, slow, runs, fps=FPS, report=report)
    # At most two chunks: the chunk that was being read, and the chunk that began before the thread saw the interrupt.
    assert len(begun) <= 2


@pytest.mark.slow
def test_all_chunks_run_the_same_program(silhouettes, caplog):
    """The learned sizes once began as another type than later chunks used, so the program was compiled twice."""
    shorter = replace(silhouettes, num_frames=60, arrays=tuple(array[:60] for array in silhouettes.arrays))
    with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):
        track(shorter, FIRST, drones=1, particles=6)
    compiled = [
        record.getMessage().split()[1] for record in caplog.records if "Compiling " in record.getMessage()
    ]
    assert sum("_track_batch" in name for name in compiled) == 1


@pytest.mark.slow
def test_runs_of_other_seeds_differ(batch):
    assert (batch[0][1][0].position_m[5] != batch[1][1][0].position_m[5]).any()


@pytest.fixture(scope="module")
def tracked_from_first(silhouettes):
    """Tracks and trajectories of both drones; the initial state holds the first drone alone."""
    return track(silhouettes, FIRST)


@pytest.mark.slow
def test_a_drone_that_enters_gets_a_new_track(tracked_from_first):
    tracked, trajectories = tracked_from_first
    new = [arrival for arrival in tracked.arrivals if not arrival.again]
    assert [arrival.drone for arrival in new] == [1]
    # The track begins where the drone enters, and has no position before.
    assert ENTERS <= new[0].frame <= ENTERS + 2
    before = trajectories.position_m[: new[0].frame, 1]
    assert np.isnan(before).all()
    assert not trajectories.seen[: new[0].frame, 1].any()
    error_m = np.linalg.norm(trajectories.position_m[new[0].frame :, 1] - TRUTH_M[new[0].frame :, 1], axis=-1)
    # The median is a fraction of a cell. The first frames start from a coarse position; their limit is two cells.
    assert np.median(error_m) < CELL_M / 2
    assert error_m.max() < 2 * CELL_M


@pytest.mark.slow
def test_a_drone_that_returns_keeps_its_number(tracked_from_first):
    """The swarm finds the drone near its last position, or the residual foreground shows where the drone is."""
    tracked, trajectories = tracked_from_first
    assert {arrival.drone for arrival in tracked.arrivals if arrival.again} <= {0}
    status = trajectories.status[:, 0]
    coasting = round(SETTINGS.status.max_coasting_s * FPS)
    assert (status[: AWAY.start] == Status.TRACKED).all()
    assert (status[AWAY.start : AWAY.start + coasting] == Status.COASTING).all()
    assert (status[AWAY.start + coasting : AWAY.stop] == Status.LOST).all()
    assert (status[AWAY.stop + 2 :] == Status.TRACKED).all()
    error_m = np.linalg.norm(trajectories.position_m - TRUTH_M, axis=-1)[AWAY.stop + 2 :, 0]
    assert error_m.max() < 2 * CELL_M


@pytest.mark.slow
def test_covariance_grows_while_a_drone_coasts(tracked_from_first):
    _, trajectories = tracked_from_first
    coasting = trajectories.status[:, 0] == Status.COASTING
    spread = np.trace(trajectories.covariance_m2[coasting, 0], axis1=-2, axis2=-1)
    assert (np.diff(spread) > 0).all()
    assert spread[-1] > 100 * np.trace(trajectories.covariance_m2[AWAY.start - 1, 0])


@pytest.mark.slow
def test_sizes_are_learned(tracked_from_first):
    """Sizes are measured by second moments, whose half length is a tenth more than the half axis of an ellipse."""
    tracked, _ = tracked_from_first
    assert (tracked.sizes.num_frames[0] > 40).all()
    # Measured 1.08 to 1.12 of the drawn lengths.
    np.testing.assert_allclose(tracked.sizes.size_m / SIZE_M, 1.1, atol=0.06)


@pytest.mark.slow
def test_a_recording_may_begin_without_drones(silhouettes):
    """The first drone is visible from the first frame, and its track begins there."""
    tracked, trajectories = track(silhouettes, NO_DRONES)
    assert trajectories.num_drones == 2
    assert [(arrival.frame, arrival.again) for arrival in tracked.arrivals[:1]] == [(0, False)]
    for drone in range(2):
        both = trajectories.seen[:, drone] & np.isfinite(TRUTH_M[:, drone]).all(axis=-1)
        assert both.sum() > 60
        error_m = np.linalg.norm(trajectories.position_m[both, drone] - TRUTH_M[both, drone], axis=-1)
        assert np.median(error_m) < CELL_M / 2


@pytest.mark.slow
def test_no_track_is_added_beyond_the_number_of_drones(silhouettes):
    tracked, trajectories = track(silhouettes, FIRST, drones=1)
    assert trajectories.num_drones == 1
    assert all(arrival.again for arrival in tracked.arrivals)


@pytest.mark.slow
def test_sizes_stay_where_learning_is_off(silhouettes):
    tracked, _ = track(silhouettes, FIRST, drones=1, learn_sizes=False)
    np.testing.assert_allclose(tracked.sizes.size_m, SIZE_M[:1], rtol=1e-6)


@pytest.mark.slow
def test_smoothing(tracked_from_first, silhouettes):
    """Smoothing makes covariances smaller and errors no larger."""
    tracked, filtered = tracked_from_first
    smoothed = trajectories_of(tracked, smoothed=True)
    seen = filtered.seen & np.isfinite(TRUTH_M).all(axis=-1)
    error_m = np.linalg.norm(smoothed.position_m - TRUTH_M, axis=-1)
    # Silhouettes without noise leave little to smooth: the mean error is 2 mm before and after.
    assert error_m[seen].mean() < CELL_M / 4
    spread = [np.trace(of.covariance_m2[seen], axis1=-2, axis2=-1).mean() for of in (filtered, smoothed)]
    assert spread[1] < spread[0]
    np.testing.assert_array_equal(smoothed.status, filtered.status)


@pytest.mark.slow
def test_frames_of_a_recording_that_is_no_multiple_of_a_chunk(silhouettes, tracked_from_first):
    """The last chunk is filled up with empty frames, which do not change the result."""
    assert NUM_FRAMES % 25
    shorter = replace(silhouettes, num_frames=40, arrays=tuple(array[:40] for array in silhouettes.arrays))
    _, trajectories = track(shorter, FIRST)
    assert trajectories.num_frames == 40
    np.testing.assert_array_equal(trajectories.position_m[:25], tracked_from_first[1].position_m[:25, :1])


@pytest.mark.slow
def test_detections_add_drones_that_silhouettes_do_not_show(silhouettes, tmp_path):
    """At frame 0 the silhouettes show the first drone alone, and the detections show both drones."""
    source = StartSource("auto", tmp_path)
    hidden_m = np.array([0.9, 0.9, 0.9])
    detected = InitialState(
        np.stack([FIRST.position_m[0] + [0.05, 0.0, -0.1], hidden_m]),
        np.zeros((2, 3)),
        SIZE_M,
        np.full(2, 4.0),
    )

    def found(detected, drones=SETTINGS.drones):
        how = {"fps": FPS, "bounds_m": ROOM_M, "max_speed_m_s": 6.0}
        state = find_initial_state(RIG, silhouettes, source, drones, **how)
        return complete_initial_state(state, detected, drones, source)

    alone, both = found(None), found(detected)
    assert len(alone.position_m) == 1
    np.testing.assert_array_equal(both.position_m, [alone.position_m[0], hidden_m])
    np.testing.assert_array_equal(both.size_m, [alone.size_m[0], SIZE_M[1]])
    np.testing.assert_array_equal(found(detected, DroneSettings(count=1)).position_m, alone.position_m)
    np.testing.assert_array_equal(found(NO_DRONES).position_m, alone.position_m)
