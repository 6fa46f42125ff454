"""The motion model and the smoother, compared with one joint Gaussian of all states and with statistics."""

from dataclasses import replace
from itertools import product

import jax
import numpy as np
import pytest
from motion_textbook import (
    DT_S,
    TO_TEXTBOOK,
    Model,
    SimulatedFlight,
    halve_errors,
    remove_measurements,
    remove_random_measurements,
    simulate_flight,
)
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2, multivariate_normal

from psotrack.tracking.motion import GATE_999, estimate_jerk_density, kalman, smooth


def as_arrays(tree, dtype):
    return jax.tree.map(lambda leaf: np.asarray(leaf, bool if leaf.dtype == bool else dtype), tree)


@jax.jit
def filter_frames(state, params, dt_s, measured_m, covariance_m2, was_measured):
    """States and NIS of every frame; `state` belongs to the frame before the first frame."""

    def step(state, frame):
        dt_s, *measurement = frame
        predicted = kalman.predict(state, dt_s, params)
        result = kalman.update(predicted, *measurement, params)
        return result[0], result

    return jax.lax.scan(step, state, (dt_s, measured_m, covariance_m2, was_measured))[1]


def run(flown, dtype=np.float32):
    """Filter frames 1 and later, from an initial state at the measurement of frame 0; NumPy arrays."""
    with jax.enable_x64(dtype == np.float64):
        params = as_arrays(flown.params, dtype)
        frames = (np.diff(flown.time_s), flown.measured_m, flown.covariance_m2, flown.was_measured)
        dt_s, measured_m, covariance_m2, there = as_arrays(frames, dtype)
        state = init(measured_m[0], np.zeros_like(measured_m[0]), covariance_m2[0], params)
        result = filter_frames(state, params, dt_s, measured_m[1:], covariance_m2[1:], there[1:])
        return jax.tree.map(np.array, result)


def as_textbook(states):
    """Means and covariances of position, velocity, acceleration and error, float64."""
    parts = (states.apparent_m, states.velocity_m_s, states.acceleration_m_s2, states.error_m)
    covariance = states.covariance.astype(np.float64)
    mean = np.concatenate([part.astype(np.float64) for part in parts], axis=-1)
    return mean @ TO_TEXTBOOK.T, TO_TEXTBOOK @ covariance @ TO_TEXTBOOK.T


# One compilation each instead of one per operation.
init, predict, update = jax.jit(kalman.init), jax.jit(kalman.predict), jax.jit(kalman.update)
log_likelihood = jax.jit(kalman.log_likelihood)


@pytest.mark.parametrize("error_share", [0.0, 0.5, 0.95])
@pytest.mark.parametrize(
    # float64: rounding of sums of 100 terms, and cancellation in the textbook's formulas. float32: rounding of 6e-8
    # of a few metres per frame, which accelerations divide by dt². Measured 4e-6 m and 3e-4 m/s².
    ("dtype", "tolerance"),
    [(np.float64, (1e-12, 1e-11, 1e-10, 1e-12)), (np.float32, (4e-5, 4e-4, 3e-3, 4e-5))],
)
def test_the_filter_is_the_gaussian_given_the_frames_so_far(dtype, tolerance, error_share):
    """Times are uneven. Errors are half as large as stated, so that none is beyond the gate."""
    flown = halve_errors(simulate_flight(1, frames=10, drones=3, error_share=error_share, error_time_s=0.3))
    flown = remove_random_measurements(flown, 2)
    uneven_s = np.random.default_rng(3).uniform(-1e-4, 1e-4, 10).round(6)
    flown = replace(flown, time_s=flown.time_s + uneven_s)
    all_means, all_covariances = as_textbook(run(flown, dtype)[0])
    # White errors have no lasting part.
    size = 12 if error_share else 9
    for drone, frame in product(range(3), (1, 2, 5, 9)):
        means, covariances = flown.textbook(drone, slice(frame + 1))
        off = np.abs(all_means[frame - 1, drone] - means[-1])[:size]
        assert (off.reshape(-1, 3).max(axis=-1) <= tolerance[: size // 3]).all()
        # The difference is in units of the standard deviations, so that metres and m/s² have the same weight.
        expected = covariances[-1, :size, :size]
        unit = np.sqrt(np.diagonal(expected))
        difference = all_covariances[frame - 1, drone, :size, :size] - expected
        # Measured 3e-13 and 1.4e-4.
        limit = 1e-11 if dtype == np.float64 else 2e-3
        assert np.abs(difference / np.outer(unit, unit)).max() < limit


@pytest.mark.parametrize("error_share", [0.0, 0.5])
def test_covariances_of_the_filter_agree_with_its_errors(error_share):
    """On flights that obey the model; one seed in 1,000 fails by chance in each comparison."""
    drones = 200
    flown = simulate_flight(6, frames=60, drones=drones, error_share=error_share)
    states, nis = run(flown)
    # Innovations of frames and drones are independent: their sum is chi-square with 3 degrees for each.
    low, high = chi2.ppf([0.0005, 0.9995], 3 * nis.size) / nis.size
    assert low < nis.mean() < high
    # One NIS in 1,000 is beyond the gate.
    assert 0.0003 < np.mean(nis > GATE_999) < 0.002
    for frame in (1, 10, 59):
        error_m = states.position_m[frame - 1] - flown.state[frame, :, :3]
        inverse = np.linalg.inv(states.position_covariance_m2[frame - 1].astype(np.float64))
        nees = np.einsum("di,dij,dj->d", error_m, inverse, error_m)
        low, high = chi2.ppf([0.0005, 0.9995], 3 * drones) / drones
        assert low < nees.mean() < high
        # Positions inside of the 90 % ellipsoids of their covariances.
        inside = np.count_nonzero(nees < chi2.ppf(0.9, 3))
        low, high = binom.ppf([0.0005, 0.9995], drones, 0.9)
        assert low <= inside <= high


def least_correlation(covariance):
    """Smallest eigenvalue of the covariances in units of their standard deviations."""
    covariance = covariance.astype(np.float64)
    unit = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return np.linalg.eigvalsh(covariance / (unit[..., :, None] * unit[..., None, :])).min(axis=-1)


def at_rest(covariance_m2, was_measured, **model):
    """A flight measured at the origin: apart from the gate, covariances do not depend on positions."""
    shape = was_measured.shape
    return SimulatedFlight(
        time_s=np.arange(shape[0]) * DT_S,
        state=np.zeros((*shape, 9)),
        measured_m=np.zeros((*shape, 3)),
        covariance_m2=covariance_m2,
        was_measured=was_measured,
        model=Model(**model),
    )


class TestFloat32:
    def long_flight(self, decades, flattest, error_share):
        """Ten thousand frames: measurements of all precisions, gaps of up to four seconds, slow and fast drones."""
        rng, shape = np.random.default_rng(7), (10_000, 6)
        turn = Rotation.random(np.prod(shape), rng=rng).as_matrix().reshape(*shape, 3, 3)
        exponent = rng.uniform(*decades, (*shape, 1)) - rng.uniform(0, flattest, (*shape, 3))
        was_measured = np.ones(shape, bool)
        for start in range(500, shape[0], 700):
            was_measured[start : start + rng.integers(1, 100), rng.integers(shape[1])] = False
        covariance_m2 = turn * 10.0 ** (2 * exponent[..., None, :]) @ np.swapaxes(turn, -1, -2)
        density = 10.0 ** np.linspace(-2, 4, shape[1])
        return at_rest(covariance_m2, was_measured, density=density, error_share=error_share)

    @pytest.mark.slow
    @pytest.mark.parametrize("error_share", [0.0, 0.5, 0.99])
    def test_positive_definite_and_right_for_ten_thousand_frames(self, error_share, optimised):
        """Deviations from a micrometre to a metre in one measurement are closer to singular than float32 resolves."""
        flown = self.long_flight((-3, 0), 4, error_share)
        assert np.linalg.cond(flown.covariance_m2).max() > 1 / np.finfo(np.float32).eps
        states, _ = run(flown)
        known = 12 if error_share else 9
        assert least_correlation(states.covariance[..., :known, :known]).min() > 0
        assert least_correlation(states.position_covariance_m2).min() > 0
        for symmetric in (states.covariance, states.position_covariance_m2):
            np.testing.assert_array_equal(symmetric, np.swapaxes(symmetric, -1, -2))
        # Deviations from a millimetre to a decimetre, with axes in ratios up to 30, as from the cameras of a hall.
        flown = self.long_flight((-2, -1), 1.5, min(error_share, 0.5))
        rounded, exact = run(flown, np.float32)[0], run(flown, np.float64)[0]
        for name in ("covariance", "position_covariance_m2"):
            variance = np.diagonal(getattr(rounded, name), axis1=-2, axis2=-1)
            expected = np.diagonal(getattr(exact, name), axis1=-2, axis2=-1)
            # Rounding of 6e-8 of the largest variance is 1,000 times larger for the smallest. Measured 5e-3 at worst.
            np.testing.assert_allclose(variance, expected, rtol=1e-2)


class TestOutliers:
    @pytest.mark.parametrize("nis", [1.0, 16.0, 17.0, 1e4])
    def test_beyond_the_gate_a_measurement_has_a_larger_covariance(self, nis):
        assert pytest.approx(chi2.ppf(0.999, 3), rel=1e-12) == GATE_999
        excess = max(nis / GATE_999, 1)
        flown = simulate_flight(9, frames=2, drones=1, error_share=0.5)
        params, covariance = flown.params, flown.covariance_m2[1]
        with jax.enable_x64(True):
            first = init(flown.measured_m[0], np.zeros((1, 3)), flown.covariance_m2[0], params)
            state = predict(first, np.float64(DT_S), params)
            mean, P = np.asarray(state.mean)[0], np.asarray(state.covariance)[0]
            # S is the covariance of the apparent position plus the white share, half of R.
            S = P[:3, :3] + covariance[0] / 2
            direction = np.array([0.6, 0.0, 0.8])
            innovation = direction * np.sqrt(nis / (direction @ np.linalg.inv(S) @ direction))
            measured = mean[None, :3] + innovation
            after, found = update(state, measured, covariance, np.array([True]), params)
            log_density = log_likelihood(state, measured, covariance, params)
        np.testing.assert_allclose(found, nis, rtol=1e-9)
        # The textbook's update, with R increased so that S becomes `excess` times S.
        K = P[:, :3] @ np.linalg.inv(excess * S)
        np.testing.assert_allclose(np.asarray(after.mean)[0], mean + K @ innovation, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(np.asarray(after.covariance)[0], P - K @ P[:3], rtol=1e-7, atol=1e-12)
        expected = multivariate_normal(np.zeros(3), excess * S).logpdf(innovation)
        np.testing.assert_allclose(log_density, expected, rtol=1e-9)

    @pytest.mark.parametrize("error_share", [0.0, 0.5])
    def test_an_outlier_has_little_weight_and_a_drone_that_really_jumps_is_followed(self, error_share):
        """Both are off by half a metre along each axis in frame 50."""
        flown = simulate_flight(10, frames=100, drones=20, error_share=error_share)
        wild = flown.measured_m.copy()
        wild[50] += 0.5
        result = smooth_flight(replace(flown, measured_m=wild))
        clean = smooth_flight(flown)
        # Measured: the outlier moves positions by up to 6 mm, where the smoothed standard deviation over three axes is
        # 4 mm (white errors) and 12 mm (lasting errors).
        moved_m = np.linalg.norm(result.position_m - clean.position_m, axis=-1)
        assert moved_m.max() < 0.012
        jump_m = 0.5 * (np.arange(100) >= 50)[:, None, None]
        truth_m = flown.state[..., :3] + jump_m
        states, _ = run(replace(flown, measured_m=flown.measured_m + jump_m))
        off_m = np.linalg.norm(states.position_m - truth_m[1:], axis=-1)
        # The filter rejects the jump in frame 50 (row 49) and has followed it a second later. Measured 0.83 m, and 0.03
        # or 0.04 m, as before the jump.
        assert off_m[49].min() > 0.8
        assert off_m[80:].max() < 0.06


# --- the smoother and the estimate of the jerk density, compared with one joint Gaussian, statistics, and symmetries


def smooth_flight(flown):
    return smooth(flown.measurements, flown.params)


class TestSmoothing:
    @pytest.mark.parametrize("error_share", [0.0, 1e-6, 0.5, 0.95])
    def test_the_result_is_the_gaussian_given_all_frames(self, error_share):
        """The recording has gaps, uneven times, a drone that is first measured in frame 5, and one that never is."""
        flown = simulate_flight(1, frames=30, drones=3, error_share=error_share, error_time_s=0.3)
        flown = halve_errors(flown)
        unknown = np.random.default_rng(2).random((30, 3)) < 0.3
        unknown[0, 0] = unknown[5, 1] = False
        unknown[:5, 1] = unknown[:, 2] = True
        # After the last measurement the drone is predicted.
        unknown[27:, 0] = True
        uneven_s = np.random.default_rng(3).uniform(-0.0005, 0.0005, 30)
        flown = remove_measurements(replace(flown, time_s=flown.time_s + uneven_s), unknown)
        result = smooth_flight(flown)
        for value in vars(result).values():
            assert np.isnan(value[:, 2]).all()
        for drone, born in ((0, 0), (1, 5)):
            mean, covariance = flown.textbook(drone, slice(born, None))
            # Both are float64, and the textbook inverts a matrix of about 60 x 60. Measured 8e-12, 8e-11, 8e-10.
            for part, expected, limit in (
                (result.position_m, mean[:, :3], 1e-9),
                (result.velocity_m_s, mean[:, 3:6], 1e-8),
                (result.acceleration_m_s2, mean[:, 6:9], 1e-7),
                (result.covariance_m2, covariance[:, :3, :3], 1e-11),
            ):
                np.testing.assert_allclose(part[born:, drone], expected, rtol=0, atol=limit)
                assert np.isnan(part[:born, drone]).all()
        # Double precision does not leave the call.
        assert not jax.config.jax_enable_x64

    @pytest.mark.parametrize("error_share", [0.0, 0.99])
    def test_covariances_are_positive_definite_over_a_long_flight_with_long_gaps(self, error_share):
        frames = 3000
        unknown = np.random.default_rng(11).random((frames, 2)) < 0.2
        unknown[1000:1500, 0] = unknown[200:, 1] = True
        unknown[0] = unknown[2900, 1] = False
        flown = simulate_flight(11, frames=frames, drones=2, error_share=error_share)
        result = smooth_flight(remove_measurements(flown, unknown))
        for value in vars(result).values():
            assert np.isfinite(value).all()
        assert np.linalg.eigvalsh(result.covariance_m2).min() > 0
        # A gap of 108 s leaves hundreds of metres of uncertainty, and the covariance must say so.
        assert np.trace(result.covariance_m2[1500, 1]) > 100.0**2


class TestJerkDensity:
    FRAMES = 600

    @pytest.mark.parametrize(("density", "error_share"), [(0.3, 0.5), (30.0, 0.5), (3000.0, 0.0)])
    @pytest.mark.slow
    def test_the_density_is_found_from_the_measurements(self, density, error_share):
        flown = simulate_flight(
            12, frames=self.FRAMES, drones=8, density=density, error_share=error_share, steady=True
        )
        flown = remove_random_measurements(flown, 13, 0.1)
        found = estimate_jerk_density(flown.measurements, Model(30.0, error_share=error_share).params(8))
        off = np.log10(found / density)
        # 24 s have about 100 independent samples of the jerk along three axes. They give the density of one drone to
        # about a tenth of a decade, and the mean of eight drones to a third of that. Measured 0.06 and 0.01 at most.
        assert np.abs(off).max() < 0.2
        assert abs(off.mean()) < 0.05

    def test_outliers_do_not_raise_the_density(self):
        flown = simulate_flight(14, frames=self.FRAMES, drones=8)
        rng = np.random.default_rng(15)
        wild = rng.random(flown.was_measured.shape) < 0.03
        wild[0] = False
        measured_m = flown.measured_m.copy()
        measured_m[wild] += rng.normal(scale=0.5, size=(wild.sum(), 3))
        found = estimate_jerk_density(replace(flown, measured_m=measured_m).measurements, flown.params)
        # The limit is the same as for flights without outliers.
        assert np.abs(np.log10(found / 30.0)).max() < 0.3

    def test_a_drone_with_almost_no_measurements_keeps_the_prior(self):
        unknown = np.zeros((30, 2), bool)
        unknown[1:, 0] = unknown[:, 1] = True
        flown = remove_measurements(simulate_flight(16, frames=30, drones=2), unknown)
        found = estimate_jerk_density(flown.measurements, Model(70.0).params(2))
        # The prior alone is a parabola, whose vertex is found to rounding.
        np.testing.assert_allclose(found, 70.0, rtol=1e-6)


def test_other_values_need_no_compilation(caplog):
    def compiled(seed, density):
        flown = remove_random_measurements(simulate_flight(seed, frames=8, drones=2), seed)
        params = Model(density).params(2)
        caplog.clear()
        smooth(flown.measurements, params)
        estimate_jerk_density(flown.measurements, params)
        return [line for line in caplog.messages if "Compiling" in line]

    with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):
        assert any("_smoothed" in line for line in compiled(20, 3.0))
        assert compiled(21, 200.0) == []
