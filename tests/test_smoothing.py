"""The smoother and the strength of the jerk: against one Gaussian over all frames, statistics, and symmetries."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_textbook import (
    Flown,
    Model,
    calm,
    fly,
    motion_params,
    nees,
    some_unknown,
    textbook_filter,
    textbook_smoother,
    without,
)
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from psotrack.errors import InputError
from psotrack.motion import estimate_jerk_density, smooth


def smoothed(flown: Flown):
    return smooth(*flown.measurements, flown.params)


class TestSmoothing:
    @pytest.mark.parametrize("error_share", [0.0, 1e-6, 0.5, 0.95])
    def test_it_is_the_gaussian_given_all_frames(self, error_share):
        """Gaps, times that are not evenly spaced, and a drone that is first seen in frame 5.

        Where errors are white the textbook has no error in its state: then the rest must be as if ours had not.
        """
        flown = calm(fly(1, frames=30, drones=2, error_share=error_share, error_time_s=0.3))
        unknown = np.random.default_rng(2).random((30, 2)) < 0.3
        unknown[0, 0], unknown[:5, 1], unknown[5, 1] = False, True, False
        time_s = flown.time_s + np.random.default_rng(3).uniform(-0.0005, 0.0005, 30)
        flown = without(replace(flown, time_s=time_s), unknown)
        result = smoothed(flown)
        for drone, born in ((0, 0), (1, 5)):
            # Nothing is beyond the gate, of which the textbook knows nothing.
            assert np.nanmax(textbook_filter(*flown.of(drone, born))[2]) < 16
            mean, covariance = textbook_smoother(*flown.of(drone, born))
            # Float64 throughout; the textbook inverts one matrix of some 60 x 60. Measured 8e-12, 8e-11, 8e-10.
            for part, expected, limit in (
                (result.position_m, mean[:, :3], 1e-9),
                (result.velocity_m_s, mean[:, 3:6], 1e-8),
                (result.acceleration_m_s2, mean[:, 6:9], 1e-7),
                (result.covariance_m2, covariance[:, :3, :3], 1e-11),
            ):
                np.testing.assert_allclose(part[born:, drone], expected, rtol=0, atol=limit)
                assert np.isnan(part[:born, drone]).all()

    def test_white_errors_leave_no_trace(self):
        """Not a bit of anything depends on how long errors last when none does."""
        flown = some_unknown(fly(1, frames=30, drones=2), 2)
        other = replace(flown, model=Model(error_time_s=7.0))
        for one, same in zip(*(vars(smoothed(each)).values() for each in (flown, other)), strict=True):
            np.testing.assert_array_equal(one, same)
        density = [estimate_jerk_density(*flown.measurements, each.params) for each in (flown, other)]
        np.testing.assert_array_equal(*density)

    def test_it_beats_the_filter_which_beats_what_is_measured(self):
        flown = fly(4, frames=100, drones=20)
        filtered_m = np.stack([textbook_filter(*flown.of(drone))[0] for drone in range(20)], axis=1)[..., :3]
        raw, filtered, after = (
            np.sqrt(((position_m - flown.state[..., :3])[20:-20] ** 2).mean())
            for position_m in (flown.measured_m, filtered_m, smoothed(flown).position_m)
        )
        # Measured 10.8, 6.0 and 2.2 mm.
        assert after < 0.7 * filtered < 0.7 * 0.7 * raw

    @pytest.mark.parametrize("unknown", [0.0, 0.4])
    @pytest.mark.parametrize("error_share", [0.0, 0.5])
    def test_it_knows_how_far_off_it_is(self, unknown, error_share):
        """NEES of independent drones is chi-square with 3 degrees each; one seed in a thousand fails by chance."""
        drones = 300
        flown = some_unknown(
            fly(5, frames=60, drones=drones, error_share=error_share, steady=True), 6, unknown
        )
        result = smoothed(flown)
        low, high = chi2.ppf([0.0005, 0.9995], 3 * drones) / drones
        for frame in (0, 1, 20, 40, 59):
            value = nees(result.position_m[frame] - flown.state[frame, :, :3], result.covariance_m2[frame])
            assert low < value.mean() < high, frame

    def test_who_takes_lasting_errors_for_white_knows_less_than_he_thinks(self):
        """Nor is he nearer to the truth."""
        flown = fly(5, frames=60, drones=300, density=1.0, error_share=0.5, steady=True)
        inside, off_m = [], []
        for each in (flown, replace(flown, model=replace(flown.model, error_share=0.0))):
            result = smoothed(each)
            error_m = result.position_m[30] - flown.state[30, :, :3]
            inside.append((nees(error_m, result.covariance_m2[30]) < chi2.ppf(0.9, 3)).mean())
            off_m.append(np.sqrt((error_m**2).mean()))
        low, high = binom.ppf([0.0005, 0.9995], 300, 0.9) / 300
        assert low <= inside[0] <= high
        # Measured 0.33.
        assert inside[1] < 0.5
        assert off_m[0] < 1.02 * off_m[1]

    def test_gaps_are_bridged_from_both_sides(self):
        unknown = np.zeros((100, 20), bool)
        unknown[40:60], unknown[90:] = True, True
        result = smoothed(without(fly(7, frames=100, drones=20, error_share=0.5, steady=True), unknown))
        spread = np.trace(result.covariance_m2, axis1=-2, axis2=-1)
        assert (np.diff(spread[39:49], axis=0) > 0).all()
        assert (np.diff(spread[50:61], axis=0) < 0).all()
        # After the last measurement it only grows.
        assert (np.diff(spread[89:], axis=0) > 0).all()

    def test_after_the_last_measurement_it_flies_on(self):
        unknown = np.zeros((30, 2), bool)
        unknown[20:] = True
        flown = without(fly(8, frames=30, drones=2, error_share=0.5), unknown)
        result = smoothed(flown)
        ahead_s = (flown.time_s[19:] - flown.time_s[19])[:, None, None]
        expected = (
            result.position_m[19]
            + ahead_s * result.velocity_m_s[19]
            + ahead_s**2 / 2 * result.acceleration_m_s2[19]
        )
        # Ten steps of float64 at some metres.
        np.testing.assert_allclose(result.position_m[19:], expected, rtol=0, atol=1e-11)

    def test_a_drone_that_is_never_measured(self):
        unknown = np.zeros((30, 2), bool)
        unknown[:, 1] = True
        flown = fly(9, frames=30, drones=2, error_share=0.5)
        result, alone = smoothed(without(flown, unknown)), smoothed(flown)
        for part, same in zip(vars(result).values(), vars(alone).values(), strict=True):
            assert np.isnan(part[:, 1]).all()
            np.testing.assert_array_equal(part[:, 0], same[:, 0])

    @pytest.mark.parametrize("error_share", [0.0, 0.5])
    def test_an_outlier_counts_for_little(self, error_share):
        flown = fly(10, frames=100, drones=20, error_share=error_share)
        wild = flown.measured_m.copy()
        wild[50] += 0.5
        result, clean = smoothed(replace(flown, measured_m=wild)), smoothed(flown)
        # By 0.87 m; measured 6 mm at most, where the smoothed standard deviation over three axes is 4 and 12 mm.
        moved_m = np.linalg.norm(result.position_m - clean.position_m, axis=-1)
        assert moved_m.max() < 0.012

    @pytest.mark.parametrize("error_share", [0.0, 1e-6, 0.5, 0.99])
    def test_covariances_are_positive_definite_over_a_long_flight_with_long_gaps(self, error_share):
        frames = 3000
        unknown = np.random.default_rng(11).random((frames, 2)) < 0.2
        unknown[0] = False
        unknown[1000:1500, 0], unknown[200:, 1] = True, True
        unknown[2900, 1] = False
        result = smoothed(without(fly(11, frames=frames, drones=2, error_share=error_share), unknown))
        for value in vars(result).values():
            assert np.isfinite(value).all()
        assert np.linalg.eigvalsh(result.covariance_m2).min() > 0
        # Bridging 108 s says little; that it says so is the point.
        assert np.trace(result.covariance_m2[1500, 1]) > 100.0**2


class TestSymmetries:
    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=15, deadline=None)
    def test_a_turned_world_gives_turned_tracks(self, seed):
        rng = np.random.default_rng(seed)
        flown = some_unknown(fly(seed, frames=30, drones=2, error_share=0.5), seed)
        turn, shift_m = Rotation.random(rng=rng).as_matrix(), rng.uniform(-3, 3, 3)
        turned = smoothed(
            replace(
                flown,
                measured_m=flown.measured_m @ turn.T + shift_m,
                covariance_m2=turn @ flown.covariance_m2 @ turn.T,
            )
        )
        here = smoothed(flown)
        # Float64, with covariances that are flat to 1e-5.
        np.testing.assert_allclose(turned.position_m, here.position_m @ turn.T + shift_m, rtol=0, atol=1e-8)
        np.testing.assert_allclose(turned.velocity_m_s, here.velocity_m_s @ turn.T, rtol=0, atol=1e-6)
        np.testing.assert_allclose(
            turned.covariance_m2,
            turn @ here.covariance_m2 @ turn.T,
            rtol=0,
            atol=1e-6 * here.covariance_m2.max(),
        )

    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=15, deadline=None)
    def test_the_film_may_run_backwards(self, seed):
        """White jerk and errors that last have no direction of time. What is known of the start has: next to nothing.

        The gate has, too: what is beyond it depends on what came before, and so nothing is.
        """
        unknown = np.random.default_rng(seed).random((30, 2)) < 0.3
        # Measured at both ends: before the first measurement there is nothing, after the last a prediction.
        unknown[[0, -1]] = False
        flown = without(calm(fly(seed, frames=30, drones=2, error_share=0.5, steady=True)), unknown)
        flown = replace(flown, model=replace(flown.model, velocity_std=1e3, acceleration_std=1e5))
        back = Flown(
            -flown.time_s[::-1],
            flown.state[::-1],
            flown.measured_m[::-1],
            flown.covariance_m2[::-1],
            flown.was_measured[::-1],
            flown.model,
        )
        forth, back = smoothed(flown), smoothed(back)
        # Starting values of 1 km/s and 10 km/s^2 pull by some 1e-7 of what is not known, a few m/s and 10 m/s2.
        np.testing.assert_allclose(back.position_m[::-1], forth.position_m, rtol=0, atol=1e-6)
        np.testing.assert_allclose(-back.velocity_m_s[::-1], forth.velocity_m_s, rtol=0, atol=1e-4)
        np.testing.assert_allclose(back.acceleration_m_s2[::-1], forth.acceleration_m_s2, rtol=0, atol=1e-2)
        np.testing.assert_allclose(back.covariance_m2[::-1], forth.covariance_m2, rtol=1e-3, atol=1e-9)


class TestJerkDensity:
    FRAMES = 600

    @pytest.mark.parametrize("error_share", [0.0, 0.5])
    @pytest.mark.parametrize("density", [0.3, 30.0, 3000.0])
    def test_it_is_found_from_the_measurements(self, density, error_share):
        flown = fly(12, frames=self.FRAMES, drones=8, density=density, error_share=error_share, steady=True)
        flown = some_unknown(flown, 13, 0.1)
        found = estimate_jerk_density(*flown.measurements, motion_params(30.0, 8, error_share=error_share))
        off = np.log10(found / density)
        # 24 s are some 100 independent looks at the jerk along three axes: each drone to a tenth of a decade or so,
        # eight of them to a third of that. Measured 0.06 and 0.01 at the most.
        assert np.abs(off).max() < 0.2
        assert abs(off.mean()) < 0.05

    def test_outliers_do_not_pass_for_jerk(self):
        flown = fly(14, frames=self.FRAMES, drones=8)
        rng = np.random.default_rng(15)
        wild = rng.random(flown.was_measured.shape) < 0.03
        wild[0] = False
        measured_m = flown.measured_m + wild[..., None] * rng.normal(scale=0.5, size=flown.measured_m.shape)
        found = estimate_jerk_density(
            *replace(flown, measured_m=measured_m).measurements, motion_params(30.0, 8)
        )
        # As if there were none.
        assert np.abs(np.log10(found / 30.0)).max() < 0.3

    def test_a_drone_that_is_hardly_measured_gets_what_was_expected(self):
        unknown = np.zeros((30, 2), bool)
        unknown[1:, 0], unknown[:, 1] = True, True
        flown = without(fly(16, frames=30, drones=2), unknown)
        found = estimate_jerk_density(*flown.measurements, motion_params(70.0, 2))
        # A prior alone is a parabola, whose vertex is found to rounding, and the params are float32.
        np.testing.assert_allclose(found, 70.0, rtol=1e-6)

    def test_a_drone_that_hangs_in_the_air_is_calm(self):
        rng = np.random.default_rng(17)
        flown = fly(17, frames=self.FRAMES, drones=8)
        still = replace(
            flown,
            measured_m=rng.normal(scale=0.01, size=flown.measured_m.shape),
            covariance_m2=np.broadcast_to(1e-4 * np.eye(3), flown.covariance_m2.shape),
        )
        # Three hundred times less, in spite of the prior: in 24 s it accelerates to less than 1 m/s2.
        assert (estimate_jerk_density(*still.measurements, flown.params) < 0.1).all()


class TestWhatIsRefused:
    def changed(self, **changes):
        flown = fly(18, frames=30, drones=2)
        for name, (index, value) in changes.items():
            getattr(flown, name)[index] = value
        return flown

    @pytest.mark.parametrize("function", [smooth, estimate_jerk_density])
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"time_s": (3, 0.01)}, "time_s: expected increasing times"),
            ({"time_s": (29, np.inf)}, "time_s: expected increasing times"),
            ({"measured_m": ((4, 1, 2), np.nan)}, "measured_m, row 4, drone 1: expected numbers"),
            (
                {"covariance_m2": ((4, 1, 2), np.inf)},
                "measured_covariance_m2, row 4, drone 1: expected numbers",
            ),
            (
                {"covariance_m2": ((5, 0), np.diag([1, 1, -1]))},
                "measured_covariance_m2, row 5, drone 0: expected a positive definite covariance",
            ),
        ],
    )
    def test_in_one_line(self, function, changes, message):
        flown = self.changed(**changes)
        with pytest.raises(InputError, match=message):
            function(*flown.measurements, flown.params)

    def test_what_is_not_measured_may_be_anything(self):
        flown = self.changed(was_measured=((4, 1), False), covariance_m2=((4, 1), np.diag([1, 1, -1])))
        assert np.isfinite(smoothed(flown).position_m).all()


def test_double_precision_stays_within():
    flown = fly(19, frames=30, drones=2)
    assert smoothed(flown).position_m.dtype == np.float64
    assert not jax.config.jax_enable_x64
    assert jax.numpy.zeros(1).dtype == np.float32


def test_other_numbers_compile_nothing(caplog):
    def both(seed, density):
        flown = some_unknown(fly(seed, frames=8, drones=2), seed)
        smooth(*flown.measurements, motion_params(density, 2))
        estimate_jerk_density(*flown.measurements, motion_params(density, 2))
        lines = [record.getMessage() for record in caplog.records if "Compiling" in record.getMessage()]
        caplog.clear()
        return lines

    with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):
        assert any("_smoothed" in line for line in both(20, 3.0))
        assert both(21, 200.0) == []
