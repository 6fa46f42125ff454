"""Drones that come and go, through the chunks of a recording whose silhouettes are drawn by casting rays."""

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
NOBODY = InitialState(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
FIRST = InitialState(TRUTH_M[:1, 0], np.array([[0.25, 0.1, 0.05]]), SIZE_M[:1], np.array([5.0]))


@pytest.fixture(scope="module")
def silhouettes():
    there = np.isfinite(TRUTH_M).all(axis=-1)
    images = [
        draw_coverage(RIG, positions[who], SIZE_M[who], REDUCTION)
        for positions, who in zip(TRUTH_M, there, strict=True)
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
    return postprocess(tracks, SETTINGS.motion, SETTINGS.identity, fps=FPS, smoothed=smoothed)[0]


@pytest.fixture(scope="module")
def batch(silhouettes):
    """Three runs at once: seeds, numbers and starts that differ. Drones are born in one and not in another."""
    starts = [FIRST, FIRST, NOBODY]
    changes = [{"seed": 0}, {"seed": 5, "drones": 1}, {"seed": 2, "iterations": 4, "inertia": 0.5}]
    runs = [run_inputs(start, **change) for start, change in zip(starts, changes, strict=True)]
    return list(zip(runs, track_silhouettes(RIG, silhouettes, runs, fps=FPS), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("run", range(3))
def test_a_run_of_a_batch_is_the_run_alone(batch, silhouettes, run):
    """To the last bit, whichever device it was on and whoever was beside it."""
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
        """Silhouettes of which only the thread of the first device reads at once."""

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
    # Two chunks at most: one that was being read when the interrupt came, and one that had begun before it was seen.
    assert len(begun) <= 2


@pytest.mark.slow
def test_chunk_after_chunk_is_one_program(silhouettes, caplog):
    """It was compiled twice: what is learned of sizes began as another type than it went on with."""
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
def told(silhouettes):
    """Both tracked from a start that knows the first drone alone."""
    return track(silhouettes, FIRST)


def test_a_drone_that_enters_is_born(told):
    tracked, trajectories = told
    born = [arrival for arrival in tracked.arrivals if not arrival.again]
    assert [arrival.drone for arrival in born] == [1]
    # It is there from this frame on; nobody has seen it before.
    assert ENTERS <= born[0].frame <= ENTERS + 2
    before = trajectories.position_m[: born[0].frame, 1]
    assert np.isnan(before).all()
    assert not trajectories.seen[: born[0].frame, 1].any()
    error_m = np.linalg.norm(
        trajectories.position_m[born[0].frame :, 1] - TRUTH_M[born[0].frame :, 1], axis=-1
    )
    # Placed to a fraction of a cell, but for its first frames, which begin from a coarse place. Limit two cells.
    assert np.median(error_m) < CELL_M / 2
    assert error_m.max() < 2 * CELL_M


def test_a_drone_that_is_lost_comes_back_as_itself(told):
    """The swarm finds it about its last place, or else what the tracks leave unexplained shows where it is."""
    tracked, trajectories = told
    assert {arrival.drone for arrival in tracked.arrivals if arrival.again} <= {0}
    status = trajectories.status[:, 0]
    coasting = round(SETTINGS.status.max_coasting_s * FPS)
    assert (status[: AWAY.start] == Status.TRACKED).all()
    assert (status[AWAY.start : AWAY.start + coasting] == Status.COASTING).all()
    assert (status[AWAY.start + coasting : AWAY.stop] == Status.LOST).all()
    assert (status[AWAY.stop + 2 :] == Status.TRACKED).all()
    error_m = np.linalg.norm(trajectories.position_m - TRUTH_M, axis=-1)[AWAY.stop + 2 :, 0]
    assert error_m.max() < 2 * CELL_M


def test_coasting_is_ever_less_certain(told):
    _, trajectories = told
    coasting = trajectories.status[:, 0] == Status.COASTING
    spread = np.trace(trajectories.covariance_m2[coasting, 0], axis1=-2, axis2=-1)
    assert (np.diff(spread) > 0).all()
    assert spread[-1] > 100 * np.trace(trajectories.covariance_m2[AWAY.start - 1, 0])


def test_sizes_are_learned(told):
    """From starts that are a fifth too large; a moment's half length is a tenth more than an ellipse's."""
    tracked, _ = told
    assert (tracked.sizes.num_frames[0] > 40).all()
    # Measured 1.08 to 1.12 of the drawn lengths.
    np.testing.assert_allclose(tracked.sizes.size_m / SIZE_M, 1.1, atol=0.06)


def test_a_recording_may_begin_without_drones(silhouettes):
    """The first drone is there from the first frame, so that it is only found late if one looks late."""
    tracked, trajectories = track(silhouettes, NOBODY)
    assert trajectories.num_drones == 2
    assert [(arrival.frame, arrival.again) for arrival in tracked.arrivals[:1]] == [(0, False)]
    for drone in range(2):
        both = trajectories.seen[:, drone] & np.isfinite(TRUTH_M[:, drone]).all(axis=-1)
        assert both.sum() > 60
        error_m = np.linalg.norm(trajectories.position_m[both, drone] - TRUTH_M[both, drone], axis=-1)
        assert np.median(error_m) < CELL_M / 2


@pytest.mark.slow
def test_nobody_is_born_beyond_the_number_of_drones(silhouettes):
    tracked, trajectories = track(silhouettes, FIRST, drones=1)
    assert trajectories.num_drones == 1
    assert all(arrival.again for arrival in tracked.arrivals)


@pytest.mark.slow
def test_sizes_may_be_pinned(silhouettes):
    tracked, _ = track(silhouettes, FIRST, drones=1, learn_sizes=False)
    np.testing.assert_allclose(tracked.sizes.size_m, SIZE_M[:1], rtol=1e-6)


def test_smoothing(told, silhouettes):
    """Smoothed tracks are more certain and no worse."""
    tracked, filtered = told
    smoothed = trajectories_of(tracked, smoothed=True)
    seen = filtered.seen & np.isfinite(TRUTH_M).all(axis=-1)
    error_m = np.linalg.norm(smoothed.position_m - TRUTH_M, axis=-1)
    # Silhouettes without noise leave little to smooth: 2 mm before as after.
    assert error_m[seen].mean() < CELL_M / 4
    spread = [np.trace(of.covariance_m2[seen], axis1=-2, axis2=-1).mean() for of in (filtered, smoothed)]
    assert spread[1] < spread[0]
    np.testing.assert_array_equal(smoothed.status, filtered.status)


def test_frames_of_a_recording_that_is_no_multiple_of_a_chunk(silhouettes, told):
    """The last chunk is filled up with empty frames, of which nothing is to be seen."""
    assert NUM_FRAMES % 25
    shorter = replace(silhouettes, num_frames=40, arrays=tuple(array[:40] for array in silhouettes.arrays))
    _, trajectories = track(shorter, FIRST)
    assert trajectories.num_frames == 40
    np.testing.assert_array_equal(trajectories.position_m[:25], told[1].position_m[:25, :1])


def test_detections_tell_of_drones_that_silhouettes_do_not_show(silhouettes, tmp_path):
    """The second drone is none of the silhouettes' at frame 0; a detector may see it, and the first one too."""
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
    np.testing.assert_array_equal(found(NOBODY).position_m, alone.position_m)
