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
    full = [{"span_m": 0.5, "doubtful": False} | dict(*row[3:]) for row in rows]
    span_m = np.array([more["span_m"] for more in full]).reshape(-1, 1)
    return LostTracks(
        drone=10 + np.arange(len(rows)),
        position_m=np.array([row[0] for row in rows], float).reshape(-1, 3),
        velocity_m_s=np.array([row[1] for row in rows], float).reshape(-1, 3),
        instant=np.array([NOW - round(row[2] * FPS) for row in rows], int),
        size_m=span_m * [1.0, 1.0, 0.5],
        doubtful=np.array([more["doubtful"] for more in full], bool),
        left_m=np.array(left_m, float).reshape(-1, 3),
    )


def assigned_drones(found, gone, **keywords):
    return reidentify(tuple(found), gone, FlightLimits(FPS, ROOM_M, 6.0), **keywords).tolist()


STILL_M_S = (0.0, 0.0, 0.0)
HERE = candidate()
NEARBY = candidate((0.0, 0.2, 1.0))
#: Lost drones: half a metre before `HERE` and flying towards it, or away from it; beside; out of reach, which is three
#: metres in half a second; long ago.
AHEAD = ((-0.5, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)
AWAY = ((0.5, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)
BESIDE = ((-0.6, 0.5, 1.0), (1.0, 0.0, 0.0), 0.5)
FAR = ((-4.5, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)
LONG_AGO = ((2.0, 2.0, 1.0), (0.0, 1.0, 0.0), 20.0)
LARGE = (*LONG_AGO, {"span_m": 0.9})
#: Two drones that left through the ceiling two metres apart; three seconds after the first, one is back near its place.
LEFT = ((-1.5, -2.0, 3.0), (0.0, 0.0, 2.0), 3.5)
LEFT_TOO = ((-1.5, 0.5, 3.0), (0.0, 0.0, 2.0), 5.5)
BACK = candidate((-0.5, -1.7, 2.8), (1.4, 0.2, -2.5), span_m=0.46)
NARROW, WIDE = {"span_m": 0.46}, {"span_m": 0.62}
#: The background model has learned a drone: its ghost, which does not move, or seems to while the drone overlaps it.
STOOD = ((0.0, 0.0, 1.0), STILL_M_S, 20.0)
GHOST = candidate(velocity_m_s=STILL_M_S, moves=False)
SEEMING = candidate((0.0, 0.0, 1.05), (0.0, -0.02, 0.13))
DEPARTING = candidate((0.5, 0.0, 1.0), frame=5)
RISING, ELSEWHERE = (candidate((x_m, 0.0, 1.3), (0.1, 0.0, 1.5), frame=9) for x_m in (0.1, 1.0))
#: The same, and another drone that comes in at two metres per second, three metres away.
COMING = candidate((0.0, -2.7, 2.7), (0.0, 0.0, -2.0))
STAYED, FLEW = (((0.0, 0.3, 1.5), velocity, 2.6) for velocity in (STILL_M_S, (0.0, 0.0, 2.0)))
#: A drone takes off where one was lost as it landed; another was lost in the air a moment ago, and is as large.
TAKING_OFF = candidate((0.0, 0.1, 0.12), (0.0, 0.0, 0.3), is_sure=False)
LANDED = ((0.0, 0.0, 0.13), (0.0, 0.5, -0.5), 9.5)
IN_THE_AIR = ((-1.3, -1.8, 3.0), (0.5, 0.5, -1.0), 2.6)
#: A drone that was found again at the place of its loss, so that it may be a ghost.
HELD = (*STOOD, {"doubtful": True})
NO_NEW = {"max_births": 0}

#: What is the case: candidates, lost drones, options, and which lost drone each candidate is.
CASES = {
    "nobody was lost": ([HERE], [], {}, [NEW]),
    "there is no candidate": ([], [], {}, []),
    "one of two flew towards the candidate": ([HERE], [AWAY, AHEAD], {}, [1]),
    # The first drone fits both candidates best, but only one candidate gets it.
    "each drone is one candidate": ([HERE, NEARBY], [AHEAD, BESIDE], {}, [0, 1]),
    "out of reach": ([HERE], [FAR], {}, [NEW]),
    "out of reach, and no drone is new": ([HERE], [FAR], NO_NEW, [0]),
    "out of reach until time has passed": ([HERE], [(*FAR[:2], 10.0)], {}, [0]),
    "long ago, of this size": ([candidate(span_m=0.55)], [LONG_AGO], {}, [0]),
    "long ago, of half the size": ([candidate(span_m=1.0)], [LONG_AGO], {}, [NEW]),
    "long ago, the other is as large": ([candidate(span_m=0.9)], [LONG_AGO, LARGE], {}, [1]),
    # Walls reflect drones, so the drones are nearer than they would be without walls.
    "the drone that left here is back": ([BACK], [LEFT, (*LEFT_TOO, NARROW)], {}, [0]),
    "sizes that differ by a third decide": ([BACK], [(*LEFT, WIDE), (*LEFT_TOO, NARROW)], {}, [1]),
    "no drone is new": ([HERE, candidate((1.0, 1.0, 1.0))], [], NO_NEW, [NO_DRONE] * 2),
    "what does not move is not new": ([GHOST], [], {}, [NO_DRONE]),
    # The lost drone may be anywhere by then, so the candidate may as well be a chair that a person has moved.
    "what does not move is no drone of long ago": ([GHOST], [LONG_AGO], {}, [NO_DRONE]),
    "it is the drone that stood here": ([GHOST], [((0.0, 0.1, 1.0), (0.05, 0.0, 0.0), 20.0)], {}, [0]),
    "a drone departs from its ghost": ([GHOST, DEPARTING], [STOOD], {}, [NO_DRONE, 0]),
    "a drone passes by": ([GHOST, candidate((0.5, 0.0, 1.0), (0, 1, 0), frame=5)], [STOOD], {}, [0, NEW]),
    "a ghost that seems to move": ([SEEMING, RISING], [STOOD], {}, [NO_DRONE, 0]),
    "a ghost of nobody that seems to move": ([SEEMING, RISING], [], {}, [NO_DRONE, NEW]),
    # A slow and a fast drone at different places are two drones.
    "a slow and a fast drone": ([SEEMING, ELSEWHERE], [STOOD], {}, [0, NEW]),
    "who stood still has stayed": ([COMING], [STAYED], {}, [NEW]),
    "who flew out of sight may be back": ([COMING], [FLEW], {}, [0]),
    "of two, the one that flew": ([COMING], [STAYED, FLEW], {}, [1]),
    "who was lost as it landed takes off": ([TAKING_OFF], [IN_THE_AIR, LANDED], {}, [1]),
    # A candidate that departs from the place where the drone was found again is the drone.
    "a ghost keeps no track": ([candidate((0.6, 0.0, 1.0))], [HELD], {}, [0]),
    "who passes by a doubtful track": ([candidate((0.6, 0.0, 1.0), (0.0, 1.0, 0.0))], [HELD], {}, [NEW]),
    "a doubtful track, and no drone is new": ([candidate((2.0, 0.0, 1.0))], [HELD], NO_NEW, [NO_DRONE]),
    # The drone was tracked for another 0.8 s, of which the first candidate was there for 0.7 s.
    "two at the same time are two": ([candidate(frame=2)], [((0.3, 0, 1), (1, 0, 0), -0.8)], {}, [NEW]),
    "nearly at the same time": ([candidate(frame=18)], [((0.3, 0, 1), (1, 0, 0), -0.8)], {}, [0]),
    # A drone that was lost is found again by fewer frames than a new one.
    "not sure, but lost here": ([candidate(is_sure=False)], [AHEAD], {}, [0]),
    "not sure": ([candidate(is_sure=False)], [], {}, [NO_DRONE]),
}


@pytest.mark.parametrize("case", CASES)
def test_which_drone_a_candidate_is(case):
    found, gone, options, expected = CASES[case]
    assert assigned_drones(found, lost_tracks(*gone), **options) == expected


def test_a_fading_ghost_is_not_new():
    """While the background model learns the floor again, the rest of the ghost seems to move."""
    dying, left_m = candidate((2.2, 1.4, 1.5), (-0.1, 0.04, 0.01)), [(2.2, 1.3, 1.5)]
    assert assigned_drones([dying], lost_tracks(left_m=left_m)) == [NO_DRONE]
    # A slow candidate elsewhere is new, and so is a fast candidate at this place; a drone lost here may be found again.
    assert assigned_drones([dying], lost_tracks(left_m=[(1.2, 1.3, 1.5)])) == [NEW]
    assert assigned_drones([candidate((2.2, 1.4, 1.5))], lost_tracks(left_m=left_m)) == [NEW]
    assert assigned_drones([dying], lost_tracks((left_m[0], STILL_M_S, 5.0), left_m=left_m)) == [0]


def test_only_so_many_candidates_are_drones():
    found = [candidate(), candidate((1.0, 1.0, 1.0)), candidate((-1.0, 1.0, 1.0))]
    assert sorted(assigned_drones(found, lost_tracks(), max_births=2)) == [NO_DRONE, NEW, NEW]
    assert sorted(assigned_drones([HERE, NEARBY], lost_tracks(AHEAD))) == [NEW, 0]


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

    def log_likelihood(one, k):
        moved = oracle_log_density(one, place[k], velocity[k], gap[k] + 0.5, sigma)
        anywhere = norm.logpdf(one.velocity_m_s, 0, sigma).sum() - np.log(ROOM_M3)
        return max(moved, anywhere) + norm.logpdf(np.log(0.5 / span[k]), 0, 0.2)

    score = np.array([[log_likelihood(one, k) for k in range(3)] for one in found])
    best = max(permutations(range(3)), key=lambda columns: score[range(3), columns].sum())
    assert assigned_drones(found, gone, max_births=0) == list(best)


# --- lost drones


def tracked_frames(*rows):
    """Whether each drone was tracked, (frames, drones), from strings of `x` (tracked) and dots (not tracked)."""
    return np.array([[letter == "x" for letter in row] for row in rows]).T


def lost_in(position_m, velocity_m_s, tracked, *, fps, every=1):
    """What was lost in the frames of every so many instants."""
    size_m, instant = np.full((len(tracked[0]), 3), 0.5), every * np.arange(len(tracked))
    return find_lost_tracks(position_m, velocity_m_s, tracked, size_m, instant=instant, fps=fps)


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
    gone = lost_in(position, position / 2, tracked, fps=2.0)
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
    size = np.full((4, 3), 0.5)
    assert find_false_tracks(position, tracked, size).tolist() == [True, False, False, False]
    assert lost_in(position, np.zeros_like(position), tracked, fps=10.0).drone.tolist() == [1, 3]
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
    gone = lost_in(position, velocity, tracked_frames(*["x" * 10 + ".."] * 4), fps=10.0)
    np.testing.assert_array_equal(gone.position_m[:, 0], [0.0, 0.27, 0.8, 0.0])
    np.testing.assert_array_equal(gone.velocity_m_s[:, 0], [0.0, 0.3, 0.05, 0.0])
    np.testing.assert_array_equal(gone.left_m, [[0.0, 0.0, 0.0], [0.0, 3.0, 0.0]])


def test_instants_that_were_left_out_count_as_time():
    """Every third instant has a frame: a drone that was slow for a second of time stood still."""
    position = np.zeros((30, 1, 3))
    position[:20, 0, 0] = np.linspace(0.0, 0.4, 20)
    position[20:, 0, 0] = 0.4
    tracked = np.ones((30, 1), bool)
    tracked[28:] = False
    gone = lost_in(position, np.full((30, 1, 3), 0.3), tracked, fps=25.0, every=3)
    assert gone.instant.tolist() == [81]
    # From instant 57 to 81 the drone moved by nothing: it stood, so that its velocity is 0.
    assert gone.velocity_m_s.tolist() == [[0.0, 0.0, 0.0]]
