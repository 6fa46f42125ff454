"""Boxes of drones: the oracle projects dense samples of the ellipsoid's surface by `project` in float64."""

import jax
import numpy as np
import pytest
from helpers import LENSES, float32, make_unnamed_rig, move_world, ring_rig, sphere_points
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.geometry import has_image, look_at, make_camera, make_extents, project, project_boxes


@jax.jit
def compiled_boxes(cameras, position_m, size_m, offset_m):
    boxes = project_boxes(make_extents(cameras, size_m, offset_m), position_m)
    return boxes.xyxy, boxes.in_front


def compute_boxes(rig, position_m, size_m, offset_m=0.0):
    offset_m = np.broadcast_to(offset_m, np.shape(size_m))
    xyxy, in_front = compiled_boxes(*float32((rig.cameras, position_m, size_m, offset_m)))
    return np.asarray(xyxy, np.float64), np.asarray(in_front)


def surface_of(position_m, size_m, count=20_000):
    """(..., drones, samples, 3), points on the surfaces of ellipsoids."""
    return position_m[..., None, :] + sphere_points(count) * size_m[:, None] / 2


def sampled_boxes(rig, surface_m):
    """(..., drones, cameras, 4), the smallest boxes around sampled surface points."""
    pixels, _ = project(rig.cameras, surface_m[..., None, :])
    # Pixel centres are at whole numbers, and box edges lie between pixels.
    return np.concatenate([pixels.min(axis=-3), pixels.max(axis=-3)], axis=-1) + 0.5


def random_drones(*shape):
    """Positions of drones, (*shape, 3), and their sizes."""
    rng = np.random.default_rng(0)
    position_m = rng.uniform((-1, -1, 0.4), (1, 1, 2.2), (*shape, 3))
    return position_m, rng.uniform(0.2, 0.6, (shape[-1], 3))


@pytest.mark.parametrize(("shape", "num_cameras"), [((1,), 1), ((2, 2), 5), ((7,), 3)])
@pytest.mark.parametrize("coefficients", sorted(LENSES))
def test_boxes_touch_the_outline_of_the_extent_around_the_position(shape, num_cameras, coefficients):
    rig = ring_rig(num_cameras, coefficients=coefficients)
    position_m, size_m = random_drones(*shape)
    offset_m = np.random.default_rng(2).uniform(-0.05, 0.05, size_m.shape)
    xyxy, in_front = compute_boxes(rig, position_m, size_m, offset_m)
    assert xyxy.shape == (*shape, num_cameras, 4)
    assert in_front.all()
    sampled = sampled_boxes(rig, surface_of(position_m + offset_m, size_m))
    # Samples are 0.025 rad apart, so the outermost sample misses the outline by up to (0.025 / sqrt 2)^2 / 2 of the
    # half width: 0.005 px at 30 px. Float32 adds 0.001 px (see test_cameras). Distortion is applied to the middles of
    # the sides, not to the points of contact: measured 0.043 px for boxes of 14 to 44 px with these lenses, limit 0.06.
    np.testing.assert_allclose(xyxy, sampled, atol=0.06 if coefficients else 0.01)


def test_the_box_of_a_large_near_ellipsoid_is_exact():
    """An ellipsoid of 1 m at a distance of 1 m: the box of its middle cross-section is tens of pixels too small."""
    rig = ring_rig(3)
    ahead = rig.cameras.T_cam_world[:1, 2, :3]
    position_m = rig.cameras.centre_world[:1] + 1.3 * ahead + [0.1, 0.2, 0.1]
    size_m = np.array([[1.0, 0.8, 0.9]])
    xyxy, _ = compute_boxes(rig, position_m, size_m)
    expected = sampled_boxes(rig, surface_of(position_m, size_m))
    # With half widths of 200 px, the outermost sample misses the outline by 0.03 px.
    np.testing.assert_allclose(xyxy, expected, atol=0.05)


WIDE_K = np.array([[450.0, 0.0, 640.0], [0.0, 455.0, 360.0], [0.0, 0.0, 1.0]])
#: Coefficients, and whether the lens is a fisheye: lenses that show more than 45 degrees off the axis in `WIDE_K`.
WIDE_LENSES = {
    "fisheye": ((-0.012, 0.021, -0.018, 0.004), True),
    "strong barrel": ((-0.25, 0.0, 0.0, 0.0), False),
    "eight coefficients": ((14.2, 8.1, 0.0004, -0.0002, 0.31, 14.5, 11.9, 2.2), False),
}


def drones_all_around(rng, count=400):
    """Positions (count, 3) up to 6 m away and 126 degrees off the x axis, and sizes."""
    angle, around, distance_m = rng.uniform((0, 0, 0.0), (2.2, 2 * np.pi, 6.0), (count, 3)).T
    x = np.cos(angle)
    y = np.sin(angle) * np.cos(around)
    z = np.sin(angle) * np.sin(around)
    position_m = distance_m[:, None] * np.stack([x, y, z], axis=-1)
    return position_m, rng.uniform(0.2, 0.5, (count, 3))


@pytest.mark.parametrize("name", WIDE_LENSES)
def test_boxes_where_a_wide_lens_shows_a_part_or_nothing_and_around_the_camera(name):
    """Boxes and their gradients are finite everywhere, and right where the lens shows the whole drone."""
    R, t_m = look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    dist, fisheye = WIDE_LENSES[name]
    camera = make_camera(R=R, t_m=t_m, K=WIDE_K, image_size_wh=(1280, 720), dist=dist, fisheye=fisheye)
    rig = make_unnamed_rig(camera)
    position_m, size_m = drones_all_around(np.random.default_rng(0))
    xyxy, in_front = compute_boxes(rig, position_m, size_m)
    xyxy, in_front = xyxy[:, 0], in_front[:, 0]
    assert np.isfinite(xyxy).all()
    # Float32 near the fold, and samples that miss the farthest point, decide between the drones of these sizes.
    smaller = has_image(camera, surface_of(position_m, 0.95 * size_m, 2000) @ R.T)
    larger = has_image(camera, surface_of(position_m, 1.05 * size_m, 2000) @ R.T)
    partly_hidden = ~smaller.all(axis=1)
    assert not in_front[partly_hidden].any()
    assert in_front[larger.all(axis=1)].all()
    assert (partly_hidden & smaller.any(axis=1)).sum() >= 8
    assert in_front.sum() > 80

    sampled = sampled_boxes(rig, surface_of(position_m, size_m, 2000))[:, 0]
    # What counts of a box is its part in the picture.
    found = np.clip(xyxy, 0, (1280, 720, 1280, 720))
    expected = np.clip(sampled, 0, (1280, 720, 1280, 720))
    width_px, height_px = (expected[:, 2:] - expected[:, :2]).T
    inside = in_front & (width_px > 0) & (height_px > 0)
    # The lens is linear over the drone up to the square of the drone's angular size. Before the fold of a lens its
    # second derivative is several times its first one.
    length_px = (sampled[:, 2:] - sampled[:, :2]).max(axis=1)
    half_angle = size_m.max(axis=1) / np.linalg.norm(position_m, axis=1) / 2
    limit_px = 0.1 + 3 * half_angle**2 * length_px
    off_px = np.abs(found - expected).max(axis=1)
    assert (off_px < limit_px)[inside].all()
    outside = found[in_front & ~inside]
    sides_px = outside[:, 2:] - outside[:, :2]
    assert (sides_px.min(axis=1) < 0.1).all()

    cameras, size_m, position_m = float32((rig.cameras, size_m, position_m))

    def sum_of_edges(position_m):
        return compiled_boxes(cameras, position_m, size_m, 0 * size_m)[0].sum()

    gradient = jax.jit(jax.grad(sum_of_edges))
    assert np.isfinite(gradient(position_m)).all()


three = st.lists(st.floats(-3, 3), min_size=3, max_size=3)


@given(three, three, st.sampled_from(sorted(LENSES)))
def test_turning_world_and_rig_together_changes_no_box_of_a_sphere(turn, shift_m, coefficients):
    rig = ring_rig(3, coefficients=coefficients)
    position_m, _ = random_drones(2)
    size_m = np.array([[0.4] * 3, [0.25] * 3])
    R = Rotation.from_rotvec(turn).as_matrix()
    moved = move_world(rig, R, shift_m)
    xyxy, _ = compute_boxes(rig, position_m, size_m)
    turned, _ = compute_boxes(moved, position_m @ R.T + shift_m, size_m)
    np.testing.assert_allclose(turned, xyxy, atol=3e-3)
