"""The filter and the smoother of camera poses: a textbook filter and least squares over all frames as oracles, ground
truth for the covariances, and outliers, wrong first poses, gaps and ambiguous poses."""

from dataclasses import replace

import numpy as np
import pytest
from camera_paths import FPS, camera_path, remove_poses
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag, expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.inside_out import CameraPath, Flag, PoseFilterParams, smooth
from psotrack.inside_out.filtering import choose_agility, filter_path, poses_of
from psotrack.inside_out.filtering import motion as pose_motion
from psotrack.inside_out.filtering.pose_filter import probability_right
from psotrack.inside_out.pose import CameraPose
from psotrack.trajectories import Status

STD_M, STD_RAD = 0.004, 0.0008
#: The 90 % quantile of the chi-square distribution with 3 degrees of freedom.
NINETY = chi2.ppf(0.9, 3)


def pose_covariance() -> np.ndarray:
    """Covariance of a pose: shifts to the side and turns about the vertical axis are correlated, as in real poses."""
    covariance = np.diag([STD_M**2] * 3 + [STD_RAD**2] * 3)
    covariance[0, 4] = covariance[4, 0] = 0.8 * STD_M * STD_RAD
    covariance[1, 3] = covariance[3, 1] = -0.8 * STD_M * STD_RAD
    return covariance


def raw_path(position_m, orientation) -> CameraPath:
    covariance = np.tile(pose_covariance(), (len(position_m), 1, 1))
    return camera_path(position_m, orientation, covariance, num_markers=2)


def flight(frames, *, acceleration=2.0, shake=2.0, seed=0):
    """A camera with random forces and damping, and raw poses with partly lasting errors.

    The motion differs from the filter's, and so does the duration of lasting errors (half a second).

    Returns:
        Raw poses, and the true positions (frames, 3) and orientations.
    """
    rng = np.random.default_rng(seed)
    finer, dt = 10, 1 / FPS / 10
    pull, twist = np.zeros(3), np.zeros(3)
    position, velocity, rate, turned = np.zeros(3), np.zeros(3), np.zeros(3), Rotation.identity()
    positions, quaternions = [], []
    for k in range(frames * finer):
        pull = np.exp(-dt / 0.4) * pull + acceleration * np.sqrt(2 * dt / 0.4) * rng.normal(size=3)
        twist = np.exp(-dt / 0.1) * twist + shake * np.sqrt(2 * dt / 0.1) * rng.normal(size=3)
        velocity = velocity + (pull - 0.3 * velocity) * dt
        rate = rate + (twist - rate) * dt
        position = position + velocity * dt
        turned = turned * Rotation.from_rotvec(rate * dt)
        if k % finer == 0:
            positions.append(position)
            quaternions.append(turned.as_quat(scalar_first=True))
    position_m, truth = np.array(positions), Rotation.from_quat(quaternions, scalar_first=True)
    root = np.linalg.cholesky(pose_covariance())
    lasting, off = rng.normal(size=6), []
    for _ in range(frames):
        off.append(root @ (np.sqrt(0.6) * lasting + np.sqrt(0.4) * rng.normal(size=6)))
        kept = np.exp(-1 / FPS / 0.5)
        lasting = kept * lasting + np.sqrt(1 - kept**2) * rng.normal(size=6)
    error = np.array(off)
    return raw_path(position_m - error[:, :3], truth * Rotation.from_rotvec(-error[:, 3:])), position_m, truth


def move_poses(path: CameraPath, rows, shift_m, turn=(0.0, 0.0, 0.0)) -> CameraPath:
    """The path with some poses shifted and turned."""
    position_m, orientation_wxyz = path.position_m.copy(), path.orientation_wxyz.copy()
    position_m[rows] += shift_m
    there = Rotation.from_quat(orientation_wxyz[rows], scalar_first=True) * Rotation.from_rotvec(turn)
    orientation_wxyz[rows] = there.as_quat(scalar_first=True)
    return replace(path, position_m=position_m, orientation_wxyz=orientation_wxyz)


def errors(path: CameraPath, position_m, truth):
    """Truth minus estimate in frames with a pose, (seen, 3) each: along the world's, and about the camera's axes."""
    seen = path.seen
    turn = Rotation.from_quat(path.orientation_wxyz[seen], scalar_first=True).inv() * truth[seen]
    return position_m[seen] - path.position_m[seen], turn.as_rotvec()


def off_m(path: CameraPath, position_m):
    """Distances from the true positions, NaN without a pose, metres."""
    return np.linalg.norm(path.position_m - position_m, axis=1)


def squares(error, covariance):
    """Squared errors by their covariances."""
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)


def lengths(error, fraction=50) -> float:
    return float(np.percentile(np.linalg.norm(error, axis=1), fraction))


# Oracles.

turns = st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3).map(np.array)
AGILITY = pose_motion.Agility(4.0, 0.7)


def test_transition_matrix_is_the_derivative_of_the_motion() -> None:
    """F equals the numerical derivative of the motion, turns included."""
    rng = np.random.default_rng(2)
    pose = CameraPose(rng.normal(size=3), Rotation.random(rng=rng).as_matrix(), pose_covariance())
    motion = pose_motion.initial_motion(pose, AGILITY)
    motion = pose_motion.moved(motion, rng.normal(size=pose_motion.SIZE))
    later, F, _ = pose_motion.predict(motion, 0.3, AGILITY)
    for k, change in enumerate(1e-6 * np.eye(pose_motion.SIZE)):
        ahead, behind = (
            pose_motion.predict(pose_motion.moved(motion, sign * change), 0.3, AGILITY)[0] for sign in (1, -1)
        )
        slope = (pose_motion.difference(later, ahead) - pose_motion.difference(later, behind)) / 2e-6
        np.testing.assert_allclose(F[:, k], slope, atol=1e-8)


def test_a_camera_that_does_not_turn_is_smoothed_as_by_least_squares_over_all_frames() -> None:
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
    rows, wanted = [], []

    def equation(coefficients, right, cov) -> None:
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


def test_hovering_and_racing_cameras_are_followed_as_well_as_stated() -> None:
    """The filter knows neither the camera's motion nor the duration of lasting errors; the smoother is better.

    Found: nine levels of motion lost a flight at 25 m/s2, with errors of metres, or had 8.9 mm where raw poses had 6.6.
    """
    agilities = []
    for size in (0.5, 25.0):
        raw, position_m, truth = flight(60, acceleration=size, shake=size, seed=33)
        agilities.append(choose_agility(raw.time_s.tolist(), poses_of(raw), PoseFilterParams()))
        filtered, smoothed = filter_path(raw), smooth(raw)
        assert (filtered.status[2:] != Status.LOST).all()
        assert smoothed.seen.all()
        assert (smoothed.status == Status.TRACKED).mean() > 0.88
        speed_m_s = np.gradient(position_m, raw.time_s, axis=0)
        by_raw, speeds = errors(raw, position_m, truth), []
        for path in (filtered, smoothed):
            found = errors(path, position_m, truth)
            for part, own, axes in zip(found, by_raw, (slice(0, 3), slice(3, 6)), strict=True):
                # Most of the error is correlated and cannot be separated from motion, so the gain is small; 60 frames
                # determine a ratio of medians to some percent.
                assert lengths(part) < 1.03 * lengths(own)
                covariance = path.covariance[path.seen][:, axes, axes]
                assert 0.7 < (squares(part, covariance) < NINETY).mean() < 1.0
            speeds.append(lengths((path.velocity_m_s - speed_m_s)[10:-2]))
        assert lengths(errors(smoothed, position_m, truth)[0]) < lengths(
            errors(filtered, position_m, truth)[0]
        )
        assert lengths(errors(smoothed, position_m, truth)[0], 99) < 1.01 * lengths(by_raw[0], 99)
        # The white error divided by the duration of a few frames, plus the change of acceleration in a frame.
        assert speeds[1] < speeds[0] < 0.1 + size / FPS
    calm, violent = agilities
    assert violent.acceleration_std_m_s2 > 8 * calm.acceleration_std_m_s2
    assert violent.rate_change_std_rad_s > 8 * calm.rate_change_std_rad_s


def test_outliers_are_bridged_with_growing_uncertainty() -> None:
    """Single wrong poses, a run of them, and some at both ends."""
    raw, position_m, truth = flight(60, seed=33)
    bad = np.r_[0, 15, 40:46, 58:60]
    raw = move_poses(raw, bad, [0.0, 0.15, 0.0], [0.0, 0.0, 0.03])
    path, smoothed = filter_path(raw), smooth(raw)
    by_filter = errors(path, position_m, truth)
    # In 6 frames, 0.24 s, the error is 0.06 m and 4 degrees at 2 m/s2 and 2 rad/s2, and more at larger accelerations.
    assert np.linalg.norm(by_filter[0], axis=1).max() < 0.25
    assert np.degrees(np.linalg.norm(by_filter[1], axis=1)).max() < 12.0
    # Bridging six frames from both sides at 2 m/s2 costs one or two centimetres.
    assert np.nanmax(off_m(smoothed, position_m)) < 0.05
    good = np.setdiff1d(np.arange(60), bad)
    for one in (path, smoothed):
        assert (one.flags[bad[1:]] & Flag.GATED).all()
        assert (one.status[bad] != Status.TRACKED).all()
        assert (one.status[good[4:]] == Status.TRACKED).mean() > 0.95
    assert (path.status[40:46] == Status.COASTING).all()
    assert (path.flags[40:46] == Flag.GATED).all()
    assert (path.num_markers[40:46] == 2).all()
    assert (np.diff(np.trace(path.covariance[39:46, :3, :3], axis1=1, axis2=2)) > 0).all()


def test_a_wrong_first_state_is_replaced_when_more_poses_contradict_it() -> None:
    raw, position_m, _ = flight(30, seed=11)
    path = filter_path(move_poses(raw, slice(0, 4), [3.0, 0.0, 0.0]))
    assert path.status[3] == Status.TRACKED
    # Four poses supported the state; the fifth pose that contradicts it makes a majority.
    assert (path.status[4:8] == Status.COASTING).all()
    assert (path.status[8:] == Status.TRACKED).all()
    assert off_m(path, position_m)[8:].max() < 0.03


def test_a_camera_that_stays_elsewhere_is_found_after_restart_after_poses() -> None:
    raw, position_m, _ = flight(45, seed=12)
    moved = np.array([0.0, 0.0, 5.0]) * (np.arange(45) >= 25)[:, None]
    raw, position_m = replace(raw, position_m=raw.position_m + moved), position_m + moved
    params = PoseFilterParams(restart_after=4)
    path, believed = filter_path(raw, params), 25 + 4 - 1
    assert (path.status[25:believed] == Status.COASTING).all()
    assert (path.status[believed : believed + 10] == Status.TRACKED).all()
    assert off_m(path, position_m)[believed:].max() < 0.03
    # Some poses beside the jump may be gated and bridged. A path drawn across the jump would be off by metres.
    assert off_m(smooth(raw, params), position_m).max() < 0.1


@pytest.mark.parametrize("calm", [40, pytest.param(280, marks=pytest.mark.slow)])
def test_a_late_turn_of_a_hovering_camera_is_followed(calm) -> None:
    """The agility of 280 calm frames says nothing about the last 20, in which the camera flies off with 40 m/s2."""
    count = calm + 20
    position_m = 0.002 * np.sin(np.arange(count)[:, None] / FPS * np.array([3.0, 4.0, 5.0]))
    position_m[calm:, 0] += 40.0 / 2 * (np.arange(1, 21) / FPS) ** 2
    rng = np.random.default_rng(36)
    raw = raw_path(position_m + rng.normal(scale=0.002, size=(count, 3)), Rotation.identity(count))
    for path in (filter_path(raw), smooth(raw)):
        assert (path.status[5:] == Status.COASTING).sum() <= 2
        assert path.seen[2:].all()
        # Raw poses are 3 mm off; one frame with 40 m/s2 instead of none is 32 mm.
        assert np.nanmax(off_m(path, position_m)) < 0.035
        # Measured 16 mm by the filter.
        assert np.nanmax(off_m(path, position_m)[calm + 2 :]) < 0.02


def test_gaps_are_bridged_for_the_longest_gap() -> None:
    """By the filter from one side, and by the smoother from both."""
    raw, position_m, truth = flight(110, acceleration=0.5, shake=0.3, seed=14)
    raw = remove_poses(raw, np.r_[0:4, 30:50, 70:100])
    path, smoothed = (one(raw, PoseFilterParams(longest_gap_s=0.45)) for one in (filter_path, smooth))
    for one in (path, smoothed):
        assert (one.status[:4] == Status.LOST).all()
        assert (one.status[70:81] == Status.COASTING).all()
        assert (one.status[82:100] == Status.LOST).all()
        # The camera hovered and is where a hovering camera would be, so no further pose is needed for confirmation.
        assert (one.status[100:] == Status.TRACKED).all()
        for value in (one.position_m, one.orientation_wxyz, one.covariance, one.ambiguity, one.velocity_m_s):
            assert np.isnan(value[82:100]).all()
        rows = np.flatnonzero(one.seen)
        in_gap = np.isin(rows, np.r_[30:50])
        for error, axes in zip(errors(one, position_m, truth), (slice(0, 3), slice(3, 6)), strict=True):
            # Once in 10,000 frames the error would be larger.
            assert squares(error[in_gap], one.covariance[rows[in_gap]][:, axes, axes]).max() < 21.1
    variance_m2 = np.trace(path.covariance[:, :3, :3], axis1=1, axis2=2)
    both_m2 = np.trace(smoothed.covariance[:, :3, :3], axis1=1, axis2=2)
    assert (path.status[30:41] == Status.COASTING).all()
    assert (path.flags[30:41] == 0).all()
    assert (np.diff(variance_m2[29:41]) > 0).all()
    # Every frame of the gap of 0.84 s is within 0.45 s of a pose; the uncertainty is largest in its middle.
    assert (smoothed.status[30:50] == Status.COASTING).all()
    assert 36 <= 30 + both_m2[30:50].argmax() <= 43
    assert both_m2[40] < 0.3 * variance_m2[40]


@pytest.mark.parametrize(
    ("acceleration", "before", "markers"),
    # Agreeing markers do not outweigh the motion of a hovering camera.
    [(2.0, 20, 2), (0.05, 60, 8)],
)
def test_wrong_poses_that_agree_after_a_gap_are_not_accepted(acceleration, before, markers) -> None:
    """Five poses after a gap of a second agree with each other but are 2.3 m off."""
    begun = before + 25
    raw, position_m, _ = flight(begun + 30, acceleration=acceleration, shake=0.5, seed=40)
    raw = remove_poses(replace(raw, num_markers=np.full(begun + 30, markers)), slice(before, begun))
    raw = move_poses(raw, slice(begun, begun + 5), [2.3, 0.0, 0.0])
    path = filter_path(raw)
    assert (path.status[begun : begun + 5] == Status.LOST).all()
    # The right poses are accepted when they are one more than the wrong poses and enough to contradict a state.
    assert (path.status[begun + 15 :] == Status.TRACKED).all()
    for one in (path, smooth(raw)):
        assert np.nanmax(off_m(one, position_m)[begun:]) < 0.05


def test_after_a_gap_markers_that_agree_beyond_chance_are_accepted_at_once() -> None:
    raw, position_m, _ = flight(75, acceleration=2.0, shake=2.0, seed=41)
    raw = remove_poses(raw, slice(30, 60))
    path = filter_path(replace(raw, num_markers=np.full(75, 3)))
    assert (path.status[60:64] == Status.TRACKED).all()
    assert (path.status[60:] != Status.LOST).all()
    assert off_m(path, position_m)[60:].max() < 0.05
    # Without such markers more poses are needed, because the gap is too long for the motion to predict a pose.
    assert (filter_path(raw).status[60:69] == Status.LOST).all()


# First poses, and paths with few poses.


@pytest.mark.parametrize(
    ("markers", "ambiguity", "first"),
    [(3, 0.0, 0), (3, 0.01, 2), (2, 0.0, 2)],
    ids=["sure", "ambiguous", "by chance"],
)
def test_an_unambiguous_first_pose_is_returned_at_once(markers, ambiguity, first) -> None:
    raw, _, _ = flight(6, seed=42)
    raw = replace(raw, num_markers=np.full(6, markers), ambiguity=np.full(6, ambiguity))
    for path in (filter_path(raw), smooth(raw)):
        assert (path.status != Status.LOST)[first:].all()
    assert not filter_path(raw).seen[:first].any()


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_paths_of_few_poses(frames) -> None:
    """A first pose counts if the recording is too short to confirm it; in its own frame, a causal filter cannot."""
    raw, _, _ = flight(5, seed=15)
    some = replace(raw, **{name: value[:frames] for name, value in vars(raw).items() if value is not None})
    for find in (filter_path, smooth):
        assert find(some).status.tolist() == [Status.LOST] * frames
        assert (find(remove_poses(raw, slice(None))).status == Status.LOST).all()
        believing = find(some, PoseFilterParams(confirm=1))
        assert (believing.status == Status.TRACKED).all()
        if frames == 1:
            # With one pose the estimate equals the pose and its covariance.
            np.testing.assert_allclose(believing.position_m, raw.position_m[:1], atol=1e-12)
            np.testing.assert_allclose(believing.covariance[0], raw.covariance[0], atol=1e-15)
    if frames:
        found = filter_path(some, PoseFilterParams().within(frames)).status
        assert found.tolist() == [Status.LOST] * (frames - 1) + [Status.TRACKED]


# Errors that are the same in all frames.


@pytest.mark.parametrize("draws", [8, pytest.param(40, marks=pytest.mark.nightly)])
def test_constant_errors_are_not_averaged_away(draws) -> None:
    """The effect of an error on the poses changes slowly, and jumps when other markers come into view."""
    rng, frames, inside, gated = np.random.default_rng(44), 12, [], 0
    scale = np.array([[0.012] * 3 + [0.002] * 3]).T
    for seed in range(draws):
        raw, position_m, _ = flight(frames, acceleration=0.5, shake=0.5, seed=seed)
        walk = rng.normal(scale=0.02, size=(frames, 6, 2)).cumsum(axis=0)
        common = scale * (rng.normal(size=(6, 2)) + walk)
        common[8:] += scale * rng.normal(scale=0.5, size=(6, 2))
        off = common @ rng.normal(size=2)
        orientation = Rotation.from_quat(raw.orientation_wxyz, scalar_first=True)
        turned = (orientation * Rotation.from_rotvec(off[:, 3:])).as_quat(scalar_first=True)
        raw = replace(raw, position_m=raw.position_m + off[:, :3], orientation_wxyz=turned)
        constant = common @ common.swapaxes(1, 2)
        with_constant = replace(raw, covariance=raw.covariance + constant)
        filtered = filter_path(with_constant, constant=constant)
        gated += int(((filtered.flags & Flag.GATED) > 0).sum())
        smoothed = smooth(with_constant, constant=constant)
        without = filter_path(raw)
        looked_at = ((filtered, 7), (filtered, 10), (smoothed, 5), (without, 7))
        inside.append(
            [
                squares((position_m - one.position_m)[[k]], one.covariance[[k], :3, :3])[0] < NINETY
                for one, k in looked_at
            ]
        )
    # Three standard deviations of a share below 0.9; the poses' own covariances are rather too wide.
    shares = np.mean(inside, axis=0)
    assert (shares[:3] > 0.9 - 3 * np.sqrt(0.09 / draws)).all()
    assert shares[3] < 0.5
    # A jump that other visible markers explain is no outlier.
    assert gated <= 0.01 * draws * frames


# Ambiguous poses.


def test_an_ambiguous_pose_is_weighted_by_its_agreement_with_the_motion() -> None:
    """With a known motion an ambiguous pose has all of its weight; where it is another camera's, it has less."""
    spread = np.diag([1e-4] * 3 + [1e-5] * 3)
    assert probability_right(np.zeros(6), spread, 0.4) > 0.999
    assert probability_right(np.zeros(6), spread, 0.0) == 1.0
    assert probability_right(np.full(6, 0.3), spread, 0.4) < 1e-6
    # Of a whole path, only motion reduces it.
    raw, _, _ = flight(20, seed=22)
    ambiguity, flags = np.full(20, 0.3), np.full(20, int(Flag.AMBIGUOUS))
    ambiguity[10], flags[10] = 0.0, 0
    path = filter_path(replace(raw, ambiguity=ambiguity, flags=flags))
    assert (path.ambiguity[2:10] == 0.3).all()
    assert (path.ambiguity[10:] == 0.0).all()
    assert (path.flags[:10] == Flag.AMBIGUOUS).all()
    assert (path.flags[10:] == 0).all()


# Invariance to the world's axes.


@settings(max_examples=4)
@given(turns, st.lists(st.floats(-100, 100), min_size=3, max_size=3).map(np.array), st.booleans())
def test_turning_and_shifting_the_world_turns_and_shifts_the_path(turn, shift_m, negate) -> None:
    raw, _, _ = flight(15, seed=23)
    raw = move_poses(remove_poses(raw, slice(5, 7)), slice(10, 11), [1.0, 0.0, 0.0])
    raw = replace(raw, covariance=raw.covariance * (1 + 0.5 * np.sin(np.arange(15.0)))[:, None, None])
    world, by_world = Rotation.from_rotvec(turn), np.eye(6)
    R = by_world[:3, :3] = world.as_matrix()
    there = raw.seen
    orientation_wxyz = raw.orientation_wxyz.copy()
    moved = world * Rotation.from_quat(orientation_wxyz[there], scalar_first=True)
    # A quaternion and its negative are the same orientation.
    orientation_wxyz[there] = moved.as_quat(scalar_first=True) * (-1 if negate else 1)
    covariance = by_world @ raw.covariance @ by_world.T
    position_m = raw.position_m @ R.T + shift_m
    other = replace(raw, position_m=position_m, orientation_wxyz=orientation_wxyz, covariance=covariance)
    here, found = filter_path(raw), filter_path(other)
    np.testing.assert_array_equal(found.status, here.status)
    np.testing.assert_array_equal(found.flags, here.flags)
    seen = here.seen
    # Rounding of positions of 100 m, 1e-14 relative, over a hundred steps.
    np.testing.assert_allclose(found.position_m[seen], here.position_m[seen] @ R.T + shift_m, atol=1e-8)
    np.testing.assert_allclose(found.velocity_m_s[seen], here.velocity_m_s[seen] @ R.T, atol=1e-6)
    expected_turns = world * Rotation.from_quat(here.orientation_wxyz[seen], scalar_first=True)
    apart = expected_turns.inv() * Rotation.from_quat(found.orientation_wxyz[seen], scalar_first=True)
    assert apart.magnitude().max() < 1e-8
    expected = by_world @ here.covariance[seen] @ by_world.T
    np.testing.assert_allclose(found.covariance[seen], expected, rtol=1e-4, atol=1e-10)
