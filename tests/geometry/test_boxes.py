"""Boxes of drones: the oracle projects dense samples of the ellipsoid's surface by `cameras.project` in float64."""

import cv2
import jax
import numpy as np
import pytest
from helpers import LENSES, float32, make_unnamed_rig, move_world, ring_rig, sphere_points
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.geometry import look_at, make_camera, make_extents, project, project_boxes


@jax.jit
def compiled_boxes(cameras, position_m, size_m):
    boxes = project_boxes(make_extents(cameras, size_m), position_m)
    return boxes.xyxy, boxes.in_front


def compute_boxes(rig, position_m, size_m):
    xyxy, in_front = compiled_boxes(float32(rig.cameras), float32(position_m), float32(size_m))
    return np.asarray(xyxy, np.float64), np.asarray(in_front)


def sampled_boxes(rig, position_m, size_m, num_points=20_000):
    """(drones, cameras, 4), the smallest boxes around sampled surface points."""
    surface = position_m[:, None] + sphere_points(num_points) * size_m[:, None] / 2
    pixels, _ = project(rig.cameras, surface[..., None, :])
    # Pixel centres are at whole numbers, and box edges lie between pixels.
    return np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=-1) + 0.5


@pytest.mark.parametrize("coefficients", [0, 5])
def test_an_offset_moves_the_extent_from_the_position(coefficients):
    """Boxes with an offset per drone equal boxes without offsets at the middles of the ellipsoids."""
    rig = ring_rig(5, coefficients=coefficients)
    position_m, size_m = random_drones(2)
    particles_m = position_m + 0.1 * np.random.default_rng(2).standard_normal((7, 2, 3))
    offset_m = np.array([[0.02, -0.01, -0.04], [0.0, 0.03, 0.05]])

    @jax.jit
    def offset_boxes(cameras, position_m, size_m, offset_m):
        return project_boxes(make_extents(cameras, size_m, offset_m), position_m).xyxy

    found = offset_boxes(*float32((rig.cameras, particles_m, size_m, offset_m)))
    expected, _ = compute_boxes(rig, particles_m + offset_m, size_m)
    # Coordinates of 5 m in float32 are exact to 5e-7 m, which is 1e-4 px; the limit is a few such errors.
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert np.abs(expected - compute_boxes(rig, particles_m, size_m)[0]).min(axis=(0, 1, 2)).max() > 0.1


def random_drones(count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform((-1, -1, 0.4), (1, 1, 2.2), (count, 3)), rng.uniform(0.2, 0.6, (count, 3))


@pytest.mark.parametrize(("num_drones", "num_cameras"), [(1, 1), (2, 5), (7, 3)])
@pytest.mark.parametrize("coefficients", sorted(LENSES))
def test_boxes_touch_the_outline(num_drones, num_cameras, coefficients):
    rig = ring_rig(num_cameras, coefficients=coefficients)
    position_m, size_m = random_drones(num_drones)
    xyxy, in_front = compute_boxes(rig, position_m, size_m)
    assert xyxy.shape == (num_drones, num_cameras, 4)
    assert in_front.all()
    sampled = sampled_boxes(rig, position_m, size_m)
    # Samples are 0.025 rad apart, so the outermost sample misses the outline by up to (0.025 / sqrt 2)^2 / 2 of the
    # half width: 0.005 px at 30 px. Float32 adds 0.001 px (see test_cameras). Distortion is applied to the middles of
    # the sides, not to the points of contact: measured 0.043 px for boxes of 14 to 44 px with these lenses, limit 0.06.
    np.testing.assert_allclose(xyxy, sampled, atol=0.06 if coefficients else 0.01)


WIDE_K = np.array([[450.0, 0.0, 640.0], [0.0, 455.0, 360.0], [0.0, 0.0, 1.0]])
BARREL = (-0.25, 0.0, 0.0, 0.0)


def wide_camera(dist, *, fisheye=False):
    """Camera at the origin that looks along the x axis."""
    R, t_m = look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    return make_camera(R=R, t_m=t_m, K=WIDE_K, image_size_wh=(1280, 720), dist=dist, fisheye=fisheye)


#: Coefficients, and whether the lens is a fisheye: lenses that show more than 45 degrees off the axis in `WIDE_K`.
WIDE_LENSES = {
    "fisheye": ((-0.012, 0.021, -0.018, 0.004), True),
    "strong barrel": (BARREL, False),
    "GoPro": ((-0.27, 0.11, 0.0003, 0.0002, -0.024), False),
    "eight coefficients": ((14.2, 8.1, 0.0004, -0.0002, 0.31, 14.5, 11.9, 2.2), False),
}


def opencv_pixels(camera, points_cam):
    """(points, 2), by OpenCV, of points in camera coordinates."""
    function = cv2.projectPoints if camera.fisheye is None else cv2.fisheye.projectPoints
    return function(points_cam[:, None], np.zeros(3), np.zeros(3), camera.K, camera.dist)[0][:, 0]


def fold_angle(camera):
    """Angle off the axis up to which OpenCV's pixels move outwards in all directions; 90 degrees at most."""
    angles, around = np.radians(np.arange(0.05, 90, 0.05)), np.radians(np.arange(0, 360, 15))
    ray = [
        np.outer(np.tan(angles), np.cos(around)),
        np.outer(np.tan(angles), np.sin(around)),
        np.ones((len(angles), len(around))),
    ]
    pixels = opencv_pixels(camera, np.stack(ray, axis=-1).reshape(-1, 3)).reshape(*ray[0].shape, 2)
    radius = np.linalg.norm((pixels - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]], axis=-1)
    inwards = (np.diff(radius, axis=0) <= 0).any(axis=1)
    return angles[inwards.argmax()] if inwards.any() else np.pi / 2


@pytest.mark.parametrize("name", WIDE_LENSES)
def test_boxes_at_the_edge_of_a_wide_lens_and_beyond(name):
    """OpenCV projects dense samples of each drone; drones are anywhere, also where the lens shows a part or nothing."""
    dist, fisheye = WIDE_LENSES[name]
    camera = wide_camera(dist, fisheye=fisheye)
    rng = np.random.default_rng(0)
    count = 400
    angle, around, distance_m = rng.uniform((0, 0, 1.5), (2.2, 2 * np.pi, 6.0), (count, 3)).T
    across = np.sin(angle)
    position_m = distance_m[:, None] * np.stack(
        [np.cos(angle), across * np.cos(around), across * np.sin(around)], axis=-1
    )
    size_m = rng.uniform(0.2, 0.5, (count, 3))
    xyxy, in_front = (one[:, 0] for one in compute_boxes(make_unnamed_rig(camera), position_m, size_m))
    assert np.isfinite(xyxy).all()

    surface = position_m[:, None] + sphere_points(4000) * size_m[:, None] / 2
    points_cam = surface @ camera.T_cam_world[:3, :3].T
    off_axis = np.arctan2(np.hypot(points_cam[..., 0], points_cam[..., 1]), points_cam[..., 2]).max(axis=1)
    fold = fold_angle(camera)
    # The grid of angles, float32 near the fold, and samples that miss the farthest point.
    assert not in_front[off_axis > fold + np.radians(0.2)].any()
    # At 89 degrees a tangent is 57; the eight coefficients' quotient then changes by less than float32 resolves.
    assert in_front[off_axis < min(fold, np.radians(89)) - np.radians(0.2)].all()
    straddles = (off_axis > fold) & (angle < fold)
    assert straddles.sum() >= 8

    size_wh = camera.image_size_wh
    seen = np.flatnonzero(in_front)
    num_outside = 0
    for drone in seen:
        pixels = opencv_pixels(camera, points_cam[drone]) + 0.5
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        # What counts of a box is its part in the picture.
        found, expected = (np.clip(box, 0, [*size_wh, *size_wh]) for box in (xyxy[drone], [*low, *high]))
        if (high < 0).any() or (low > size_wh).any():
            num_outside += 1
            assert (found[2:] - found[:2]).min() < 0.1
            continue
        # The lens is linear over the drone up to the square of the drone's angular size, at most (1 / 6)². Before the
        # fold of a lens its second derivative is several times its first one.
        limit = 0.1 + 3 * (size_m[drone].max() / distance_m[drone] / 2) ** 2 * (high - low).max()
        assert np.abs(found - expected).max() < limit, (np.degrees(angle[drone]), found, expected)
    assert len(seen) > 80
    assert num_outside >= (0 if name in ("strong barrel", "GoPro") else 5)

    cameras, size_m = float32((make_unnamed_rig(camera).cameras, size_m))
    gradient = jax.grad(lambda position: compiled_boxes(cameras, position, size_m)[0].sum())
    assert np.isfinite(jax.jit(gradient)(float32(position_m))).all()


def test_the_box_of_a_large_near_ellipsoid_is_exact():
    """An ellipsoid of 1 m at a distance of 1 m: the box of its middle cross-section is tens of pixels too small."""
    rig = ring_rig(3)
    position_m = rig.cameras.centre_world[:1] + 1.3 * rig.cameras.T_cam_world[:1, 2, :3] + [[0.1, 0.2, 0.1]]
    size_m = np.array([[1.0, 0.8, 0.9]])
    xyxy, _ = compute_boxes(rig, position_m, size_m)
    # With half widths of 200 px, the outermost sample misses the outline by 0.03 px.
    np.testing.assert_allclose(xyxy, sampled_boxes(rig, position_m, size_m), atol=0.05)


shifts = st.lists(st.floats(-3, 3), min_size=3, max_size=3)


@given(st.lists(st.floats(-np.pi, np.pi), min_size=3, max_size=3), shifts, st.sampled_from(sorted(LENSES)))
def test_turning_world_and_rig_together_changes_no_box_of_a_sphere(turn, shift_m, coefficients):
    rig = ring_rig(3, coefficients=coefficients)
    position_m, _ = random_drones(2)
    size_m = np.array([[0.4] * 3, [0.25] * 3])
    R = Rotation.from_rotvec(turn).as_matrix()
    xyxy, _ = compute_boxes(rig, position_m, size_m)
    turned, _ = compute_boxes(move_world(rig, R, shift_m), position_m @ R.T + shift_m, size_m)
    np.testing.assert_allclose(turned, xyxy, atol=3e-3)


def test_particles_drones_and_cameras_broadcast():
    rig = ring_rig(5)
    _, size_m = random_drones(2)
    position_m = random_drones(14)[0].reshape(7, 2, 3)
    together, _ = compute_boxes(rig, position_m, size_m)
    assert together.shape == (7, 2, 5, 4)
    for particle in range(7):
        alone, _ = compute_boxes(rig, position_m[particle], size_m)
        # Both are the same arithmetic, but the compiler may fuse operations differently.
        np.testing.assert_allclose(together[particle], alone, atol=1e-3)


@pytest.mark.parametrize("distance_m", [-3.0, -0.05, 0.0, 0.1, 0.199])
def test_behind_or_around_the_camera_is_flagged_and_finite(distance_m):
    """A drone behind or around a camera has no valid box, but the box's numbers and gradients are finite."""
    rig = ring_rig(3, coefficients=5)
    position_m = rig.cameras.centre_world[:1] + distance_m * rig.cameras.T_cam_world[:1, 2, :3]
    size_m = np.full((1, 3), 0.4)
    xyxy, in_front = compute_boxes(rig, position_m, size_m)
    assert not in_front[0, 0]
    assert in_front[0, 1:].all()
    assert np.isfinite(xyxy).all()

    def total(position):
        return compiled_boxes(float32(rig.cameras), position, float32(size_m))[0].sum()

    assert np.isfinite(jax.jit(jax.grad(total))(float32(position_m))).all()


@given(
    st.lists(st.floats(-8, 8, width=32), min_size=3, max_size=3),
    st.lists(st.floats(0.015625, 1.5, width=32), min_size=3, max_size=3),
)
def test_edges_are_in_order_for_drones_in_front(position_m, size_m):
    xyxy, in_front = compute_boxes(ring_rig(5), np.array([position_m]), np.array([size_m]))
    assert np.isfinite(xyxy).all()
    x0, y0, x1, y1 = xyxy[in_front].T
    assert (x0 < x1).all()
    assert (y0 < y1).all()
