"""Poses from the markers of one frame: exact cases, SciPy, random draws, wrong markers, second poses, refused input."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import LENSES
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import look_at, make_camera, project
from psotrack.inside_out import PoseSettings
from psotrack.inside_out.pose import CameraPose, CornerNoise, estimate_pose
from psotrack.inside_out.pose.estimating import FALSE_ALARM

K = np.array([[920.0, 0, 959.5], [0, 921.0, 539.5], [0, 0, 1]])
SETTINGS = PoseSettings()
ANY_NUMBER = PoseSettings(min_markers=1)
#: Standard deviation of the inset of all corners that the fit allows for, px.
INSET_STD_PX = 0.5
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


def inward(corners_px):
    """Unit vectors from each corner into its marker."""
    to_next = np.roll(corners_px, -1, axis=1) - corners_px
    to_next /= np.linalg.norm(to_next, axis=-1, keepdims=True)
    into = to_next - np.roll(to_next, 1, axis=1)
    return into / np.linalg.norm(into, axis=-1, keepdims=True)


def own_whitener(std_px):
    """(8, 8), inverse root of the covariance of a marker's corners, whose mean has 0.48 of independent errors' std."""
    mean = np.kron(np.full((4, 4), 0.25), np.eye(2))
    return (np.eye(8) + (1 / 0.48 - 1) * mean) / std_px


def test_pose_and_covariance_equal_scipys_least_squares_over_all_unknowns():
    """Unknowns: pose, inset, focal length, markers' offsets; the noise of each marker is another."""
    rng = np.random.default_rng(0)
    view, corners_m = camera_looking_at(coefficients=4), two_walls(6)
    count, focal_error, std_px = 6, 0.005, np.array([0.1, 0.2, 0.3, 0.2, 0.1, 0.4])
    placed_m = corners_m + 0.003 * rng.normal(size=(count, 1, 3))
    pixels = image_corners(longer_lens(view, 0.003), placed_m)
    corners_px = pixels + 0.5 * std_px[:, None, None] * rng.normal(size=pixels.shape)
    map_std_m = np.full(count, 0.0018)
    stated = PoseSettings(focal_error=focal_error, noise=CornerNoise(1.0, 0.0024))
    found = estimate_pose(
        corners_px, corners_m, without_pose(view), stated, std_px=std_px, map_std_m=map_std_m
    )
    assert found.used.all()

    def best_for(corners_px, start, factor=1.0):
        def residuals(x):
            turned = found.R_world_cam @ Rotation.from_rotvec(x[3:6]).as_matrix()
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = turned.T, -turned.T @ (found.position_m + x[:3])
            there = longer_lens(replace(view, T_cam_world=T), focal_error * x[7])
            pixels = project(there, corners_m + x[8:].reshape(count, 1, 3))[0] + x[6] * inward(corners_px)
            off = (corners_px - pixels).reshape(count, 8)
            white = np.concatenate([own_whitener(std) @ one for std, one in zip(std_px, off, strict=True)])
            place = x[8:] / np.hypot(0.0024 * np.sqrt(factor), 0.0018)
            return np.concatenate([white / np.sqrt(factor), place, [x[6] / INSET_STD_PX, x[7]]])

        return least_squares(residuals, start, "3-point", x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-12)

    result = best_for(corners_px, np.zeros(8 + 3 * count))
    deviation = np.sqrt(np.diag(found.covariance))
    # Derivatives are those at the markers' positions in the map, 3 mm from their fitted positions at 5 m.
    np.testing.assert_allclose(result.x[:6] / deviation, 0, atol=0.03)
    # For the covariances, the stated variances weigh as much as 50 residuals of the frame.
    factor = (50 + 2 * result.cost) / (50 + 8 * count - 6)
    result = best_for(corners_px, result.x, factor)
    expected = np.linalg.inv(result.jac.T @ result.jac)[:6, :6]
    # A shift of all corners by 0.015 px, which no residual shows, adds a little to the turn.
    np.testing.assert_allclose(
        found.covariance / np.outer(deviation, deviation),
        expected / np.outer(deviation, deviation),
        atol=0.05,
    )
    # The constant part is the effect of the markers' places in the map and of the focal length.
    by_errors = []
    for column in range(3 * count + 1):
        off_m = np.zeros(3 * count + 1)
        off_m[column] = 1.0
        there = longer_lens(view, focal_error * off_m[-1])
        moved = project(there, corners_m + 0.0018 * off_m[:-1].reshape(count, 1, 3))[0]
        by_px = moved - project(view, corners_m)[0]
        by_errors.append(best_for(corners_px + by_px, result.x, factor).x[:6] - result.x[:6])
    constant = np.transpose(by_errors) @ np.array(by_errors)
    np.testing.assert_allclose(
        found.constant / np.outer(deviation, deviation), constant / np.outer(deviation, deviation), atol=0.05
    )
    assert np.linalg.eigvalsh(found.covariance - found.constant)[0] > 0


def test_markers_with_smaller_deviations_count_more():
    """Found: `std_px`, which detection writes, had no effect on the pose."""
    rng = np.random.default_rng(15)
    off_m = {"stated": [], "equal": []}
    for view in (view for _, view in random_estimates(np.random.default_rng(16), 8, 0.1, 0.0, SETTINGS, 60)):
        corners_m, std_px = two_walls(8), np.array([0.05] * 4 + [1.0] * 4)
        pixels = image_corners(view, corners_m)
        corners_px = pixels + std_px[:, None, None] * rng.normal(size=pixels.shape)
        for name, stated in (("stated", std_px), ("equal", np.full(8, 0.7))):
            found = estimate_pose(corners_px, corners_m, without_pose(view), SETTINGS, std_px=stated)
            off_m[name].append(np.linalg.norm(found.position_m - view.centre_world))
    assert np.median(off_m["stated"]) < 0.5 * np.median(off_m["equal"])


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
        # The means of corners with independent errors vary more than those of edges, as places that are off by 0.3 mm.
        pytest.param(0.2, 0.0, PoseSettings(noise=CornerNoise(1.0, 6e-4)), 0.85, id="corners"),
        pytest.param(0.2, 0.003, PoseSettings(noise=CornerNoise(1.0, 0.003)), 0.85, id="places"),
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
            assert np.linalg.eigvalsh(found.covariance - found.constant)[0] > 0
    # A limit of three standard deviations of a share of 100.
    assert np.mean(inside) > 0.9 - 3 * np.sqrt(0.09 / 100)
    assert np.mean(inside_without) < np.mean(inside) - 0.05
    # Markers on two walls determine the focal length; one pose cannot separate the errors of the map.
    assert np.median(off_m) < (0.8 if focal_error else 1.05) * np.median(off_without_m)


def test_inset_of_all_corners_does_not_move_the_camera():
    view, corners_m = camera_looking_at(), two_walls(8)
    corners_px = image_corners(view, corners_m)
    found = estimate_pose(corners_px + 0.5 * inward(corners_px), corners_m, without_pose(view), SETTINGS)
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
        found = estimate_pose(corners_px, corners_m, without_pose(view), ANY_NUMBER, std_px=np.array([0.3]))
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
        expected = CameraPose(
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
    elsewhere = CameraPose(view.centre_world + 30.0, np.eye(3), 1e-6 * np.eye(6))
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
    expected = CameraPose(
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
    with pytest.raises(SettingsError, match="scale"):
        CornerNoise(scale=0.0)
    with pytest.raises(SettingsError, match="place_m"):
        CornerNoise(place_m=np.inf)
    with pytest.raises(SettingsError, match=r"focal_error: expected a number from 0 to below 1, found -0.1"):
        PoseSettings(focal_error=-0.1)
    with pytest.raises(SettingsError, match="map_error_m: expected a number from 0 to below 1, found nan"):
        PoseSettings(map_error_m=np.nan)
