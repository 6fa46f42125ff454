"""Poses from the markers of one frame: exact cases, SciPy, random draws, wrong markers, second poses, refused input."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import LENSES
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import approx_fprime, least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import look_at, make_camera, project
from psotrack.inside_out import PoseSettings
from psotrack.inside_out.pose import ExpectedPose, estimate_pose
from psotrack.inside_out.pose.equations import (
    INSET_STD_PX,
    Noise,
    equations,
    seen_markers,
    summed,
)
from psotrack.inside_out.pose.fit import FALSE_ALARM

K = np.array([[920.0, 0, 959.5], [0, 921.0, 539.5], [0, 0, 1]])
SETTINGS = PoseSettings()
ANY_NUMBER = PoseSettings(min_markers=1)
SIDE_M = 0.3


def marker(centre_m, right, down, side_m=SIDE_M):
    """Corners (4, 3) of a marker, clockwise from the top left when seen from the front."""
    right, down = np.asarray(right, float), np.asarray(down, float)
    offsets = [-right - down, right - down, right + down, -right + down]
    return np.asarray(centre_m) + side_m / 2 * np.array(offsets)


def two_walls(count=10):
    """Corners (count, 4, 3) of markers on the walls y = 4 and x = 5, at three heights."""
    on_y = [marker((x, 4.0, 1.2 + 0.7 * (i % 3)), (1, 0, 0), (0, 0, -1)) for i, x in enumerate(range(5))]
    on_x = [
        marker((5.0, 3.0 - y, 1.5 + 0.7 * (i % 3)), (0, -1, 0), (0, 0, -1)) for i, y in enumerate(range(5))
    ]
    return np.array([one for pair in zip(on_y, on_x, strict=True) for one in pair])[:count]


def one_wall(count=9):
    """Corners (count, 4, 3) of markers on the wall y = 4."""
    return np.array([marker((x - 1, 4.0, z + 1), (1, 0, 0), (0, 0, -1)) for x in range(3) for z in range(3)])[
        :count
    ]


def camera_looking_at(centre_m=(-0.8, -2.5, 1.3), target_m=(3.0, 3.0, 1.8), coefficients=0, K=K):
    R, t_m = look_at(tuple(centre_m), tuple(target_m))
    return make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1920, 1080), dist=LENSES[coefficients])


def with_lens(view, dist, *, fisheye=False):
    T = view.T_cam_world
    return make_camera(
        R=T[:3, :3], t_m=T[:3, 3], K=view.K, image_size_wh=(1920, 1080), dist=dist, fisheye=fisheye
    )


def longer_lens(view, by):
    """The camera with a focal length that is longer by the share `by`."""
    return replace(view, K=view.K * np.array([[1 + by, 1 + by, 1], [1 + by, 1 + by, 1], [1, 1, 1]]))


def without_pose(view):
    """The camera without its pose."""
    return replace(view, T_cam_world=np.eye(4))


def image_corners(view, corners_m, rng=None, noise_px=0.0):
    pixels = project(view, corners_m)[0]
    return pixels if rng is None else pixels + noise_px * rng.normal(size=pixels.shape)


def pose_error(found, view):
    """Errors (6,) in the covariance's order: position along the world's axes, and turn about the camera's axes."""
    R_world_cam = view.T_cam_world[:3, :3].T
    turn = Rotation.from_matrix(found.R_world_cam.T @ R_world_cam).as_rotvec()
    return np.concatenate([view.centre_world - found.position_m, turn])


def squared_deviations(found, view):
    off = pose_error(found, view)
    return off @ np.linalg.solve(found.covariance, off)


@pytest.mark.parametrize("coefficients", sorted(LENSES))
@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 10])
def test_exact_corners_give_the_pose_exactly(coefficients, count):
    view, corners_m = camera_looking_at(coefficients=coefficients), two_walls(count)
    found = estimate_pose(image_corners(view, corners_m), corners_m, without_pose(view), ANY_NUMBER)
    # The last step converges quadratically, so the remaining error is far below a standard deviation.
    np.testing.assert_allclose(pose_error(found, view), 0, atol=1e-9)
    assert found.used.all()
    assert found.reprojection_px < 1e-6
    assert found.ambiguity < 1e-3


@pytest.mark.parametrize(
    ("dist", "fisheye"),
    [((-0.02, 0.01, -0.01, 0.002), True), ((-0.2, 0.05, 0.001, 0.0, 0.0, *7 * [0.001], 0.05, 0.02), False)],
)
def test_a_pose_through_every_lens_model(dist, fisheye):
    at = camera_looking_at(K=np.array([[620.0, 0, 959.5], [0, 621.0, 539.5], [0, 0, 1]]))
    view, corners_m = with_lens(at, dist, fisheye=fisheye), two_walls(7)
    found = estimate_pose(image_corners(view, corners_m), corners_m, without_pose(view), ANY_NUMBER)
    np.testing.assert_allclose(pose_error(found, view), 0, atol=1e-8)
    assert found.used.all()


def test_markers_where_the_lens_shows_nothing_are_not_used():
    """x (1 - k r²) grows up to 2 / 3 / sqrt(3 k), which is 354 px: another marker is claimed outside of this circle."""
    view = with_lens(
        camera_looking_at(K=np.array([[400.0, 0, 959.5], [0, 400.0, 539.5], [0, 0, 1]])),
        (-0.19, 0.0, 0.0, 0.0),
    )
    corners_m = two_walls(7)
    corners_px = image_corners(view, corners_m)
    corners_px[2] += [900.0, 0.0]
    found = estimate_pose(corners_px, corners_m, without_pose(view), ANY_NUMBER)
    np.testing.assert_allclose(pose_error(found, view), 0, atol=1e-6)
    assert found.used.tolist() == [number != 2 for number in range(7)]
    assert found.common.shape == (6, 22)
    assert not found.common[:, 6:9].any()


def test_derivatives_equal_finite_differences():
    view, corners_m = camera_looking_at(coefficients=8), two_walls(3)
    corners = seen_markers(
        image_corners(view, corners_m), corners_m, without_pose(view), 0.3, 1e-4, focal_error=0.005
    )
    R_world_cam = view.T_cam_world[:3, :3].T

    def off_px(x):
        turned = R_world_cam @ Rotation.from_rotvec(x[3:6]).as_matrix()
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turned.T, -turned.T @ (view.centre_world + x[:3])
        longer = longer_lens(replace(view, T_cam_world=T), 0.005 * x[7])
        return (project(longer, corners_m)[0] + x[6] * corners.inward).ravel()

    rows, depth_m = equations(corners, view.centre_world, R_world_cam, np.zeros(2))
    slopes = approx_fprime(np.zeros(8), off_px, 1e-7).reshape(3, 4, 2, 8)
    # A finite step of 1e-7 has an error of 1e-5 px from curvature and of 1e-6 px from rounding.
    np.testing.assert_allclose(rows[..., :8], slopes, rtol=1e-4, atol=0.01)
    np.testing.assert_allclose(depth_m, project(view, corners_m)[1], rtol=1e-12)


def test_elimination_equals_scipys_least_squares_over_all_unknowns():
    """Unknowns: pose, inset, focal length, markers' offsets. Errors common to all frames move the pose as in SciPy."""
    rng = np.random.default_rng(0)
    view, corners_m = camera_looking_at(coefficients=4), two_walls(6)
    noise, count, focal_error = Noise(0.4**2, 0.003**2, 10.0, 10.0), 6, 0.005
    placed_m = corners_m + 0.003 * rng.normal(size=(count, 1, 3))
    corners_px = image_corners(longer_lens(view, 0.003), placed_m, rng, 0.4)
    # A share of 0.6 of the stated deviation of a marker is an error of the map.
    corners = seen_markers(corners_px, corners_m, without_pose(view), 0.4, 0.0024, 0.0018, focal_error)
    position_m, R, nuisance = view.centre_world, view.T_cam_world[:3, :3].T, np.zeros(2)
    for _ in range(6):
        sums = summed(equations(corners, position_m, R, nuisance)[0], np.ones((count, 4), bool))
        solution = sums.solved(noise, corners.prior_information, nuisance)
        position_m, nuisance = position_m + solution.step[:3], nuisance + solution.step[6:]
        R = R @ Rotation.from_rotvec(solution.step[3:6]).as_matrix()

    def best_for(corners_px, start):
        def residuals(x):
            turned = R @ Rotation.from_rotvec(x[3:6]).as_matrix()
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = turned.T, -turned.T @ (position_m + x[:3])
            there = longer_lens(replace(view, T_cam_world=T), focal_error * x[7])
            pixels = project(there, corners_m + x[8:].reshape(count, 1, 3))[0] + x[6] * corners.inward
            prior = [x[8:] / 0.003, [x[6] / INSET_STD_PX, x[7]]]
            return np.concatenate([((corners_px - pixels) / 0.4).ravel(), *prior])

        return least_squares(residuals, start, "3-point", x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-12)

    start = np.zeros(8 + 3 * count)
    start[6:8] = nuisance
    result = best_for(corners_px, start)
    deviation = np.sqrt(np.diag(solution.covariance))
    # Derivatives are mapped_m at the markers' positions in the map, 3 mm from their fitted positions at 5 m.
    np.testing.assert_allclose((result.x[:8] - start[:8]) / deviation, 0, atol=0.01)
    expected = np.linalg.inv(result.jac.T @ result.jac)[:8, :8]
    np.testing.assert_allclose(
        solution.covariance / np.outer(deviation, deviation),
        expected / np.outer(deviation, deviation),
        atol=0.01,
    )

    common = sums.common(solution, noise, corners.map_share)
    there, off_m = longer_lens(view, 0.003), np.zeros((count, 1, 3))
    off_m[4, 0, 2] = 0.003 * 0.6
    for column, changed_view, moved_m in (
        (3 * 4 + 2, there, placed_m + off_m),
        (-1, longer_lens(view, 0.003 + focal_error), placed_m),
    ):
        by_px = project(changed_view, moved_m)[0] - project(there, placed_m)[0]
        moved = best_for(corners_px + by_px, result.x).x[:6] - result.x[:6]
        # The problem is nearly linear, and the covariance is good to a hundredth.
        np.testing.assert_allclose(common[:6, column] / deviation[:6], moved / deviation[:6], atol=0.02)


def test_the_pose_equals_scipys_for_an_exact_map():
    rng = np.random.default_rng(1)
    view, corners_m = camera_looking_at(coefficients=5), two_walls(8)
    corners_px = image_corners(view, corners_m, rng, 0.3)
    lens = without_pose(view)
    found = estimate_pose(corners_px, corners_m, lens, PoseSettings(noise_px=0.3, place_m=1e-7))
    inward = seen_markers(corners_px, corners_m, lens, 0.3, 1e-7).inward

    def residuals(x):
        R = Rotation.from_rotvec(x[3:6]).as_matrix()
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, -R @ x[:3]
        off_px = corners_px - project(replace(view, T_cam_world=T), corners_m)[0] - x[6] * inward
        return np.append(off_px.ravel() / 0.3, x[6] / INSET_STD_PX)

    start = np.concatenate(
        [view.centre_world, Rotation.from_matrix(view.T_cam_world[:3, :3]).as_rotvec(), [0.0]]
    )
    result = least_squares(residuals, start, x_scale="jac", xtol=1e-14, ftol=1e-14)
    deviation_m = np.sqrt(np.diag(found.covariance)[:3])
    # The noise is estimated, so the prior of the inset has a slightly different weight than in SciPy's problem.
    np.testing.assert_allclose((found.position_m - result.x[:3]) / deviation_m, 0, atol=0.02)


def random_estimates(rng, count, noise_px, place_m, stated, number):
    """Estimated poses and true cameras, with random positions of the camera, noise of corners and marker offsets."""
    for _ in range(number):
        view = camera_looking_at(
            rng.uniform((-1.5, -3, 0.8), (0.0, -1, 2)), rng.uniform((2.5, 3, 1.2), (3.5, 3.5, 2.2))
        )
        corners_m = two_walls(count)
        placed_m = corners_m + place_m * rng.normal(size=(count, 1, 3))
        yield (
            estimate_pose(
                image_corners(view, placed_m, rng, noise_px), corners_m, without_pose(view), stated
            ),
            view,
        )


@pytest.mark.parametrize(
    ("noise_px", "place_m", "stated", "least"),
    [
        pytest.param(0.2, 0.0, SETTINGS, 0.85, id="as stated"),
        pytest.param(1.0, 0.0, SETTINGS, 0.85, id="more noise than stated"),
        pytest.param(0.1, 0.0, SETTINGS, 0.85, id="less noise than stated"),
        pytest.param(0.3, 0.003, PoseSettings(place_m=0.003), 0.85, id="marker offsets as stated"),
        # The variance of the offsets of 8 markers is not well known, because the pose takes up 6 unknowns.
        pytest.param(0.3, 0.003, SETTINGS, 0.7, id="marker offsets thirty times as stated"),
    ],
)
@pytest.mark.slow
def test_covariances_agree_with_the_errors(noise_px, place_m, stated, least):
    poses = random_estimates(np.random.default_rng(2), 8, noise_px, place_m, stated, 120)
    squares = np.array([squared_deviations(found, view) for found, view in poses])
    share = np.mean(squares < chi2.ppf(0.9, 6))
    # A limit of three standard deviations of a share of 120.
    assert share > least - 3 * np.sqrt(least * (1 - least) / 120)
    # The covariance must not be too wide either: deviations are at most one and a half times too large.
    assert np.median(squares) > chi2.median(6) / 1.5**2


@pytest.mark.parametrize(
    ("map_error_m", "focal_error"), [(0.002, 0.0), (0.0, 0.005), (0.002, 0.005)], ids=["map", "focal", "both"]
)
@pytest.mark.slow
def test_covariance_includes_errors_of_the_map_and_of_the_focal_length(map_error_m, focal_error):
    """Six markers with noise of 0.1 px; each pose has another map and another lens."""
    rng = np.random.default_rng(12)
    with_errors = PoseSettings(map_error_m=map_error_m, focal_error=focal_error)
    views = [view for _, view in random_estimates(np.random.default_rng(13), 6, 0.1, 0.0, SETTINGS, 100)]
    limit, corners_m = chi2.ppf(0.9, 3), two_walls(6)
    inside, inside_without, off_m, off_without_m = [], [], [], []
    for view in views:
        placed_m = corners_m + map_error_m * rng.normal(size=(6, 1, 3))
        corners_px = image_corners(longer_lens(view, focal_error * rng.normal()), placed_m, rng, 0.1)
        for stated, within, off in (
            (with_errors, inside, off_m),
            (SETTINGS, inside_without, off_without_m),
        ):
            found = estimate_pose(corners_px, corners_m, without_pose(view), stated)
            miss_m = view.centre_world - found.position_m
            within.append(miss_m @ np.linalg.solve(found.covariance[:3, :3], miss_m) < limit)
            off.append(np.linalg.norm(miss_m))
            of_common = found.common @ found.common.T
            assert np.linalg.eigvalsh(found.covariance - of_common)[0] > 0
    # A limit of three standard deviations of a share of 100.
    assert np.mean(inside) > 0.9 - 3 * np.sqrt(0.09 / 100)
    assert np.mean(inside_without) < np.mean(inside) - 0.05
    # Markers on two walls determine the focal length; one pose cannot separate the errors of the map.
    assert np.median(off_m) < (0.8 if focal_error else 1.05) * np.median(off_without_m)


def test_chance_is_the_expected_number_of_sets_of_markers_that_agree():
    rng = np.random.default_rng(14)
    view, corners_m = camera_looking_at(), two_walls(4)
    corners_px = image_corners(view, corners_m, rng, 0.05)
    found = {
        count: estimate_pose(corners_px[:count], corners_m[:count], without_pose(view), ANY_NUMBER).chance
        for count in (1, 2, 4)
    }
    # The area within 15 times the stated 0.2 px of a marker's position, as a share of an image of 1920 x 1080.
    near = np.pi * 3.0**2 / (1920 * 1080)
    assert found[1] == 1.0
    assert found[2] == pytest.approx(2 * near)
    assert found[4] == pytest.approx(4 * near**3)
    # Any two of the four other markers could agree with the first marker.
    wrong_px = np.concatenate([corners_px[:3], corners_px[2:] + rng.uniform(200, 400, (2, 1, 2))])
    mapped_m = np.concatenate([corners_m[:3], two_walls(6)[4:]])
    some = estimate_pose(wrong_px, mapped_m, without_pose(view), ANY_NUMBER)
    np.testing.assert_array_equal(some.used, [True] * 3 + [False] * 2)
    assert some.chance == pytest.approx(5 * 6 * near**2)


def test_inset_of_all_corners_does_not_move_the_camera():
    view, corners_m = camera_looking_at(), two_walls(8)
    corners_px = image_corners(view, corners_m)
    inward = seen_markers(corners_px, corners_m, without_pose(view), 0.3, 1e-4).inward
    found = estimate_pose(corners_px + 0.5 * inward, corners_m, without_pose(view), SETTINGS)
    assert squared_deviations(found, view) < 0.01
    assert found.reprojection_px == pytest.approx(0.5, rel=0.01)


@given(
    axis=st.tuples(*[st.floats(-3, 3)] * 3),
    shift_m=st.tuples(*[st.floats(-50, 50)] * 3),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=20)
def test_pose_follows_a_transformed_world_and_reordered_markers(axis, shift_m, seed):
    rng = np.random.default_rng(seed)
    view, corners_m = camera_looking_at(), two_walls(9)
    corners_px = image_corners(view, corners_m, rng, 0.2)
    corners_px[4] += 40.0
    order = rng.permutation(9)
    R = Rotation.from_rotvec(axis).as_matrix()
    one = estimate_pose(corners_px, corners_m, without_pose(view), SETTINGS)
    other = estimate_pose(corners_px[order], corners_m[order] @ R.T + shift_m, without_pose(view), SETTINGS)
    np.testing.assert_array_equal(other.used, one.used[order])
    # Both fits end within a tenth of a deviation of the same minimum; deviations are about 1 mm and 0.2 mrad.
    np.testing.assert_allclose(R.T @ (other.position_m - shift_m), one.position_m, atol=1e-4)
    np.testing.assert_allclose(R.T @ other.R_world_cam, one.R_world_cam, atol=2e-5)
    turned = np.kron(np.eye(2), R)
    turned[3:, 3:] = np.eye(3)
    np.testing.assert_allclose(
        turned.T @ other.covariance @ turned,
        one.covariance,
        rtol=0.02,
        atol=0.02 * np.abs(one.covariance).max(),
    )


@pytest.mark.parametrize("wrong", [1, 2, 3, 4])
def test_markers_with_the_id_of_another_are_left_out(wrong):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        view, corners_m = camera_looking_at(), two_walls(10)
        corners_px = image_corners(view, corners_m, rng, 0.2)
        swapped = rng.permutation(10)[:wrong]
        mapped_m = corners_m.copy()
        for index in swapped:
            mapped_m[index] = corners_m[rng.choice([i for i in range(10) if i != index])]
        found = estimate_pose(corners_px, mapped_m, without_pose(view), SETTINGS)
        np.testing.assert_array_equal(np.flatnonzero(~found.used), np.sort(swapped))
        assert squared_deviations(found, view) < chi2.ppf(0.9999, 6)


def test_one_bad_corner_excludes_the_corner_and_two_exclude_the_marker():
    rng = np.random.default_rng(3)
    view, corners_m = camera_looking_at(), two_walls(8)
    clean_px = image_corners(view, corners_m, rng, 0.2)
    one_px, two_px = clean_px.copy(), clean_px.copy()
    one_px[2, 1] += (4.0, -3.0)
    two_px[2, 1:3] += (4.0, -3.0)
    clean, one, two, without = (
        estimate_pose(corners_px, places_m, without_pose(view), SETTINGS)
        for corners_px, places_m in (
            (clean_px, corners_m),
            (one_px, corners_m),
            (two_px, corners_m),
            (np.delete(clean_px, 2, axis=0), np.delete(corners_m, 2, axis=0)),
        )
    )
    assert clean.used.all()
    assert one.used.all()
    np.testing.assert_array_equal(two.used, np.arange(8) != 2)
    # Excluded corners have no effect: the pose equals that of the other markers to a tenth of a deviation.
    np.testing.assert_allclose(two.position_m, without.position_m, atol=1e-4)
    assert one.reprojection_px < 1.0
    # 31 corners have almost the information of 32 corners.
    assert np.trace(one.covariance[:3, :3]) == pytest.approx(np.trace(clean.covariance[:3, :3]), rel=0.5)


def test_good_markers_are_excluded_as_seldom_as_stated():
    found = [one.used for one, _ in random_estimates(np.random.default_rng(4), 10, 0.3, 0.0, SETTINGS, 60)]
    num_excluded = np.sum(~np.array(found))
    # A marker is excluded by the mean of its corners, or by two of its corners, which is much rarer.
    assert num_excluded <= binom.ppf(0.9999, 600, 2 * FALSE_ALARM)


def far_marker(rng, angle_deg=20.0, distance_m=7.0):
    """A camera, a single small marker that is slightly turned from it, and the marker's corners in the image."""
    angle = np.deg2rad(angle_deg)
    view = camera_looking_at((0.0, 0.0, 1.0), (0.0, distance_m, 1.0))
    one = marker((0.0, distance_m, 1.0), (np.cos(angle), np.sin(angle), 0), (0, 0, -1))[None]
    return view, one, image_corners(view, one, rng, 0.3)


def test_the_ambiguity_of_a_single_marker_is_the_probability_of_the_other_pose():
    rng = np.random.default_rng(5)
    stated, wrong = [], []
    for _ in range(120):
        view, corners_m, corners_px = far_marker(rng)
        found = estimate_pose(corners_px, corners_m, without_pose(view), ANY_NUMBER)
        stated.append(found.ambiguity)
        # In the mirrored pose, the marker is turned to the other side.
        wrong.append(np.rad2deg(np.linalg.norm(pose_error(found, view)[3:])) > 20)
    assert 0.1 < np.mean(stated) < 0.5
    # Three standard deviations of the count, plus a fifth for approximations.
    limit = 3 * np.sqrt(np.mean(stated) / 120) + 0.2 * np.mean(stated)
    assert abs(np.mean(wrong) - np.mean(stated)) < limit


def test_expected_pose_decides_between_the_poses_of_a_single_marker():
    rng = np.random.default_rng(6)
    for _ in range(20):
        view, corners_m, corners_px = far_marker(rng)
        expected = ExpectedPose(
            view.centre_world + np.array([0.2, -0.1, 0.1]),
            view.T_cam_world[:3, :3].T,
            np.diag([0.1] * 3 + [0.01] * 3),
        )
        found = estimate_pose(corners_px, corners_m, without_pose(view), ANY_NUMBER, expected)
        assert np.rad2deg(np.linalg.norm(pose_error(found, view)[3:])) < 20
        assert found.ambiguity < 0.05


def test_markers_outweigh_a_wrong_expected_pose():
    view, corners_m = camera_looking_at(), two_walls(6)
    corners_px = image_corners(view, corners_m)
    elsewhere = ExpectedPose(view.centre_world + 30.0, np.eye(3), 1e-6 * np.eye(6))
    found = estimate_pose(corners_px, corners_m, without_pose(view), SETTINGS, elsewhere)
    np.testing.assert_allclose(pose_error(found, view), 0, atol=1e-9)


def test_markers_of_one_wall_are_ambiguous_from_far_away_only():
    rng = np.random.default_rng(7)
    corners_m = one_wall()
    near = camera_looking_at((1.5, -0.5, 1.5), (0.0, 4.0, 2.0))
    found = estimate_pose(image_corners(near, corners_m, rng, 0.3), corners_m, without_pose(near), SETTINGS)
    assert found.ambiguity < 1e-9
    tele = np.array([[920.0, 0, 959.5], [0, 920.0, 539.5], [0, 0, 1]])
    ambiguities = []
    for _ in range(20):
        far = camera_looking_at((12.0, -60.0, 1.5), (0.0, 4.0, 2.0), K=tele)
        ambiguities.append(
            estimate_pose(
                image_corners(far, corners_m, rng, 0.5), corners_m, without_pose(far), SETTINGS
            ).ambiguity
        )
    assert max(ambiguities) > 0.05


def test_two_markers_that_contradict_each_other_are_ambiguous_without_an_expected_pose():
    rng = np.random.default_rng(8)
    view, all_m = camera_looking_at(), two_walls(10)
    corners_m = all_m[[0, 1]]
    corners_px = image_corners(view, corners_m, rng, 0.2)
    mapped_m = np.stack([corners_m[0], all_m[8]])
    found = estimate_pose(corners_px, mapped_m, without_pose(view), ANY_NUMBER)
    assert found is None or (found.used.sum() == 1 and found.ambiguity > 0.01)
    expected = ExpectedPose(
        view.centre_world + 0.05, view.T_cam_world[:3, :3].T, np.diag([0.01] * 3 + [0.003] * 3)
    )
    found = estimate_pose(corners_px, mapped_m, without_pose(view), ANY_NUMBER, expected)
    np.testing.assert_array_equal(found.used, [True, False])
    assert found.ambiguity < 0.01
    assert squared_deviations(found, view) < chi2.ppf(0.9999, 6)


def test_a_marker_that_the_map_places_behind_the_camera_is_left_out():
    view, corners_m = camera_looking_at(), two_walls(6)
    corners_px = image_corners(view, corners_m)
    mapped_m = corners_m.copy()
    mapped_m[3] = marker((0.0, -4.0, 1.5), (-1, 0, 0), (0, 0, -1))
    found = estimate_pose(corners_px, mapped_m, without_pose(view), SETTINGS)
    np.testing.assert_array_equal(found.used, np.arange(6) != 3)
    np.testing.assert_allclose(pose_error(found, view), 0, atol=1e-9)


def test_too_few_markers_give_no_pose():
    view, corners_m = camera_looking_at(), two_walls(4)
    corners_px = image_corners(view, corners_m)
    nothing = np.zeros((0, 4, 2)), np.zeros((0, 4, 3))
    assert estimate_pose(*nothing, without_pose(view), ANY_NUMBER) is None
    assert estimate_pose(corners_px[:3], corners_m[:3], without_pose(view), SETTINGS) is None
    assert estimate_pose(corners_px, corners_m, without_pose(view), SETTINGS) is not None


def test_markers_that_do_not_determine_a_pose_give_no_pose():
    view = camera_looking_at()
    # All corners lie on one line, in the image and in the map.
    line_m = np.array([[[x + 0.1 * i, 4.0, 1.5] for i in range(4)] for x in range(5)])
    assert estimate_pose(image_corners(view, line_m), line_m, without_pose(view), SETTINGS) is None
    # All corners lie in one point.
    point_m = np.tile([1.0, 4.0, 1.5], (5, 4, 1))
    assert estimate_pose(image_corners(view, point_m), point_m, without_pose(view), SETTINGS) is None


def test_markers_that_all_contradict_one_another_give_no_pose():
    rng = np.random.default_rng(9)
    view, corners_m = camera_looking_at(), two_walls(10)
    for seed in range(5):
        shuffled = np.roll(np.random.default_rng(seed).permutation(10), 1)
        corners_px = rng.uniform((200, 200), (1700, 900), (10, 1, 2)) + 30 * np.array(
            [[-1, -1], [1, -1], [1, 1], [-1, 1]]
        )
        assert estimate_pose(corners_px, corners_m[shuffled], without_pose(view), SETTINGS) is None


def test_invalid_corners_and_settings_are_refused():
    view, corners_m = camera_looking_at(), two_walls(4)
    corners_px = image_corners(view, corners_m)
    with pytest.raises(InputError, match="finite coordinates"):
        estimate_pose(np.where(corners_px > 1e9, 0, np.nan), corners_m, without_pose(view), SETTINGS)
    with pytest.raises(SettingsError, match="min_markers: expected at least 1, found 0"):
        PoseSettings(min_markers=0)
    with pytest.raises(SettingsError, match="noise_px"):
        PoseSettings(noise_px=0.0)
    with pytest.raises(SettingsError, match="place_m"):
        PoseSettings(place_m=np.inf)
    with pytest.raises(SettingsError, match=r"focal_error: expected a number from 0 to below 1, found -0.1"):
        PoseSettings(focal_error=-0.1)
    with pytest.raises(SettingsError, match="map_error_m: expected a number from 0 to below 1, found nan"):
        PoseSettings(map_error_m=np.nan)
