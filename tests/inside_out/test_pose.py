"""Poses from the markers of one frame: exact cases, SciPy, random draws, wrong markers, second poses; and the errors of
corners, which are learned from a recording."""

from dataclasses import replace

import numpy as np
import pytest
from camera_paths import pose_errors, squared_errors
from helpers import LENSES
from hypothesis import given, settings
from hypothesis import strategies as st
from marker_worlds import LENS, found_markers, marker_at, posed
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.geometry import make_camera, project
from psotrack.inside_out import LocaliseSettings, MarkerMap, PoseSettings, RollingShutter
from psotrack.inside_out.localising import localise_frames
from psotrack.inside_out.pose import CameraPose, CornerNoise, estimate_pose

SIZE_WH = (1920, 1080)
SETTINGS = PoseSettings()
ANY_NUMBER = PoseSettings(min_markers=1)
#: Standard deviation of the inset of all corners that the fit allows for, px.
INSET_STD_PX = 0.5


def two_walls(count=10):
    """Corners (count, 4, 3) of markers on the walls y = 4 and x = 5, at three heights."""
    corners = []
    for i in range(5):
        height_m = 0.7 * (i % 3)
        corners.append(marker_at((i, 4.0, 1.2 + height_m), (0, -1, 0)))
        corners.append(marker_at((5.0, 3.0 - i, 1.5 + height_m), (-1, 0, 0)))
    return np.array(corners)[:count]


def camera_at(
    centre_m=(-0.8, -2.5, 1.3), target_m=(3.0, 3.0, 1.8), dist=(), *, fisheye=False, focal_px=920.0
):
    """A camera that looks at the walls; its rows are a little taller than its columns are wide."""
    K = np.array([[focal_px, 0, 959.5], [0, focal_px + 1, 539.5], [0, 0, 1]])
    R, t_m = np.eye(3), np.zeros(3)
    lens = make_camera(R=R, t_m=t_m, K=K, image_size_wh=SIZE_WH, dist=dist, fisheye=fisheye)
    return posed(lens, centre_m, target_m)


def longer_lens(view, by):
    """The camera with a focal length that is longer by the share `by`."""
    factor = np.ones((3, 3))
    factor[:2, :2] += by
    return replace(view, K=view.K * factor)


def estimated(view, corners_px, corners_m, stated=SETTINGS, *others, **options):
    """The pose of the camera, which is not told where it is."""
    return estimate_pose(
        corners_px, corners_m, replace(view, T_cam_world=np.eye(4)), stated, *others, **options
    )


def image_corners(view, corners_m, rng=None, noise_px=0.0):
    pixels = project(view, corners_m)[0]
    return pixels if rng is None else pixels + noise_px * rng.normal(size=pixels.shape)


def pose_error(found, view):
    """Errors (6,) in the covariance's order: position along the world's axes, and turn about the camera's axes."""
    R_world_cam = view.T_cam_world[:3, :3].T
    turn = Rotation.from_matrix(found.R_world_cam.T @ R_world_cam).as_rotvec()
    return np.concatenate([view.centre_world - found.position_m, turn])


#: Coefficients, and whether the lens is a fisheye.
LENS_MODELS = [(dist, False) for dist in LENSES.values()]
LENS_MODELS.append(((-0.02, 0.01, -0.01, 0.002), True))
LENS_MODELS.append(((-0.2, 0.05, 0.001, 0.0, 0.0, *7 * [0.001], 0.05, 0.02), False))


@pytest.mark.parametrize(("dist", "fisheye"), LENS_MODELS)
@pytest.mark.parametrize("count", [1, 4])
def test_exact_corners_give_the_pose_exactly(dist, fisheye, count):
    view = camera_at(dist=dist, fisheye=fisheye)
    corners_m = two_walls(count)
    found = estimated(view, image_corners(view, corners_m), corners_m, ANY_NUMBER)
    # The last step converges quadratically, so the remaining error is far below a standard deviation.
    np.testing.assert_allclose(pose_error(found, view), 0, atol=1e-9)
    assert found.used.all()
    assert found.reprojection_px < 1e-6
    assert found.ambiguity < 1e-3


def test_markers_where_the_lens_shows_nothing_are_not_used():
    """x (1 - k r²) grows up to 2 / 3 / sqrt(3 k), which is 354 px: another marker is claimed outside of this circle."""
    view = camera_at(dist=(-0.19, 0.0, 0.0, 0.0), focal_px=400.0)
    corners_m = two_walls(7)
    corners_px = image_corners(view, corners_m)
    corners_px[2] += [900.0, 0.0]
    found = estimated(view, corners_px, corners_m, ANY_NUMBER)
    np.testing.assert_allclose(pose_error(found, view), 0, atol=1e-6)
    np.testing.assert_array_equal(found.used, np.arange(7) != 2)


def inward(corners_px):
    """Unit vectors from each corner into its marker."""
    to_next = np.roll(corners_px, -1, axis=1) - corners_px
    to_next /= np.linalg.norm(to_next, axis=-1, keepdims=True)
    into = to_next - np.roll(to_next, 1, axis=1)
    return into / np.linalg.norm(into, axis=-1, keepdims=True)


def test_pose_and_covariance_equal_scipys_least_squares_over_all_unknowns():
    """Unknowns: pose, inset, focal length, markers' offsets; the noise of each marker is another.

    Found: `std_px`, which detection writes, had no effect on the pose.
    """
    rng = np.random.default_rng(0)
    count, focal_error = 6, 0.005
    std_px = np.array([0.1, 0.2, 0.3, 0.2, 0.1, 0.4])
    view, corners_m = camera_at(dist=LENSES[4]), two_walls(count)
    placed_m = corners_m + 0.003 * rng.normal(size=(count, 1, 3))
    pixels = image_corners(longer_lens(view, 0.003), placed_m)
    corners_px = pixels + 0.5 * std_px[:, None, None] * rng.normal(size=pixels.shape)
    stated = PoseSettings(focal_error=focal_error, map_error_m=0.0012, noise=CornerNoise(1.0, 0.0024))
    # The map states no deviation of three markers, which have the one of the settings.
    map_std_m = np.array([0.0018] * 3 + [0.0] * 3)
    map_error_m = np.repeat([0.0018, 0.0012], 9)
    found = estimated(view, corners_px, corners_m, stated, std_px=std_px, map_std_m=map_std_m)
    assert found.used.all()

    def projected(x):
        """Corners by the found pose, changed by the first six unknowns, and by the focal length and the places."""
        turned = found.R_world_cam @ Rotation.from_rotvec(x[3:6]).as_matrix()
        T = np.eye(4)
        T[:3, :3] = turned.T
        T[:3, 3] = -turned.T @ (found.position_m + x[:3])
        there = longer_lens(replace(view, T_cam_world=T), focal_error * x[7])
        return project(there, corners_m + x[8:].reshape(count, 1, 3))[0]

    def best_for(corners_px, start, factor=1.0):
        # Inverse roots of the covariances of corners, whose mean has 0.48 of independent errors' deviation.
        root = np.eye(8) + (1 / 0.48 - 1) * np.kron(np.full((4, 4), 0.25), np.eye(2))
        whiteners = [root / std / np.sqrt(factor) for std in std_px]
        place_std_m = np.hypot(0.0024 * np.sqrt(factor), map_error_m)
        inset = inward(corners_px)

        def residuals(x):
            off_px = corners_px - projected(x) - x[6] * inset
            white = np.einsum("nij,nj->ni", whiteners, off_px.reshape(count, 8))
            return np.concatenate([white.ravel(), x[8:] / place_std_m, [x[6] / INSET_STD_PX, x[7]]])

        return least_squares(residuals, start, "3-point", x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-10)

    result = best_for(corners_px, np.zeros(8 + 3 * count))
    deviation = np.sqrt(np.diag(found.covariance))
    scale = np.outer(deviation, deviation)
    # Derivatives are those at the markers' positions in the map, 3 mm from their fitted positions at 5 m.
    np.testing.assert_allclose(result.x[:6] / deviation, 0, atol=0.03)
    # For the covariances, the stated variances weigh as much as 50 residuals of the frame.
    factor = (50 + 2 * result.cost) / (50 + 8 * count - 6)
    result = best_for(corners_px, result.x, factor)
    expected = np.linalg.inv(result.jac.T @ result.jac)[:6, :6]
    # A shift of all corners by 0.015 px, which no residual shows, adds a little to the turn.
    np.testing.assert_allclose(found.covariance / scale, expected / scale, atol=0.05)
    # The constant part is the effect of the markers' places in the map and of the focal length.
    by_errors = []
    for off in np.diag([1.0, *map_error_m]):
        there = longer_lens(view, focal_error * off[0])
        moved_px = project(there, corners_m + off[1:].reshape(count, 1, 3))[0]
        changed_px = corners_px + moved_px - image_corners(view, corners_m)
        by_errors.append(best_for(changed_px, result.x, factor).x[:6] - result.x[:6])
    constant = np.transpose(by_errors) @ np.array(by_errors)
    np.testing.assert_allclose(found.constant / scale, constant / scale, atol=0.05)
    assert np.linalg.eigvalsh(found.covariance - found.constant)[0] > 0


@given(
    axis=st.tuples(*[st.floats(-3, 3)] * 3),
    shift_m=st.tuples(*[st.floats(-50, 50)] * 3),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=15)
def test_pose_follows_a_transformed_world_and_reordered_markers(axis, shift_m, seed):
    rng = np.random.default_rng(seed)
    view, corners_m = camera_at(), two_walls(9)
    corners_px = image_corners(view, corners_m, rng, 0.2)
    corners_px[4] += 40.0
    order = rng.permutation(9)
    R = Rotation.from_rotvec(axis).as_matrix()
    one = estimated(view, corners_px, corners_m)
    other = estimated(view, corners_px[order], corners_m[order] @ R.T + shift_m)
    np.testing.assert_array_equal(other.used, one.used[order])
    # Both fits end within a tenth of a deviation of the same minimum; deviations are about 1 mm and 0.2 mrad.
    np.testing.assert_allclose(R.T @ (other.position_m - shift_m), one.position_m, atol=1e-4)
    np.testing.assert_allclose(R.T @ other.R_world_cam, one.R_world_cam, atol=2e-5)
    turned = np.kron(np.eye(2), R)
    turned[3:, 3:] = np.eye(3)
    back = turned.T @ other.covariance @ turned
    np.testing.assert_allclose(back, one.covariance, rtol=0.02, atol=0.02 * np.abs(one.covariance).max())


# Wrong markers.


@pytest.mark.parametrize("wrong", [1, 4])
def test_markers_with_the_id_of_another_are_left_out(wrong):
    view, corners_m = camera_at(), two_walls(10)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        corners_px = image_corners(view, corners_m, rng, 0.2)
        swapped = rng.permutation(10)[:wrong]
        mapped_m = corners_m.copy()
        for index in swapped:
            others = np.delete(np.arange(10), index)
            mapped_m[index] = corners_m[rng.choice(others)]
        found = estimated(view, corners_px, mapped_m)
        np.testing.assert_array_equal(np.flatnonzero(~found.used), np.sort(swapped))
        off = pose_error(found, view)
        assert off @ np.linalg.solve(found.covariance, off) < chi2.ppf(0.9999, 6)


def test_a_marker_that_the_map_places_behind_the_camera_is_left_out():
    view, corners_m = camera_at(), two_walls(6)
    corners_px = image_corners(view, corners_m)
    corners_m[3] = marker_at((0.0, -4.0, 1.5), (0, 1, 0))
    found = estimated(view, corners_px, corners_m)
    np.testing.assert_array_equal(found.used, np.arange(6) != 3)
    np.testing.assert_allclose(pose_error(found, view), 0, atol=1e-9)


def test_one_bad_corner_excludes_the_corner_and_two_exclude_the_marker():
    view, corners_m = camera_at(), two_walls(8)
    clean_px = image_corners(view, corners_m, np.random.default_rng(3), 0.2)
    one_px, two_px = clean_px.copy(), clean_px.copy()
    one_px[2, 1] += (4.0, -3.0)
    two_px[2, 1:3] += (4.0, -3.0)
    clean = estimated(view, clean_px, corners_m)
    one = estimated(view, one_px, corners_m)
    two = estimated(view, two_px, corners_m)
    assert clean.used.all()
    assert one.used.all()
    np.testing.assert_array_equal(two.used, np.arange(8) != 2)
    # Excluded corners have no effect: the pose equals that of the other markers to a tenth of a deviation.
    without = estimated(view, np.delete(clean_px, 2, axis=0), np.delete(corners_m, 2, axis=0))
    np.testing.assert_allclose(two.position_m, without.position_m, atol=1e-4)
    assert one.reprojection_px < 1.0
    # 31 corners have almost the information of 32 corners.
    np.testing.assert_allclose(np.diag(one.covariance), np.diag(clean.covariance), rtol=0.5)


def test_too_few_markers_and_markers_that_determine_nothing_give_no_pose():
    view, corners_m = camera_at(), two_walls(4)
    corners_px = image_corners(view, corners_m)
    assert estimated(view, corners_px[:0], corners_m[:0], ANY_NUMBER) is None
    assert estimated(view, corners_px[:3], corners_m[:3]) is None
    assert estimated(view, corners_px, corners_m) is not None
    # All corners lie on one line, or in one point, in the image and in the map.
    point_m = np.tile([1.0, 4.0, 1.5], (5, 4, 1))
    line_m = point_m.copy()
    line_m[..., 0] = np.arange(5)[:, None] + 0.1 * np.arange(4)
    for places_m in (line_m, point_m):
        assert estimated(view, image_corners(view, places_m), places_m) is None


# Second poses.


def far_marker(rng, angle_deg=20.0, distance_m=7.0):
    """A camera, a single small marker that is slightly turned from it, and the marker's corners in the image."""
    angle = np.deg2rad(angle_deg)
    view = camera_at((0.0, 0.0, 1.0), (0.0, distance_m, 1.0))
    one = marker_at((0.0, distance_m, 1.0), (np.sin(angle), -np.cos(angle), 0))[None]
    return view, one, image_corners(view, one, rng, 0.3)


def is_mirrored(found, view):
    """Whether the pose is the one in which the single marker is turned to the other side."""
    return np.rad2deg(np.linalg.norm(pose_error(found, view)[3:])) > 20


def test_the_ambiguity_of_a_single_marker_is_the_probability_of_the_other_pose():
    rng = np.random.default_rng(5)
    stated, wrong = [], []
    for _ in range(120):
        view, corners_m, corners_px = far_marker(rng)
        found = estimated(view, corners_px, corners_m, ANY_NUMBER, std_px=np.array([0.3]))
        stated.append(found.ambiguity)
        wrong.append(is_mirrored(found, view))
    assert 0.1 < np.mean(stated) < 0.5
    # Three standard deviations of the count, plus a fifth for approximations.
    limit = 3 * np.sqrt(np.mean(stated) / 120) + 0.2 * np.mean(stated)
    assert abs(np.mean(wrong) - np.mean(stated)) < limit


def near(view, off_m, variances):
    """An expected pose beside the camera's, with its variances along and about each axis."""
    position, turn = variances
    covariance = np.diag([position] * 3 + [turn] * 3)
    return CameraPose(view.centre_world + off_m, view.T_cam_world[:3, :3].T, covariance)


def test_expected_pose_decides_between_the_poses_of_a_single_marker():
    rng = np.random.default_rng(6)
    for _ in range(20):
        view, corners_m, corners_px = far_marker(rng)
        expected = near(view, np.array([0.2, -0.1, 0.1]), (0.1, 0.01))
        found = estimated(view, corners_px, corners_m, ANY_NUMBER, expected)
        assert not is_mirrored(found, view)
        assert found.ambiguity < 0.05


def test_six_markers_outweigh_a_wrong_expected_pose():
    view, corners_m = camera_at(), two_walls(6)
    elsewhere = near(view, 30.0, (1e-6, 1e-6))
    found = estimated(view, image_corners(view, corners_m), corners_m, SETTINGS, elsewhere)
    np.testing.assert_allclose(pose_error(found, view), 0, atol=1e-9)


# Errors of corners, which are learned from a recording.

#: Ten markers on a wall and on a pillar in front of it, by id.
WALL = {}
for number in range(10):
    place_m = np.array([-1.475 + 0.8 * (number // 2), 3.0, 1.025 + 0.7 * (number % 2)])
    if number % 3 == 0:
        place_m[1] = 2.6
    WALL[number] = marker_at(place_m, (0, -1, 0), side_m=0.25)


def filmed(markers, errors_px):
    """Frames that show the first markers of the wall, and the camera's true positions and orientations.

    `errors_px` are standard deviations of errors of each corner for itself, of a marker's corners together, as of a
    lens that is not exact, and of all corners of a frame together.
    """
    rng = np.random.default_rng(0)
    each_px, marker_px, frame_px = errors_px
    points_m = np.array([WALL[number] for number in range(markers)])
    frames, centres_m, turns = [], [], []
    for number in range(60):
        centre_m = rng.uniform((-0.5, -1.1, 0.9), (0.5, -0.1, 1.9))
        target_m = rng.uniform((-0.1, 2.9, 1.25), (0.1, 3.1, 1.45))
        view = posed(LENS, centre_m, target_m)
        pixels = image_corners(view, points_m, rng, each_px)
        pixels += marker_px * rng.normal(size=(markers, 1, 2))
        pixels += frame_px * rng.normal(size=2)
        frames.append((number, number / 30, found_markers(range(markers), pixels)))
        centres_m.append(centre_m)
        turns.append(view.T_cam_world[:3, :3].T)
    return frames, np.array(centres_m), Rotation.from_matrix(turns)


def fit_of_covariances(errors_px, markers=10, noise=None):
    """For poses (6) and positions (3): mean squared error by the covariances, as a share of its expectation, and the
    share of the truths in the 90 % ellipsoid; in 60 frames."""
    frames, centres_m, turns = filmed(markers, errors_px)
    stated = LocaliseSettings(pose=PoseSettings(noise=noise), filter=None, shutter=RollingShutter(0.0))
    path = localise_frames(frames, MarkerMap(WALL), LENS, stated).path
    error = pose_errors(path, centres_m, turns)
    fits = []
    for size in (6, 3):
        distances = squared_errors(error[:, :size], path.covariance)
        fits.append((np.mean(distances) / size, np.mean(distances < chi2.ppf(0.9, size))))
    return fits


@pytest.mark.parametrize(
    ("errors_px", "markers"),
    [((0.1, 0.3, 0.0), 10), ((0.05, 0.0, 0.0), 4)],
    ids=["of whole markers", "of four markers"],
)
def test_covariances_fit_the_errors_of_a_recording(errors_px, markers):
    """Two variances fit all of them; the residuals of four markers alone say little."""
    for found, inside in fit_of_covariances(errors_px, markers):
        # Measured 0.7 to 1.1, and 0.85 to 0.95; with 60 frames, 0.13 and 0.04 are one standard deviation.
        assert 0.5 < found < 1.4
        assert inside >= 0.78


def test_a_shift_of_all_corners_of_a_frame_may_be_stated():
    """Found: 0.015 px, as in drawn videos, whatever the camera."""
    found, inside = fit_of_covariances((0.1, 0.0, 0.2), noise=CornerNoise(0.5, 3e-4, shift_px=0.2))[0]
    assert 0.5 < found < 1.3
    assert inside >= 0.8
