"""Triangulation against exact cases, OpenCV (two cameras) and explicit least squares; viewpoints."""

import cv2
import numpy as np
import pytest
from helpers import LENSES, make_unnamed_rig, points_in_room, project_points, ring_rig

from psotrack.geometry import (
    triangulate_linearly,
    viewpoints,
)


@pytest.mark.parametrize("coefficients", sorted(LENSES))
@pytest.mark.parametrize(("num_cameras", "shape"), [(2, (7,)), (3, (5, 2)), (5, ()), (7, (3,))])
def test_exact_pixels_give_the_point(num_cameras, shape, coefficients):
    rig, points = ring_rig(num_cameras, coefficients=coefficients), points_in_room(*shape)
    found = triangulate_linearly(rig.cameras, project_points(rig, points))
    assert found.shape == points.shape
    # Pixels are undistorted to 1e-8 (see test_cameras), which is 4e-8 m at 4 m; two cameras enlarge the error a little.
    np.testing.assert_allclose(found, points, atol=1e-6)


def test_two_cameras_agree_with_opencv():
    rig, points = ring_rig(2), points_in_room(31)
    noise = np.random.default_rng(1).normal(0, 0.3, (31, 2, 2))
    pixels = project_points(rig, points) + noise
    projections = rig.cameras.K @ rig.cameras.T_cam_world[:, :3]
    homogeneous = cv2.triangulatePoints(*projections, pixels[:, 0].T.copy(), pixels[:, 1].T.copy())
    expected = (homogeneous[:3] / homogeneous[3]).T
    # Both solve the same four equations, OpenCV with a norm of one on (X, 1), in pixels: with noise of 0.3 px, a point
    # is off by 5 mm, and the two differ where the rays miss each other: measured 0.2 mm, limit 1 mm.
    np.testing.assert_allclose(triangulate_linearly(rig.cameras, pixels), expected, atol=1e-3)
    exact = project_points(rig, points)
    homogeneous = cv2.triangulatePoints(*projections, exact[:, 0].T.copy(), exact[:, 1].T.copy())
    np.testing.assert_allclose(
        triangulate_linearly(rig.cameras, exact), (homogeneous[:3] / homogeneous[3]).T, atol=1e-6
    )


def test_weighted_least_squares():
    """Equations (3) of the paper, solved by `lstsq`, with noise so that no point solves them exactly."""
    rig, points = ring_rig(5), points_in_room(11)
    rng = np.random.default_rng(2)
    pixels = project_points(rig, points) + rng.normal(0, 1.0, (11, 5, 2))
    weights = rng.uniform(0.1, 2, (11, 5))
    found = triangulate_linearly(rig.cameras, pixels, weights)
    for n in range(11):
        rows, right = [], []
        for c in range(5):
            x, y, _ = np.linalg.inv(rig.cameras.K[c]) @ (*pixels[n, c], 1)
            r1, r2, r3, _ = rig.cameras.T_cam_world[c]
            for r, value in ((r1, x), (r2, y)):
                rows.append(np.sqrt(weights[n, c]) * (value * r3[:3] - r[:3]))
                right.append(np.sqrt(weights[n, c]) * (r[3] - value * r3[3]))
        expected = np.linalg.lstsq(np.array(rows), np.array(right))[0]
        # Normal equations square the condition number, here about 10.
        np.testing.assert_allclose(found[n], expected, atol=1e-10)


def test_a_camera_that_does_not_see_the_point_does_not_count():
    rig, points = ring_rig(5), points_in_room(7)
    pixels = project_points(rig, points) + np.random.default_rng(3).normal(0, 1, (7, 5, 2))
    gone = pixels.copy()
    gone[:, 1] = np.nan
    gone[:, 3, 0] = np.nan
    without = rig.select(["c0", "c2", "c4"])
    expected = triangulate_linearly(without.cameras, pixels[:, [0, 2, 4]])
    np.testing.assert_allclose(triangulate_linearly(rig.cameras, gone), expected, atol=1e-12)
    weights = np.array([1.0, 0.0, 1.0, 0.0, 1.0]) * np.ones((7, 1))
    np.testing.assert_allclose(triangulate_linearly(rig.cameras, pixels, weights), expected, atol=1e-12)


@pytest.mark.parametrize("num_seeing", [0, 1])
def test_too_few_cameras_is_nan(num_seeing):
    rig, points = ring_rig(5), points_in_room(3)
    pixels = project_points(rig, points)
    pixels[1, num_seeing:] = np.nan
    found = triangulate_linearly(rig.cameras, pixels)
    assert np.isnan(found[1]).all()
    np.testing.assert_allclose(found[[0, 2]], points[[0, 2]], atol=1e-6)


def test_rays_from_one_position_are_nan():
    """Two cameras at one position see a point along one ray, without depth. So does a single camera with weight."""
    one = ring_rig(3).cameras[0]
    rig = make_unnamed_rig(one, one)
    pixels = project_points(rig, points_in_room(3))
    assert np.isnan(triangulate_linearly(rig.cameras, pixels)).all()
    rig = ring_rig(3)
    weights = np.array([[0.0, 1.0, 0.0]] * 3)
    assert np.isnan(triangulate_linearly(rig.cameras, project_points(rig, points_in_room(3)), weights)).all()


def test_cameras_side_by_side_share_a_viewpoint():
    rig = ring_rig(4)
    doubled = make_unnamed_rig(*(rig.cameras[i] for i in (0, 1, 0, 2, 1, 3)))
    label = viewpoints(doubled.cameras)
    assert label[0] == label[2]
    assert label[1] == label[4]
    assert len(set(label.tolist())) == 4
