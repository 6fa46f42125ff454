"""Triangulated and refined points: the oracles are equations (3) of the paper, OpenCV, SciPy, and simulated noise."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import (
    LENSES,
    make_unnamed_rig,
    move_world,
    opencv_pixels,
    points_in_room,
    posed,
    project_points,
    ring_rig,
    simple_lens,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from psotrack.geometry import project, reconstruct, triangulate, triangulate_linearly


def noisy_pixels(rig, points, seed=0, noise_px=1.0):
    pixels = project_points(rig, points)
    return pixels + np.random.default_rng(seed).normal(size=pixels.shape) * np.asarray(noise_px)[..., None]


# --- linear points


def test_linear_points_are_weighted_least_squares_of_the_views_that_see_them():
    """Equations (3) of the paper, solved by `lstsq`, with noise so that no point solves them exactly."""
    rig = ring_rig(5)
    pixels = noisy_pixels(rig, points_in_room(11))
    weights = np.random.default_rng(2).uniform(0.1, 2, (11, 5))
    weights[:3, 1] = 0.0
    pixels[2:5, 3, 0] = np.nan
    found = triangulate_linearly(rig.cameras, pixels, weights)
    for n in range(11):
        rows, right = [], []
        for c in np.flatnonzero((weights[n] > 0) & np.isfinite(pixels[n, :, 0])):
            x, y, _ = np.linalg.inv(rig.cameras.K[c]) @ (*pixels[n, c], 1)
            r1, r2, r3, _ = np.sqrt(weights[n, c]) * rig.cameras.T_cam_world[c]
            for row in (x * r3 - r1, y * r3 - r2):
                rows.append(row[:3])
                right.append(-row[3])
        expected, *_ = np.linalg.lstsq(np.array(rows), np.array(right))
        # Normal equations square the condition number, here about 10.
        np.testing.assert_allclose(found[n], expected, atol=1e-10)


# --- exact cases


@pytest.mark.parametrize("refine", [True, False])
@pytest.mark.parametrize("coefficients", sorted(LENSES))
@pytest.mark.parametrize(("num_cameras", "shape"), [(2, (7,)), (5, ()), (7, (3, 0)), (7, (3, 2))])
def test_exact_pixels_give_the_point(num_cameras, shape, coefficients, refine):
    rig = ring_rig(num_cameras, coefficients=coefficients)
    points = points_in_room(*shape)
    found = reconstruct(rig.cameras, project_points(rig, points), refine=refine)
    assert found.covariance_m2.shape == (*shape, 3, 3)
    assert found.used.shape == (*shape, num_cameras)
    assert found.used.all()
    # Pixels are undistorted to 1e-8, which is 4e-8 m at 4 m; two cameras enlarge the error a little.
    # The refinement does not undistort: its last step is smaller than
    # 1e-4 standard deviations of 5 to 20 mm, and it converges quadratically: measured 1e-9.
    tolerance_m, tolerance_px = (1e-8, 1e-5) if refine else (1e-6, 1e-3)
    np.testing.assert_allclose(found.position_m, points, atol=tolerance_m)
    np.testing.assert_allclose(found.reprojection_px, np.zeros(found.used.shape), atol=tolerance_px)


# --- least squares


@pytest.mark.parametrize("coefficients", LENSES)
def test_refined_points_agree_with_scipy(coefficients):
    """Levenberg-Marquardt on OpenCV's pixels, with a noise and a weight per view; its Jacobian gives the covariance.

    Three bugs of other programs: undistortion with the distorted radius, the intrinsics of the first two cameras used
    for every pair, and poses of the wrong cameras. Each camera of the rig has a focal length of its own.
    """
    rig = ring_rig(5, coefficients=coefficients)
    points = points_in_room(7)
    rng = np.random.default_rng(3)
    noise_px = rng.uniform(0.5, 4.0, (7, 5))
    weights = rng.uniform(0.2, 3.0, (7, 5))
    pixels = noisy_pixels(rig, points, noise_px=noise_px)
    pixels[2, 3] = np.nan
    weights[4, 1] = 0.0
    found = reconstruct(rig.cameras, pixels, weights, noise_px=noise_px, robust=False)
    scale = np.sqrt(weights) / noise_px
    scale[2, 3] = 0.0
    np.testing.assert_array_equal(found.used, scale > 0)
    for n in range(7):

        def off_px(point, n=n):
            """(cameras, 2), NaN for a view that sees nothing."""
            seen = [opencv_pixels(rig.cameras[camera], point) for camera in range(5)]
            return np.array(seen) - pixels[n]

        def off(point, n=n, off_px=off_px):
            return np.nan_to_num(off_px(point) * scale[n][:, None]).ravel()

        expected = least_squares(off, points[n], method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
        # The last step is below 1e-4 standard deviations, which are below 2 cm: 2e-6 m; measured 2e-8 m.
        np.testing.assert_allclose(found.position_m[n], expected.x, rtol=0, atol=2e-6)
        # SciPy's Jacobian is by finite differences, to 1e-8 of itself, which the inverse makes 1e-6.
        covariance_m2 = np.linalg.inv(expected.jac.T @ expected.jac)
        np.testing.assert_allclose(found.covariance_m2[n], covariance_m2, rtol=1e-4, atol=1e-9)
        # Views that are not used have a distance too; views that see nothing have NaN.
        distance_px = np.linalg.norm(off_px(expected.x), axis=-1)
        np.testing.assert_allclose(found.reprojection_px[n], distance_px, rtol=0, atol=1e-3)


def test_refined_points_are_never_worse_than_linear_points():
    """Also within a metre of a camera with noise of half a drone's width, where Gauss-Newton steps overshoot."""
    rig = ring_rig(2)
    nearness = np.random.default_rng(0).uniform(0.8, 0.98, (3000, 1))
    points = nearness * rig.cameras.centre_world[0] + (1 - nearness) * np.array([0.1, -0.1, 1.2])
    pixels = noisy_pixels(rig, points, noise_px=20.0).clip(-2000, 2000)
    linear = reconstruct(rig.cameras, pixels, robust=False, refine=False)
    refined = reconstruct(rig.cameras, pixels, robust=False)
    both = (linear.used & refined.used).all(axis=-1)
    assert both.sum() > 1000
    linear_px2 = (linear.reprojection_px[both] ** 2).sum(axis=-1)
    refined_px2 = (refined.reprojection_px[both] ** 2).sum(axis=-1)
    assert (refined_px2 <= linear_px2 * (1 + 1e-9)).all()


# --- simulated noise


@pytest.mark.parametrize("num_cameras", [2, 3, 7])
def test_the_covariance_agrees_with_simulated_noise(num_cameras):
    """90 % of the points are inside the 90 % ellipsoid; the mean squared Mahalanobis distance is 3, as for χ²(3)."""
    rig = ring_rig(num_cameras, coefficients=5, image_size_wh=(960, 720))
    point, draws = np.array([0.4, -0.3, 1.1]), 4000
    noise_px = np.linspace(0.5, 3.0, num_cameras)
    pixels = noisy_pixels(rig, np.broadcast_to(point, (draws, 3)), noise_px=noise_px)
    found = reconstruct(rig.cameras, pixels, noise_px=noise_px, robust=False)
    off = found.position_m - point
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.covariance_m2), off)
    low, high = binom.interval(1 - 1e-4, draws, 0.9)
    assert low <= (squared < chi2.ppf(0.9, 3)).sum() <= high
    # Four standard errors of sqrt(6 / draws) = 0.04, and 0.02 for the nonlinearity of the projection over 3 px.
    assert abs(squared.mean() - 3) < 0.18


@pytest.mark.parametrize("noise_px", [0.2, 2.0, 8.0])
def test_the_noise_is_learned_where_some_views_are_wrong(noise_px):
    """Positions and covariances are those of the known noise; one wrong view in ten is left out."""
    rig = ring_rig(6, image_size_wh=(1920, 1080))
    points = points_in_room(150)
    pixels = noisy_pixels(rig, points, noise_px=noise_px)
    rng = np.random.default_rng(4)
    wrong = rng.random(pixels.shape[:2]) < 0.1
    pixels[wrong] += 300 * rng.normal(size=(wrong.sum(), 2))
    learned = reconstruct(rig.cameras, pixels)
    known = reconstruct(rig.cameras, pixels, noise_px=noise_px)
    # The standard error of the noise from 800 views is 3 %; a covariance is in proportion to the noise squared.
    ratio = np.median(learned.covariance_m2 / known.covariance_m2)
    assert 0.8 < ratio < 1.25
    assert (learned.used == known.used).mean() > 0.99
    assert (learned.used & wrong).sum() < 0.05 * wrong.sum()
    np.testing.assert_array_equal(triangulate(rig.cameras, pixels), learned.position_m)
    linear_m = triangulate_linearly(rig.cameras, pixels)
    error_m = np.linalg.norm(learned.position_m - points, axis=-1)
    linear_error_m = np.linalg.norm(linear_m - points, axis=-1)
    # About half of the points have a wrong view.
    assert np.median(error_m) < 0.7 * np.median(linear_error_m)


def test_few_views_do_not_show_the_noise():
    rig = ring_rig(4)
    pixels = noisy_pixels(rig, points_in_room(4), noise_px=5.0)
    learned = reconstruct(rig.cameras, pixels)
    stated = reconstruct(rig.cameras, pixels, noise_px=1.0)
    np.testing.assert_array_equal(learned.covariance_m2, stated.covariance_m2)


@pytest.mark.parametrize("num_cameras", [3, 4, 8])
@pytest.mark.parametrize("false_alarm", [0.05, 0.01])
def test_correct_views_are_left_out_with_the_promised_probability(num_cameras, false_alarm):
    rig, draws = ring_rig(num_cameras, image_size_wh=(960, 720)), 10_000
    noise_px = np.linspace(0.5, 2.0, num_cameras)
    pixels = noisy_pixels(rig, points_in_room(draws), noise_px=noise_px)
    found = reconstruct(rig.cameras, pixels, noise_px=noise_px, false_alarm=false_alarm)
    lost = (~found.used.all(axis=-1)).sum()
    assert lost <= binom.ppf(1 - 1e-4, draws, false_alarm)
    # A much lower rate would mean that the gate is too wide. Of three views, one is left out only on strong evidence.
    assert lost >= (binom.ppf(1e-4, draws, 0.6 * false_alarm) if num_cameras > 3 else 1)


# --- views that disagree


@pytest.mark.parametrize(
    ("num_cameras", "num_wrong", "off_px"), [(4, 1, 15.0), (5, 1, 60.0), (8, 1, 300.0), (8, 3, 100.0)]
)
def test_wrong_views_are_left_out(num_cameras, num_wrong, off_px):
    rig = ring_rig(num_cameras, coefficients=4)
    pixels = noisy_pixels(rig, points_in_room(120))
    rng = np.random.default_rng(0)
    wrong = rng.random((120, num_cameras)).argsort(axis=1) < num_wrong
    angle = rng.uniform(0, 2 * np.pi, wrong.sum())
    pixels[wrong] += off_px * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    found = reconstruct(rig.cameras, pixels)
    # Wrong views may agree with others by chance. Of 4000 points in each case, other views than the wrong ones are left
    # out at 45, 0, 5 and 90: at most 2.3 %, and of 120 points at more than 10 once in ten thousand times.
    right = (found.used == ~wrong).all(axis=1)
    assert (~right).sum() <= 10
    assert (found.reprojection_px[right][wrong[right]] > 0.5 * off_px).all()
    # The point equals the point from the other views alone.
    linear = reconstruct(rig.cameras, pixels, refine=False)
    pixels[wrong] = np.nan
    alone = reconstruct(rig.cameras, pixels, robust=False)
    linear_alone = reconstruct(rig.cameras, pixels, refine=False, robust=False)
    np.testing.assert_allclose(found.position_m[right], alone.position_m[right], rtol=0, atol=2e-6)
    np.testing.assert_allclose(found.covariance_m2[right], alone.covariance_m2[right], rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(linear.position_m[right], linear_alone.position_m[right], rtol=0, atol=1e-9)


def epipolar_direction(rig, of, to, point):
    """Unit vector in the image of camera `of` along the projected line of sight of camera `to` through the point."""
    nearer = point + 0.02 * (rig.cameras.centre_world[to] - point)
    there, beside = project_points(rig, np.stack([point, nearer]))[:, of]
    return (beside - there) / np.linalg.norm(beside - there)


def test_of_three_views_the_wrong_one_is_found_only_if_the_others_alone_agree():
    rig = ring_rig(5).select(["c0", "c1", "c3"])
    point = np.array([0.2, 0.1, 1.2])
    exact = project_points(rig, point)
    second = epipolar_direction(rig, 0, 1, point)
    third = epipolar_direction(rig, 0, 2, point)
    # The error is across both epipolar lines: neither of the other views agrees with the wrong view.
    between = second - third * np.sign(second @ third)
    across = exact.copy()
    across[0] += 30 * between / np.linalg.norm(between)
    # The error is along the second camera's epipolar line: the wrong view agrees with the second view, and the second
    # view agrees with the third.
    on_line = exact.copy()
    on_line[0] += 30 * second
    found = reconstruct(rig.cameras, np.stack([exact, across, on_line]))
    assert found.used.tolist() == [[True] * 3, [False, True, True], [True] * 3]
    np.testing.assert_allclose(found.position_m[:2], [point, point], atol=1e-6)
    # The reprojection errors show the disagreement.
    assert found.reprojection_px[2].max() > 3


def test_two_cameras_at_one_position_do_not_outvote_a_third():
    """Two such cameras always agree with each other, and without the third camera there is no depth."""
    one, _, other, _, _ = ring_rig(5).cameras
    T = one.T_cam_world.copy()
    T[:3, 3] += (0.02, 0.0, 0.0)
    beside = replace(one, T_cam_world=T)
    rig = make_unnamed_rig(one, beside, other)
    point = np.array([0.2, 0.1, 1.2])
    pixels = project_points(rig, point)
    x, y = epipolar_direction(rig, 2, 0, point)
    pixels[2] += 40 * np.array([-y, x])
    found = reconstruct(rig.cameras, pixels)
    assert found.used.all()
    assert found.reprojection_px.max() > 10


def test_without_agreement_no_view_is_left_out():
    rig = ring_rig(6)
    pixels = np.random.default_rng(7).uniform((0, 0), (320, 240), (50, 6, 2))
    found = reconstruct(rig.cameras, pixels)
    whole = found.used.all(axis=-1)
    # Three of six rays may meet by chance, but rarely.
    assert whole.sum() > 25
    assert (found.reprojection_px[whole].max(axis=-1) > 5).all()
    expected = reconstruct(rig.cameras, pixels, robust=False)
    np.testing.assert_allclose(found.position_m[whole], expected.position_m[whole], atol=1e-4)


# --- ordinary trouble


def assert_no_point(found):
    """Nothing is known of the points, and no view is used."""
    for values in (found.position_m, found.covariance_m2, found.reprojection_px):
        assert np.isnan(values).all()
    assert not found.used.any()


NARROW = simple_lens(300.0, (320, 240))


def test_views_that_determine_no_point_give_nan():
    rig = ring_rig(5)
    points = points_in_room(2)
    pixels = project_points(rig, points)
    for num_seeing in (0, 1):
        sees = np.arange(5) < num_seeing
        few = np.where(sees[:, None], pixels, np.nan)
        assert_no_point(reconstruct(rig.cameras, few))
        weights = np.tile(sees, (2, 1)).astype(float)
        assert_no_point(reconstruct(rig.cameras, pixels, weights))
    one = rig.cameras[0]
    at_one_place = make_unnamed_rig(one, one, one)
    assert_no_point(reconstruct(at_one_place.cameras, project_points(at_one_place, points)))
    left = posed(NARROW, (-1, 0, 1), (-1.5, 3, 1))
    right = posed(NARROW, (1, 0, 1), (1.5, 3, 1))
    apart = make_unnamed_rig(left, right)
    # The rays meet behind the cameras.
    assert_no_point(reconstruct(apart.cameras, np.full((2, 2, 2), 130.0)))


def test_a_camera_that_looks_away_is_left_out():
    """The point is behind the last camera; the pixel of this camera belongs to another object."""
    point = np.array([0.2, 0.1, 1.2])
    away = posed(NARROW, (0, 3, 1.2), (0, 6, 1.2))
    rig = make_unnamed_rig(*ring_rig(4).cameras, away)
    pixels = project_points(rig, point)
    pixels[4] = [160.0, 120.0]
    found = reconstruct(rig.cameras, pixels)
    assert found.used.tolist() == [True] * 4 + [False]
    np.testing.assert_allclose(found.position_m, point, atol=1e-6)
    assert np.isinf(found.reprojection_px[4])
    assert np.isfinite(found.reprojection_px[:4]).all()


def test_a_camera_whose_lens_shows_nothing_there_is_left_out():
    """A lens that folds in the image shows no point at the corners."""
    point = np.array([0.2, 0.1, 1.2])
    folds = replace(ring_rig(5).cameras, dist=np.tile([-0.9, 0.0, 0.0, 0.0], (5, 1)))
    pixels, _ = project(folds, point[None])
    pixels[1] = [319.0, 239.0]
    np.testing.assert_allclose(triangulate_linearly(folds, pixels), point, atol=1e-9)
    pixels[1:] = [319.0, 239.0]
    assert np.isnan(triangulate_linearly(folds, pixels)).all()


# --- invariants


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_points_move_with_the_world_and_the_order_of_cameras_does_not_matter(seed):
    """Views with noise, gaps and wrong pixels."""
    rng = np.random.default_rng(seed)
    rig = ring_rig(6, coefficients=4)
    pixels = noisy_pixels(rig, points_in_room(9, seed=seed), seed=seed)
    pixels[rng.random((9, 6)) < 0.15] = np.nan
    pixels[rng.random((9, 6)) < 0.1] += 50.0
    R = Rotation.random(rng=seed).as_matrix()
    shift_m = 10 * rng.normal(size=3)
    order = rng.permutation(6)
    moved = move_world(rig, R, shift_m)
    one = reconstruct(rig.cameras, pixels)
    other = reconstruct(moved.cameras[order], pixels[:, order])
    np.testing.assert_array_equal(one.used[:, order], other.used)
    # Sums have another order, and a last step below 1e-4 standard deviations may be taken in one case only.
    moved_m = one.position_m @ R.T + shift_m
    np.testing.assert_allclose(moved_m, other.position_m, rtol=0, atol=2e-6)
    np.testing.assert_allclose(one.reprojection_px[:, order], other.reprojection_px, rtol=1e-3, atol=1e-3)
    turned_m2 = R @ one.covariance_m2 @ R.T
    np.testing.assert_allclose(turned_m2, other.covariance_m2, rtol=1e-3, atol=1e-9)
