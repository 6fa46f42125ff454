"""Projection: OpenCV is the oracle for distortion, and rigid motions of the world are the oracle for the geometry."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import LENSES, float32, move_world, ring_rig
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.geometry import NEAR_M, look_at, project


def points_in_room(count, seed=0):
    return np.random.default_rng(seed).uniform((-2, -2, 0.2), (2, 2, 2.5), (count, 3))


def opencv_pixels(camera, points):
    R, t = camera.T_cam_world[:3, :3], camera.T_cam_world[:3, 3]
    dist = camera.dist if camera.dist.size else None
    return cv2.projectPoints(points, cv2.Rodrigues(R)[0], t, camera.K, dist)[0][:, 0]


@pytest.mark.parametrize("coefficients", sorted(LENSES))
@pytest.mark.parametrize("num_cameras", [1, 5])
def test_pixels_equal_those_of_opencv(num_cameras, coefficients):
    rig, points = ring_rig(num_cameras, coefficients=coefficients), points_in_room(7)
    pixels, depth = project(rig.cameras, points[:, None, :])
    assert pixels.shape == (7, num_cameras, 2)
    assert pixels.dtype == np.float64
    for i in range(num_cameras):
        # Both are float64; 1e-9 px is a thousand roundings of 300 px. OpenCV converts through Rodrigues vectors.
        np.testing.assert_allclose(pixels[:, i], opencv_pixels(rig.cameras[i], points), atol=1e-9)
        R, t = rig.cameras.T_cam_world[i, :3, :3], rig.cameras.T_cam_world[i, :3, 3]
        np.testing.assert_allclose(depth[:, i], (points @ R.T + t)[:, 2], atol=1e-12)


@given(
    st.lists(st.floats(-np.pi, np.pi), min_size=3, max_size=3),
    st.lists(st.floats(-10, 10), min_size=3, max_size=3),
    st.sampled_from(sorted(LENSES)),
)
def test_moving_world_and_rig_together_changes_no_pixel(turn, shift_m, coefficients):
    rig, points = ring_rig(3, coefficients=coefficients), points_in_room(5)
    R = Rotation.from_rotvec(turn).as_matrix()
    pixels, depth = project(rig.cameras, points[:, None, :])
    pixels_moved, depth_moved = project(
        move_world(rig, R, shift_m).cameras, (points @ R.T + shift_m)[:, None, :]
    )
    # Shifts of 10 m cost one or two of float64's sixteen digits.
    np.testing.assert_allclose(pixels_moved, pixels, atol=1e-9)
    np.testing.assert_allclose(depth_moved, depth, atol=1e-12)


@pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])
def test_points_behind_have_finite_pixels_and_negative_depth(xp):
    rig = ring_rig(3, coefficients=5)
    cameras = rig.cameras if xp is np else float32(rig.cameras)
    behind = rig.cameras.centre_world - 0.5 * rig.cameras.T_cam_world[:, 2, :3]
    at_centre = rig.cameras.centre_world
    for points, expected in ((behind, -0.5), (at_centre, 0.0)):
        pixels, depth = project(cameras, xp.asarray(points, xp.float64 if xp is np else xp.float32))
        assert np.isfinite(pixels).all()
        # Float32 at coordinates of 4 m: 2e-7 relative.
        np.testing.assert_allclose(depth, expected, atol=1e-12 if xp is np else 3e-6)
        assert (np.asarray(depth) < NEAR_M).all()


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
