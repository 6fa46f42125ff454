"""The causal filter of camera poses: its rotations compared with SciPy, its arithmetic with a textbook filter, its
covariance with ground truth; outliers, wrong first poses, gaps and ambiguous poses."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.errors import InputError, SettingsError
from psotrack.inside_out import CameraPath, Flag, PoseFilterParams, smooth
from psotrack.inside_out.filtering import FilterRun, filter_path, poses_of, step
from psotrack.inside_out.filtering import motion as pose_motion
from psotrack.inside_out.filtering.pose_filter import probability_right
from psotrack.inside_out.pose import CameraPose
from psotrack.trajectories import Status

FPS = 25.0
STD_M, STD_RAD = 0.004, 0.0008
#: The 90 % quantile of the chi-square distribution with 3 degrees of freedom.
NINETY = chi2.ppf(0.9, 3)


def pose_covariance() -> np.ndarray:
    """Covariance of a pose: shifts to the side and turns about the vertical axis are correlated, as in real poses."""
    covariance = np.diag([STD_M**2] * 3 + [STD_RAD**2] * 3)
    covariance[0, 4] = covariance[4, 0] = 0.8 * STD_M * STD_RAD
    covariance[1, 3] = covariance[3, 1] = -0.8 * STD_M * STD_RAD
    return covariance


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


def raw_path(position_m, orientation, time_s=None) -> CameraPath:
    count = len(position_m)
    return CameraPath(
        frame=np.arange(count),
        time_s=np.arange(count) / FPS if time_s is None else time_s,
        position_m=position_m,
        orientation_wxyz=orientation.as_quat(scalar_first=True).reshape(count, 4),
        covariance=np.tile(pose_covariance(), (count, 1, 1)),
        num_markers=np.full(count, 2),
        reprojection_px=np.full(count, 0.3),
        ambiguity=np.zeros(count),
        status=np.full(count, int(Status.TRACKED)),
        flags=np.zeros(count, int),
    )


def remove_poses(path: CameraPath, gone) -> CameraPath:
    """The path with the poses of some frames lost."""
    values = {
        name: getattr(path, name).copy()
        for name in ("position_m", "orientation_wxyz", "covariance", "ambiguity", "reprojection_px")
    }
    for value in values.values():
        value[gone] = np.nan
    status, num_markers = path.status.copy(), path.num_markers.copy()
    status[gone], num_markers[gone] = Status.LOST, 0
    return replace(path, **values, status=status, num_markers=num_markers)


def move_poses(path: CameraPath, rows, shift_m, turn=(0.0, 0.0, 0.0)) -> CameraPath:
    """The path with some poses shifted and turned."""
    position_m, orientation_wxyz = path.position_m.copy(), path.orientation_wxyz.copy()
    position_m[rows] += shift_m
    there = Rotation.from_quat(orientation_wxyz[rows], scalar_first=True) * Rotation.from_rotvec(turn)
    orientation_wxyz[rows] = there.as_quat(scalar_first=True)
    return replace(path, position_m=position_m, orientation_wxyz=orientation_wxyz)


def some_frames(path: CameraPath, kept) -> CameraPath:
    """The path of some of its frames."""
    return replace(path, **{name: value[kept] for name, value in vars(path).items() if value is not None})


def errors(path: CameraPath, position_m, truth):
    """Truth minus estimate in frames with a pose, (seen, 3) each: along the world's, and about the camera's axes."""
    seen = path.seen
    turn = Rotation.from_quat(path.orientation_wxyz[seen], scalar_first=True).inv() * truth[seen]
    return position_m[seen] - path.position_m[seen], turn.as_rotvec()


def fraction_within(error, covariance) -> float:
    """Share of errors inside their 90 % ellipsoids."""
    return float((np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error) < NINETY).mean())


turns = st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3).map(np.array)


@given(turns)
@pytest.mark.parametrize("scale", [1.0, 0.02, 0.0])
def test_the_jacobian_is_the_numerical_derivative(scale, turn) -> None:
    turn, small = scale * turn, 1e-6
    right = np.zeros((3, 3))
    for axis, step_rad in enumerate(small * np.eye(3)):
        ahead, behind = (Rotation.from_rotvec(turn + sign * step_rad) for sign in (1, -1))
        right[:, axis] = (behind.inv() * ahead).as_rotvec() / (2 * small)
    # Central differences have errors of the squared step, and rounding errors divided by the step, 1e-10.
    np.testing.assert_allclose(pose_motion.right_jacobian(turn), right, atol=2e-9)


AGILITY = pose_motion.Agility(4.0, 0.7)


def test_translation_of_a_camera_without_turns_equals_a_textbook_filter() -> None:
    """Kalman's equations in textbook form, for position, velocity, acceleration and the correlated error.

    F and Q come from the matrix exponential (C. F. Van Loan, Computing integrals involving the matrix exponential,
    1978).
    """
    rng = np.random.default_rng(1)
    noise = rng.normal(size=(3, 3))
    noise_m2 = 1e-5 * (noise @ noise.T + np.eye(3))
    covariance = np.zeros((6, 6))
    covariance[:3, :3], covariance[3:, 3:] = noise_m2, 1e-6 * np.eye(3)
    fraction, correlated_s = pose_motion.CORRELATED_FRACTION, pose_motion.CORRELATED_TIME_S
    variances, axes = np.linalg.eigh(noise_m2)
    root = axes @ np.diag(np.sqrt(fraction * variances)) @ axes.T
    H = np.hstack([np.eye(3), np.zeros((3, 6)), root])

    A = np.zeros((12, 12))
    A[:3, 3:6] = A[3:6, 6:9] = np.eye(3)
    A[6:9, 6:9] = -np.eye(3) / pose_motion.ACCELERATION_TIME_S
    A[9:, 9:] = -np.eye(3) / correlated_s
    jerk = 2 * AGILITY.acceleration_std_m_s2**2 / pose_motion.ACCELERATION_TIME_S
    driven = np.diag([0.0] * 6 + [jerk] * 3 + [2 / correlated_s] * 3)

    motion = pose_motion.initial_motion(CameraPose(np.zeros(3), np.eye(3), covariance), AGILITY)
    part = np.r_[0:9, 15:18]
    x, P = np.zeros(12), motion.covariance[np.ix_(part, part)]
    for dt_s in (0.04, 0.04, 0.01, 0.3, 0.04):
        loan = expm(np.block([[-A, driven], [np.zeros((12, 12)), A.T]]) * dt_s)
        F = loan[12:, 12:].T
        x, P = F @ x, F @ P @ F.T + F @ loan[:12, 12:]
        z = rng.normal(scale=0.01, size=3)
        S = H @ P @ H.T + (1 - fraction) * noise_m2
        K = P @ H.T @ np.linalg.inv(S)
        x, P = x + K @ (z - H @ x), P - K @ S @ K.T

        motion, _, _ = pose_motion.predict(motion, dt_s, AGILITY)
        motion = pose_motion.correct(
            motion, pose_motion.innovation(motion, CameraPose(z, np.eye(3), covariance))
        )
        # Measured 1e-11 of the largest value of each kind; velocity variances of 25 are reduced to 1e-3.
        np.testing.assert_allclose(motion.mean[part], x, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(motion.covariance[np.ix_(part, part)], P, rtol=1e-7, atol=1e-10)


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


# The filter on whole flights.


@pytest.mark.parametrize(("acceleration", "shake"), [(0.2, 0.5), (2.0, 2.0), (25.0, 25.0)])
def test_filter_improves_poses_for_hovering_and_racing_cameras(acceleration, shake) -> None:
    """The filter has no knowledge of the camera's motion and of the duration of lasting errors."""
    raw, position_m, truth = flight(150, acceleration=acceleration, shake=shake, seed=6)
    path = filter_path(raw)
    assert (path.status[2:] != Status.LOST).all()
    off_m, off_rad = errors(path, position_m, truth)
    raw_off_m, raw_off_rad = errors(raw, position_m, truth)
    # Most of the error is correlated and cannot be separated from motion, so the gain is small.
    assert np.median(np.linalg.norm(off_m, axis=1)) < 1.03 * np.median(np.linalg.norm(raw_off_m, axis=1))
    assert np.median(np.linalg.norm(off_rad, axis=1)) < 1.03 * np.median(np.linalg.norm(raw_off_rad, axis=1))
    covariance = path.covariance[path.seen]
    assert 0.78 < fraction_within(off_m, covariance[:, :3, :3]) < 0.98
    assert 0.75 < fraction_within(off_rad, covariance[:, 3:, 3:]) < 0.98
    speed_error = np.linalg.norm(
        path.velocity_m_s[10:] - np.gradient(position_m, raw.time_s, axis=0)[10:], axis=1
    )
    # The white error divided by the duration of a few frames, plus the change of acceleration in a frame.
    assert np.median(speed_error) < 0.1 + acceleration / FPS


def test_good_poses_are_gated_as_seldom_as_stated() -> None:
    raw, _, _ = flight(300, acceleration=0.5, shake=0.3, seed=6)
    path = filter_path(raw, PoseFilterParams(false_alarm=0.03))
    # 9 of 300 are expected if level and errors are as assumed; 20 would be 4 standard deviations more.
    assert 1 <= ((path.flags & Flag.GATED) > 0).sum() <= 20


@pytest.mark.parametrize("near", [False, True])
def test_outliers_are_not_used(near) -> None:
    """2 in 100 poses are wrong, including the first pose, and two runs of several frames."""
    raw, position_m, truth = flight(150, seed=8)
    bad = np.zeros(150, bool)
    bad[[0, 15, 40, 90]] = True
    bad[50:56], bad[110:118] = True, True
    shift_m, turn = ([0.0, 0.15, 0.0], [0.0, 0.0, 0.03]) if near else ([1.5, -2.0, 0.3], [0.0, 0.9, 0.0])
    path = filter_path(move_poses(raw, bad, shift_m, turn))
    off_m, off_rad = errors(path, position_m, truth)
    # In 8 frames, 0.32 s, the error is 0.1 m and 6 degrees at 2 m/s2 and 2 rad/s2, and more at larger accelerations.
    assert np.linalg.norm(off_m, axis=1).max() < 0.25
    assert np.degrees(np.linalg.norm(off_rad, axis=1)).max() < 12.0
    assert (path.flags[bad][1:] & Flag.GATED).all()
    assert (path.status[bad] != Status.TRACKED).all()
    assert ((path.flags[~bad] & Flag.GATED) > 0).sum() <= 3
    assert (path.status == Status.LOST).sum() <= 5


def test_gated_frames_coast_with_growing_uncertainty() -> None:
    raw, _, _ = flight(60, seed=10)
    path = filter_path(move_poses(raw, slice(40, 46), [0.0, 3.0, 0.0]))
    assert (path.status[40:46] == Status.COASTING).all()
    assert (path.flags[40:46] == Flag.GATED).all()
    assert (path.num_markers[40:46] == 2).all()
    assert (np.diff(np.trace(path.covariance[39:46, :3, :3], axis1=1, axis2=2)) > 0).all()
    assert path.status[46] == Status.TRACKED


def test_a_wrong_first_state_is_replaced_when_more_poses_contradict_it() -> None:
    raw, position_m, _ = flight(40, seed=11)
    path = filter_path(move_poses(raw, slice(0, 4), [3.0, 0.0, 0.0]))
    assert path.status[3] == Status.TRACKED
    # Four poses supported the state; the fifth pose that contradicts it makes a majority.
    assert (path.status[4:8] == Status.COASTING).all()
    assert (path.status[8:] == Status.TRACKED).all()
    assert np.linalg.norm(path.position_m[8:] - position_m[8:], axis=1).max() < 0.03


@pytest.mark.parametrize("restart_after", [4, 10])
def test_a_camera_that_stays_elsewhere_is_found_after_restart_after_poses(restart_after) -> None:
    raw, position_m, _ = flight(100, seed=12)
    path = filter_path(
        move_poses(raw, slice(50, None), [0.0, 0.0, 5.0]), PoseFilterParams(restart_after=restart_after)
    )
    believed = 50 + restart_after - 1
    assert (path.status[50:believed] == Status.COASTING).all()
    assert (path.status[believed : believed + 10] == Status.TRACKED).all()
    moved_m = position_m[believed:] + np.array([0.0, 0.0, 5.0])
    assert np.linalg.norm(path.position_m[believed:] - moved_m, axis=1).max() < 0.03


def test_an_unpredicted_turn_is_followed_after_one_frame_or_at_once() -> None:
    """A hovering camera accelerates by 40 m/s2 from one frame to the next."""
    position_m = np.zeros((60, 3))
    position_m[50:, 0] = 40.0 / 2 * (np.arange(1, 11) / FPS) ** 2
    rng = np.random.default_rng(13)
    raw = raw_path(position_m + rng.normal(scale=0.002, size=(60, 3)), Rotation.identity(60))
    path = filter_path(raw)
    assert (path.status[50:] == Status.COASTING).sum() <= 1
    assert np.linalg.norm(path.position_m[52:] - position_m[52:], axis=1).max() < 0.03


def test_gaps_are_bridged_for_the_longest_gap() -> None:
    raw, position_m, truth = flight(150, acceleration=0.5, shake=0.3, seed=14)
    raw = remove_poses(raw, np.r_[50:58, 90:120])
    path = filter_path(raw, PoseFilterParams(longest_gap_s=0.5))
    assert (path.status[50:58] == Status.COASTING).all()
    assert (path.flags[50:58] == 0).all()
    assert (np.diff(np.trace(path.covariance[49:58, :3, :3], axis1=1, axis2=2)) > 0).all()
    assert (path.status[90:101] == Status.COASTING).all()
    assert (path.status[102:120] == Status.LOST).all()
    for value in (path.position_m, path.orientation_wxyz, path.covariance, path.ambiguity, path.velocity_m_s):
        assert np.isnan(value[102:120]).all()
    # The camera hovered and is where a hovering camera would be, so no further pose is needed for confirmation.
    assert (path.status[120:130] == Status.TRACKED).all()
    off_m, off_rad = errors(path, position_m, truth)
    covariance = path.covariance[path.seen]
    gap = slice(48, 56)
    assert (np.einsum("ni,nij,nj->n", off_m, np.linalg.inv(covariance[:, :3, :3]), off_m)[gap] < 16.3).all()
    assert (
        np.einsum("ni,nij,nj->n", off_rad, np.linalg.inv(covariance[:, 3:, 3:]), off_rad)[gap] < 16.3
    ).all()


def flight_with_false_poses(acceleration, *, markers=2):
    """A flight with a gap of a second, after which five poses agree with each other but are 2.3 m off."""
    raw, position_m, _ = flight(150, acceleration=acceleration, shake=0.5, seed=40)
    raw = replace(raw, num_markers=np.full(150, markers))
    return move_poses(remove_poses(raw, slice(60, 85)), slice(85, 90), [2.3, 0.0, 0.0]), position_m


@pytest.mark.parametrize("acceleration", [0.5, pytest.param(2.0, marks=pytest.mark.slow)])
def test_wrong_poses_that_agree_after_a_gap_are_not_accepted(acceleration) -> None:
    raw, position_m = flight_with_false_poses(acceleration)
    path = filter_path(raw)
    assert (path.status[85:90] == Status.LOST).all()
    # The right poses are accepted when they are one more than the wrong poses and enough to contradict a state.
    assert (path.status[100:] == Status.TRACKED).all()
    assert np.nanmax(np.linalg.norm(path.position_m[85:] - position_m[85:], axis=1)) < 0.05
    smoothed = smooth(raw)
    assert np.nanmax(np.linalg.norm(smoothed.position_m[85:] - position_m[85:], axis=1)) < 0.05


def test_after_a_gap_agreeing_markers_do_not_outweigh_the_motion_of_a_hovering_camera() -> None:
    raw, position_m = flight_with_false_poses(0.05, markers=8)
    path = filter_path(raw)
    assert (path.status[85:90] == Status.LOST).all()
    assert np.nanmax(np.linalg.norm(path.position_m[85:] - position_m[85:], axis=1)) < 0.05


def test_after_a_gap_markers_that_agree_beyond_chance_are_accepted_at_once() -> None:
    raw, position_m, _ = flight(120, acceleration=2.0, shake=2.0, seed=41)
    raw = remove_poses(raw, slice(60, 90))
    path = filter_path(replace(raw, num_markers=np.full(120, 3)))
    assert (path.status[90:94] == Status.TRACKED).all()
    assert (path.status[90:] != Status.LOST).all()
    assert np.linalg.norm(path.position_m[90:] - position_m[90:], axis=1).max() < 0.05
    # Without such markers more poses are needed, because the gap is too long for the motion to predict a pose.
    assert (filter_path(raw).status[90:99] == Status.LOST).all()


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
        found = path.status != Status.LOST
        assert found[first:].all()
    assert not filter_path(raw).seen[:first].any()


@pytest.mark.parametrize("frames", [1, 2])
def test_a_first_pose_counts_if_the_recording_is_too_short_to_confirm_it(frames) -> None:
    raw, _, _ = flight(5, seed=43)
    path = filter_path(some_frames(raw, slice(frames)), PoseFilterParams().within(frames))
    # The first pose cannot be confirmed in its own frame, because the filter is causal.
    assert (path.status[: frames - 1] == Status.LOST).all()
    assert path.status[-1] == Status.TRACKED


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_paths_with_few_poses(frames) -> None:
    raw, _, _ = flight(5, seed=15)
    some = some_frames(raw, slice(frames))
    path = filter_path(some)
    assert path.num_frames == frames
    assert (path.status == Status.LOST).all()
    believing = filter_path(some, PoseFilterParams(confirm=1))
    assert (believing.status == Status.TRACKED).all()
    if frames == 1:
        # With one pose the estimate equals the pose and its covariance.
        np.testing.assert_allclose(believing.position_m, raw.position_m[:1], atol=1e-12)
        np.testing.assert_allclose(believing.covariance[0], raw.covariance[0], atol=1e-15)


def test_paths_without_poses_and_without_poses_at_the_beginning() -> None:
    raw, _, _ = flight(30, seed=16)
    assert (filter_path(remove_poses(raw, slice(None))).status == Status.LOST).all()
    path = filter_path(remove_poses(raw, slice(0, 10)))
    assert (path.status[:12] == Status.LOST).all()
    assert (path.status[12:] == Status.TRACKED).all()


def test_filtering_leaves_the_raw_path_unchanged() -> None:
    raw, _, _ = flight(30, seed=17)
    raw = remove_poses(move_poses(raw, slice(20, 21), [1.0, 0.0, 0.0]), slice(5, 8))
    before = {name: np.copy(value) for name, value in vars(raw).items() if value is not None}
    filter_path(raw)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(raw, name), value)


def test_times_may_be_irregular() -> None:
    """A live stream with randomly dropped frames is followed as accurately as its frames allow."""
    raw, position_m, truth = flight(200, acceleration=0.5, shake=0.3, seed=20)
    kept = np.flatnonzero(np.random.default_rng(21).random(200) < 0.4)
    some = some_frames(raw, kept)
    path = filter_path(some)
    off_m, _ = errors(path, position_m[kept], truth[kept])
    raw_off_m, _ = errors(some, position_m[kept], truth[kept])
    assert np.median(np.linalg.norm(off_m, axis=1)) < 1.03 * np.median(np.linalg.norm(raw_off_m, axis=1))


# Errors that are the same in all frames.


@pytest.mark.slow
def test_constant_errors_are_not_averaged_away() -> None:
    """The effect of an error on the poses changes slowly, and jumps when other markers come into view."""
    rng, frames, inside, inside_without, gated = np.random.default_rng(44), 12, [], [], 0
    scale = np.array([[0.012] * 3 + [0.002] * 3]).T
    for seed in range(40):
        raw, position_m, _ = flight(frames, acceleration=0.5, shake=0.5, seed=seed)
        common = scale * (
            rng.normal(size=(6, 2)) + rng.normal(scale=0.02, size=(frames, 6, 2)).cumsum(axis=0)
        )
        common[8:] += scale * rng.normal(scale=0.5, size=(6, 2))
        off = common @ rng.normal(size=2)
        orientation = Rotation.from_quat(raw.orientation_wxyz, scalar_first=True)
        raw = replace(
            raw,
            position_m=raw.position_m + off[:, :3],
            orientation_wxyz=(orientation * Rotation.from_rotvec(off[:, 3:])).as_quat(scalar_first=True),
        )
        constant = common @ common.swapaxes(1, 2)
        with_constant = replace(raw, covariance=raw.covariance + constant)
        filtered = filter_path(with_constant, constant=constant)
        gated += int(((filtered.flags & Flag.GATED) > 0).sum())
        inside.append([within_90(filtered, position_m, k) for k in (7, 10)])
        inside[-1].append(within_90(smooth(with_constant, constant=constant), position_m, 5))
        inside_without.append(within_90(filter_path(raw), position_m, 7))
    # Three standard deviations of a share of 40 below 0.9; the poses' own covariances are rather too wide.
    assert (np.mean(inside, axis=0) > 0.9 - 3 * np.sqrt(0.09 / 40)).all()
    assert np.mean(inside_without) < 0.5
    # A jump that other visible markers explain is no outlier.
    assert gated <= 0.01 * 40 * frames


def within_90(path: CameraPath, position_m, k) -> bool:
    """Whether the true position in a frame is within its 90 % ellipsoid."""
    off_m = position_m[k] - path.position_m[k]
    return bool(off_m @ np.linalg.solve(path.covariance[k, :3, :3], off_m) < NINETY)


# Ambiguous poses.


def test_an_ambiguous_pose_is_weighted_by_its_agreement_with_the_motion() -> None:
    """With a known motion an ambiguous pose has all of its weight; where it is another camera's, it has less."""
    spread = np.diag([1e-4] * 3 + [1e-5] * 3)
    assert probability_right(np.zeros(6), spread, 0.4) > 0.999
    assert probability_right(np.zeros(6), spread, 0.0) == 1.0
    assert probability_right(np.full(6, 0.3), spread, 0.4) < 1e-6


def test_only_motion_reduces_ambiguity() -> None:
    raw, _, _ = flight(30, seed=22)
    ambiguity, flags = np.full(30, 0.3), np.full(30, int(Flag.AMBIGUOUS))
    path = filter_path(replace(raw, ambiguity=ambiguity, flags=flags))
    assert (path.ambiguity[2:] == 0.3).all()
    assert (path.flags == Flag.AMBIGUOUS).all()
    ambiguity[10], flags[10] = 0.0, 0
    path = filter_path(replace(raw, ambiguity=ambiguity, flags=flags))
    assert (path.ambiguity[2:10] == 0.3).all()
    assert (path.ambiguity[10:] == 0.0).all()
    assert (path.flags[10:] == 0).all()


# Invariance to the world's axes.


@settings(max_examples=6)
@given(turns, st.lists(st.floats(-100, 100), min_size=3, max_size=3).map(np.array), st.booleans())
def test_turning_and_shifting_the_world_turns_and_shifts_the_path(turn, shift_m, negate) -> None:
    raw, _, _ = flight(15, seed=23)
    raw = move_poses(remove_poses(raw, slice(5, 7)), slice(10, 11), [1.0, 0.0, 0.0])
    raw = replace(raw, covariance=raw.covariance * (1 + 0.5 * np.sin(np.arange(15.0)))[:, None, None])
    world = Rotation.from_rotvec(turn)
    by_world = np.eye(6)
    by_world[:3, :3] = world.as_matrix()
    there = raw.seen
    orientation_wxyz = raw.orientation_wxyz.copy()
    moved = world * Rotation.from_quat(orientation_wxyz[there], scalar_first=True)
    # A quaternion and its negative are the same orientation.
    orientation_wxyz[there] = moved.as_quat(scalar_first=True) * (-1 if negate else 1)
    other = replace(
        raw,
        position_m=raw.position_m @ world.as_matrix().T + shift_m,
        orientation_wxyz=orientation_wxyz,
        covariance=by_world @ raw.covariance @ by_world.T,
    )
    here, moved_path = filter_path(raw), filter_path(other)
    np.testing.assert_array_equal(moved_path.status, here.status)
    np.testing.assert_array_equal(moved_path.flags, here.flags)
    seen = here.seen
    # Rounding of positions of 100 m, 1e-14 relative, over a hundred steps.
    np.testing.assert_allclose(
        moved_path.position_m[seen], here.position_m[seen] @ world.as_matrix().T + shift_m, atol=1e-8
    )
    np.testing.assert_allclose(
        moved_path.velocity_m_s[seen], here.velocity_m_s[seen] @ world.as_matrix().T, atol=1e-6
    )
    expected_turns = world * Rotation.from_quat(here.orientation_wxyz[seen], scalar_first=True)
    apart = expected_turns.inv() * Rotation.from_quat(moved_path.orientation_wxyz[seen], scalar_first=True)
    assert apart.magnitude().max() < 1e-8
    np.testing.assert_allclose(
        moved_path.covariance[seen], by_world @ here.covariance[seen] @ by_world.T, rtol=1e-4, atol=1e-10
    )


# Refused input.


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"false_alarm": 0.0}, r"false_alarm: expected a probability above 0 and below 1, found 0"),
        ({"longest_gap_s": -1.0}, r"longest_gap_s: expected a number above 0, found -1"),
        ({"confirm": 0}, r"confirm: expected at least 1, found 0"),
        ({"restart_after": 0}, r"restart_after: expected at least 1, found 0"),
    ],
)
def test_invalid_settings_are_refused(setting, message) -> None:
    with pytest.raises(SettingsError, match=message):
        PoseFilterParams(**setting)


def test_decreasing_times_and_invalid_covariances_are_refused() -> None:
    raw, _, _ = flight(5, seed=24)
    first, later = poses_of(raw)[:2]
    run = step(FilterRun(), raw.time_s[1], later, PoseFilterParams(), AGILITY)
    with pytest.raises(InputError, match=r"time_s: expected a time after 0.04 s, found 0 s"):
        step(run, raw.time_s[0], first, PoseFilterParams(), AGILITY)
    raw.covariance[3] = np.nan
    with pytest.raises(InputError, match=r"covariance at 0.12 s: expected a positive definite matrix"):
        filter_path(raw)
