"""Poses of cameras from known points: compared with OpenCV and exact cases, covariances, and invalid input."""

import cv2
import numpy as np
import pytest
from helpers import LENSES
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from psotrack.calibration import inflation, locate_camera, spread_px
from psotrack.errors import InputError, SettingsError
from psotrack.geometry import look_at, make_camera, project

K = np.array([[1157.0, 0, 959.5], [0, 1157.0, 539.5], [0, 0, 1]])
LENS = make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=(1920, 1080))


def view(rng, *, count=12, nearest_m=3.5, farthest_m=6.5, dist=(), K=K):
    """A camera 5 m from its target, and points at random depths, one in each cell of a grid of its image."""
    angle = rng.uniform(0, 2 * np.pi)
    R, t_m = look_at((5 * np.cos(angle), 5 * np.sin(angle), 2.0), (0.0, 0.0, 1.0))
    camera = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1920, 1080), dist=dist)
    cells = np.array([(i, j) for i in range(4) for j in range(3)] * (count // 12 + 1))[:count]
    pixels = (cells + rng.uniform(0.1, 0.9, (count, 2))) * (480, 360)
    rays = np.concatenate([pixels, np.ones((count, 1))], axis=1) @ np.linalg.inv(K).T
    # Distortion moves the pixels of the points a little; they only need to be near the middles of the cells.
    return camera, (rays * rng.uniform(nearest_m, farthest_m, (count, 1)) - t_m) @ R


def centre(T):
    return -T[:3, :3].T @ T[:3, 3]


@pytest.mark.parametrize(
    ("dist", "fisheye"),
    [((-0.02, 0.01, -0.01, 0.002), True), ((-0.2, 0.05, 0.001, 0.0, 0.0, *7 * [0.001], 0.05, 0.02), False)],
)
def test_exact_points_give_the_pose_through_a_wide_lens(dist, fisheye):
    """Points up to 70 degrees from the axis; one pixel lies where the lens shows nothing."""
    wide_K = np.array([[480.0, 0, 959.5], [0, 480.0, 539.5], [0, 0, 1]])
    R, t_m = look_at((4.0, -3.0, 2.0), (0.0, 0.0, 1.0))
    camera = make_camera(R=R, t_m=t_m, K=wide_K, image_size_wh=(1920, 1080), dist=dist, fisheye=fisheye)
    angle, around = np.radians(np.tile([10.0, 40.0, 55.0, 70.0], 3)), np.arange(12) * 2.4
    rays = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], axis=-1)
    points = (rays * np.linspace(2, 6, 12)[:, None] - t_m) @ R
    pixels = project(camera, points)[0]
    pixels[3] = (1e5, 1e5)
    located = locate_camera(points, pixels, camera)
    np.testing.assert_allclose(located.T_cam_world, camera.T_cam_world, atol=1e-7)
    assert located.used.tolist() == [index != 3 for index in range(12)]


@pytest.mark.parametrize("coefficients", sorted(LENSES))
@pytest.mark.parametrize("count", [6, 12, 29])
def test_exact_points_give_the_camera(count, coefficients):
    camera, points = view(np.random.default_rng(count), count=count, dist=LENSES[coefficients])
    located = locate_camera(points, project(camera, points)[0], camera)
    # The least squares stop at 1e-8 of the cost's scale.
    np.testing.assert_allclose(located.T_cam_world, camera.T_cam_world, atol=1e-6)
    assert located.used.all()


def test_the_pose_equals_opencvs_least_squares_pose():
    rng = np.random.default_rng(3)
    camera, points = view(rng, dist=LENSES[5])
    pixels = project(camera, points)[0] + rng.normal(0, 1, (12, 2))
    located = locate_camera(points, pixels, camera)
    turn, t_m = cv2.Rodrigues(camera.T_cam_world[:3, :3])[0], camera.T_cam_world[:3, 3:].copy()
    turn, t_m = cv2.solvePnPRefineLM(points, pixels, camera.K, camera.dist, turn, t_m)
    np.testing.assert_allclose(located.T_cam_world[:3, :3], cv2.Rodrigues(turn)[0], atol=1e-6)
    # Both searches end within a millionth of the minimum's width, which is 8 mm.
    np.testing.assert_allclose(located.T_cam_world[:3, 3], t_m.ravel(), atol=1e-6)


@pytest.mark.parametrize(
    ("nearest_m", "farthest_m"), [(2.5, 7.5), pytest.param(4.5, 5.5, marks=pytest.mark.slow)]
)
def test_twelve_points_and_a_pixel_of_noise(nearest_m, farthest_m):
    """If the points are spread in depth, the centre's error is below 1 cm at 5 m; 90 % ellipsoids contain 90 %."""
    rng, runs = np.random.default_rng(1), 50
    errors_m, distances = [], []
    for _ in range(runs):
        camera, points = view(rng, nearest_m=nearest_m, farthest_m=farthest_m)
        located = locate_camera(points, project(camera, points)[0] + rng.normal(0, 1, (12, 2)), LENS, 1.0)
        off = centre(located.T_cam_world) - camera.centre_world
        errors_m.append(np.linalg.norm(off))
        distances.append(off @ np.linalg.solve(located.centre_covariance_m2, off))
    # The limits are exceeded by chance once in a thousand tests.
    for share in (0.5, 0.9):
        inside = int((np.array(distances) < chi2.ppf(share, 3)).sum())
        assert binom.ppf(0.0005, runs, share) <= inside <= binom.ppf(0.9995, runs, share)
    if nearest_m < 3:
        # Measured in 1000 runs: median 4.6 mm, 95 % below 10.1 mm.
        assert np.median(errors_m) < 0.006
        assert np.percentile(errors_m, 90) < 0.01


def test_outliers_are_found_and_not_used():
    rng = np.random.default_rng(5)
    camera, points = view(rng, count=13)
    pixels = project(camera, points)[0] + rng.normal(0, 1, (13, 2))
    wrong = np.array([1, 4, 8, 11])
    spoilt = pixels.copy()
    spoilt[wrong] += rng.uniform(60, 400, (4, 2)) * rng.choice([-1, 1], (4, 2))
    located = locate_camera(points, spoilt, LENS)
    assert np.flatnonzero(~located.used).tolist() == wrong.tolist()
    without = locate_camera(np.delete(points, wrong, 0), np.delete(pixels, wrong, 0), LENS)
    # Both use the same points, but start from different poses.
    np.testing.assert_allclose(located.T_cam_world, without.T_cam_world, atol=1e-6)
    assert (located.residual_px[wrong] > 30).all()


def test_noise_larger_than_stated_widens_the_covariance():
    rng = np.random.default_rng(6)
    camera, points = view(rng, count=36)
    off = rng.normal(0, 1, (36, 2))
    small = locate_camera(points, project(camera, points)[0] + off, LENS, noise_px=1.0)
    large = locate_camera(points, project(camera, points)[0] + 4 * off, LENS, noise_px=1.0)
    assert large.used.all()
    ratio = np.sqrt(large.centre_covariance_m2.trace() / small.centre_covariance_m2.trace())
    # 36 points determine the standard deviation to 10 %.
    assert 3 < ratio < 5


def test_points_in_a_plane_determine_the_pose():
    rng = np.random.default_rng(7)
    R, t_m = look_at((4.0, 1.0, 2.5), (0.0, 0.0, 0.0))
    camera = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1920, 1080))
    points = np.concatenate([rng.uniform(-1.5, 1.5, (12, 2)), np.zeros((12, 1))], axis=1)
    located = locate_camera(points, project(camera, points)[0] + rng.normal(0, 1, (12, 2)), LENS)
    off = centre(located.T_cam_world) - camera.centre_world
    # The 99.9 % ellipsoid contains the true centre.
    assert off @ np.linalg.solve(located.centre_covariance_m2, off) < chi2.ppf(0.999, 3)


@settings(max_examples=8)
@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-20, 20)] * 3))
def test_moving_the_world_moves_the_camera_with_it(turn, shift_m):
    rng = np.random.default_rng(8)
    camera, points = view(rng)
    pixels = project(camera, points)[0] + rng.normal(0, 1, (12, 2))
    R = Rotation.from_rotvec(turn).as_matrix()
    here = locate_camera(points, pixels, LENS)
    there = locate_camera(points @ R.T + shift_m, pixels, LENS)
    np.testing.assert_allclose(
        centre(there.T_cam_world), R @ centre(here.T_cam_world) + shift_m, rtol=0, atol=1e-5
    )
    # Relative to variances of 1e-5 m².
    np.testing.assert_allclose(
        there.centre_covariance_m2, R @ here.centre_covariance_m2 @ R.T, rtol=0, atol=1e-8
    )


def error_message(points, pixels, *, noise_px=1.0):
    """Message of the error for these points, which must be one line with the name of the camera."""
    with pytest.raises(InputError) as error:
        locate_camera(points, pixels, LENS, noise_px, name="camera c7")
    assert str(error.value).startswith("camera c7: ")
    assert "\n" not in str(error.value)
    return str(error.value)


def test_points_that_determine_no_pose_are_refused():
    rng = np.random.default_rng(9)
    camera, points = view(rng)
    pixels = project(camera, points)[0]
    assert "at least 4 points of known position, found 3" in error_message(points[:3], pixels[:3])
    line = np.array([0, 0, 1.0]) + np.arange(5)[:, None] * np.array([0.2, 0.1, 0.05])
    assert "not all on one line" in error_message(line, project(camera, line)[0])
    broken = points.copy()
    broken[2, 1] = np.nan
    assert "NaN" in error_message(broken, pixels)
    mirrored = error_message(points * np.array([1, -1, 1]), pixels)
    assert "right-handed axes" in mirrored
    assert "mirrored" in mirrored
    assert "mixed up" in error_message(points, pixels[rng.permutation(12)])
    with pytest.raises(SettingsError, match="noise_px"):
        locate_camera(points, pixels, LENS, 0.0)


def test_a_small_plane_far_away_has_two_poses():
    """A sheet of 20 cm at a distance of 8 m, tilted a little, looks the same if it is tilted to the other side."""
    R, t_m = look_at((0.9, 0.0, 8.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    camera = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1920, 1080))
    sheet = np.array([(x, y, 0) for x in (-0.1, 0.0, 0.1) for y in (-0.1, 0.1)])
    rng = np.random.default_rng(0)
    assert "two poses" in error_message(sheet, project(camera, sheet)[0] + rng.normal(0, 0.5, (6, 2)))


def test_spread_and_inflation():
    rng = np.random.default_rng(10)
    distance = np.linalg.norm(rng.normal(0, 2.0, (20001, 2)), axis=1)
    # A median of 20,000 values has an error of 1 %.
    assert spread_px(distance, 0) == pytest.approx(2.0, rel=0.03)
    assert spread_px(distance, 20001) == pytest.approx(2.0 * np.sqrt(2), rel=0.03)
    assert spread_px(np.ones(3), 6) == 0.0
    assert inflation(24.0, 18) == 1.0
    assert inflation(180.0, 18) == 10.0
    assert inflation(5.0, 0) == 1.0
