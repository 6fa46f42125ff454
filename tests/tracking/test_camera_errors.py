"""Errors of cameras learned from what they show of tracked drones, and covariances that hold for these errors."""

import tracemalloc
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np
import pytest
from helpers import fading, ring_rig
from motion_textbook import Model
from scipy.linalg import toeplitz
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.geometry import project, reconstruct
from psotrack.settings import ErrorSettings, MotionSettings
from psotrack.tracking.camera_errors import (
    Autocorrelation,
    CameraErrors,
    FittedPlaces,
    MeasurementErrors,
    autocorrelation_of,
    camera_variances,
    filtered_variances,
    fit_constant_errors,
    learn_camera_errors,
    noise_covariance,
    noise_ratios,
    systematic_covariances,
    views_of_places,
)
from psotrack.tracking.motion import Measurements, filter_measurements

FPS = 25.0
USUAL = (0.7, 0.4)
NOTHING_KNOWN = Autocorrelation(1.0, np.zeros(1), np.ones(1))
#: The chi-square distribution with 3 degrees of freedom is below this with probability 0.9.
INSIDE_90 = chi2.ppf(0.9, 3)


def flights(rng, frames, drones):
    """Smooth paths in the middle of the room of `ring_rig`, and their velocities."""
    time_s = np.arange(frames)[:, None, None] / FPS
    path = np.zeros((frames, drones, 3))
    for _ in range(3):
        rate = rng.uniform(0.3, 2.0, (drones, 3))
        phase = rng.uniform(0, 6.3, (drones, 3))
        path += np.array([0.7, 0.7, 0.3]) * np.sin(rate * time_s + phase)
    return path + np.array([0.1, -0.1, 1.2]), np.gradient(path, 1 / FPS, axis=0)


def world(seed, num_cameras, frames, drones=2):
    """What is random, a rig, and flights."""
    rng = np.random.default_rng(seed)
    return rng, ring_rig(num_cameras, image_size_wh=(1920, 1080)), *flights(rng, frames, drones)


def turned(rig, angle_deg, rng):
    """The rig with every camera turned about its centre by an angle, about a random axis."""
    T = rig.cameras.T_cam_world.copy()
    for camera in range(len(rig)):
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis))
        T[camera, :3] = turn.as_matrix() @ T[camera, :3]
    return replace(rig, cameras=replace(rig.cameras, T_cam_world=T))


def correlated(rng, shape, share, frames):
    """Errors of variance 1, a share of which fades exponentially over some frames, the rest white."""
    lasting = fading(rng.normal(size=shape), np.exp(-1 / frames))
    return np.sqrt(share) * lasting + np.sqrt(1 - share) * rng.normal(size=shape)


def fitted_views(rig, stated, position_m, velocity_m_s, error_px):
    """Views of positions that a stated rig fits to places with errors, and the errors of the positions.

    The fit is linear, and exact for the places that the stated rig would show.
    """
    place_px, _ = project(rig.cameras, position_m[:, :, None])
    weight = np.ones(place_px.shape)
    views = views_of_places(stated.cameras, place_px + error_px, weight, position_m, velocity_m_s)
    moved_m = np.einsum("fdcik,fdck->fdi", views.gain, views.residual_px)
    residual_px = views.residual_px - np.einsum("fdcik,fdk->fdci", views.jacobian, moved_m)
    return replace(views, residual_px=residual_px), moved_m


def views_at(rig, position_m, velocity_m_s, place_px=np.nan):
    """Views of drones at positions, all of which count alike; no camera shows them unless their places are given."""
    shape = (*position_m.shape[:2], len(rig), 2)
    return views_of_places(
        rig.cameras, np.broadcast_to(place_px, shape), np.ones(shape), position_m, velocity_m_s
    )


def only_noise(noise_px, fading):
    """Errors of cameras that have no systematic errors; `fading` is the noise's fraction that fades, and its time."""
    unknowns = 4 * len(noise_px)
    return CameraErrors(noise_px, *fading, np.zeros(noise_px.shape), 0.0, 0.0, np.zeros((unknowns, unknowns)))


class TestViews:
    def test_gain_is_the_derivative_of_the_weighted_fit(self):
        rig = ring_rig(4)
        position_m = np.array([[0.3, -0.2, 1.0]])
        noise_px = np.array([1.0, 2.0, 0.5, 1.5])
        pixels, _ = project(rig.cameras, position_m[:, None])
        weight = np.repeat(noise_px[:, None] ** -2.0, 2, axis=-1)[None, None]
        views = views_of_places(rig.cameras, pixels[None], weight, position_m[None], np.zeros((1, 1, 3)))
        fit = partial(reconstruct, rig.cameras, noise_px=noise_px, robust=False)
        for camera, axis in product(range(4), range(2)):
            step_px = np.zeros((4, 2))
            step_px[camera, axis] = 0.5
            after_m = fit(pixels + step_px).position_m[0]
            before_m = fit(pixels - step_px).position_m[0]
            np.testing.assert_allclose(views.gain[0, 0, camera, :, axis], after_m - before_m, atol=1e-4)
        # One camera alone has no gain.
        alone = views_at(ring_rig(1), position_m[None], np.zeros((1, 1, 3)), 0.0)
        assert (alone.gain == 0).all()
        # Learning asks block by block: 100,000 frames took half an hour, because each block computed all frames.
        assert alone.shown is alone.shown

    @pytest.mark.parametrize("coefficients", [0, 5])
    def test_turns_are_derivatives_of_the_projection(self, coefficients):
        rig = ring_rig(3, coefficients=coefficients)
        position_m = np.array([[[0.4, 0.3, 0.9]]])
        views = views_at(rig, position_m, np.zeros((1, 1, 3)))
        before_px, _ = project(rig.cameras, position_m[:, :, None])
        for axis in range(3):
            angle = np.zeros(3)
            angle[axis] = 1e-6
            T = rig.cameras.T_cam_world.copy()
            T[:, :3] = Rotation.from_rotvec(angle).as_matrix() @ T[:, :3]
            after_px, _ = project(replace(rig.cameras, T_cam_world=T), position_m[:, :, None])
            derivative = (after_px - before_px) / 1e-6
            np.testing.assert_allclose(views.turn_px[..., axis], derivative, rtol=1e-3, atol=1e-2)

    def test_a_long_recording_takes_little_more_memory_than_its_views(self):
        """Found: 1.6 GB, more than all of the tracking before, for 100,000 frames of 4 drones in 8 cameras."""

        def peak_bytes(frames):
            rng, rig, position_m, velocity_m_s = world(1, 6, frames)
            place_px, _ = project(rig.cameras, position_m[:, :, None])
            place_px = place_px + rng.normal(size=place_px.shape)
            tracemalloc.start()
            views = views_at(rig, position_m, velocity_m_s, place_px)
            errors = learn_camera_errors(views, FPS, USUAL)
            noise_covariance(views, errors)
            systematic_covariances(views, errors)
            _, peak = tracemalloc.get_traced_memory()
            tracemalloc.stop()
            return peak

        # Ten numbers for each view, and some for each drone. Errors are learned from 6,000 rows of either recording.
        more_bytes = peak_bytes(12_000) - peak_bytes(6_000)
        assert more_bytes / (6_000 * 2 * 6) < 20 * 8


class TestLearning:
    def test_variances_of_cameras_are_not_shrunk_by_the_fit(self):
        rng, rig, position_m, velocity_m_s = world(1, 4, 800, 1)
        noise_px = np.array([[1.0, 0.7], [1.5, 1.5], [2.0, 3.0], [4.0, 1.0]])
        error_px = noise_px * rng.normal(size=(800, 1, 4, 2))
        views, _ = fitted_views(rig, rig, position_m, velocity_m_s, error_px)
        places = FittedPlaces(views.residual_px[:, 0], views.jacobian[:, 0], np.ones((800, 4), bool))
        found = np.sqrt(camera_variances(places))
        # Positions follow the precise cameras, so only some of the 800 residuals show these cameras' noise, whose
        # standard error is a tenth.
        np.testing.assert_allclose(found, noise_px, rtol=0.2)
        # The plain spread of the residuals is too small.
        assert np.square(views.residual_px).mean() < 0.8 * np.square(noise_px).mean()
        # A camera that shows nothing has no variance.
        variance = camera_variances(replace(places, shown=places.shown & [True, True, True, False]))
        assert np.isfinite(variance[:3]).all()
        assert np.isnan(variance[3]).all()

    @pytest.mark.parametrize(("fraction", "frames"), [(0.7, 10), (0.7, 25), (0.0, 10)])
    def test_correlated_errors_are_found(self, fraction, frames):
        values = correlated(np.random.default_rng(3), (600, 3, 4, 2), fraction, frames)
        found = autocorrelation_of(values, np.ones((600, 3, 4), bool), 1 / FPS, NOTHING_KNOWN)
        assert found.white == pytest.approx(1 - fraction, abs=0.08)
        # The inflation is that of a long sum.
        correlation = fraction * np.exp(-np.arange(4000) / frames)
        correlation[0] = 1.0
        long = toeplitz(correlation).sum() / 4000
        right = Autocorrelation(1 - fraction, np.array([fraction]), np.array([frames / FPS]))
        assert right.inflation(1 / FPS) == pytest.approx(long, rel=0.015)
        assert found.inflation(1 / FPS) == pytest.approx(long, rel=0.35)

    def test_errors_that_never_change_are_bias(self):
        rng = np.random.default_rng(3)
        values = 0.6 * rng.normal(size=(1, 3, 4, 2)) + 0.8 * rng.normal(size=(600, 3, 4, 2))
        there = np.ones((600, 3, 4), bool)
        found = autocorrelation_of(values, there, 1 / FPS, NOTHING_KNOWN)
        true = np.square(values.mean(axis=0)).mean() / np.square(values).mean()
        assert found.bias == pytest.approx(true, abs=0.06)
        # Too few frames are correlated as usual.
        assert autocorrelation_of(values[:4], there[:4], 1 / FPS, NOTHING_KNOWN) is NOTHING_KNOWN

    @pytest.mark.parametrize(("angle_deg", "late_s"), [(0.1, 0.0), (0.5, 0.0), (0.0, 0.02)])
    def test_turned_cameras_and_late_clocks_are_found(self, angle_deg, late_s):
        apart_s = late_s * np.array([0.0, 1.0, -0.5, 1.5, 0.0, -1.0])
        found = []
        for seed in range(2):
            rng, rig, position_m, velocity_m_s = world(seed, 6, 100)
            late_px = -views_at(rig, position_m, velocity_m_s).flow_px_s * apart_s[:, None]
            stated = turned(rig, angle_deg, rng)
            error_px = rng.normal(size=(100, 2, 6, 2)) + late_px
            views, _ = fitted_views(rig, stated, position_m, velocity_m_s, error_px)
            found.append(learn_camera_errors(views, FPS, USUAL))
        # The angle is spread over three axes.
        angle = np.degrees(np.mean([each.turn_rad for each in found])) * np.sqrt(3)
        assert angle == pytest.approx(angle_deg, rel=0.25, abs=0.03)
        clock_s = np.mean([each.clock_s for each in found])
        assert clock_s == pytest.approx(apart_s.std(), rel=0.3, abs=0.004)
        for each in found:
            assert each.noise_px.mean() == pytest.approx(1.0, rel=0.1)

    def test_few_frames_that_turns_explain_exactly_have_a_finite_covariance(self):
        """Turns and clocks fit a few frames exactly: the noise that remains is that of the arithmetic."""
        rng, rig, position_m, velocity_m_s = world(3, 4, 2, 1)
        views, _ = fitted_views(rig, rig, position_m, velocity_m_s, rng.normal(size=(2, 1, 4, 2)))
        places = FittedPlaces(views.residual_px[:, 0], views.jacobian[:, 0], views.shown[:, 0])
        derivatives = views.turn_px[:, 0], views.flow_px_s[:, 0]
        constant = fit_constant_errors(places, *derivatives, np.full((4, 2), 1e-14), 1.0)
        assert np.isfinite(constant.covariance).all()
        largest = np.abs(constant.covariance).max()
        assert np.linalg.eigvalsh(constant.covariance).min() > -1e-9 * largest

    @pytest.mark.parametrize("frames", [200, 2100])
    def test_a_sound_rig_has_no_systematic_errors(self, frames):
        rng, rig, position_m, velocity_m_s = world(6, 5, frames)
        error_px = correlated(rng, (frames, 2, 5, 2), 0.5, 8)
        views, _ = fitted_views(rig, rig, position_m, velocity_m_s, error_px)
        errors = learn_camera_errors(views, FPS, USUAL)
        np.testing.assert_allclose(errors.noise_px, 1.0, rtol=0.2)
        assert errors.bias_px.max() < 0.5
        assert np.degrees(errors.turn_rad) < 0.03
        assert errors.clock_s < 0.004
        # Without views, nothing is learned.
        nothing = learn_camera_errors(views_at(rig, position_m, velocity_m_s), FPS, USUAL)
        assert np.isnan(nothing.noise_px).all()
        assert (nothing.bias_px.max(), nothing.turn_rad, nothing.clock_s) == (0.0, 0.0, 0.0)


class TestCovariances:
    def test_given_errors_count_where_the_cameras_show_less(self):
        _, rig, position_m, velocity_m_s = world(8, 2, 6)
        position_m[[0, 3, 4], 1] = np.nan
        views = views_at(rig, position_m, velocity_m_s)
        none = only_noise(np.full((2, 2), np.nan), USUAL)
        some = replace(none, noise_px=np.ones((2, 2)), bias_px=np.full((2, 2), 3.0))
        assert (systematic_covariances(views, none).absolute_m2 == 0).all()
        given = systematic_covariances(views, none, ErrorSettings(pixel_px=2.0)).absolute_m2
        expected = 4.0 * np.einsum("fcik,fcjk->fij", views.gain[:, 0], views.gain[:, 0])
        np.testing.assert_allclose(given[:, 0], expected)
        # A drone keeps its covariance while it is not seen.
        np.testing.assert_array_equal(given[[0, 3, 4], 1], given[[1, 2, 2], 1])
        assert (np.linalg.eigvalsh(given[:, 1])[:, 0] > 0).all()
        learned = systematic_covariances(views, some)
        both = systematic_covariances(views, some, ErrorSettings(pixel_px=2.0))
        np.testing.assert_allclose(learned.absolute_m2, both.absolute_m2)

    def test_covariances_of_a_long_recording_are_those_of_its_frames(self):
        """Covariances are computed in parts; the mean of the turns is that of all frames."""
        rng, rig, position_m, velocity_m_s = world(11, 3, 2300)
        views, _ = fitted_views(rig, rig, position_m, velocity_m_s, np.zeros((2300, 2, 3, 2)))
        turn_rad, clock_s = 0.01, 0.02
        noise_px, bias_px = rng.uniform(1, 2, (2, 3, 2))
        constant = np.diag(np.tile(np.square([turn_rad, turn_rad, turn_rad, clock_s]), 3))
        errors = CameraErrors(noise_px, *USUAL, bias_px, turn_rad, clock_s, constant)
        found = systematic_covariances(views, errors)

        def spread(moved):
            return (moved @ moved.swapaxes(-1, -2)).sum(axis=2)

        by_noise = spread(views.gain * noise_px[:, None])
        np.testing.assert_allclose(noise_covariance(views, errors), by_noise, rtol=1e-9)
        by_bias = spread(views.gain * bias_px[:, None])
        by_clock = clock_s**2 * spread(views.gain @ views.flow_px_s[..., None])
        turns = turn_rad * views.gain @ views.turn_px
        absolute = by_bias + by_clock + spread(turns)
        np.testing.assert_allclose(found.absolute_m2, absolute, rtol=1e-9)
        relative = by_bias + by_clock + spread(turns - turns.mean(axis=0))
        np.testing.assert_allclose(found.relative_m2, relative, rtol=1e-9)

    @pytest.mark.parametrize(
        ("num_cameras", "num_rigs"),
        [pytest.param(3, 20, marks=pytest.mark.slow), pytest.param(8, 40, marks=pytest.mark.nightly)],
    )
    @pytest.mark.parametrize(
        ("angle_deg", "late_s", "noise_px", "frames"),
        [(0.0, 0.0, 1.0, 1), (0.3, 0.0, 1.0, 1), (0.0, 0.02, 1.0, 1), (0.0, 0.0, 3.0, 18)],
    )
    def test_positions_lie_in_their_ellipsoids(
        self, num_cameras, num_rigs, angle_deg, late_s, noise_px, frames
    ):
        """Errors that last are the same in all frames of a rig: many rigs are needed, and few frames of each."""
        # Noise that fades over 18 frames needs more frames.
        fades = frames > 1
        num_frames, share = (75, 0.7) if fades else (30, 0.0)
        rates = []
        for seed in range(num_rigs):
            rng, rig, position_m, velocity_m_s = world(seed, num_cameras, num_frames)
            noise = correlated(rng, (num_frames, 2, num_cameras, 2), share, frames)
            flow_px_s = views_at(rig, position_m, velocity_m_s).flow_px_s
            late_px = -flow_px_s * rng.uniform(-late_s, late_s, num_cameras)[:, None]
            stated = turned(rig, angle_deg, rng)
            views, moved_m = fitted_views(rig, stated, position_m, velocity_m_s, noise_px * noise + late_px)
            errors = learn_camera_errors(views, FPS, USUAL)
            covariance_m2 = (
                noise_covariance(views, errors) + systematic_covariances(views, errors).absolute_m2
            )
            squared = np.einsum("fdi,fdij,fdj->fd", moved_m, np.linalg.inv(covariance_m2), moved_m)
            rates.append((squared <= INSIDE_90).mean())
        # In 75 frames are four independent errors of 18 frames: Student's t widens their variance.
        assert 0.8 <= np.mean(rates) <= (0.98 if fades else 0.97)


class TestFilteredVariance:
    def test_the_variance_is_that_of_filtered_flights(self):
        rng = np.random.default_rng(10)
        frames, drones, dt_s = 200, 100, 0.04
        assumed, found = MeasurementErrors(4e-4, 0.7, 0.4), MeasurementErrors(1e-4, 0.8, 1.0)
        stated, real = filtered_variances(assumed, found, dt_s=dt_s, jerk_density_m2_s5=1.0)
        # A filter that assumes the right errors states the right variance.
        right = filtered_variances(found, found, dt_s=dt_s, jerk_density_m2_s5=1.0)
        assert right[1] == pytest.approx(right[0], rel=1e-3)
        jerk = rng.normal(size=(frames, drones, 3)) / np.sqrt(dt_s)
        position_m = jerk
        for _ in range(3):
            position_m = dt_s * np.cumsum(position_m, axis=0)
        error_m = 0.01 * correlated(rng, (frames, drones, 3), 0.8, 1.0 / dt_s)
        model = Model(density=1.0, velocity_std=1.0, acceleration_std=3.0, error_share=0.7, error_time_s=0.4)
        measured = Measurements(
            dt_s * np.arange(frames),
            position_m + error_m,
            np.tile(4e-4 * np.eye(3), (frames, drones, 1, 1)),
            np.ones((frames, drones), bool),
        )
        filtered = filter_measurements(measured, model.params(drones))
        assert filtered.covariance_m2[-1, 0, 0, 0] == pytest.approx(stated, rel=0.01)
        late_m = (filtered.position_m - position_m)[100:]
        assert np.square(late_m).mean() == pytest.approx(real, rel=0.15)

    def test_ratios_compare_found_and_stated_noise(self):
        measured = np.tile(np.eye(3) * 4e-4, (100, 3, 1, 1))
        noise = np.tile(np.eye(3) * 1e-4, (100, 3, 1, 1))
        # Of the second drone no noise is known. The last drone leaves the view of some cameras, of which the tracker
        # says less than that.
        noise[:, 1] = np.nan
        measured[50:, 2] *= 4
        noise[50:, 2] *= 16
        errors = only_noise(np.ones((4, 2)), USUAL)
        motion = MotionSettings(error_share=0.7, error_time_s=0.4)
        ratio, filtered = noise_ratios(measured, noise, errors, motion, FPS)
        np.testing.assert_allclose(ratio[:, 0], 0.25)
        np.testing.assert_allclose(ratio[:, 1], 1.0)
        np.testing.assert_allclose(ratio[:50, 2], 0.25)
        np.testing.assert_allclose(ratio[50:, 2], 1.0)
        assert ((filtered[:, 0] > 0.2) & (filtered[:, 0] < 0.6)).all()
        assert (filtered[:, 1] == 1.0).all()
        np.testing.assert_allclose(filtered[:50, 2], filtered[:50, 0], rtol=1e-3)
        np.testing.assert_allclose(filtered[50:, 2], 1.0, rtol=1e-3)
