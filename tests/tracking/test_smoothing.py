"""The smoother and the estimate of the jerk density, compared with one joint Gaussian, statistics, and symmetries."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_textbook import (
    SimulatedFlight,
    halve_errors,
    motion_params,
    nees,
    remove_measurements,
    remove_random_measurements,
    simulate_flight,
    textbook_filter,
    textbook_smoother,
)
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.tracking.motion import estimate_jerk_density, smooth


def smooth_flight(flown: SimulatedFlight):
    return smooth(flown.measurements, flown.params)


class TestSmoothing:
    @pytest.mark.parametrize("error_share", [0.0, 1e-6, 0.5, 0.95])
    def test_the_result_is_the_gaussian_given_all_frames(self, error_share):
        """The recording has gaps, uneven times, and a drone that is first measured in frame 5.

        If errors are white, the textbook has no lasting error in its state, and the other components must agree.
        """
        flown = halve_errors(
            simulate_flight(1, frames=30, drones=2, error_share=error_share, error_time_s=0.3)
        )
        unknown = np.random.default_rng(2).random((30, 2)) < 0.3
        unknown[0, 0], unknown[:5, 1], unknown[5, 1] = False, True, False
        # After the last measurement the drone is predicted.
        unknown[27:, 0] = True
        time_s = flown.time_s + np.random.default_rng(3).uniform(-0.0005, 0.0005, 30)
        flown = remove_measurements(replace(flown, time_s=time_s), unknown)
        result = smooth_flight(flown)
        for drone, born in ((0, 0), (1, 5)):
            # No measurement is beyond the gate, because the textbook filter has none.
            assert np.nanmax(textbook_filter(*flown.textbook_arguments(drone, born))[2]) < 16
            mean, covariance = textbook_smoother(*flown.textbook_arguments(drone, born))
            # Both are float64, and the textbook inverts a matrix of about 60 x 60. Measured 8e-12, 8e-11, 8e-10.
            for part, expected, limit in (
                (result.position_m, mean[:, :3], 1e-9),
                (result.velocity_m_s, mean[:, 3:6], 1e-8),
                (result.acceleration_m_s2, mean[:, 6:9], 1e-7),
                (result.covariance_m2, covariance[:, :3, :3], 1e-11),
            ):
                np.testing.assert_allclose(part[born:, drone], expected, rtol=0, atol=limit)
                assert np.isnan(part[:born, drone]).all()

    @pytest.mark.parametrize("unknown", [0.0, 0.4])
    @pytest.mark.parametrize("error_share", [0.0, 0.5])
    @pytest.mark.slow
    def test_covariances_cover_the_errors(self, unknown, error_share):
        """NEES of independent drones is chi-square with 3 degrees each; one seed in 1,000 fails by chance."""
        drones = 300
        flown = remove_random_measurements(
            simulate_flight(5, frames=60, drones=drones, error_share=error_share, steady=True), 6, unknown
        )
        result = smooth_flight(flown)
        low, high = chi2.ppf([0.0005, 0.9995], 3 * drones) / drones
        for frame in (0, 1, 20, 40, 59):
            value = nees(result.position_m[frame] - flown.state[frame, :, :3], result.covariance_m2[frame])
            assert low < value.mean() < high, frame

    def test_a_drone_that_is_never_measured(self):
        unknown = np.zeros((30, 2), bool)
        unknown[:, 1] = True
        flown = simulate_flight(9, frames=30, drones=2, error_share=0.5)
        result, alone = smooth_flight(remove_measurements(flown, unknown)), smooth_flight(flown)
        for part, same in zip(vars(result).values(), vars(alone).values(), strict=True):
            assert np.isnan(part[:, 1]).all()
            np.testing.assert_array_equal(part[:, 0], same[:, 0])

    @pytest.mark.parametrize("error_share", [0.0, 0.5])
    def test_an_outlier_has_little_weight(self, error_share):
        flown = simulate_flight(10, frames=100, drones=20, error_share=error_share)
        wild = flown.measured_m.copy()
        wild[50] += 0.5
        result, clean = smooth_flight(replace(flown, measured_m=wild)), smooth_flight(flown)
        # The outlier is 0.87 m off. Measured: it moves positions by up to 6 mm, where the smoothed standard deviation
        # over three axes is 4 mm (white errors) and 12 mm (lasting errors).
        moved_m = np.linalg.norm(result.position_m - clean.position_m, axis=-1)
        assert moved_m.max() < 0.012

    @pytest.mark.parametrize("error_share", [0.0, 1e-6, 0.5, 0.99])
    def test_covariances_are_positive_definite_over_a_long_flight_with_long_gaps(self, error_share):
        frames = 3000
        unknown = np.random.default_rng(11).random((frames, 2)) < 0.2
        unknown[0] = False
        unknown[1000:1500, 0], unknown[200:, 1] = True, True
        unknown[2900, 1] = False
        result = smooth_flight(
            remove_measurements(
                simulate_flight(11, frames=frames, drones=2, error_share=error_share), unknown
            )
        )
        for value in vars(result).values():
            assert np.isfinite(value).all()
        assert np.linalg.eigvalsh(result.covariance_m2).min() > 0
        # A gap of 108 s leaves hundreds of metres of uncertainty, and the covariance must say so.
        assert np.trace(result.covariance_m2[1500, 1]) > 100.0**2


class TestSymmetries:
    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=15, deadline=None)
    def test_a_turned_world_gives_turned_tracks(self, seed):
        rng = np.random.default_rng(seed)
        flown = remove_random_measurements(simulate_flight(seed, frames=30, drones=2, error_share=0.5), seed)
        turn, shift_m = Rotation.random(rng=rng).as_matrix(), rng.uniform(-3, 3, 3)
        turned = smooth_flight(
            replace(
                flown,
                measured_m=flown.measured_m @ turn.T + shift_m,
                covariance_m2=turn @ flown.covariance_m2 @ turn.T,
            )
        )
        here = smooth_flight(flown)
        # The arithmetic is float64; the condition number of the covariances is 1e5.
        np.testing.assert_allclose(turned.position_m, here.position_m @ turn.T + shift_m, rtol=0, atol=1e-8)
        np.testing.assert_allclose(turned.velocity_m_s, here.velocity_m_s @ turn.T, rtol=0, atol=1e-6)
        np.testing.assert_allclose(
            turned.covariance_m2,
            turn @ here.covariance_m2 @ turn.T,
            rtol=0,
            atol=1e-6 * here.covariance_m2.max(),
        )


class TestJerkDensity:
    FRAMES = 600

    @pytest.mark.parametrize("error_share", [0.0, 0.5])
    @pytest.mark.parametrize("density", [0.3, 30.0, 3000.0])
    @pytest.mark.slow
    def test_the_density_is_found_from_the_measurements(self, density, error_share):
        flown = simulate_flight(
            12, frames=self.FRAMES, drones=8, density=density, error_share=error_share, steady=True
        )
        flown = remove_random_measurements(flown, 13, 0.1)
        found = estimate_jerk_density(flown.measurements, motion_params(30.0, 8, error_share=error_share))
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
        measured_m = flown.measured_m + wild[..., None] * rng.normal(scale=0.5, size=flown.measured_m.shape)
        found = estimate_jerk_density(
            replace(flown, measured_m=measured_m).measurements, motion_params(30.0, 8)
        )
        # The limit is the same as for flights without outliers.
        assert np.abs(np.log10(found / 30.0)).max() < 0.3

    def test_a_drone_with_almost_no_measurements_keeps_the_prior(self):
        unknown = np.zeros((30, 2), bool)
        unknown[1:, 0], unknown[:, 1] = True, True
        flown = remove_measurements(simulate_flight(16, frames=30, drones=2), unknown)
        found = estimate_jerk_density(flown.measurements, motion_params(70.0, 2))
        # The prior alone is a parabola, whose vertex is found to rounding.
        np.testing.assert_allclose(found, 70.0, rtol=1e-6)

    def test_a_hovering_drone_has_a_small_density(self):
        rng = np.random.default_rng(17)
        flown = simulate_flight(17, frames=self.FRAMES, drones=8)
        still = replace(
            flown,
            measured_m=rng.normal(scale=0.01, size=flown.measured_m.shape),
            covariance_m2=np.broadcast_to(1e-4 * np.eye(3), flown.covariance_m2.shape),
        )
        # The density is 300 times below the prior; it corresponds to accelerations below 1 m/s² within 24 s.
        assert (estimate_jerk_density(still.measurements, flown.params) < 0.1).all()


def test_double_precision_does_not_leave_the_call_and_what_was_not_measured_is_ignored():
    flown = simulate_flight(19, frames=30, drones=2)
    flown.was_measured[4, 1], flown.covariance_m2[4, 1] = False, np.diag([1, 1, -1])
    assert np.isfinite(smooth_flight(flown).position_m).all()
    assert smooth_flight(flown).position_m.dtype == np.float64
    assert not jax.config.jax_enable_x64
    assert jax.numpy.zeros(1).dtype == np.float32


def test_other_values_need_no_compilation(caplog):
    def both(seed, density):
        flown = remove_random_measurements(simulate_flight(seed, frames=8, drones=2), seed)
        smooth(flown.measurements, motion_params(density, 2))
        estimate_jerk_density(flown.measurements, motion_params(density, 2))
        lines = [record.getMessage() for record in caplog.records if "Compiling" in record.getMessage()]
        caplog.clear()
        return lines

    with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):
        assert any("_smoothed" in line for line in both(20, 3.0))
        assert both(21, 200.0) == []
