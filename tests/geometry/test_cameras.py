"""Cameras and their lenses, with OpenCV as the oracle, also for where a lens folds; rotations; views that meet."""

from dataclasses import replace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from board_rigs import record_detections
from helpers import assert_refused, float32, opencv_pixels, posed, simple_lens, sphere_points
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.geometry import (
    NEAR_M,
    cross_matrices,
    has_image,
    look_at,
    make_camera,
    make_rig,
    project,
    project_with_jacobian,
    rotation_matrices,
    sizes_m,
    sizes_px,
    undistort,
    undistortion_stretch,
    views_meet,
)
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import Detections

SIZE_WH = (1920, 1080)
K = np.array([[1050.0, 0.0, 965.0], [0.0, 1043.0, 532.0], [0.0, 0.0, 1.0]])
WIDE_K = np.diag([0.45, 0.45, 1.0]) @ K
RATIONAL = (14.2, 8.1, 0.0004, -0.0002, 0.31, 14.5, 11.9, 2.2)
PRISM = (-0.28, 0.11, 0.0007, -0.0011, -0.02, 0.02, -0.01, 0.003, 0.0011, -0.0004, -0.0008, 0.0003)
LENSES = {
    "weak barrel": (K, (-0.12, 0.03, 0.0008, -0.0005), False),
    "folds with decentring": (WIDE_K, (-0.25, 0.03, 0.004, -0.003, -0.001), False),
    "GoPro": (0.9 * WIDE_K + np.diag([0, 0, 0.1]), (-0.27, 0.11, 0.0003, 0.0002, -0.024), False),
    "rational": (WIDE_K, RATIONAL, False),
    "pole": (WIDE_K, (0.1, 0.0, 0.0, 0.0, 0.0, -0.2, 0.0, 0.0), False),
    "tilt": (K, (*PRISM, 0.06, -0.04), False),
    "fisheye": (WIDE_K, (-0.012, 0.021, -0.018, 0.004), True),
    "fisheye that folds": (WIDE_K, (-0.13, 0.0, 0.0, 0.0), True),
}


def make_lens(name):
    lens_K, dist, fisheye = LENSES[name]
    return make_camera(
        R=np.eye(3), t_m=np.zeros(3), K=lens_K, image_size_wh=SIZE_WH, dist=dist, fisheye=fisheye
    )


def rays(angles_deg, directions=16):
    """Points on rays from the axis outwards, (directions, angles, 3)."""
    around = 2 * np.pi * (np.arange(directions) + 0.3) / directions
    r = np.tan(np.radians(angles_deg))
    x = np.outer(np.cos(around), r)
    y = np.outer(np.sin(around), r)
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def opencv_determinant(lens, points):
    """Determinant of the pixels' derivative by x and y, by differences of OpenCV's pixels."""
    step = 1e-6 * (1 + np.abs(points[..., :2]).max(axis=-1, keepdims=True))
    by = []
    for axis in np.eye(3)[:2]:
        ahead = opencv_pixels(lens, points + step * axis)
        behind = opencv_pixels(lens, points - step * axis)
        by.append((ahead - behind) / (2 * step))
    slopes = np.stack(by, axis=-1) / np.diag(lens.K)[:2, None]
    return np.linalg.det(slopes)


def before_fold(lens, points):
    """Points before, and points beyond, the first change of sign on their ray; points at the fold are neither."""
    determinant = opencv_determinant(lens, points)
    before = np.logical_and.accumulate(determinant > 1e-4, axis=1)
    beyond = np.logical_or.accumulate(determinant < -1e-4, axis=1)
    return before, beyond


@pytest.mark.parametrize("name", LENSES)
def test_pixels_equal_opencvs_come_back_before_the_fold_and_have_no_point_beyond(name):
    lens = make_lens(name)
    points = rays(np.linspace(0, 85, 400))
    pixels = opencv_pixels(lens, points)
    # Both are float64. Pixels far outside the image are large numbers.
    found, _ = project(lens, points)
    np.testing.assert_allclose(found, pixels, rtol=1e-11, atol=1e-9)
    before, beyond = before_fold(lens, points)
    assert before[:, :100].all()
    back = undistort(lens, pixels)
    # The determinant is above 1e-4, so that an error of 1e-8 px is at most 1e-4 px in the undistorted image.
    np.testing.assert_allclose(back[before], points[before][:, :2], rtol=1e-7, atol=1e-7)
    # A pixel that comes back shows the point that was found.
    known = np.isfinite(back).all(axis=-1)
    found = cv2.convertPointsToHomogeneous(back[known])[:, 0]
    np.testing.assert_allclose(opencv_pixels(lens, found), pixels[known], rtol=1e-9, atol=1e-6)
    shown = has_image(lens, points)
    assert shown[before].all()
    assert not shown[beyond].any()
    # A pixel of a point beyond the fold shows another point, which is nearer to the axis, or none.
    known &= beyond
    radius = np.linalg.norm(back[known], axis=-1)
    assert (radius < np.linalg.norm(points[known][:, :2], axis=-1)).all()


@pytest.mark.parametrize("name", LENSES)
def test_derivatives_equal_differences(name):
    lens = make_lens(name)
    points = np.random.default_rng(1).uniform((-1, -0.6, 1.0), (1, 0.6, 2.0), (40, 3))
    pixels, _, slopes = project_with_jacobian(lens, points)
    expected, _ = project(lens, points)
    np.testing.assert_allclose(pixels, expected, rtol=1e-13)
    for axis, step in enumerate(1e-6 * np.eye(3)):
        ahead, _ = project(lens, points + step)
        behind, _ = project(lens, points - step)
        by_axis = (ahead - behind) / 2e-6
        np.testing.assert_allclose(slopes[..., axis], by_axis, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("name", LENSES)
def test_float32_pixels_are_within_a_thousandth(name):
    lens = make_lens(name)
    points = rays(np.linspace(0, 60, 40))
    exact, _ = project(lens, points)
    visible = has_image(lens, points)
    near = (exact > -100) & (exact < np.array(SIZE_WH) + 100)
    near = visible & near.all(axis=-1)
    pixels, _ = jax.jit(project)(float32(lens), float32(points))
    assert pixels.dtype == jnp.float32
    # x / z itself is rounded, by 6e-8 of up to 2 in 1000 px.
    np.testing.assert_allclose(np.asarray(pixels)[near], exact[near], atol=1e-3)
    shown = jax.jit(has_image)(float32(lens), float32(points))
    assert np.mean(shown == visible) > 0.99


@pytest.mark.parametrize("name", ["weak barrel", "tilt", "fisheye"])
def test_points_on_the_axis_and_behind_the_camera_have_finite_pixels_and_gradients(name):
    lens = float32(make_lens(name))
    points = float32(np.array([[0.0, 0.0, 2.0], [1e-9, 0, 1], [0.3, 0.2, -1], [0, 0, 0]]))
    pixels, depth = jax.jit(project)(lens, points)
    assert np.isfinite(pixels).all()
    np.testing.assert_array_equal(depth, points[:, 2])
    assert (depth < NEAR_M).tolist() == [False, False, True, True]

    def sum_of_pixels(points):
        return project(lens, points)[0].sum()

    for derivative in (jax.jacfwd, jax.grad):
        slopes = jax.jit(derivative(sum_of_pixels))(points)
        assert np.isfinite(slopes).all()


MIXED = ("weak barrel", "fisheye", "tilt")


def mixed_rig():
    """Three cameras with other lenses that look at the middle of a room."""
    centres_m = [(4.0, 0.5, 2.0), (-3.5, 1.0, 2.4), (0.0, -5.0, 1.5)]
    cameras = {}
    for name, centre_m in zip(MIXED, centres_m, strict=True):
        cameras[name] = posed(make_lens(name), centre_m, (0.0, 0.0, 1.0))
    return make_rig(cameras)


POINTS_M = np.random.default_rng(0).uniform((-1, -1, 0.2), (1, 1, 2), (30, 3))


def test_rigs_mix_lens_models():
    rig = mixed_rig()
    assert rig.cameras.fisheye.tolist() == [False, True, False]
    assert rig.cameras.dist.shape == (3, 14)
    pixels, depth_m = project(rig.cameras, POINTS_M[:, None])
    back = undistort(rig.cameras, pixels)
    for i, name in enumerate(MIXED):
        T = rig.cameras.T_cam_world[i]
        lens = replace(make_lens(name), T_cam_world=T)
        np.testing.assert_allclose(pixels[:, i], opencv_pixels(lens, POINTS_M), atol=1e-9)
        in_camera = POINTS_M @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(depth_m[:, i], in_camera[:, 2], atol=1e-12)
        np.testing.assert_allclose(back[:, i], in_camera[:, :2] / in_camera[:, 2:], atol=1e-9)
        shown = has_image(rig.cameras, in_camera[:, None])
        np.testing.assert_array_equal(shown[:, i], has_image(lens, in_camera))
    pinholes = rig.select(["weak barrel", "tilt"])
    of_pinholes, _ = project(pinholes.cameras, POINTS_M[:, None])
    np.testing.assert_array_equal(of_pinholes, pixels[:, [0, 2]])
    # A rig of pinholes alone computes no fisheye.
    alone = make_rig({"a": make_lens("tilt")})
    assert len(jax.tree.leaves(alone.cameras)) == 4


@pytest.mark.parametrize("centre_m", [(4.0, 0.0, 2.0), (-1.0, 3.0, 0.5), (0.1, 0.0, 9.0)])
def test_look_at(centre_m):
    target_m = (0.0, 0.2, 1.0)
    R, t_m = look_at(centre_m, target_m)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    np.testing.assert_allclose(R @ np.array(centre_m) + t_m, 0, atol=1e-12)
    distance = np.linalg.norm(np.subtract(target_m, centre_m))
    np.testing.assert_allclose(R @ np.array(target_m) + t_m, (0, 0, distance), atol=1e-12)
    # The image is upright: a point above the target has a smaller row and the same column.
    assert R[1, 2] < 0
    assert abs(R[0, 2]) < 1e-12


def test_rotation_and_cross_product_matrices_equal_scipys_and_numpys():
    rng = np.random.default_rng(0)
    turns = Rotation.random(12, rng=rng)
    wxyz = turns.as_quat(scalar_first=True)
    found = rotation_matrices(wxyz.reshape(4, 3, 4))
    np.testing.assert_allclose(found.reshape(12, 3, 3), turns.as_matrix(), rtol=0, atol=1e-14)
    wxyz[5] = np.nan
    known = np.isfinite(rotation_matrices(wxyz)).all(axis=(1, 2))
    assert np.flatnonzero(~known).tolist() == [5]
    vectors, others = rng.normal(size=(2, 5, 2, 3))
    # Rounding of differences of products of small numbers.
    found = np.matvec(cross_matrices(vectors), others)
    np.testing.assert_allclose(found, np.cross(vectors, others), rtol=0, atol=1e-14)


@settings(deadline=None, max_examples=40)
@given(
    st.sampled_from([4, 5, 8, 12, 14]),
    st.lists(st.floats(-1, 1), min_size=14, max_size=14),
    st.lists(st.floats(-1, 1), min_size=2, max_size=2),
    st.floats(-30, 30),
)
def test_every_lens_comes_back_and_zeros_change_nothing(coefficients, numbers, xy, skew):
    size = np.array([0.4, 0.2, 0.003, 0.003, 0.1, 0.3, 0.1, 0.05, *4 * [0.002], 0.1, 0.1])
    dist = (numbers * size)[:coefficients].tolist()
    skewed = K.copy()
    skewed[0, 1] = skew
    flat = make_camera(R=np.eye(3), t_m=np.zeros(3), K=np.eye(3), dist=dist, image_size_wh=SIZE_WH)
    lens = replace(flat, K=skewed)
    point = np.array([*xy, 1.0])
    pixel, _ = project(lens, point)
    # The formula of skew: OpenCV's projection has no skew, so that it is added to normalised coordinates.
    bent = np.append(opencv_pixels(flat, point), 1.0)
    np.testing.assert_allclose(pixel, skewed[:2] @ bent, rtol=1e-12)
    padded = replace(lens, dist=np.pad(dist, (0, 14 - coefficients)))
    same, _ = project(padded, point)
    np.testing.assert_allclose(same, pixel, rtol=1e-14)
    back = np.append(undistort(lens, pixel), 1.0)
    if np.isfinite(back).all():
        assert has_image(lens, back)
        again, _ = project(lens, back)
        np.testing.assert_allclose(again, pixel, atol=1e-6)
    else:
        assert not has_image(lens, point)


@pytest.mark.parametrize("name", ["fisheye", "fisheye that folds"])
def test_sizes_of_small_spheres_follow_from_their_boxes(name):
    rig = make_rig({name: make_lens(name)})
    points = 3 * rays([0.0, 20.0, 40.0], 5).reshape(-1, 1, 3)
    surface = points + 0.01 * sphere_points(4000)
    pixels = opencv_pixels(rig.cameras[0], surface)
    size_px = np.ptp(pixels, axis=1)[:, None]
    # Of 4000 points on a sphere, the outermost ones miss the outline by a thousandth of its radius.
    np.testing.assert_allclose(sizes_m(rig.cameras, points, size_px), 0.02, rtol=4e-3)
    size_m = np.full((1, 1, 2), 0.02)
    np.testing.assert_allclose(sizes_px(rig.cameras, points, size_m), size_px, rtol=4e-3)


@pytest.mark.parametrize("name", ["tilt", "fisheye", "GoPro"])
def test_undistorting_stretches_small_circles(name):
    lens = make_lens(name)
    points = rays([0.0, 25.0, 45.0], 5).reshape(-1, 1, 3)
    angle = np.arange(0, 6.28, 0.1)
    around = 1e-4 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    pixels = opencv_pixels(lens, points) + around * np.diag(lens.K)[:2]
    off = undistort(lens, pixels) - points[..., :2]
    squares = (off**2).sum(axis=-1)
    expected = np.sqrt(squares.mean(axis=-1)) / 1e-4
    found = undistortion_stretch(lens, points[:, 0, :2])
    np.testing.assert_allclose(found, expected, rtol=5e-3)


# Views that meet, and rigs in whose common view no drone can be found.

FRAMES = 40


def rig_of(centres_m, targets_m, focal_px=1000.0, dist=()):
    """Cameras at places that look at targets."""
    lens = simple_lens(focal_px, (1920, 1080), dist)
    looks = enumerate(zip(centres_m, targets_m, strict=True))
    return make_rig({f"{number}": posed(lens, *look) for number, look in looks})


def around(target_m):
    centres_m = [(6, 0, 3), (-2, 5, 2), (-3, -5, 4)]
    return rig_of(centres_m, [target_m] * 3)


ANGLE = np.array([0.0, 2.1, 4.2])
DIRECTIONS = np.stack([np.cos(ANGLE), np.sin(ANGLE), np.zeros(3)], axis=-1)
#: Cameras beside each other that look away from each other, with lenses that distort.
OUTWARDS = rig_of(DIRECTIONS, 9 * DIRECTIONS, focal_px=3000.0, dist=(-0.2, 0.05, 0.0, 0.0))
#: Two cameras 100 m away from the middle, with images of 3 m there.
FAR_M = [(-100, 0, 1), (0, -100, 1)]
#: What it shows -> a rig, and whether views of its cameras meet.
RIGS = {
    "around": (around((0.0, 0.0, 1.5)), True),
    "side by side": (rig_of([(0, 0, 1), (4, 0, 1)], [(0, 9, 1), (4, 9, 1)]), True),
    "back to back": (rig_of([(0, 1, 1), (0, -1, 1)], [(0, 9, 1), (0, -9, 1)]), False),
    "far": (rig_of(FAR_M, [(0, 0, 1), (0, 0, 1)], focal_px=6e4), True),
    "far, at two heights": (rig_of(FAR_M, [(0, 0, 1), (0, 0, 21)], focal_px=6e4), False),
    "outwards": (OUTWARDS, False),
}


@pytest.mark.parametrize(("rig", "meet"), RIGS.values(), ids=RIGS)
def test_whether_views_meet(rig, meet):
    assert views_meet(rig.cameras) == meet


@pytest.mark.slow
def test_tracks_from_cameras_that_stand_elsewhere_than_stated_are_refused(run_psotrack, tmp_path):
    """Detections by cameras that look at a room, with the calibration of cameras that look elsewhere."""
    folder = tmp_path / "recording"
    true = around((0.0, 0.0, 1.5))
    time_s = np.arange(FRAMES)[:, None] / 25.0 + 3.0 * np.arange(2)
    truth_m = np.stack([np.sin(time_s), np.cos(1.3 * time_s), 1.5 + 0.4 * np.sin(2 * time_s)], axis=-1)
    frame = np.repeat(np.arange(FRAMES), 2)
    seen = {}
    for index, name in enumerate(true.names):
        centre_px, _ = project(true.cameras[index], truth_m.reshape(-1, 3))
        boxes = np.concatenate([centre_px - 5.5, centre_px + 6.5], axis=1)
        seen[name] = Detections(frame, boxes, np.ones(len(frame)))
    record_detections(folder, seen, OUTWARDS)
    words = ("track", folder, "--method", "projection-lines", "--out", folder / "tracks.csv")

    def track():
        return run_psotrack(*words, "--cache", tmp_path / "cache")

    expected = "expected cameras of which two have a place in view together"
    assert_refused(track, expected, "found that no views of 0, 1, 2 meet", unchanged=folder)
    write_rig(folder / "rig.toml", around((0.0, 0.9, 2.5)), force=True)
    expected = f"detections of different cameras that meet in a place in 0 of {FRAMES} frames"
    assert_refused(track, expected, f"`psotrack doctor {folder}`", unchanged=folder)
