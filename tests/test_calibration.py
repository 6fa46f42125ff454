"""Where cameras stand: OpenCV and exact cases, honest covariances, and what is refused; lenses; bundle adjustment."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers import LENSES, ring_rig
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from psotrack.bundle import adjust
from psotrack.calibration import inflation, locate_camera, reproject, spread_px
from psotrack.cameras import CameraRig, camera, look_at, project
from psotrack.errors import InputError, SettingsError
from psotrack.lenses import Board, lens_of_board, lens_of_sensor, lens_of_view
from psotrack.video import VideoWriter, probe

K = np.array([[1157.0, 0, 959.5], [0, 1157.0, 539.5], [0, 0, 1]])
NO_LENS = np.zeros(0)


def view(rng, *, count=12, nearest_m=3.5, farthest_m=6.5, dist=(), K=K):
    """A camera 5 m from what it looks at, and points in a grid of cells of its image, at various depths."""
    angle = rng.uniform(0, 2 * np.pi)
    R, t_m = look_at((5 * np.cos(angle), 5 * np.sin(angle), 2.0), (0.0, 0.0, 1.0))
    one = camera(R=R, t_m=t_m, K=K, image_size_wh=(1920, 1080), dist=dist)
    cells = np.array([(i, j) for i in range(4) for j in range(3)] * (count // 12 + 1))[:count]
    pixels = (cells + rng.uniform(0.1, 0.9, (count, 2))) * (480, 360)
    rays = np.concatenate([pixels, np.ones((count, 1))], axis=1) @ np.linalg.inv(K).T
    # The lens moves the pixels a little: they are points near those rays.
    return one, (rays * rng.uniform(nearest_m, farthest_m, (count, 1)) - t_m) @ R


def centre(T):
    return -T[:3, :3].T @ T[:3, 3]


@pytest.mark.parametrize("coefficients", sorted(LENSES))
def test_derivatives_are_those_of_differences(coefficients):
    rng = np.random.default_rng(0)
    skewed = K + np.array([[0, 3.0, 0], [0, 0, 0], [0, 0, 0]])
    one, points = view(rng, count=7, dist=LENSES[coefficients], K=skewed)
    R, t_m = one.T_cam_world[:3, :3], one.T_cam_world[:3, 3]

    def pixels(step):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix() @ R, t_m + step[3:]
        return project(replace(one, T_cam_world=T), points)[0].ravel()

    found, by_turn, by_shift = reproject(points, R, t_m, one)
    # Both are the same formula, of numbers of about 1000.
    np.testing.assert_allclose(found, project(one, points)[0], atol=1e-9)
    slopes = approx_fprime(np.zeros(6), pixels, 1e-7).reshape(-1, 2, 6)
    # A step of 1e-7 bends by 1e-4 px and rounds at 1e-6 px.
    np.testing.assert_allclose(np.concatenate([by_turn, by_shift], axis=-1), slopes, rtol=1e-4, atol=0.01)


@pytest.mark.parametrize("coefficients", sorted(LENSES))
@pytest.mark.parametrize("count", [6, 12, 29])
def test_exact_points_give_the_camera(count, coefficients):
    one, points = view(np.random.default_rng(count), count=count, dist=LENSES[coefficients])
    located = locate_camera(points, project(one, points)[0], one.K, one.dist)
    # Least squares ends at 1e-8 of the cost's scale.
    np.testing.assert_allclose(located.T_cam_world, one.T_cam_world, atol=1e-6)
    assert located.used.all()


def test_it_is_the_least_squares_pose_of_opencv():
    rng = np.random.default_rng(3)
    one, points = view(rng, dist=LENSES[5])
    pixels = project(one, points)[0] + rng.normal(0, 1, (12, 2))
    located = locate_camera(points, pixels, one.K, one.dist)
    turn, t_m = cv2.Rodrigues(one.T_cam_world[:3, :3])[0], one.T_cam_world[:3, 3:].copy()
    turn, t_m = cv2.solvePnPRefineLM(points, pixels, one.K, one.dist, turn, t_m)
    np.testing.assert_allclose(located.T_cam_world[:3, :3], cv2.Rodrigues(turn)[0], atol=1e-6)
    # Two searches that end at the same bottom to a millionth of its width, which is 8 mm.
    np.testing.assert_allclose(located.T_cam_world[:3, 3], t_m.ravel(), atol=1e-6)


@pytest.mark.parametrize(("nearest_m", "farthest_m"), [(2.5, 7.5), (4.5, 5.5)])
def test_twelve_points_and_a_pixel_of_noise(nearest_m, farthest_m):
    """The centre is within 1 cm at 5 m where points are spread in depth, and its 90 % ellipsoid holds 90 %."""
    rng, runs = np.random.default_rng(1), 100
    errors_m, distances = [], []
    for _ in range(runs):
        one, points = view(rng, nearest_m=nearest_m, farthest_m=farthest_m)
        located = locate_camera(points, project(one, points)[0] + rng.normal(0, 1, (12, 2)), K, NO_LENS, 1.0)
        off = centre(located.T_cam_world) - one.centre_world
        errors_m.append(np.linalg.norm(off))
        distances.append(off @ np.linalg.solve(located.centre_covariance_m2, off))
    # What chance allows once in a thousand tests, on either side.
    for share in (0.5, 0.9):
        inside = int((np.array(distances) < chi2.ppf(share, 3)).sum())
        assert binom.ppf(0.0005, runs, share) <= inside <= binom.ppf(0.9995, runs, share)
    if nearest_m < 3:
        # Measured over 1000: median 4.6 mm, 95 % below 10.1 mm.
        assert np.median(errors_m) < 0.006
        assert np.percentile(errors_m, 90) < 0.01


def test_outliers_are_found_and_do_not_count():
    rng = np.random.default_rng(5)
    one, points = view(rng, count=13)
    pixels = project(one, points)[0] + rng.normal(0, 1, (13, 2))
    wrong = np.array([1, 4, 8, 11])
    spoilt = pixels.copy()
    spoilt[wrong] += rng.uniform(60, 400, (4, 2)) * rng.choice([-1, 1], (4, 2))
    located = locate_camera(points, spoilt, K, NO_LENS)
    assert np.flatnonzero(~located.used).tolist() == wrong.tolist()
    without = locate_camera(np.delete(points, wrong, 0), np.delete(pixels, wrong, 0), K, NO_LENS)
    # The same points, started from elsewhere.
    np.testing.assert_allclose(located.T_cam_world, without.T_cam_world, atol=1e-6)
    assert (located.residual_px[wrong] > 30).all()


def test_noise_larger_than_stated_widens_the_covariance():
    rng = np.random.default_rng(6)
    one, points = view(rng, count=36)
    off = rng.normal(0, 1, (36, 2))
    small = locate_camera(points, project(one, points)[0] + off, K, NO_LENS, noise_px=1.0)
    large = locate_camera(points, project(one, points)[0] + 4 * off, K, NO_LENS, noise_px=1.0)
    assert large.used.all()
    ratio = np.sqrt(large.centre_covariance_m2.trace() / small.centre_covariance_m2.trace())
    # 36 points tell σ to a tenth.
    assert 3 < ratio < 5


def test_points_in_a_plane_do():
    rng = np.random.default_rng(7)
    R, t_m = look_at((4.0, 1.0, 2.5), (0.0, 0.0, 0.0))
    one = camera(R=R, t_m=t_m, K=K, image_size_wh=(1920, 1080))
    points = np.concatenate([rng.uniform(-1.5, 1.5, (12, 2)), np.zeros((12, 1))], axis=1)
    located = locate_camera(points, project(one, points)[0] + rng.normal(0, 1, (12, 2)), K, NO_LENS)
    off = centre(located.T_cam_world) - one.centre_world
    # 99.9 %.
    assert off @ np.linalg.solve(located.centre_covariance_m2, off) < chi2.ppf(0.999, 3)


@settings(max_examples=8)
@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-20, 20)] * 3))
def test_moving_the_world_moves_the_camera_with_it(turn, shift_m):
    rng = np.random.default_rng(8)
    one, points = view(rng)
    pixels = project(one, points)[0] + rng.normal(0, 1, (12, 2))
    R = Rotation.from_rotvec(turn).as_matrix()
    here = locate_camera(points, pixels, K, NO_LENS)
    there = locate_camera(points @ R.T + shift_m, pixels, K, NO_LENS)
    np.testing.assert_allclose(
        centre(there.T_cam_world), R @ centre(here.T_cam_world) + shift_m, rtol=0, atol=1e-5
    )
    # Relative to variances of 1e-5 m².
    np.testing.assert_allclose(
        there.centre_covariance_m2, R @ here.centre_covariance_m2 @ R.T, rtol=0, atol=1e-8
    )


def refused(points, pixels, *, noise_px=1.0):
    with pytest.raises(InputError) as error:
        locate_camera(points, pixels, K, NO_LENS, noise_px, name="camera c7")
    assert str(error.value).startswith("camera c7: ")
    assert "\n" not in str(error.value)
    return str(error.value)


def test_what_no_pose_can_be_found_from_is_refused():
    rng = np.random.default_rng(9)
    one, points = view(rng)
    pixels = project(one, points)[0]
    assert "at least 4 points of known place, found 3" in refused(points[:3], pixels[:3])
    line = np.array([0, 0, 1.0]) + np.arange(5)[:, None] * np.array([0.2, 0.1, 0.05])
    assert "not all on one line" in refused(line, project(one, line)[0])
    broken = points.copy()
    broken[2, 1] = np.nan
    assert "NaN" in refused(broken, pixels)
    mirrored = refused(points * np.array([1, -1, 1]), pixels)
    assert "right-handed axes" in mirrored
    assert "mirrored" in mirrored
    assert "mixed up" in refused(points, pixels[rng.permutation(12)])
    with pytest.raises(SettingsError, match="noise_px"):
        locate_camera(points, pixels, K, NO_LENS, 0.0)


def test_a_small_plane_far_away_has_two_poses():
    """A sheet of 20 cm at 8 m, hardly tilted: turned to the other side it looks the same."""
    R, t_m = look_at((0.9, 0.0, 8.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
    one = camera(R=R, t_m=t_m, K=K, image_size_wh=(1920, 1080))
    sheet = np.array([(x, y, 0) for x in (-0.1, 0.0, 0.1) for y in (-0.1, 0.1)])
    rng = np.random.default_rng(0)
    assert "two poses" in refused(sheet, project(one, sheet)[0] + rng.normal(0, 0.5, (6, 2)))


def test_spread_and_inflation():
    rng = np.random.default_rng(10)
    distance = np.linalg.norm(rng.normal(0, 2.0, (20001, 2)), axis=1)
    # A median of 20,000 is known to 1 %.
    assert spread_px(distance, 0) == pytest.approx(2.0, rel=0.03)
    assert spread_px(distance, 20001) == pytest.approx(2.0 * np.sqrt(2), rel=0.03)
    assert spread_px(np.ones(3), 6) == 0.0
    assert inflation(24.0, 18) == 1.0
    assert inflation(180.0, 18) == 10.0
    assert inflation(5.0, 0) == 1.0


def test_lenses_of_a_data_sheet():
    """The dataset's action camera, 92.45 x 60.83 degrees; and half of a sensor that a ray at 45 degrees meets."""
    lens = lens_of_view(92.45, 60.83, (3840, 2160))
    edges = project(
        lens, np.array([[np.tan(np.deg2rad(92.45 / 2)), 0, 1], [0, -np.tan(np.deg2rad(60.83 / 2)), 1]])
    )[0]
    # Pixel centres are at whole numbers: the image ends half a pixel after the last one.
    np.testing.assert_allclose(edges, [[3839.5, 1079.5], [1919.5, -0.5]], atol=1e-9)
    lens = lens_of_sensor(8.0, (16.0, 12.0), (640, 480))
    np.testing.assert_allclose(project(lens, np.array([1.0, 0, 1.0]))[0], [639.5, 239.5], atol=1e-9)
    with pytest.raises(SettingsError, match="between 0 and 180"):
        lens_of_view(180.0, 60.0, (640, 480))
    with pytest.raises(SettingsError, match="sensor_mm"):
        lens_of_sensor(8.0, (16.0, 0.0), (640, 480))


BOARD = Board((7, 5), 0.04, 0.03)
BOARD_K = np.array([[620.0, 0, 322.0], [0, 625.0, 236.0], [0, 0, 1]])


def board_video(path, poses, size_wh=(640, 480)):
    """The board drawn by OpenCV and warped by the homography of each pose (turn, distance, shift)."""
    per_m = 4000.0
    sheet = BOARD.opencv().generateImage((int(0.28 * per_m), int(0.2 * per_m)))
    with VideoWriter(path, 25.0, size_wh) as writer:
        for turn, shift in poses:
            R = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
            # Pixel (u, v) of the sheet is at ((u + 0.5) / per_m, (v + 0.5) / per_m) of the board.
            to_board = np.array(
                [[1 / per_m, 0, 0.5 / per_m - 0.14], [0, 1 / per_m, 0.5 / per_m - 0.1], [0, 0, 1]]
            )
            H = BOARD_K @ np.column_stack([R[:, 0], R[:, 1], shift]) @ to_board
            large = cv2.warpPerspective(
                sheet,
                np.diag([3.0, 3.0, 1.0]) @ OFFSET @ H,
                (3 * size_wh[0], 3 * size_wh[1]),
                borderValue=200,
            )
            image = cv2.resize(large, size_wh, interpolation=cv2.INTER_AREA)
            writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    return probe(path)


#: Three times as large, pixel p is at 3 p + 1.
OFFSET = np.array([[1, 0, 1 / 3], [0, 1, 1 / 3], [0, 0, 1.0]])


def test_a_lens_from_a_board(tmp_path):
    rng = np.random.default_rng(0)
    poses = [
        (rng.uniform(-35, 35, 3), (rng.uniform(-0.1, 0.1), rng.uniform(-0.08, 0.08), rng.uniform(0.32, 0.55)))
        for _ in range(30)
    ]
    lens = lens_of_board(probe_of(tmp_path, poses), BOARD)
    found = np.array([*np.diag(lens.camera.K)[:2], *lens.camera.K[:2, 2]])
    # Corners are found to a tenth of a pixel; an error of 5 standard deviations has a chance of one in a million.
    assert (np.abs(found - [620, 625, 322, 236]) < 5 * lens.std[:4] + 0.5).all()
    assert (np.abs(found - [620, 625, 322, 236]) < [6, 6, 4, 4]).all()
    assert np.abs(lens.camera.dist).max() < 0.1
    assert (lens.residual_px < 0.5).all()
    assert len(lens.frame) > 20


def probe_of(folder, poses):
    return board_video(folder / "board.avi", poses)


def test_boards_that_tell_too_little_are_refused(tmp_path):
    with pytest.raises(InputError, match="at least 8 frames that show 8 corners"):
        lens_of_board(probe_of(tmp_path, [((0, 0, 0), (0, 0, 0.4))] * 5), BOARD)
    (tmp_path / "board.avi").unlink()
    flat = [((0, 0, 3.0 * i), (0.003 * i, 0, 0.4)) for i in range(10)]
    with pytest.raises(InputError, match="views that fix the focal length"):
        lens_of_board(probe_of(tmp_path, flat), BOARD)
    with pytest.raises(SettingsError, match=r"board\.marker_m"):
        Board((7, 5), 0.04, 0.05)
    with pytest.raises(SettingsError, match="at least 3 x 3 squares"):
        Board((7, 2), 0.04, 0.03)
    with pytest.raises(SettingsError, match=r"dictionary: expected one of .*, 4x4_50, .*, found 9x9"):
        Board((7, 5), 0.04, 0.03, "9x9").opencv()


def jittered(rig: CameraRig, rng, *, turn_deg=0.6, shift_m=0.03, skip=()) -> CameraRig:
    T = rig.cameras.T_cam_world.copy()
    for index, name in enumerate(rig.names):
        if name not in skip:
            R = Rotation.from_rotvec(rng.normal(0, np.deg2rad(turn_deg), 3)).as_matrix() @ T[index, :3, :3]
            T[index, :3, :3] = R
            T[index, :3, 3] = -R @ (rig.cameras.centre_world[index] + rng.normal(0, shift_m, 3))
    return CameraRig(rig.names, replace(rig.cameras, T_cam_world=T))


def flown(rig, rng, count, *, noise_px=1.0, unseen=0.2):
    points = rng.uniform((-1.5, -1.5, 0.3), (1.5, 1.5, 2.3), (count, 3))
    pixels = project(rig.cameras, points[:, None])[0] + rng.normal(0, noise_px, (count, len(rig), 2))
    pixels[rng.random((count, len(rig))) < unseen] = np.nan
    return points, pixels


def similar(points, others):
    """Points after the similarity that brings them nearest to others (Umeyama 1991)."""
    a, b = points - points.mean(axis=0), others - others.mean(axis=0)
    U, strength, Vt = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.sign(np.linalg.det(U @ Vt))])
    return (strength * sign).sum() / (a * a).sum() * a @ (U * sign @ Vt).T + others.mean(axis=0)


def test_a_jittered_rig_comes_back_to_the_truth():
    rng = np.random.default_rng(0)
    rig = ring_rig(5, coefficients=4, image_size_wh=(1920, 1080))
    points, pixels = flown(rig, rng, 151)
    seen = np.isfinite(pixels).all(axis=-1)
    wrong = seen & (rng.random(seen.shape) < 0.03)
    pixels[wrong] += rng.choice([-1, 1], (wrong.sum(), 2)) * rng.uniform(25, 200, (wrong.sum(), 2))
    given_rig = jittered(rig, rng)
    adjusted = adjust(given_rig, pixels, 1.0)
    truth = rig.cameras.centre_world
    assert np.linalg.norm(given_rig.cameras.centre_world - truth, axis=1).mean() > 0.03
    off = np.linalg.norm(similar(adjusted.rig.cameras.centre_world, truth) - truth, axis=1)
    std = np.sqrt(np.trace(adjusted.centre_covariance_m2, axis1=1, axis2=2))
    # Aligned on five centres, errors are smaller than those of a rig that is held by its poses.
    assert (off < 4 * std).all()
    assert std.max() < 0.004
    # Outliers are found, and of a point that two cameras see both are left out.
    assert not adjusted.used[wrong].any()
    assert adjusted.used[seen & ~wrong].mean() > 0.95
    assert (np.isfinite(adjusted.residual_px) == (seen & (seen.sum(axis=1) >= 2)[:, None])).all()
    there = np.isfinite(adjusted.points_m).all(axis=1)
    # A pixel is 2.6 mm at 4 m; points that are seen twice from one side are worse.
    assert (
        np.median(np.linalg.norm(similar(adjusted.points_m[there], points[there]) - points[there], axis=1))
        < 0.005
    )


def test_the_covariance_of_the_rig_is_honest():
    """Two cameras are fixed at the truth, so that nothing need be aligned: the others' ellipsoids hold their share."""
    rng, runs = np.random.default_rng(1), 12
    rig = ring_rig(5, image_size_wh=(1920, 1080))
    distances = []
    for _ in range(runs):
        _, pixels = flown(rig, rng, 31)
        adjusted = adjust(jittered(rig, rng, skip=("c0", "c3")), pixels, 1.0, fixed=("c0", "c3"))
        off = adjusted.rig.cameras.centre_world - rig.cameras.centre_world
        # To the last bit.
        np.testing.assert_array_equal(off[[0, 3]], 0)
        np.testing.assert_array_equal(adjusted.covariance[[0, 3]], 0)
        distances += [off[i] @ np.linalg.solve(adjusted.centre_covariance_m2[i], off[i]) for i in (1, 2, 4)]
    # The three of a run are not independent: counted as if there were a third of them.
    for share in (0.5, 0.9):
        inside = (np.array(distances) < chi2.ppf(share, 3)).mean() * runs
        assert binom.ppf(0.0005, runs, share) - 1 <= inside <= binom.ppf(0.9995, runs, share) + 1


def test_the_rig_as_a_whole_stays():
    """Exact pixels of a world that was moved and grew: the cameras fit, and are as near to those given as can be."""
    rng = np.random.default_rng(2)
    rig = ring_rig(5, image_size_wh=(1920, 1080))
    _, pixels = flown(rig, rng, 61, noise_px=0.0)
    given_rig = jittered(rig, rng)
    adjusted = adjust(given_rig, pixels, 1.0)
    assert np.nanmax(adjusted.residual_px) < 1e-3
    turns = Rotation.from_matrix(
        adjusted.rig.cameras.T_cam_world[:, :3, :3].swapaxes(1, 2) @ given_rig.cameras.T_cam_world[:, :3, :3]
    ).as_rotvec()
    shifts = adjusted.rig.cameras.centre_world - given_rig.cameras.centre_world
    from_middle = given_rig.cameras.centre_world - given_rig.cameras.centre_world.mean(axis=0)
    # No slope along shifts and growth, of sums that are 0.1 m if the rig is not held.
    np.testing.assert_allclose(shifts.sum(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose((from_middle * shifts).sum(), 0, atol=1e-3)
    # And along turns: shifts of 5 cm weigh as much as turns of half a degree.
    torque = np.cross(from_middle, shifts).sum(axis=0) / 0.05**2 + turns.sum(axis=0) / np.deg2rad(0.5) ** 2
    assert np.abs(torque).max() < 0.02 * np.linalg.norm(turns, axis=1).sum() / np.deg2rad(0.5) ** 2


def test_errors_that_are_alike_within_groups_count_as_one():
    """Every error seven times: as sure as if each were there once, and not as seven independent ones."""
    rng = np.random.default_rng(6)
    rig = ring_rig(4, image_size_wh=(1920, 1080))
    points = rng.uniform((-1.5, -1.5, 0.3), (1.5, 1.5, 2.3), (60, 3))
    pixels = project(rig.cameras, points[:, None])[0] + rng.normal(0, 1, (60, 4, 2))
    seven = np.repeat(np.arange(60), 7)
    once = adjust(rig, pixels)
    alike = adjust(rig, pixels[seven], groups=seven)
    believed = adjust(rig, pixels[seven])
    variance = [
        np.trace(one.centre_covariance_m2, axis1=1, axis2=2).mean() for one in (once, alike, believed)
    ]
    # 60 groups tell a variance to a fifth.
    assert variance[1] / variance[0] == pytest.approx(1, rel=0.4)
    assert variance[2] / variance[0] == pytest.approx(1 / 7, rel=0.05)


def test_a_common_focal_length_is_found():
    rng = np.random.default_rng(4)
    rig = ring_rig(5, image_size_wh=(1920, 1080))
    _, pixels = flown(rig, rng, 151)
    wide = jittered(rig, rng)
    wrong_K = wide.cameras.K.copy()
    wrong_K[:, :2, :2] *= 1.02
    adjusted = adjust(
        CameraRig(rig.names, replace(wide.cameras, K=wrong_K)), pixels, refine_focal_length=True
    )
    # Four standard deviations.
    assert abs(adjusted.focal_scale - 1 / 1.02) < 4 * adjusted.focal_scale_std
    assert adjusted.focal_scale_std < 0.002
    np.testing.assert_allclose(
        adjusted.rig.cameras.K,
        wrong_K
        * np.array(
            [[adjusted.focal_scale, adjusted.focal_scale, 1], [1, adjusted.focal_scale, 1], [1, 1, 1]]
        ),
        rtol=1e-12,
    )


def test_what_cannot_be_adjusted_is_refused():
    rng = np.random.default_rng(5)
    rig = ring_rig(3, image_size_wh=(1920, 1080))
    _, pixels = flown(rig, rng, 23, unseen=0.0)
    blind = pixels.copy()
    blind[5:, 1] = np.nan
    with pytest.raises(
        InputError, match="camera c1: expected at least 6 points that another camera sees too, found 5"
    ):
        adjust(rig, blind)
    assert np.isfinite(adjust(rig, blind, fixed=("c1",)).rig.cameras.T_cam_world).all()
    with pytest.raises(InputError, match=r"camera c0: .* found 0"):
        adjust(rig, pixels[:0])
    with pytest.raises(SettingsError, match="fixed: expected some of c0, c1, c2, found c9"):
        adjust(rig, pixels, fixed=("c9",))
    with pytest.raises(SettingsError, match="a camera that may move"):
        adjust(rig, pixels, fixed=rig.names)
    with pytest.raises(SettingsError, match="noise_px"):
        adjust(rig, pixels, noise_px=float("nan"))
