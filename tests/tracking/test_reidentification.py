"""Re-identification of lost drones: which candidate is which drone, and which drones are lost."""

from itertools import permutations

import numpy as np
import pytest
from helpers import ROOM_M
from scipy.linalg import expm
from scipy.stats import multivariate_normal, norm

from psotrack.tracking.births import (
    NEW,
    FlightLimits,
    LostTracks,
    TrackCandidate,
    find_false_tracks,
    find_lost_tracks,
    reidentify,
)
from psotrack.tracking.births.reidentification import NO_DRONE

FPS = 25.0
#: The instant from which the times of the tests count.
NOW = 1000

ROOM_M3 = float(np.prod(ROOM_M[1] - ROOM_M[0]))


def candidate(position_m=(0.0, 0.0, 1.0), velocity_m_s=(1.0, 0.0, 0.0), *, frame=0, span_m=0.5, **how):
    """A candidate that is first seen some frames after instant `NOW`."""
    size = np.array([span_m, span_m, span_m / 2])
    how = {"num_cameras": 5, "moves": True} | how
    return TrackCandidate(
        NOW + frame, np.array(position_m, float), np.array(velocity_m_s, float), size, **how
    )


def lost_tracks(*rows, left_m=()):
    """Lost drones: rows of position, velocity, seconds before `NOW`, and a dictionary of `span_m`, `doubtful`."""
    full = [{"span_m": 0.5, "doubtful": False} | (row[3] if len(row) > 3 else {}) for row in rows]
    return LostTracks(
        drone=10 + np.arange(len(rows)),
        position_m=np.array([row[0] for row in rows], float).reshape(-1, 3),
        velocity_m_s=np.array([row[1] for row in rows], float).reshape(-1, 3),
        instant=np.array([NOW - round(row[2] * FPS) for row in rows], int),
        size_m=np.array([[more["span_m"], more["span_m"], more["span_m"] / 2] for more in full]).reshape(
            -1, 3
        ),
        doubtful=np.array([more["doubtful"] for more in full], bool),
        left_m=np.array(left_m, float).reshape(-1, 3),
    )


def assigned_drones(found, gone, **keywords):
    return reidentify(tuple(found), gone, FlightLimits(FPS, ROOM_M, 6.0), **keywords).tolist()


AHEAD = ((-0.5, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)


def test_without_lost_drones_a_candidate_is_new():
    assert assigned_drones([candidate()], lost_tracks()) == [NEW]
    assert assigned_drones([], lost_tracks()) == []


def test_the_drone_on_course_is_chosen():
    """Two drones were lost half a metre away: one flew towards the candidate's place, one away from it."""
    away = ((0.5, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)
    assert assigned_drones([candidate()], lost_tracks(away, AHEAD)) == [1]


def test_each_lost_drone_is_one_candidate():
    """The first lost drone fits both candidates best, but only one candidate gets it."""
    also = ((-0.6, 0.5, 1.0), (1.0, 0.0, 0.0), 0.5)
    assert assigned_drones([candidate(), candidate((0.0, 0.2, 1.0))], lost_tracks(AHEAD, also)) == [0, 1]
    assert assigned_drones([candidate((0.0, 0.2, 1.0)), candidate()], lost_tracks(AHEAD, also)) == [1, 0]
    assert sorted(assigned_drones([candidate(), candidate((0.0, 0.2, 1.0))], lost_tracks(AHEAD))) == [NEW, 0]


def test_a_candidate_out_of_reach_is_new_unless_new_drones_are_not_allowed():
    """At six metres per second for half a second, the reach is three metres."""
    far = ((-4.5, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)
    assert assigned_drones([candidate()], lost_tracks(far)) == [NEW]
    assert assigned_drones([candidate()], lost_tracks(far), max_births=0) == [0]
    assert assigned_drones([candidate()], lost_tracks((*far[:2], 10.0))) == [0]


def test_after_a_long_time_the_size_decides():
    gone = ((2.0, 2.0, 1.0), (0.0, 1.0, 0.0), 20.0)
    assert assigned_drones([candidate(span_m=0.55)], lost_tracks(gone)) == [0]
    assert assigned_drones([candidate(span_m=1.0)], lost_tracks(gone)) == [NEW]
    assert assigned_drones([candidate(span_m=0.9)], lost_tracks(gone, (*gone, {"span_m": 0.9}))) == [1]
    assert assigned_drones([candidate(span_m=1.0)], lost_tracks(gone), max_births=0) == [0]


def test_a_drone_comes_back_near_the_place_where_it_left():
    """Two drones left through the ceiling two metres apart; after three seconds a candidate is near one of the places.

    Walls reflect drones, so the drones are nearer than they would be without walls.
    """
    left = (-1.5, -2.0, 3.0), (0.0, 0.0, 2.0), 3.5
    also = (-1.5, 0.5, 3.0), (0.0, 0.0, 2.0), 5.5
    back = candidate((-0.5, -1.7, 2.8), (1.4, 0.2, -2.5), span_m=0.46)
    assert assigned_drones([back], lost_tracks((*left, {"span_m": 0.5}), (*also, {"span_m": 0.46}))) == [0]
    assert assigned_drones([back], lost_tracks((*also, {"span_m": 0.46}), (*left, {"span_m": 0.5}))) == [1]
    # Sizes that differ by a third decide.
    assert assigned_drones([back], lost_tracks((*left, {"span_m": 0.62}), (*also, {"span_m": 0.46}))) == [1]


def test_the_number_of_new_drones_is_limited():
    found = [candidate(), candidate((1.0, 1.0, 1.0)), candidate((-1.0, 1.0, 1.0))]
    assert assigned_drones(found, lost_tracks()) == [NEW] * 3
    assert sorted(assigned_drones(found, lost_tracks(), max_births=2)) == [NO_DRONE, NEW, NEW]
    assert assigned_drones(found, lost_tracks(), max_births=0) == [NO_DRONE] * 3


def test_a_candidate_that_does_not_move_is_never_new():
    still = candidate(velocity_m_s=(0.0, 0.0, 0.0), moves=False)
    assert assigned_drones([still], lost_tracks()) == [NO_DRONE]
    # The lost drone may be anywhere by then, so the candidate may as well be a chair that a person has moved.
    assert assigned_drones([still], lost_tracks(((2.0, 2.0, 1.0), (0.0, 1.0, 0.0), 20.0))) == [NO_DRONE]
    # A drone that stood at the candidate's place when it was lost is assigned, after any time.
    assert assigned_drones([still], lost_tracks(((0.0, 0.1, 1.0), (0.05, 0.0, 0.0), 20.0))) == [0]


def test_a_ghost_is_not_the_drone_that_departed_from_it():
    """The background model has learned a drone. The ghost is exactly at its place, the drone half a metre away."""
    stood = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 20.0)
    ghost = candidate((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), moves=False)
    drone = candidate((0.5, 0.0, 1.0), (1.0, 0.0, 0.0), frame=5)
    assert assigned_drones([ghost, drone], lost_tracks(stood)) == [NO_DRONE, 0]
    passing_by = candidate((0.5, 0.0, 1.0), (0.0, 1.0, 0.0), frame=5)
    assert assigned_drones([ghost, passing_by], lost_tracks(stood)) == [0, NEW]


def test_a_drone_that_stood_still_when_it_was_lost_has_stayed():
    """The background model has learned a drone; another drone comes in at two metres per second, three metres away.

    The other drone is not the one that stood still. A drone that flew out of sight may be back.
    """
    coming = candidate((0.0, -2.7, 2.7), (0.0, 0.0, -2.0))
    stood = ((0.0, 0.3, 1.5), (0.0, 0.0, 0.0), 2.6)
    flew = ((0.0, 0.3, 1.5), (0.0, 0.0, 2.0), 2.6)
    assert assigned_drones([coming], lost_tracks(stood)) == [NEW]
    assert assigned_drones([coming], lost_tracks(flew)) == [0]
    # If no drone can be new, it is the drone that stood still; of two lost drones, it is the one that flew.
    assert assigned_drones([coming], lost_tracks(stood), max_births=0) == [0]
    assert assigned_drones([coming], lost_tracks(stood, flew)) == [1]


def test_a_drone_that_was_lost_as_it_landed_takes_off_from_there():
    """The other drone was lost in the air a moment ago, and is as large."""
    takes_off = candidate((0.0, 0.1, 0.12), (0.0, 0.0, 0.3), is_sure=False)
    landed = ((0.0, 0.0, 0.13), (0.0, 0.5, -0.5), 9.5)
    flew = ((-1.3, -1.8, 3.0), (0.5, 0.5, -1.0), 2.6)
    assert assigned_drones([takes_off], lost_tracks(flew, landed)) == [1]


def test_a_ghost_that_seems_to_move_is_no_drone():
    """While the drone overlaps its ghost, the ghost seems to move slowly upwards; the drone is the faster candidate."""
    stood = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 20.0)
    ghost = candidate((0.0, 0.0, 1.05), (0.0, -0.02, 0.13))
    drone = candidate((0.1, 0.0, 1.3), (0.1, 0.0, 1.5), frame=9)
    assert assigned_drones([ghost, drone], lost_tracks(stood)) == [NO_DRONE, 0]
    assert assigned_drones([ghost, drone], lost_tracks()) == [NO_DRONE, NEW]
    # A slow and a fast drone at different places are two drones.
    elsewhere = candidate((1.0, 0.0, 1.3), (0.1, 0.0, 1.5), frame=9)
    assert assigned_drones([ghost, elsewhere], lost_tracks(stood)) == [0, NEW]


def test_a_fading_ghost_is_not_new():
    """While the background model learns the floor again, the rest of the ghost seems to move."""
    dying = candidate((2.2, 1.4, 1.5), (-0.1, 0.04, 0.01))
    assert assigned_drones([dying], lost_tracks(left_m=[(2.2, 1.3, 1.5)])) == [NO_DRONE]
    # A slow candidate elsewhere is new, and so is a fast candidate at this place; a drone lost here may be found again.
    assert assigned_drones([dying], lost_tracks(left_m=[(1.2, 1.3, 1.5)])) == [NEW]
    assert assigned_drones([candidate((2.2, 1.4, 1.5))], lost_tracks(left_m=[(2.2, 1.3, 1.5)])) == [NEW]
    stood = ((2.2, 1.3, 1.5), (0.0, 0.0, 0.0), 5.0)
    assert assigned_drones([dying], lost_tracks(stood, left_m=[(2.2, 1.3, 1.5)])) == [0]


def test_a_ghost_does_not_keep_a_track():
    """A drone found again at the place of its loss may be a ghost; a candidate that departs from there is the drone."""
    held = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 20.0, {"doubtful": True})
    assert assigned_drones([candidate((0.6, 0.0, 1.0))], lost_tracks(held)) == [0]
    assert assigned_drones([candidate((0.6, 0.0, 1.0), (0.0, 1.0, 0.0))], lost_tracks(held)) == [NEW]
    assert assigned_drones([candidate((2.0, 0.0, 1.0))], lost_tracks(held), max_births=0) == [NO_DRONE]


def test_a_drone_that_was_tracked_elsewhere_at_the_same_time_is_another_drone():
    """The drone is lost in frame 20 of the chunk, and the candidate is there from frame 2 on: both for 0.7 s."""
    here = ((0.3, 0.0, 1.0), (1.0, 0.0, 0.0), -20 / FPS)
    assert assigned_drones([candidate(frame=2)], lost_tracks(here)) == [NEW]
    assert assigned_drones([candidate(frame=18)], lost_tracks(here)) == [0]


def oracle_log_density(one, position_m, velocity_m_s, gap_s, sigma_m_s, time_s=1.0):
    """dv = -v/time dt + noise: the exact discretisation by a matrix exponential (C. F. Van Loan, 1978).

    The walls are mirrors: the images of the drone in them count as the drone.
    """
    drift = np.array([[0.0, 1.0], [0.0, -1.0 / time_s]])
    noise = np.diag([0.0, 2 * sigma_m_s**2 / time_s])
    big = expm(np.block([[-drift, noise], [np.zeros((2, 2)), drift.T]]) * gap_s)
    to = big[2:, 2:].T
    measured = np.diag([0.1**2, 0.3**2])
    covariance = to @ big[:2, 2:] + to @ measured @ to.T + measured
    total = 0.0
    for axis, walls in enumerate(ROOM_M.T):
        density = multivariate_normal(to @ [position_m[axis], velocity_m_s[axis]], covariance).pdf
        seen = images = {(one.position_m[axis], one.velocity_m_s[axis])}
        for _ in range(5):
            images = {(round(2 * wall - place, 9), -velocity) for wall in walls for place, velocity in images}
            seen = seen | images
        total += np.log(sum(density(image) for image in seen))
    return total


@pytest.mark.parametrize("seed", range(20))
def test_the_assignment_has_the_largest_likelihood(seed):
    """Compared with all permutations, with likelihoods from SciPy, for moving drones within reach."""
    rng = np.random.default_rng(seed)
    velocity, place = rng.normal(0.0, 1.0, (3, 3)), rng.uniform((-1, -1, 1), (1, 1, 2), (3, 3))
    gap = rng.uniform(0.2, 1.5, 3)
    span = rng.uniform(0.4, 0.6, 3)
    order = rng.permutation(3)
    found = [
        candidate(
            place[k] + gap[k] * velocity[k] + rng.normal(0, 0.3, 3), velocity[k] + rng.normal(0, 0.5, 3)
        )
        for k in order
    ]
    gone = lost_tracks(*((place[k], velocity[k], gap[k] + 0.5, {"span_m": span[k]}) for k in range(3)))
    sigma = 6.0 / 3
    score = np.array(
        [
            [
                max(
                    oracle_log_density(one, place[k], velocity[k], gap[k] + 0.5, sigma),
                    norm.logpdf(one.velocity_m_s, 0, sigma).sum() - np.log(ROOM_M3),
                )
                + norm.logpdf(np.log(0.5 / span[k]), 0, 0.2)
                for k in range(3)
            ]
            for one in found
        ]
    )
    best = max(permutations(range(3)), key=lambda columns: score[range(3), columns].sum())
    assert assigned_drones(found, gone, max_births=0) == list(best)


# --- lost drones


def tracked_frames(*rows):
    """Whether each drone was tracked, (frames, drones), from strings of `x` (tracked) and dots (not tracked)."""
    return np.array([[letter == "x" for letter in row] for row in rows]).T


def test_lost_drones_by_hand():
    """Seven drones: tracked; lost early; lost late; not there; doubtful; moved; given in frame 3, but never seen."""
    tracked = tracked_frames(
        "xxxxxxxxxxxx",
        "xxx.........",
        "xxxxxxxxxx..",
        "............",
        "xx....xxxxxx",
        "xx....xxxxxx",
        "............",
    )
    frames = np.arange(12.0)
    position = np.zeros((12, 7, 3))
    position[..., 0] = frames[:, None]
    position[:, 3] = position[:3, 6] = np.nan
    position[:, 4] = (1.0, 2.0, 0.1)
    gone = find_lost_tracks(
        position, position / 2, tracked, np.full((7, 3), 0.5), instant=np.arange(12), fps=2.0
    )
    assert gone.drone.tolist() == [1, 2, 4, 6]
    # The last frames in which these drones were tracked are 2, 9 and 1; the last drone was given in frame 3.
    np.testing.assert_array_equal(gone.position_m[:, 0], [2.0, 9.0, 1.0, 3.0])
    # The third drone stands still, so its velocity is 0, although its state has another.
    np.testing.assert_array_equal(gone.velocity_m_s[:, 0], [1.0, 4.5, 0.0, 1.5])
    np.testing.assert_array_equal(gone.instant, [2, 9, 1, 3])
    assert gone.doubtful.tolist() == [False, False, True, False]


def test_a_track_that_never_moved_where_a_drone_was_is_false():
    """One track stands still; one lands at its place; one passes above; one hovers elsewhere. The first is false."""
    position = np.full((12, 4, 3), np.nan)
    position[:6, 0] = (1.0, 0.0, 0.1)
    position[:8, 1] = (1.0, 0.0, 0.1)
    position[:7, 1, 2] += np.arange(7)[::-1] * 0.2
    position[:, 2] = (0.0, 0.0, 0.4)
    position[:, 2, 0] += 0.2 * np.arange(12)
    position[:4, 3] = (1.6, 0.0, 0.1)
    position[:, :, 1] += 0.01 * np.arange(12)[:, None] % 0.02
    tracked = np.isfinite(position[..., 0])
    size = np.tile([0.5, 0.5, 0.2], (4, 1))
    assert find_false_tracks(position, tracked, size).tolist() == [True, False, False, False]
    still = np.zeros_like(position)
    assert find_lost_tracks(
        position, still, tracked, size, instant=np.arange(12), fps=10.0
    ).drone.tolist() == [1, 3]
    # A drone that lands is no false track, even if it is not found exactly there; a single track is not false.
    assert find_false_tracks(position[:, 1:], tracked[:, 1:], size[1:]).tolist() == [False, False, False]
    assert find_false_tracks(position[:, :1], tracked[:, :1], size[:1]).tolist() == [False]
    assert find_false_tracks(position[:, :0], tracked[:, :0], size[:0]).shape == (0,)


def test_a_drone_that_the_background_learns_only_seems_to_move():
    """Ten frames at 10 frames per second, with four drones.

    The first drone stood still until the rest of its blob moved slowly away; the second flew slowly; the third stopped;
    the fourth has just landed.
    """
    position = np.zeros((12, 4, 3))
    position[..., 1] = (0.0, 1.0, 2.0, 3.0)
    position[8:10, 0, 0] = (0.04, 0.08)
    position[:, 1, 0] = 0.03 * np.arange(12)
    position[:4, 3, 2] = (0.8, 0.6, 0.4, 0.2)
    position[9, 3, 0] = 0.06
    velocity = np.zeros((12, 4, 3))
    velocity[9, 3, 0] = 0.4
    velocity[8:10, 0, 0], velocity[:, 1, 0], velocity[9, 2, 0] = 0.5, 0.3, 0.05
    position[:, 2, 0] = np.minimum(0.1 * np.arange(12), 0.8)
    gone = find_lost_tracks(
        position,
        velocity,
        tracked_frames(*["x" * 10 + ".."] * 4),
        np.full((4, 3), 0.5),
        instant=np.arange(12),
        fps=10.0,
    )
    np.testing.assert_array_equal(gone.position_m[:, 0], [0.0, 0.27, 0.8, 0.0])
    np.testing.assert_array_equal(gone.velocity_m_s[:, 0], [0.0, 0.3, 0.05, 0.0])
    np.testing.assert_array_equal(gone.left_m, [[0.0, 0.0, 0.0], [0.0, 3.0, 0.0]])


def test_a_candidate_that_is_not_sure_is_a_lost_drone_or_none():
    """A drone that was lost is found again by fewer frames than a new one."""
    unsure = candidate(is_sure=False)
    assert assigned_drones([unsure], lost_tracks(AHEAD)) == [0]
    assert assigned_drones([unsure], lost_tracks()) == [NO_DRONE]


def test_instants_that_were_left_out_count_as_time():
    """Every third instant has a frame: a drone that was slow for a second of time stood still."""
    instant = 3 * np.arange(30)
    position = np.zeros((30, 1, 3))
    position[:20, 0, 0] = np.linspace(0.0, 0.4, 20)
    position[20:, 0, 0] = 0.4
    tracked = np.ones((30, 1), bool)
    tracked[28:] = False
    gone = find_lost_tracks(
        position, np.full((30, 1, 3), 0.3), tracked, np.full((1, 3), 0.5), instant=instant, fps=25.0
    )
    assert gone.instant.tolist() == [81]
    # From instant 57 to 81 the drone moved by nothing: it stood, so that its velocity is 0.
    assert gone.velocity_m_s.tolist() == [[0.0, 0.0, 0.0]]
