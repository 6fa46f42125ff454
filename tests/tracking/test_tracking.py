"""Tracking a whole recording: drones enter, leave and return. Silhouettes are drawn by casting rays."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import ROOM_M, drawn_silhouettes, ring_rig, track_settings

from psotrack.tracking.births import InitialState
from psotrack.tracking.identity import postprocess
from psotrack.tracking.swarm import RunInputs, track_silhouettes, tracker_settings
from psotrack.trajectories import Status

pytestmark = pytest.mark.slow

FPS = 25.0
REDUCTION = 2
NUM_FRAMES = 130
RIG = ring_rig(5, image_size_wh=(480, 360))
SIZE_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]])
#: A cell of a silhouette is 2 px; at 4 m and a focal length of 390 px that is 2 cm.
CELL_M = 0.02
#: Lengths that are learned, as multiples of an ellipsoid's: drones lie between ellipses and rhombi (see `moments`).
LEARNED = 1.1
EFFORT = {"particles": 20, "iterations": 15}
SETTINGS = track_settings(**EFFORT)

#: The first drone is away for a while and comes back elsewhere. The second enters in the last nine frames of a block of
#: 25: it is found in ten frames, so that both its block and the next one are tracked again.
AWAY = slice(60, 100)
ENTERS = 43


def paths():
    """(frames, 2, 3) positions; NaN where there is no drone."""
    time_s = np.arange(NUM_FRAMES)[:, None] / FPS
    first = np.array([-0.9, -0.6, 1.2]) + time_s * [0.25, 0.1, 0.05]
    first[AWAY.stop :] += [0.3, -0.9, 0.2]
    second = np.array([1.4, 0.9, 0.9]) + time_s * [-0.4, 0.05, 0.05]
    truth = np.stack([first, second], axis=1)
    truth[AWAY, 0] = np.nan
    truth[:ENTERS, 1] = np.nan
    return truth


TRUTH_M = paths()
FIRST = InitialState(TRUTH_M[:1, 0], np.array([[0.25, 0.1, 0.05]]), 0.75 * SIZE_M[:1], np.array([5.0]))


@pytest.fixture(scope="module")
def silhouettes(optimised):
    return drawn_silhouettes(RIG, TRUTH_M, SIZE_M, REDUCTION)


def track(silhouettes, given=None, **settings):
    runs = [RunInputs(ROOM_M, tracker_settings(track_settings(**(EFFORT | settings))), given)]
    ((tracks, _),) = track_silhouettes(RIG, silhouettes, runs, fps=FPS)
    return tracks, trajectories_of(tracks)


def trajectories_of(tracks, *, smoothed=False):
    smoothing = SETTINGS.motion if smoothed else None
    return postprocess(tracks, SETTINGS.motion, SETTINGS.identity, fps=FPS, smoothing=smoothing)[0]


@pytest.fixture(scope="module")
def tracked(silhouettes):
    """Tracks and trajectories of both drones, of which nothing was given."""
    return track(silhouettes)


def test_a_drone_that_enters_late_in_a_block_has_a_track_from_where_it_enters(tracked):
    tracks, trajectories = tracked
    assert trajectories.num_drones == 2
    new = [arrival for arrival in tracks.arrivals if not arrival.again]
    assert [(arrival.frame, arrival.drone) for arrival in new] == [(ENTERS, 1)]
    assert not trajectories.seen[:ENTERS, 1].any()
    assert np.isnan(trajectories.position_m[:ENTERS, 1]).all()
    assert (trajectories.status[ENTERS:, 1] == Status.TRACKED).all()
    error_m = np.linalg.norm(trajectories.position_m - TRUTH_M, axis=-1)[ENTERS:, 1]
    # The median is a fraction of a cell. The first frames start from a coarse position; their limit is two cells.
    assert np.median(error_m) < CELL_M / 2
    assert error_m.max() < 2 * CELL_M


def test_a_drone_that_returns_keeps_its_number(tracked):
    """The swarm finds the drone near its last position, or the residual foreground shows where the drone is."""
    tracks, trajectories = tracked
    assert [(arrival.frame, arrival.drone) for arrival in tracks.arrivals if arrival.again] == [
        (AWAY.stop, 0)
    ]
    status = trajectories.status[:, 0]
    coasting = AWAY.start + round(SETTINGS.status.max_coasting_s * FPS)
    assert (status[: AWAY.start] == Status.TRACKED).all()
    assert (status[AWAY.start : coasting] == Status.COASTING).all()
    assert (status[coasting : AWAY.stop] == Status.LOST).all()
    assert (status[AWAY.stop :] == Status.TRACKED).all()
    error_m = np.linalg.norm(trajectories.position_m - TRUTH_M, axis=-1)[AWAY.stop :, 0]
    assert error_m.max() < 2 * CELL_M
    spread = np.trace(trajectories.covariance_m2[: AWAY.stop, 0], axis1=-2, axis2=-1)
    assert (np.diff(spread[AWAY.start : coasting]) > 0).all()
    assert spread[coasting - 1] > 100 * spread[AWAY.start - 1]


@pytest.mark.parametrize("wrong", [0.75, 1.3])
def test_sizes_converge_to_the_drawn_sizes(silhouettes, wrong):
    first = replace(silhouettes, num_frames=50, arrays=tuple(array[:50] for array in silhouettes.arrays))
    given = replace(FIRST, size_m=wrong * LEARNED * SIZE_M[:1])
    tracks, _ = track(first, given, drones=1)
    assert (tracks.size_frames[0] > 40).all()
    # Edges are good to a quarter of a pixel, and the drones are at least 25 pixels high.
    np.testing.assert_allclose(tracks.size_m[0] / SIZE_M[0], LEARNED, rtol=0.02)
    tracks, _ = track(first, given, drones=1, learn_sizes=False)
    np.testing.assert_allclose(tracks.size_m, given.size_m, rtol=1e-6)


def test_a_drone_as_large_as_the_given_one_is_found_beside_it_from_the_first_frame(optimised):
    """What is larger than twice the known drones is no drone, and the given drone is known."""
    size_m = np.full((2, 3), 0.8)
    truth_m = TRUTH_M[:25].copy()
    truth_m[:, 1] = truth_m[:, 0] + [1.6, 1.2, 0.0]
    given = InitialState(FIRST.position_m, FIRST.velocity_m_s, size_m[:1], FIRST.num_cameras)
    tracks, _ = track(drawn_silhouettes(RIG, truth_m, size_m, REDUCTION), given)
    assert tracks.num_drones == 2
    assert (tracks.status == Status.TRACKED).all()


def test_no_track_is_added_beyond_the_number_of_drones(silhouettes):
    tracks, trajectories = track(silhouettes, FIRST, drones=1)
    assert trajectories.num_drones == 1
    assert all(arrival.again for arrival in tracks.arrivals)


def test_smoothing(tracked):
    """Smoothing makes covariances smaller and errors no larger."""
    tracks, filtered = tracked
    smoothed = trajectories_of(tracks, smoothed=True)
    seen = filtered.seen & np.isfinite(TRUTH_M).all(axis=-1)
    error_m = np.linalg.norm(smoothed.position_m - TRUTH_M, axis=-1)
    # Silhouettes without noise leave little to smooth: the mean error is 2 mm before and after.
    assert error_m[seen].mean() < CELL_M / 4
    spread = [np.trace(of.covariance_m2[seen], axis1=-2, axis2=-1).mean() for of in (filtered, smoothed)]
    assert spread[1] < spread[0]
    np.testing.assert_array_equal(smoothed.status, filtered.status)


def test_a_recording_that_is_no_multiple_of_a_block(silhouettes, tracked):
    """The last block is filled up with empty frames, which do not change the result."""
    shorter = replace(silhouettes, num_frames=40, arrays=tuple(array[:40] for array in silhouettes.arrays))
    _, trajectories = track(shorter)
    assert trajectories.num_frames == 40
    np.testing.assert_array_equal(trajectories.position_m, tracked[1].position_m[:40, :1])
