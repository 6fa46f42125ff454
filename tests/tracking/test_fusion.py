"""Fusion of the tracks of two methods: simulated tracks whose errors are known."""

import numpy as np

from psotrack.settings import MotionSettings
from psotrack.tracking.camera_errors import CameraErrors, SystematicCovariances, TrackErrors
from psotrack.tracking.fusion import COMMON_CORRELATION, fuse_tracks
from psotrack.trajectories import Arrival, Status, Tracks

FPS, FRAMES = 25.0, 200
SETTINGS, MAX_COASTING_S = MotionSettings(), 0.5
#: (3,), standard deviations along x, y and z, metres. Errors of the swarm are small along x and large along y; errors
#: of the projection lines are large along x and small along y.
SWARM_STD_M, LINES_STD_M = np.array([0.005, 0.02, 0.01]), np.array([0.02, 0.005, 0.01])


def circular_paths(num_drones):
    """(frames, drones, 3), positions of drones on circles at heights a metre apart."""
    angle = np.arange(FRAMES)[:, None] / FPS + 2.0 * np.arange(num_drones)
    height_m = np.broadcast_to(1.0 + np.arange(num_drones), angle.shape)
    return np.stack([np.cos(angle), np.sin(angle), height_m], axis=-1)


def simulate_method(truth_m, std_m, *, seed, hidden=(), offset_m=(0.0, 0.0, 0.0), arrivals=()):
    """Simulate the result of a method.

    Args:
        truth_m: (frames, drones, 3), true positions.
        std_m: (3,), standard deviations of the measurements, metres.
        seed: of the random errors.
        hidden: tuples (drone, first frame, end frame) of frames in which a drone is lost.
        offset_m: (3,), offset of all measurements, metres.
        arrivals: arrivals that the method reports.
    """
    rng = np.random.default_rng(seed)
    measured_m = truth_m + std_m * rng.standard_normal(truth_m.shape) + offset_m
    status = np.full(truth_m.shape[:2], int(Status.TRACKED))
    for drone, first, last in hidden:
        status[first:last, drone] = Status.LOST
    measured_m[status != Status.TRACKED] = np.nan
    covariance_m2 = np.broadcast_to(np.diag(np.square(std_m)), (*truth_m.shape, 3))
    size_m = np.full((truth_m.shape[1], 3), 0.4)
    return Tracks(
        position_m=measured_m,
        velocity_m_s=np.zeros_like(measured_m),
        covariance_m2=covariance_m2,
        measured_m=measured_m,
        measured_covariance_m2=covariance_m2,
        fitness=np.where(status == Status.TRACKED, 0.5, 0.0),
        num_cameras=np.where(status == Status.TRACKED, 4, 0),
        status=status,
        size_m=size_m,
        size_frames=np.zeros(size_m.shape, int),
        arrivals=tuple(arrivals),
    )


def fuse(swarm, lines, **options):
    fusion = fuse_tracks(swarm, lines, SETTINGS, fps=FPS, max_coasting_s=MAX_COASTING_S, **options)
    return fusion.tracks, fusion


def both_methods(truth_m):
    """Tracks of the swarm and of the projection lines, whose errors are independent."""
    swarm = simulate_method(truth_m, SWARM_STD_M, seed=0)
    return swarm, simulate_method(truth_m, LINES_STD_M, seed=1)


def variances(covariance_m2):
    return np.diagonal(covariance_m2, axis1=-2, axis2=-1)


def test_information_adds_up():
    truth_m = circular_paths(3)
    fused, middles = fuse(*both_methods(truth_m))
    # Errors are relative to each drone's median, because the tracked point has an unknown offset. Their spread is
    # computed from a median, because one frame in 1000 is beyond the gate, where only the swarm's measurement is used.
    off_m = fused.measured_m - truth_m
    off_m -= np.median(off_m, axis=0)
    std_m = 1.4826 * np.median(np.abs(off_m), axis=(0, 1))
    expected_m = 1 / np.sqrt(1 / SWARM_STD_M**2 + 1 / LINES_STD_M**2)
    # The spread of 600 errors, computed from a median, has an error of 4 %.
    np.testing.assert_allclose(std_m, expected_m, rtol=0.1)
    # The measurements of the projection lines also have the error of the offset between the middles.
    expected_m2 = 1 / (1 / SWARM_STD_M**2 + 1 / (LINES_STD_M**2 + middles.offset_std_m**2))
    stated_m2 = np.median(variances(fused.measured_covariance_m2), axis=0)
    np.testing.assert_allclose(stated_m2, expected_m2, rtol=1e-9)
    assert (fused.status == Status.TRACKED).all()


def test_the_offset_between_the_middles_has_a_standard_error_and_disagreement_leaves_the_swarm():
    truth_m, off_m = circular_paths(4), np.array([0.01, 0.0, 0.08])
    first = simulate_method(truth_m, SWARM_STD_M, seed=0)
    second = simulate_method(truth_m, LINES_STD_M, seed=1, offset_m=off_m)
    # In a tenth of the frames, the first drone's measurement is that of another object.
    second.measured_m[20:40, 0] += 0.2
    fused, middles = fuse(first, second)
    np.testing.assert_array_equal(fused.measured_m[20:40, 0], first.measured_m[20:40, 0])
    # The fused point is the middle of the silhouette: the tracks do not have this offset.
    mean_off_m = (fused.measured_m - truth_m)[40:].mean(axis=(0, 1))
    np.testing.assert_allclose(mean_off_m, 0.0, atol=0.003)
    # Standard error of a median of 200 independent differences.
    expected_m = np.sqrt(np.pi / 2 * (SWARM_STD_M**2 + LINES_STD_M**2) / FRAMES)
    # The estimate may be a little smaller, because tails are clipped, and larger, if errors are correlated by chance.
    assert (middles.offset_std_m[1:] > 0.85 * expected_m).all()
    assert (middles.offset_std_m[1:] < 2.0 * expected_m).all()
    assert (np.abs(middles.offset_m - off_m) < 4 * middles.offset_std_m).all()


def test_the_offset_is_less_certain_with_correlated_errors():
    truth_m = circular_paths(1)
    first = simulate_method(truth_m, np.full(3, 1e-6), seed=0)
    second = simulate_method(truth_m, np.full(3, 1e-6), seed=1)
    lasting_m = np.random.default_rng(2).normal(0.0, 0.01, (FRAMES // 10, 1, 3))
    second.measured_m[:] += np.repeat(lasting_m, 10, axis=0)
    _, middles = fuse(first, second)
    # There are 20 independent errors, not 200, so the spread has an error of about a quarter.
    expected_m = np.sqrt(np.pi / 2 / 20) * 0.01
    np.testing.assert_allclose(middles.offset_std_m / expected_m, 1.0, atol=0.6)


def test_methods_with_the_same_foreground_have_correlated_errors():
    """The best linear estimate from correlated errors has a larger covariance than that from independent errors."""
    methods = both_methods(circular_paths(2))
    independent, _ = fuse(*methods)
    correlated, middles = fuse(*methods, same_foreground=True)
    # The least variance of a weighted mean is 1 / (1ᵀ S⁻¹ 1) along each axis.
    lines_m2 = LINES_STD_M**2 + middles.offset_std_m**2
    swarm_m2 = np.broadcast_to(SWARM_STD_M**2, lines_m2.shape)
    cross_m2 = COMMON_CORRELATION * np.sqrt(swarm_m2 * lines_m2)
    joint_m2 = np.array([[swarm_m2, cross_m2], [cross_m2, lines_m2]]).transpose(2, 3, 0, 1)
    expected_m2 = 1 / np.linalg.inv(joint_m2).sum(axis=(-2, -1))
    stated_m2 = np.median(variances(correlated.measured_covariance_m2), axis=0)
    np.testing.assert_allclose(stated_m2, expected_m2, rtol=1e-9)
    independent_m2 = np.median(variances(independent.measured_covariance_m2), axis=0)
    assert (stated_m2.prod(axis=-1) > independent_m2.prod(axis=-1)).all()


def test_where_one_method_has_no_measurement_the_other_is_used_and_where_both_have_none_a_drone_is_lost():
    truth_m = circular_paths(2)
    first = simulate_method(truth_m, SWARM_STD_M, seed=0, hidden=[(0, 50, 100), (0, 150, 200)])
    second = simulate_method(truth_m, LINES_STD_M, seed=1, hidden=[(1, 120, 150), (0, 150, 200)])
    fused, middles = fuse(first, second)
    assert (fused.status[:150] == Status.TRACKED).all()
    # Measurements of the lines alone are only moved by the constant offset between the middles.
    moved_m = fused.measured_m[50:100, 0] - second.measured_m[50:100, 0]
    assert np.ptp(moved_m, axis=0).max() < 1e-12
    # They have the uncertainty of the offset.
    expected_m2 = LINES_STD_M**2 + middles.offset_std_m[0] ** 2
    np.testing.assert_allclose(variances(fused.measured_covariance_m2[60, 0]), expected_m2, rtol=1e-9)
    np.testing.assert_array_equal(fused.measured_m[120:150, 1], first.measured_m[120:150, 1])
    off_m = (fused.position_m - truth_m)[50:100, 0]
    assert np.linalg.norm(off_m, axis=-1).max() < 0.06
    lost_from = 150 + round(MAX_COASTING_S * FPS)
    assert (fused.status[150:lost_from, 0] == Status.COASTING).all()
    assert (fused.status[lost_from:, 0] == Status.LOST).all()
    variance = np.trace(fused.covariance_m2[149:, 0], axis1=1, axis2=2)
    assert (np.diff(variance) > 0).all()


def test_drones_found_only_by_the_lines_come_last_and_have_no_offset():
    truth_m = circular_paths(3)
    swarm = simulate_method(truth_m[:, [2, 0]], SWARM_STD_M, seed=0, arrivals=[Arrival(3, 1, again=False)])
    arrivals = [Arrival(9, 0, again=False), Arrival(20, 1, again=True)]
    lines = simulate_method(truth_m, LINES_STD_M, seed=1, arrivals=arrivals)
    fused, middles = fuse(swarm, lines)
    np.testing.assert_allclose(fused.measured_m, truth_m[:, [2, 0, 1]], atol=0.1)
    assert np.isfinite(middles.offset_m[:, 0]).tolist() == [True, True, False]
    # The first arrival of the projection lines is ignored, because the swarm has a track of this drone.
    assert fused.arrivals == (Arrival(3, 1, again=False), Arrival(20, 2, again=True))
    # With the same foreground, a track of lines alone is no drone.
    fused, _ = fuse(swarm, lines, same_foreground=True)
    assert fused.num_drones == 2


def test_methods_may_have_no_tracks():
    found = simulate_method(circular_paths(2), SWARM_STD_M, seed=0)
    empty = simulate_method(circular_paths(0), SWARM_STD_M, seed=0)
    for pair in ((found, empty), (empty, found)):
        fused, _ = fuse(*pair)
        np.testing.assert_array_equal(fused.measured_m, found.measured_m)
    nothing, _ = fuse(empty, empty)
    assert nothing.num_drones == 0


def systematic_errors(variance_m2):
    """The errors of a method whose positions of two drones have systematic errors of a variance."""
    absolute_m2 = np.broadcast_to(variance_m2 * np.eye(3), (FRAMES, 2, 3, 3))
    two = np.ones((2, 2))
    cameras = CameraErrors(two, 0.0, 0.1, two, 0.002, 0.0, np.eye(8))
    return TrackErrors(cameras, SystematicCovariances(absolute_m2, 0.25 * absolute_m2))


def fused_systematic(swarm, lines, swarm_errors, lines_errors):
    _, fusion = fuse(swarm, lines, errors=(swarm_errors, lines_errors))
    return fusion.errors.systematic


def test_systematic_errors_are_those_of_the_method_that_found_the_drone():
    truth_m = circular_paths(2)
    swarm = simulate_method(truth_m, SWARM_STD_M, seed=0, hidden=[(1, 0, FRAMES), (0, 50, FRAMES)])
    lines = simulate_method(truth_m, LINES_STD_M, seed=1, hidden=[(0, 0, 30), (0, 100, FRAMES)])
    one, other = systematic_errors(1e-4), systematic_errors(9e-4)
    systematic = fused_systematic(swarm, lines, one, other)
    variance_m2 = systematic.absolute_m2[..., 0, 0]
    np.testing.assert_allclose(variance_m2[:30, 0], 1e-4)
    assert (variance_m2[30:50, 0] > 1e-4).all()
    assert (variance_m2[30:50, 0] < 9e-4).all()
    # Also from frame 100 on, where neither finds the drone: the last errors count.
    np.testing.assert_allclose(variance_m2[50:, 0], 9e-4)
    # The swarm never finds its second drone; the lines' drone there is a third one.
    np.testing.assert_allclose(variance_m2[:, 2], 9e-4)
    without = fused_systematic(swarm, lines, None, other)
    np.testing.assert_allclose(without.absolute_m2[50:100, 0, 0, 0], 9e-4)
    # Turned cameras move the positions of both methods alike: noise averages out, this error does not.
    same = fused_systematic(swarm, lines, one, one)
    np.testing.assert_allclose(same.absolute_m2[:, 0, 0, 0], 1e-4)
    np.testing.assert_allclose(same.relative_m2, 0.25 * same.absolute_m2)
