"""The tracker in one block of frames, from given first positions. Silhouettes are drawn by casting rays."""

import numpy as np
import pytest
from helpers import (
    ROOM_M,
    assert_same,
    draw_coverage,
    drawn_silhouettes,
    ring_rig,
    silhouettes_in_memory,
    track_settings,
)

from psotrack.tracking.births import InitialState
from psotrack.tracking.swarm import RunInputs, track_silhouettes, tracker_settings
from psotrack.trajectories import Status

FPS = 25.0
REDUCTION = 2
NUM_FRAMES = 24
RIG = ring_rig(5, coefficients=5)
SIZE_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]])


def curve(time_s):
    """Two drones at 1 m/s on arcs: (frames, 2, 3) positions."""
    first = np.stack(
        [0.8 * np.cos(1.2 * time_s), 0.8 * np.sin(1.2 * time_s), 1.4 + 0.2 * np.sin(2 * time_s)], -1
    )
    second = np.stack([-0.9 + 0.9 * time_s, -1.1 + 0.3 * time_s**2, 0.8 + 0.3 * time_s], -1)
    return np.stack([first, second], axis=1)


TIME_S = np.arange(NUM_FRAMES) / FPS
TRUTH_M = curve(TIME_S)
VELOCITY_M_S = (curve(TIME_S + 1e-4) - curve(TIME_S - 1e-4)) / 2e-4
#: A cell of a silhouette is 2 px; at 4 m and a focal length of 260 px that is 3 cm.
CELL_M = 0.03


@pytest.fixture(scope="module")
def coverage():
    images = np.stack([draw_coverage(RIG, positions, SIZE_M, REDUCTION) for positions in TRUTH_M])
    images.flags.writeable = False
    return images


def track(coverage, position_m=TRUTH_M[0], velocity_m_s=VELOCITY_M_S[0], *, size_m=SIZE_M, **settings):
    """Tracks of two drones that are given in the first frame."""
    chosen = track_settings(**({"particles": 20, "iterations": 20, "drones": 2} | settings))
    given = InitialState(np.asarray(position_m), np.asarray(velocity_m_s), size_m, np.full(2, 5.0))
    runs = [RunInputs(ROOM_M, tracker_settings(chosen), given)]
    silhouettes = silhouettes_in_memory(RIG, coverage, REDUCTION)
    ((tracks, _),) = track_silhouettes(RIG, silhouettes, runs, fps=FPS)
    return tracks


@pytest.mark.parametrize("swarm", ["per-drone", pytest.param("joint", marks=pytest.mark.slow)])
def test_it_follows_the_drones(coverage, swarm):
    # The joint swarm searches six dimensions at once, which takes more particles.
    effort = {"particles": 60, "iterations": 40} if swarm == "joint" else {}
    tracks = track(coverage, swarm=swarm, **effort)
    error_m = np.linalg.norm(tracks.position_m - TRUTH_M, axis=-1)
    # Five views place the middle of an ellipse to a fraction of a cell. The limit is one cell, in every frame.
    assert error_m.max() < CELL_M
    assert (tracks.status == Status.TRACKED).all()
    assert ((tracks.fitness > 0.2) & (tracks.fitness <= 1)).all()
    assert (tracks.num_cameras == 5).all()


@pytest.mark.slow
def test_the_hard_score_follows_as_well_as_its_plateau_allows(coverage):
    tracks = track(coverage, score="hard")
    # Boxes that fit exactly leave a plateau of a cell or two.
    assert np.linalg.norm(tracks.position_m - TRUTH_M, axis=-1).max() < 3 * CELL_M
    assert (tracks.status == Status.TRACKED).all()


def test_velocity_is_estimated(coverage):
    """The initial velocity is wrong (0); the estimate converges to the true velocity."""
    tracks = track(coverage, velocity_m_s=np.zeros((2, 3)))
    error_m_s = np.linalg.norm(tracks.velocity_m_s - VELOCITY_M_S, axis=-1)
    # The filter averages over about three frames: noise of a third of a cell gives 0.08 m/s, and the lag of three
    # frames, in which the velocity turns by 0.2 m/s, adds to that. Measured 0.09, limit 0.4.
    assert np.median(error_m_s[10:]) < 0.4
    assert error_m_s[0].min() > 0.4


def test_same_seed_same_result(coverage):
    first, second, other = (track(coverage, seed=seed) for seed in (3, 3, 4))
    for name in ("position_m", "covariance_m2", "fitness", "status"):
        assert_same(getattr(first, name), getattr(second, name))
    assert (first.position_m != other.position_m).any()
    # A swarm with another seed converges to the same maximum.
    np.testing.assert_allclose(other.position_m, first.position_m, atol=CELL_M)
    # Each frame has new random numbers: a drone that hovers is not found at the same place again.
    hovering = track(np.repeat(coverage[:1], NUM_FRAMES, axis=0), velocity_m_s=np.zeros((2, 3)))
    assert len(np.unique(hovering.measured_m[:, 0], axis=0)) == NUM_FRAMES


@pytest.mark.slow
def test_drones_of_their_own_swarms_interact_by_occlusion_alone(coverage):
    """Without occlusion, another initial position of the second drone changes no bit of the first drone's track."""
    elsewhere_m = TRUTH_M[0] + [[0, 0, 0], [0.1, 0, 0]]
    one, other = (
        track(coverage, position_m, **{"score.occlusion": False}) for position_m in (TRUTH_M[0], elsewhere_m)
    )
    np.testing.assert_array_equal(other.position_m[:, 0], one.position_m[:, 0])
    assert (other.position_m[0, 1] != one.position_m[0, 1]).any()


@pytest.mark.slow
def test_drones_that_pass_close_keep_their_identities():
    """Two drones meet head on at 1.5 m/s each. Their middles pass at 0.3 m, their hulls at 0.05 m."""
    along_m = 1.5 * (TIME_S - TIME_S[NUM_FRAMES // 2])
    beside_m, height_m = np.full(NUM_FRAMES, 0.15), np.full(NUM_FRAMES, 1.3)
    paths = ([along_m, beside_m, height_m], [-along_m, -beside_m, height_m])
    truth_m = np.stack([np.stack(path, axis=-1) for path in paths], axis=1)
    size_m = np.array([[0.25, 0.25, 0.15]] * 2)
    images = np.stack([draw_coverage(RIG, positions, size_m, REDUCTION) for positions in truth_m])
    velocity_m_s = np.array([[1.5, 0, 0], [-1.5, 0, 0]])
    rms_m = {}
    for occlusion in (True, False):
        how = {"score.occlusion": occlusion, "drones.learn_sizes": False}
        tracks = track(images, truth_m[0], velocity_m_s, size_m=size_m, **how)
        error_m = np.linalg.norm(tracks.position_m - truth_m, axis=-1)
        assert (tracks.status == Status.TRACKED).all()
        # A tenth of the distance at which the drones pass, in every frame; measured 11 mm.
        assert error_m.max() < CELL_M
        passing = np.linalg.norm(truth_m[:, 0] - truth_m[:, 1], axis=-1) < 0.6
        rms_m[occlusion] = np.sqrt(np.mean(error_m[passing] ** 2))
    # During the pass: measured 6.0 mm with occlusion and 8.0 mm without; three seeds agree to 0.3 mm.
    assert rms_m[True] < 0.9 * rms_m[False]


HOVER_M = np.array([[0.3, -0.2, 1.2], [-0.9, 0.7, 0.8]])
GONE, BACK, GONE_AGAIN = 4, 15, 20


def test_a_drone_that_vanishes_coasts_is_lost_and_comes_back():
    """Of two drones that hover, the first one vanishes, returns, and vanishes again."""
    truth_m = np.repeat(HOVER_M[None], NUM_FRAMES, axis=0)
    truth_m[GONE:BACK, 0] = truth_m[GONE_AGAIN:, 0] = np.nan
    images = np.moveaxis(np.array(drawn_silhouettes(RIG, truth_m, SIZE_M, REDUCTION).arrays), 0, 1)
    # The search region grows with the time since the drone was last found: at 1.2 m/s by 0.6 m, which does not reach
    # the neighbour.
    tracks = track(images, HOVER_M, np.zeros((2, 3)), max_coasting_s=5 / FPS, max_speed_m_s=1.2)
    status = tracks.status[:, 0]
    assert (status[:GONE] == Status.TRACKED).all()
    assert (status[GONE : GONE + 5] == Status.COASTING).all()
    assert (status[GONE + 5 : BACK] == Status.LOST).all()
    assert (status[BACK:GONE_AGAIN] == Status.TRACKED).all()
    # The count of missed frames starts again at zero.
    assert (status[GONE_AGAIN:] == Status.COASTING).all()
    error_m = np.linalg.norm(tracks.position_m - HOVER_M, axis=-1)
    # The drone is found at once, although the prediction drifted for 5 frames at a few cm/s.
    assert error_m[BACK + 1 : GONE_AGAIN, 0].max() < CELL_M
    # In one view the neighbour lies in the search region; one view is not enough.
    assert (tracks.num_cameras[GONE:BACK, 0] <= 1).all()
    # The neighbour is tracked all the time.
    assert (tracks.status[:, 1] == Status.TRACKED).all()
    assert error_m[:, 1].max() < CELL_M


def test_a_lost_drone_does_not_take_over_another_drone():
    """A drone that appears farther away than a drone's span may be another drone; re-identification decides that."""
    truth_m = np.repeat(HOVER_M[None], NUM_FRAMES, axis=0)
    truth_m[4:17, 0] = np.nan
    # Seven frames are too few to be a drone.
    truth_m[17:, 0] += (0.7, 0.0, 0.0)
    images = np.moveaxis(np.array(drawn_silhouettes(RIG, truth_m, SIZE_M, REDUCTION).arrays), 0, 1)
    tracks = track(images, HOVER_M, np.zeros((2, 3)), max_coasting_s=5 / FPS, max_speed_m_s=3.0)
    assert (tracks.status[:4, 0] == Status.TRACKED).all()
    assert (tracks.status[10:, 0] == Status.LOST).all()


def test_coasting_goes_straight_on(coverage):
    """Without foreground a track continues at its last velocity, and stands still after the drone is lost."""
    tracks = track(np.zeros_like(coverage), max_coasting_s=8 / FPS)
    assert (tracks.status[:8] == Status.COASTING).all()
    assert (tracks.status[8:] == Status.LOST).all()
    straight = TRUTH_M[0] + TIME_S[:8, None, None] * VELOCITY_M_S[0]
    # Rounding of eight float32 additions.
    np.testing.assert_allclose(tracks.position_m[:8], straight, atol=1e-5)
    np.testing.assert_allclose(tracks.position_m[9:], tracks.position_m[8:-1], atol=1e-6)
    assert not tracks.velocity_m_s[8:].any()


def test_tracks_stay_in_the_room(coverage):
    """A track that coasts into a wall at 5 m/s stops at the wall."""
    tracks = track(
        np.zeros_like(coverage),
        position_m=np.array([[2.8, 0, 1.5], [0, 0, 0.2]]),
        velocity_m_s=np.array([[5.0, 0, 0], [0, 0, -5.0]]),
        max_coasting_s=5.0,
    )
    low, high = ROOM_M.astype(np.float32)
    assert (tracks.position_m >= low).all()
    assert (tracks.position_m <= high).all()
    np.testing.assert_allclose(tracks.position_m[-1], [[3, 0, 1.5], [0, 0, 0]], atol=1e-6)


def test_no_track_is_faster_than_the_largest_speed(coverage):
    """Silhouettes that jump by 0.8 m in one frame move the tracks by the allowed distance only."""
    jumping = coverage.copy()
    # Seven frames are too few to be a drone that is back.
    jumping[17:] = draw_coverage(RIG, TRUTH_M[16] + [0.0, 0.8, 0.0], SIZE_M, REDUCTION)
    tracks = track(jumping, max_speed_m_s=2.0)
    assert np.linalg.norm(tracks.velocity_m_s, axis=-1).max() <= 2.0 * (1 + 1e-5)
    # The search region is a box about the last position, and grows while the drone is not found.
    moved_m = np.abs(np.diff(tracks.position_m, axis=0))
    found = (tracks.status[1:] == Status.TRACKED) & (tracks.status[:-1] == Status.TRACKED)
    assert found[:16].all()
    assert (moved_m[found] <= 2.0 / FPS * (1 + 1e-4) + 1e-6).all()


def test_cameras_with_foreground_are_counted_and_too_few_do_not_find_a_drone(coverage):
    blinded = coverage.copy()
    blinded[8:, [1, 3]] = 0
    tracks = track(blinded)
    assert (tracks.num_cameras[:8] == 5).all()
    assert (tracks.num_cameras[8:] == 3).all()
    assert (tracks.status == Status.TRACKED).all()
    blinded[:, 2:] = 0
    tracks = track(blinded, min_cameras=3)
    assert (tracks.num_cameras <= 2).all()
    assert (tracks.status != Status.TRACKED).all()


def test_no_iterations_still_evaluates_the_start(coverage):
    """With no iterations, the result is the best of the initial particles, which lie about the prediction."""
    tracks = track(coverage, iterations=0)
    assert np.linalg.norm(tracks.position_m - TRUTH_M, axis=-1).max() < 0.2
