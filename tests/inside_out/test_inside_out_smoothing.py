"""The smoother of camera poses, compared with least squares over all frames and with the filter, and its gaps."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_inside_out_filter import (
    FPS,
    errors,
    flight,
    fraction_within,
    move_poses,
    pose_covariance,
    raw_path,
    remove_poses,
    some_frames,
)

from psotrack.errors import InputError
from psotrack.inside_out import Flag, PoseFilterParams, smooth
from psotrack.inside_out.filtering import choose_agility, filter_path, poses_of
from psotrack.inside_out.filtering import motion as pose_motion
from psotrack.inside_out.pose import CameraPose
from psotrack.trajectories import Status


def median_mm(error) -> float:
    return 1e3 * float(np.median(np.linalg.norm(error, axis=1)))


def test_a_camera_that_does_not_turn_is_smoothed_as_by_least_squares_over_all_frames() -> None:
    """The reference solves one linear problem for the positions, velocities, accelerations and errors of all frames."""
    frames, dt_s, fraction = 12, 1 / FPS, pose_motion.CORRELATED_FRACTION
    noise_m2 = np.diag([1e-5, 2e-5, 4e-5])
    covariance = np.zeros((6, 6))
    covariance[:3, :3], covariance[3:, 3:] = noise_m2, 1e-6 * np.eye(3)
    rng = np.random.default_rng(1)
    measured_m = np.cumsum(rng.normal(scale=0.01, size=(frames, 3)), axis=0) * 0.3
    raw = raw_path(measured_m, Rotation.identity(frames))
    raw, gone = (
        remove_poses(replace(raw, covariance=np.tile(covariance, (frames, 1, 1))), slice(5, 8)),
        slice(5, 8),
    )
    agility = choose_agility(raw.time_s.tolist(), poses_of(raw), PoseFilterParams())
    path = smooth(raw)
    assert (path.flags == 0).all()

    part = np.r_[0:9, 15:18]
    start = pose_motion.initial_motion(CameraPose(measured_m[0], np.eye(3), covariance), agility)
    _, F, Q = pose_motion.predict(start, dt_s, agility)
    F, Q, first = (matrix[np.ix_(part, part)] for matrix in (F, Q, start.covariance))
    H = np.hstack([np.eye(3), np.zeros((3, 6)), np.sqrt(fraction * noise_m2)])
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
    for k in range(1, frames):
        equation(at(k, np.eye(12)) - at(k - 1, F), np.zeros(12), Q)
        if not gone.start <= k < gone.stop:
            equation(at(k, H), measured_m[k], (1 - fraction) * noise_m2)
    A, b = np.vstack(rows), np.concatenate(wanted)
    best = np.linalg.lstsq(A, b, rcond=None)[0].reshape(frames, 12)
    inverse = np.linalg.inv(A.T @ A)
    # The condition number of 1e5 is squared in the normal equations, which leaves six digits of the covariance.
    np.testing.assert_allclose(path.position_m, best[:, :3], atol=1e-7)
    np.testing.assert_allclose(path.velocity_m_s, best[:, 3:6], atol=1e-5)
    for k in range(frames):
        expected = inverse[12 * k : 12 * k + 3, 12 * k : 12 * k + 3]
        np.testing.assert_allclose(path.covariance[k, :3, :3], expected, rtol=1e-3, atol=1e-10)


def test_agility_distinguishes_calm_from_violent_flights() -> None:
    calm, violent = (
        choose_agility(raw.time_s.tolist(), poses_of(raw), PoseFilterParams())
        for raw, _, _ in (flight(100, acceleration=size, shake=size, seed=33) for size in (0.5, 25.0))
    )
    assert violent.acceleration_std_m_s2 > 8 * calm.acceleration_std_m_s2
    assert violent.rate_change_std_rad_s > 8 * calm.rate_change_std_rad_s


@pytest.mark.parametrize("seed", [0, 1])
def test_smoothing_a_camera_that_shakes_is_never_worse_than_its_raw_poses(seed) -> None:
    """Found: nine levels of motion lost such a flight, with errors of metres, and 8.9 mm where raw poses had 6.6 mm."""
    raw, position_m, truth = flight(100, acceleration=25.0, shake=25.0, seed=seed)
    path = smooth(raw)
    assert path.seen.all()
    for found, own in zip(errors(path, position_m, truth), errors(raw, position_m, truth), strict=True):
        for fraction in (50, 99):
            found_off, own_off = (
                np.percentile(np.linalg.norm(one, axis=1), fraction) for one in (found, own)
            )
            assert found_off < 1.01 * own_off


@pytest.mark.parametrize(
    ("acceleration", "shake"), [(0.5, 0.5), pytest.param(8.0, 8.0, marks=pytest.mark.slow)]
)
def test_the_smoother_is_better_than_the_filter_and_its_covariances_are_right(acceleration, shake) -> None:
    raw, position_m, truth = flight(100, acceleration=acceleration, shake=shake, seed=33)
    filtered, smoothed = filter_path(raw), smooth(raw)
    # In a violent flight, one of the two filter runs may gate a pose in ten.
    assert (smoothed.status == Status.TRACKED).mean() > 0.88
    assert (smoothed.status != Status.LOST).all()
    off_m, off_rad = errors(smoothed, position_m, truth)
    filter_off_m, filter_off_rad = errors(filtered, position_m, truth)
    assert median_mm(off_m) < median_mm(filter_off_m)
    assert median_mm(off_rad) < 1.02 * median_mm(filter_off_rad)
    assert 0.75 < fraction_within(off_m, smoothed.covariance[:, :3, :3]) < 1.0
    assert 0.7 < fraction_within(off_rad, smoothed.covariance[:, 3:, 3:]) < 1.0
    speed_m_s = np.gradient(position_m, raw.time_s, axis=0)
    speed_error_m_s = np.linalg.norm(smoothed.velocity_m_s - speed_m_s, axis=1)[2:-2]
    assert np.median(speed_error_m_s) < np.median(
        np.linalg.norm(filtered.velocity_m_s - speed_m_s, axis=1)[2:-2]
    )


def test_gaps_are_bridged_from_both_sides() -> None:
    raw, position_m, truth = flight(110, acceleration=1.0, shake=1.0, seed=32)
    gone = np.r_[0:4, 30:50, 70:100]
    raw = remove_poses(raw, gone)
    path, filtered = smooth(raw, PoseFilterParams(longest_gap_s=0.45)), filter_path(raw)
    # Every frame of the gap of 0.84 s is within 0.45 s of a pose; the gap of 1.24 s has frames that are not. Frames
    # before the first pose are lost.
    assert (path.status[:4] == Status.LOST).all()
    assert (path.status[30:50] == Status.COASTING).all()
    assert (path.status[70:81] == Status.COASTING).all()
    assert (path.status[81:100] == Status.LOST).all()
    assert np.isnan(path.position_m[81:100]).all()
    assert (path.status[100:] == Status.TRACKED).all()
    variance_m2 = np.trace(path.covariance[:, :3, :3], axis1=1, axis2=2)
    # The uncertainty is largest in the middle of the gap, and far smaller than the filter's.
    assert 36 <= 30 + variance_m2[30:50].argmax() <= 43
    assert variance_m2[40] < 0.3 * np.trace(filtered.covariance[40, :3, :3])
    seen_frames = np.flatnonzero(path.seen)
    off_m, _ = errors(path, position_m, truth)
    inside = np.isin(seen_frames, np.r_[30:50])
    off_m, covariance = off_m[inside], path.covariance[seen_frames][inside, :3, :3]
    # 21.1 is exceeded by chi-square with 3 degrees of freedom once in 10,000.
    assert (np.einsum("ni,nij,nj->n", off_m, np.linalg.inv(covariance), off_m) < 21.1).all()


def test_outliers_and_wrong_poses_at_both_ends_are_not_used() -> None:
    raw, position_m, truth = flight(100, seed=33)
    bad = np.r_[0:4, 40, 60:66, 98:100]
    path = smooth(move_poses(raw, bad, [0.4, -2.0, 0.3], [0.0, 0.5, 0.0]))
    assert (path.flags[bad] & Flag.GATED).all()
    assert (path.status[bad] != Status.TRACKED).all()
    off_m, _ = errors(path, position_m, truth)
    # Bridging six frames from both sides at 2 m/s² costs one or two centimetres.
    assert np.linalg.norm(off_m, axis=1).max() < 0.05
    good = np.setdiff1d(np.arange(100), bad)
    assert (path.status[good] == Status.TRACKED).mean() > 0.95


def test_a_sharp_turn_is_used_by_the_smoother() -> None:
    position_m = np.zeros((60, 3))
    position_m[30:, 0] = 40.0 / 2 * (np.arange(1, 31) / FPS) ** 2
    rng = np.random.default_rng(34)
    raw = raw_path(position_m + rng.normal(scale=0.002, size=(60, 3)), Rotation.identity(60))
    path = smooth(raw)
    assert (path.status[28:34] == Status.TRACKED).all()


def test_a_late_turn_of_a_hovering_camera_is_followed() -> None:
    """The agility of 280 calm frames says nothing about the last 20, in which the camera flies off with 40 m/s2."""
    position_m = 0.002 * np.sin(np.arange(300)[:, None] / FPS * np.array([3.0, 4.0, 5.0]))
    position_m[280:, 0] += 40.0 / 2 * (np.arange(1, 21) / FPS) ** 2
    rng = np.random.default_rng(36)
    raw = raw_path(position_m + rng.normal(scale=0.002, size=(300, 3)), Rotation.identity(300))
    for path in (filter_path(raw), smooth(raw)):
        assert (path.status[5:] == Status.COASTING).sum() <= 2
        assert path.seen[2:].all()
        off_m = np.linalg.norm(path.position_m - position_m, axis=1)
        # Raw poses are 3 mm off; one frame with 40 m/s2 instead of none is 32 mm.
        assert np.nanmax(off_m) < 0.035
        # Measured 16 mm by the filter.
        assert np.nanmax(off_m[282:]) < 0.02


def test_the_path_is_not_drawn_across_a_permanent_jump() -> None:
    """The path jumps with the camera, and is not bent on either side of the jump."""
    raw, position_m, _ = flight(60, seed=35)
    path = smooth(move_poses(raw, slice(30, None), [0.0, 0.0, 5.0]))
    position_m = position_m + np.array([0.0, 0.0, 5.0]) * (np.arange(60) >= 30)[:, None]
    # Some poses beside the jump may be gated and bridged. A path drawn across the jump would be off by metres.
    assert np.linalg.norm(path.position_m - position_m, axis=1).max() < 0.1


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_paths_of_few_poses(frames) -> None:
    raw, _, _ = flight(5, seed=36)
    some = some_frames(raw, slice(frames))
    assert (smooth(some).status == Status.LOST).all()
    confirmed_at_once = smooth(some, PoseFilterParams(confirm=1))
    assert (confirmed_at_once.status == Status.TRACKED).all()
    if frames == 1:
        np.testing.assert_allclose(confirmed_at_once.position_m, raw.position_m[:1], atol=1e-12)
        np.testing.assert_allclose(confirmed_at_once.covariance[0], pose_covariance(), atol=1e-15)


def test_the_raw_path_is_not_changed() -> None:
    raw, _, _ = flight(20, seed=37)
    raw = remove_poses(move_poses(raw, slice(15, 16), [1.0, 0.0, 0.0]), slice(5, 8))
    before = {name: np.copy(value) for name, value in vars(raw).items() if value is not None}
    smooth(raw)
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(raw, name), value)
    assert (smooth(remove_poses(raw, slice(None))).status == Status.LOST).all()


def test_a_singular_covariance_is_refused() -> None:
    raw, _, _ = flight(6, seed=38)
    raw.covariance[4] = 0.0
    with pytest.raises(InputError, match=r"covariance at 0.16 s: expected a positive definite matrix"):
        smooth(raw)
