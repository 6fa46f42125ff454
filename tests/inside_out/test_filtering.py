"""The filter and the smoother of camera poses: a textbook filter and least squares over all frames as oracles, ground
truth for the covariances, and outliers, wrong first poses, gaps and ambiguous poses."""

from dataclasses import replace

import numpy as np
import pytest
from camera_paths import (
    FPS,
    camera_path,
    distances_m,
    in_other_world,
    orientations,
    pose_errors,
    remove_poses,
    squared_errors,
)
from helpers import fading
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag, expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.inside_out import Flag, PoseFilterParams, smooth
from psotrack.inside_out.filtering import choose_agility, filter_path, poses_of
from psotrack.inside_out.filtering import motion as pose_motion
from psotrack.inside_out.pose import CameraPose
from psotrack.trajectories import Status

STD_M, STD_RAD = 0.004, 0.0008
#: The 90 % quantile of the chi-square distribution with 3 degrees of freedom.
NINETY = chi2.ppf(0.9, 3)


def pose_covariance():
    """Covariance of a pose: shifts to the side and turns about the vertical axis are correlated, as in real poses."""
    covariance = np.diag([STD_M**2] * 3 + [STD_RAD**2] * 3)
    covariance[0, 4] = covariance[4, 0] = 0.8 * STD_M * STD_RAD
    covariance[1, 3] = covariance[3, 1] = -0.8 * STD_M * STD_RAD
    return covariance


def raw_path(position_m, orientation):
    covariance = np.tile(pose_covariance(), (len(position_m), 1, 1))
    return camera_path(position_m, orientation, covariance, num_markers=2)


def random_motion(rng, frames, acceleration, shake):
    """True positions (frames, 3) and orientations of a camera with random forces and damping.

    The motion differs from the filter's.
    """
    finer = 10
    dt_s = 1 / FPS / finer
    kept_pull, kept_twist = np.exp(-dt_s / 0.4), np.exp(-dt_s / 0.1)
    new_pull = acceleration * np.sqrt(2 * dt_s / 0.4)
    new_twist = shake * np.sqrt(2 * dt_s / 0.1)
    pull, twist, position, velocity, rate = np.zeros((5, 3))
    turned = Rotation.identity()
    positions, turns = [], []
    for k in range(frames * finer):
        pull = kept_pull * pull + new_pull * rng.normal(size=3)
        twist = kept_twist * twist + new_twist * rng.normal(size=3)
        velocity = velocity + (pull - 0.3 * velocity) * dt_s
        rate = rate + (twist - rate) * dt_s
        position = position + velocity * dt_s
        turned = turned * Rotation.from_rotvec(rate * dt_s)
        if k % finer == 0:
            positions.append(position)
            turns.append(turned)
    return np.array(positions), Rotation.concatenate(turns)


def flight(frames, *, acceleration=2.0, shake=2.0, seed=0):
    """Raw poses, the true positions (frames, 3) and orientations. Errors last half a second, and not as assumed."""
    rng = np.random.default_rng(seed)
    position_m, truth = random_motion(rng, frames, acceleration, shake)
    root = np.linalg.cholesky(pose_covariance())
    noise = rng.normal(size=(frames, 2, 6))
    lasting = fading(noise[:, 0], np.exp(-1 / FPS / 0.5))
    error = (np.sqrt(0.6) * lasting + np.sqrt(0.4) * noise[:, 1]) @ root.T
    raw_turns = truth * Rotation.from_rotvec(-error[:, 3:])
    return raw_path(position_m - error[:, :3], raw_turns), position_m, truth


def move_poses(path, rows, shift_m, turn=(0.0, 0.0, 0.0)):
    """The path with some poses shifted and turned."""
    position_m = path.position_m.copy()
    position_m[rows] += shift_m
    turned = orientations(path)[rows] * Rotation.from_rotvec(turn)
    orientation_wxyz = path.orientation_wxyz.copy()
    orientation_wxyz[rows] = turned.as_quat(scalar_first=True)
    return replace(path, position_m=position_m, orientation_wxyz=orientation_wxyz)


def typical(error, percent=50):
    """The median length of errors (n, 3), or another percentile."""
    lengths = np.linalg.norm(error, axis=1)
    return float(np.percentile(lengths, percent))


# Oracles.

turns = st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3).map(np.array)
AGILITY = pose_motion.Agility(4.0, 0.7)


def test_transition_matrix_is_the_derivative_of_the_motion():
    """F equals the numerical derivative of the motion, turns included."""
    rng = np.random.default_rng(2)
    pose = CameraPose(rng.normal(size=3), Rotation.random(rng=rng).as_matrix(), pose_covariance())
    motion = pose_motion.initial_motion(pose, AGILITY)
    motion = pose_motion.moved(motion, rng.normal(size=pose_motion.SIZE))
    later, F, _ = pose_motion.predict(motion, 0.3, AGILITY)

    def changed_by(change):
        other, _, _ = pose_motion.predict(pose_motion.moved(motion, change), 0.3, AGILITY)
        return pose_motion.difference(later, other)

    for k, change in enumerate(1e-6 * np.eye(pose_motion.SIZE)):
        slope = (changed_by(change) - changed_by(-change)) / 2e-6
        np.testing.assert_allclose(F[:, k], slope, atol=1e-8)


def test_a_camera_that_does_not_turn_is_smoothed_as_by_least_squares_over_all_frames():
    """The reference solves one linear problem for the positions, velocities, accelerations and errors of all frames.

    F and Q come from the matrix exponential (C. F. Van Loan, Computing integrals involving the matrix exponential,
    1978).
    """
    time_s = np.cumsum([0.0, *[0.04] * 6, 0.02, 0.2, *[0.04] * 4])
    frames, gone = len(time_s), range(4, 7)
    fraction, correlated_s = pose_motion.CORRELATED_FRACTION, pose_motion.CORRELATED_TIME_S
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(3, 3))
    noise_m2 = 1e-5 * (noise @ noise.T + np.eye(3))
    covariance = block_diag(noise_m2, 1e-6 * np.eye(3))
    measured_m = np.cumsum(rng.normal(scale=0.01, size=(frames, 3)), axis=0) * 0.3
    raw = camera_path(measured_m, Rotation.identity(frames), np.tile(covariance, (frames, 1, 1)))
    raw = remove_poses(replace(raw, time_s=time_s), gone)
    agility = choose_agility(raw.time_s.tolist(), poses_of(raw), PoseFilterParams())
    filtered, path = filter_path(raw), smooth(raw)
    assert (path.flags == 0).all()

    variances, axes = np.linalg.eigh(noise_m2)
    root = axes @ np.diag(np.sqrt(fraction * variances)) @ axes.T
    H = np.hstack([np.eye(3), np.zeros((3, 6)), root])
    A = np.zeros((12, 12))
    A[:3, 3:6] = A[3:6, 6:9] = np.eye(3)
    A[6:9, 6:9] = -np.eye(3) / pose_motion.ACCELERATION_TIME_S
    A[9:, 9:] = -np.eye(3) / correlated_s
    jerk = 2 * agility.acceleration_std_m_s2**2 / pose_motion.ACCELERATION_TIME_S
    driven = np.diag([0.0] * 6 + [jerk] * 3 + [2 / correlated_s] * 3)
    part = np.r_[0:9, 15:18]
    start = pose_motion.initial_motion(CameraPose(measured_m[0], np.eye(3), covariance), agility)
    first = start.covariance[np.ix_(part, part)]
    rows, wanted = [], []

    def equation(coefficients, right, cov):
        whiten = np.linalg.inv(np.linalg.cholesky(cov))
        rows.append(whiten @ coefficients)
        wanted.append(whiten @ right)

    def at(frame, matrix):
        whole = np.zeros((len(matrix), 12 * frames))
        whole[:, 12 * frame : 12 * frame + 12] = matrix
        return whole

    equation(at(0, np.eye(12)), np.concatenate([measured_m[0], np.zeros(9)]), first)
    for k, dt_s in enumerate(np.diff(time_s), start=1):
        loan = expm(np.block([[-A, driven], [np.zeros((12, 12)), A.T]]) * dt_s)
        F = loan[12:, 12:].T
        equation(at(k, np.eye(12)) - at(k - 1, F), np.zeros(12), F @ loan[:12, 12:])
        if k not in gone:
            equation(at(k, H), measured_m[k], (1 - fraction) * noise_m2)
    A, b = np.vstack(rows), np.concatenate(wanted)
    best = np.linalg.lstsq(A, b, rcond=None)[0].reshape(frames, 12)
    inverse = np.linalg.inv(A.T @ A)
    # The condition number of 1e5 is squared in the normal equations, which leaves six digits of the covariance.
    np.testing.assert_allclose(path.position_m, best[:, :3], atol=1e-7)
    np.testing.assert_allclose(path.velocity_m_s, best[:, 3:6], atol=1e-5)
    # In the last frame, the filter knows as much.
    np.testing.assert_allclose(filtered.position_m[-1], best[-1, :3], atol=1e-7)
    np.testing.assert_allclose(filtered.velocity_m_s[-1], best[-1, 3:6], atol=1e-5)
    for k in range(frames):
        expected = inverse[12 * k : 12 * k + 3, 12 * k : 12 * k + 3]
        np.testing.assert_allclose(path.covariance[k, :3, :3], expected, rtol=1e-3, atol=1e-10)


# Whole flights.


@pytest.mark.parametrize("size", [0.5, 25.0], ids=["hovering", "racing"])
def test_a_camera_is_followed_as_well_as_stated(size):
    """The filter knows neither the camera's motion nor the duration of lasting errors; the smoother is better.

    Found: nine levels of motion lost a flight at 25 m/s2, with errors of metres, or had 8.9 mm where raw poses had 6.6.
    """
    raw, position_m, truth = flight(60, acceleration=size, shake=size, seed=33)
    raw_error = pose_errors(raw, position_m, truth)
    filtered, smoothed = filter_path(raw), smooth(raw)
    assert (filtered.status[2:] != Status.LOST).all()
    assert smoothed.seen.all()
    assert (smoothed.status == Status.TRACKED).mean() > 0.88
    true_m_s = np.gradient(position_m, raw.time_s, axis=0)
    positions, speeds = [], []
    for path in (filtered, smoothed):
        seen = path.seen
        error = pose_errors(path, position_m, truth)[seen]
        for axes in (slice(0, 3), slice(3, 6)):
            # Most of the error is correlated and cannot be separated from motion, so the gain is small; 60 frames
            # determine a ratio of medians to some percent.
            assert typical(error[:, axes]) < 1.03 * typical(raw_error[:, axes])
            distances = squared_errors(error[:, axes], path.covariance[seen][:, axes, axes])
            assert 0.7 < (distances < NINETY).mean() < 1.0
        positions.append(typical(error[:, :3]))
        off_m_s = path.velocity_m_s - true_m_s
        speeds.append(typical(off_m_s[10:-2]))
    assert positions[1] < positions[0]
    worst_m = typical(error[:, :3], 99)
    assert worst_m < 1.01 * typical(raw_error[:, :3], 99)
    # The white error divided by the duration of a few frames, plus the change of acceleration in a frame.
    assert speeds[1] < speeds[0] < 0.1 + size / FPS


def test_outliers_are_bridged_with_growing_uncertainty():
    """Single wrong poses, a run of them, and some at both ends."""
    raw, position_m, truth = flight(60, seed=33)
    bad, run = np.r_[0, 15, 40:46, 58:60], slice(40, 46)
    raw = move_poses(raw, bad, [0.0, 0.15, 0.0], [0.0, 0.0, 0.03])
    path, smoothed = filter_path(raw), smooth(raw)
    error = pose_errors(path, position_m, truth)[path.seen]
    # In 6 frames, 0.24 s, the error is 0.06 m and 4 degrees at 2 m/s2 and 2 rad/s2, and more at larger accelerations.
    assert typical(error[:, :3], 100) < 0.25
    assert np.degrees(typical(error[:, 3:], 100)) < 12.0
    # Bridging six frames from both sides at 2 m/s2 costs one or two centimetres.
    assert np.nanmax(distances_m(smoothed, position_m)) < 0.05
    good = np.setdiff1d(np.arange(4, 60), bad)
    for one in (path, smoothed):
        assert (one.flags[bad[1:]] & Flag.GATED).all()
        assert (one.status[bad] != Status.TRACKED).all()
        assert (one.status[good] == Status.TRACKED).mean() > 0.95
    assert (path.status[run] == Status.COASTING).all()
    assert (path.flags[run] == Flag.GATED).all()
    assert (path.num_markers[run] == 2).all()
    variance_m2 = path.covariance[:, range(3), range(3)].sum(axis=1)
    assert (np.diff(variance_m2[39:46]) > 0).all()


def test_a_camera_that_stays_elsewhere_is_found_after_restart_after_poses():
    raw, position_m, _ = flight(45, seed=12)
    raw = move_poses(raw, slice(25, 45), [0.0, 0.0, 5.0])
    position_m[25:] += [0.0, 0.0, 5.0]
    params = PoseFilterParams(restart_after=4)
    path, believed = filter_path(raw, params), 25 + 4 - 1
    assert (path.status[25:believed] == Status.COASTING).all()
    assert (path.status[believed : believed + 10] == Status.TRACKED).all()
    assert distances_m(path, position_m)[believed:].max() < 0.03
    # Some poses beside the jump may be gated and bridged. A path drawn across the jump would be off by metres.
    assert distances_m(smooth(raw, params), position_m).max() < 0.1


@pytest.mark.parametrize("calm", [40, pytest.param(280, marks=pytest.mark.slow)])
def test_a_late_turn_of_a_hovering_camera_is_followed(calm):
    """The agility of 280 calm frames says nothing about the last 20, in which the camera flies off with 40 m/s2."""
    count = calm + 20
    time_s = np.arange(count) / FPS
    position_m = 0.002 * np.sin(np.outer(time_s, [3.0, 4.0, 5.0]))
    flying_s = time_s[1:21]
    position_m[calm:, 0] += 40.0 / 2 * flying_s**2
    noise_m = np.random.default_rng(36).normal(scale=0.002, size=(count, 3))
    raw = raw_path(position_m + noise_m, Rotation.identity(count))
    for path in (filter_path(raw), smooth(raw)):
        assert (path.status[5:] == Status.COASTING).sum() <= 2
        assert path.seen[2:].all()
        # Raw poses are 3 mm off; one frame with 40 m/s2 instead of none is 32 mm.
        off_m = distances_m(path, position_m)
        assert np.nanmax(off_m) < 0.035
        # Measured 16 mm by the filter.
        assert np.nanmax(off_m[calm + 2 :]) < 0.02


def test_gaps_are_bridged_for_the_longest_gap():
    """By the filter from one side, and by the smoother from both."""
    raw, position_m, truth = flight(110, acceleration=0.5, shake=0.3, seed=14)
    raw = remove_poses(raw, np.r_[0:4, 30:50, 70:100])
    params, variances_m2 = PoseFilterParams(longest_gap_s=0.45), []
    path, smoothed = filter_path(raw, params), smooth(raw, params)
    for one in (path, smoothed):
        assert (one.status[:4] == Status.LOST).all()
        assert (one.status[70:81] == Status.COASTING).all()
        assert (one.status[82:100] == Status.LOST).all()
        # The camera hovered and is where a hovering camera would be, so no further pose is needed for confirmation.
        assert (one.status[100:] == Status.TRACKED).all()
        for value in (one.position_m, one.orientation_wxyz, one.covariance, one.ambiguity, one.velocity_m_s):
            assert np.isnan(value[82:100]).all()
        bridged = np.arange(110)[30:50][one.seen[30:50]]
        error = pose_errors(one, position_m, truth)[bridged]
        for axes in (slice(0, 3), slice(3, 6)):
            # Once in 10,000 frames the error would be larger.
            assert squared_errors(error[:, axes], one.covariance[bridged][:, axes, axes]).max() < 21.1
        variances_m2.append(one.covariance[:, range(3), range(3)].sum(axis=1))
    forward_m2, both_m2 = variances_m2
    assert (path.status[30:41] == Status.COASTING).all()
    assert (path.flags[30:41] == 0).all()
    assert (np.diff(forward_m2[29:41]) > 0).all()
    # Every frame of the gap of 0.84 s is within 0.45 s of a pose; the uncertainty is largest in its middle.
    assert (smoothed.status[30:50] == Status.COASTING).all()
    assert 6 <= both_m2[30:50].argmax() <= 13
    assert both_m2[40] < 0.3 * forward_m2[40]


@pytest.mark.parametrize(
    ("acceleration", "before", "markers"),
    # Agreeing markers do not outweigh the motion of a hovering camera.
    [(2.0, 20, 2), (0.05, 60, 8)],
)
def test_wrong_poses_that_agree_after_a_gap_are_not_accepted(acceleration, before, markers):
    """Five poses after a gap of a second agree with each other but are 2.3 m off."""
    begun = before + 25
    wrong = slice(begun, begun + 5)
    raw, position_m, _ = flight(begun + 30, acceleration=acceleration, shake=0.5, seed=40)
    raw.num_markers[:] = markers
    raw = remove_poses(raw, slice(before, begun))
    raw = move_poses(raw, wrong, [2.3, 0.0, 0.0])
    path = filter_path(raw)
    assert (path.status[wrong] == Status.LOST).all()
    # The right poses are accepted when they are one more than the wrong poses and enough to contradict a state.
    assert (path.status[begun + 15 :] == Status.TRACKED).all()
    for one in (path, smooth(raw)):
        off_m = distances_m(one, position_m)
        assert np.nanmax(off_m[begun:]) < 0.05


def test_after_a_gap_markers_that_agree_beyond_chance_are_accepted_at_once():
    raw, position_m, _ = flight(75, acceleration=2.0, shake=2.0, seed=41)
    raw = remove_poses(raw, slice(30, 60))
    # With two markers more poses are needed, because the gap is too long for the motion to predict a pose.
    assert (filter_path(raw).status[60:69] == Status.LOST).all()
    path = filter_path(replace(raw, num_markers=np.full(75, 3)))
    assert (path.status[60:64] == Status.TRACKED).all()
    assert (path.status[60:] != Status.LOST).all()
    assert distances_m(path, position_m)[60:].max() < 0.05


# First poses, and paths with few poses.


@pytest.mark.parametrize(
    ("markers", "ambiguity", "first"),
    [(3, 0.0, 0), (3, 0.01, 2), (2, 0.0, 2)],
    ids=["sure", "ambiguous", "by chance"],
)
def test_an_unambiguous_first_pose_is_returned_at_once(markers, ambiguity, first):
    raw, _, _ = flight(6, seed=42)
    raw.num_markers[:] = markers
    raw.ambiguity[:] = ambiguity
    filtered = filter_path(raw)
    assert filtered.seen.tolist() == [False] * first + [True] * (6 - first)
    assert (smooth(raw).status[first:] != Status.LOST).all()


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_paths_of_few_poses(frames):
    """A first pose counts if the recording is too short to confirm it; in its own frame, a causal filter cannot."""
    raw, _, _ = flight(5, seed=15)
    values = {name: value[:frames] for name, value in vars(raw).items() if value is not None}
    some, none = replace(raw, **values), remove_poses(raw, slice(None))
    for find in (filter_path, smooth):
        assert find(some).status.tolist() == [Status.LOST] * frames
        assert not find(none).seen.any()
        believing = find(some, PoseFilterParams(confirm=1))
        assert (believing.status == Status.TRACKED).all()
        if frames == 1:
            # With one pose the estimate equals the pose and its covariance.
            np.testing.assert_allclose(believing.position_m, some.position_m, atol=1e-12)
            np.testing.assert_allclose(believing.covariance, some.covariance, atol=1e-15)
    within = filter_path(some, PoseFilterParams().within(frames))
    assert within.seen.tolist() == [False, True][2 - frames :]


# Errors that are the same in all frames.


def with_constant_errors(raw, rng):
    """Raw poses with errors that last, and the constant parts of their covariances.

    The effect of an error on the poses changes slowly, and jumps when other markers come into view.
    """
    frames = raw.num_frames
    scale = np.array([[0.012] * 3 + [0.002] * 3]).T
    effect = rng.normal(size=(6, 2)) + rng.normal(scale=0.02, size=(frames, 6, 2)).cumsum(axis=0)
    effect[8:] += rng.normal(scale=0.5, size=(6, 2))
    effect = scale * effect
    off = effect @ rng.normal(size=2)
    constant = effect @ effect.mT
    turned = orientations(raw) * Rotation.from_rotvec(off[:, 3:])
    return replace(
        raw,
        position_m=raw.position_m + off[:, :3],
        orientation_wxyz=turned.as_quat(scalar_first=True),
        covariance=raw.covariance + constant,
    ), constant


@pytest.mark.parametrize("draws", [8, pytest.param(40, marks=pytest.mark.nightly)])
def test_constant_errors_are_not_averaged_away(draws):
    rng, frames, inside, gated = np.random.default_rng(44), 12, [], 0
    for seed in range(draws):
        raw, position_m, truth = flight(frames, acceleration=0.5, shake=0.5, seed=seed)
        stated, constant = with_constant_errors(raw, rng)
        filtered = filter_path(stated, constant=constant)
        gated += ((filtered.flags & Flag.GATED) > 0).sum()
        smoothed = smooth(stated, constant=constant)
        unstated = filter_path(replace(stated, covariance=raw.covariance))
        held = []
        for path, frame in ((filtered, 7), (filtered, 10), (smoothed, 5), (unstated, 7)):
            error = pose_errors(path, position_m, truth)[[frame], :3]
            held.append(squared_errors(error, path.covariance[[frame]])[0] < NINETY)
        inside.append(held)
    # Three standard deviations of a share below 0.9; the poses' own covariances are rather too wide.
    shares = np.mean(inside, axis=0)
    assert (shares[:3] > 0.9 - 3 * np.sqrt(0.09 / draws)).all()
    assert shares[3] < 0.5
    # A jump that other visible markers explain is no outlier.
    assert gated <= 0.01 * draws * frames


# Ambiguous poses.


def test_an_unambiguous_pose_makes_the_later_path_unambiguous():
    raw, _, _ = flight(20, seed=22)
    raw.ambiguity[:], raw.flags[:] = 0.3, Flag.AMBIGUOUS
    raw.ambiguity[10], raw.flags[10] = 0.0, 0
    path = filter_path(raw)
    assert (path.ambiguity[2:10] == 0.3).all()
    assert (path.ambiguity[10:] == 0.0).all()
    assert (path.flags[:10] == Flag.AMBIGUOUS).all()
    assert (path.flags[10:] == 0).all()


# Invariance to the world's axes.


@settings(max_examples=4)
@given(turns, st.lists(st.floats(-100, 100), min_size=3, max_size=3).map(np.array), st.booleans())
def test_turning_and_shifting_the_world_turns_and_shifts_the_path(rotvec, shift_m, negate):
    raw, _, _ = flight(15, seed=23)
    raw = move_poses(remove_poses(raw, slice(5, 7)), slice(10, 11), [1.0, 0.0, 0.0])
    factor = 1 + 0.5 * np.sin(np.arange(15.0))
    raw = replace(raw, covariance=raw.covariance * factor[:, None, None])
    turn = Rotation.from_rotvec(rotvec)
    other = in_other_world(raw, turn, shift_m)
    if negate:
        # A quaternion and its negative are the same orientation.
        other = replace(other, orientation_wxyz=-other.orientation_wxyz)
    found, expected = filter_path(other), in_other_world(filter_path(raw), turn, shift_m)
    np.testing.assert_array_equal(found.status, expected.status)
    np.testing.assert_array_equal(found.flags, expected.flags)
    # Rounding of positions of 100 m, 1e-14 relative, over a hundred steps.
    np.testing.assert_allclose(found.position_m, expected.position_m, atol=1e-8)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-4, atol=1e-10)
    seen = found.seen
    velocity_m_s = turn.apply(filter_path(raw).velocity_m_s[seen])
    np.testing.assert_allclose(found.velocity_m_s[seen], velocity_m_s, atol=1e-6)
    apart = orientations(found)[seen].inv() * orientations(expected)[seen]
    assert apart.magnitude().max() < 1e-8
