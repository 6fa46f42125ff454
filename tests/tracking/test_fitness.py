"""The soft IoU and its vertex: compared with fractions computed by hand, with NumPy, and their invariants.

Results that are computed by hand use cameras so far away that their images are parallel projections.
"""

from dataclasses import replace
from functools import partial
from itertools import product

import jax
import numpy as np
import pytest
from helpers import draw_coverage, far_camera, float32, make_unnamed_rig, posed, ring_rig, simple_lens
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pixel_sums import area_weighted_sum
from windows import best_place, cut_at

from psotrack.foreground.silhouettes import summed_area_table
from psotrack.tracking.swarm import SoftIoU
from psotrack.tracking.swarm.fitness import camera_scores, drone_fitness, joint_fitness, score_inputs
from psotrack.tracking.swarm.vertex import SPAN, find_vertex

#: 64 x 48 pixels, 20 pixels per metre: a drone of 1 m x 0.5 m at the origin covers columns 22 to 42, rows 19 to 29.
FAR = {"image_size_wh": (64, 48), "pixels_per_m": 20.0}
SIZE_M = np.array([[1.0, 1.0, 0.5]])
PIXEL_M = 1 / 20


ONE_BOX = SoftIoU(windows=(1.0,), ring=1.5, min_cameras=1)
HARD = SoftIoU(windows=(1.0,), ring=1.5, min_cameras=1, whole_pixels=True)

#: Tolerance of results by hand. Edges of boxes have errors of 1e-5 px (float32 at 1000 m with a focal length of
#: 20000 px), so areas of 200 px have relative errors of 1e-5.
HAND = 1e-4


def silhouette(*rectangles, value=255, shape=(48, 64)):
    """(1, height, width), silhouette of filled rectangles (x0, y0, x1, y1)."""
    image = np.zeros((1, *shape), np.uint8)
    for x0, y0, x1, y1 in rectangles:
        image[:, y0:y1, x0:x1] = value
    return image


def evaluate(function, rig, images, position_m, size_m=SIZE_M, settings=ONE_BOX):
    reduction = int(rig.cameras.image_size_wh[0, 0]) // images.shape[-1]
    arrays = float32((rig.cameras, position_m, size_m))
    return jax.tree.map(np.asarray, _compiled(function, settings, reduction, images, *arrays))


@partial(jax.jit, static_argnums=(0, 1, 2))
def _compiled(function, settings, reduction, images, cameras, position_m, size_m):
    tables = summed_area_table(images)
    return function(score_inputs(cameras, size_m, tables, settings, reduction=reduction), position_m)


def score_at(image, x_px=0.0, settings=ONE_BOX):
    """Fitness of one drone in one camera, `x_px` pixels to the right of the origin."""
    rig = make_unnamed_rig(far_camera(**FAR))
    position_m = np.array([[x_px * PIXEL_M, 0, 0]])
    return evaluate(drone_fitness, rig, image, position_m, settings=settings).item()


DRONE = (22, 19, 42, 29)


#: What the silhouette shows -> the silhouette, and the fitness: foreground in the box over the union of both.
BY_HAND = {
    "the drone": (silhouette(DRONE), 1),
    "an L": (silhouette((22, 19, 42, 21), (22, 21, 24, 29)), (40 + 16) / 200),
    "nothing": (silhouette(), 0),
    "a fifth covered": (silhouette(DRONE, value=51), 1 / 5),
    # Foreground beside the box, within the ring of 30 x 15 pixels, makes the union larger.
    "twice as wide": (silhouette((12, 19, 52, 29)), 200 / (200 + 300 - 200)),
    "everything": (silhouette((0, 0, 64, 48)), 200 / (200 + 30 * 15 - 200)),
    # Foreground beside the box, but none inside.
    "beside": (silhouette((42, 19, 46, 29)), 0 / (200 + 40)),
}


@pytest.mark.parametrize("settings", [ONE_BOX, HARD], ids=["soft", "hard"])
@pytest.mark.parametrize("shown", BY_HAND)
def test_one_box_by_hand(shown, settings):
    image, expected = BY_HAND[shown]
    if settings.whole_pixels and shown == "everything":
        # The ring's rows 16.5 to 31.5 are rounded half to even: 16 to 32.
        expected = 200 / (30 * 16)
    assert score_at(image, settings=settings) == pytest.approx(expected, abs=HAND)


def test_hard_edges_are_whole_pixels():
    assert score_at(silhouette(DRONE), 0.25, HARD) == pytest.approx(1, abs=HAND)
    assert score_at(silhouette(DRONE), 0.75, HARD) == pytest.approx(19 / 21, abs=HAND)


def test_fitness_is_undefined_with_too_few_cameras():
    """A drone may be outside both images, behind both cameras, or visible in one camera where two are required."""
    centred = far_camera(**FAR)
    K = centred.K.copy()
    K[0, 2] += 200
    elsewhere = replace(centred, K=K)
    both, only_first = make_unnamed_rig(centred, centred), make_unnamed_rig(centred, elsewhere)
    images = np.concatenate([silhouette(DRONE)] * 2)
    two = replace(ONE_BOX, min_cameras=2)

    def fitness(rig, place_m, settings):
        return evaluate(drone_fitness, rig, images, np.array([place_m]), settings=settings).item()

    origin_m = (0.0, 0.0, 0.0)
    assert fitness(both, origin_m, two) == pytest.approx(1, abs=HAND)
    assert fitness(only_first, origin_m, ONE_BOX) == pytest.approx(1, abs=HAND)
    assert np.isnan(fitness(only_first, origin_m, two))
    assert np.isnan(fitness(both, (10.0, 0.0, 0.0), two))
    assert np.isnan(fitness(both, (0.0, -1500.0, 0.0), two))


# Invariants, for cameras in a room.

RIG = ring_rig(5)
TRUTH_M = np.array([[0.3, -0.2, 1.3], [-0.6, 0.5, 0.9]])
SIZES_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]])
IMAGES = draw_coverage(RIG, TRUTH_M, SIZES_M, reduction=2)
SOFT = SoftIoU()


@pytest.mark.parametrize("settings", [SOFT, SoftIoU(windows=(1.0,), whole_pixels=True)])
def test_particles_and_drones_do_not_interact(settings):
    """In another order, the fitness of each is the same to the bit, and so it is beside others that move."""
    position_m = TRUTH_M + 0.2 * np.random.default_rng(0).standard_normal((11, 2, 3))
    order = np.random.default_rng(1).permutation(11)
    fitness = evaluate(drone_fitness, RIG, IMAGES, position_m, SIZES_M, settings)
    assert len(np.unique(fitness)) > 11
    position_m[4, 1] += 0.1
    changed = evaluate(drone_fitness, RIG, IMAGES, position_m[order], SIZES_M, settings)
    differs = np.zeros((11, 2), bool)
    differs[4, 1] = True
    np.testing.assert_array_equal(changed != fitness[order], differs[order])


def numpy_box(camera, middle_m, size_m):
    """Middle and half lengths, (x, y), of the box around the outline of an ellipsoid, from the outline's dual conic."""
    move = np.eye(4)
    move[:3, 3] = middle_m
    ellipsoid = move @ np.diag([*np.square(size_m / 2), -1]) @ move.T
    P = camera.K @ camera.T_cam_world[:3]
    conic = P @ ellipsoid @ P.T
    middle = conic[:2, 2] / conic[2, 2]
    half = np.sqrt(middle**2 - np.diagonal(conic)[:2] / conic[2, 2])
    return middle + 0.5, half


def numpy_fitness(rig, images, middle_m, size_m, settings, reduction=2):
    """Fitness of one drone in float64, from boxes of outlines and sums over pixels, without distortion."""
    scores, weights = [], []
    for index, image in enumerate(images):
        middle, half = numpy_box(rig.cameras[index], middle_m, size_m)
        side_px = reduction * np.array(image.shape[::-1])

        def window(scale, image=image, middle=middle, half=half, side_px=side_px):
            """Foreground and area of the box, enlarged and cut at the image's border, in the silhouette's pixels."""
            low = np.clip(middle - scale * half, 0, side_px) / reduction
            high = np.clip(middle + scale * half, 0, side_px) / reduction
            return area_weighted_sum(image, (*low, *high)) / 255, np.prod(high - low)

        ring, _ = window(settings.ring)
        each = []
        for scale in settings.windows:
            filled, area = window(scale)
            union = area + max(ring - filled, 0)
            # A window outside the image has neither foreground nor area.
            each.append(filled / max(union, 1e-12))
        scores.append(np.mean(each))
        _, area = window(1.0)
        weights.append(area * reduction**2 / np.prod(2 * half))
    return np.average(scores, weights=weights)


@jax.jit
def _soft_fitness(cameras, position_m, size_m, offset_m):
    tables = summed_area_table(IMAGES)
    inputs = score_inputs(cameras, size_m, tables, SOFT, reduction=2, offset_m=offset_m)
    return drone_fitness(inputs, position_m)


def test_joint_fitness_is_the_mean_over_drones_with_0_for_undefined():
    position_m = np.stack([TRUTH_M[0], (40.0, 0.0, 0.0)])
    each = evaluate(drone_fitness, RIG, IMAGES, position_m, SIZES_M, SOFT)
    assert np.isfinite(each).tolist() == [True, False]
    joint = evaluate(joint_fitness, RIG, IMAGES, position_m, SIZES_M, SOFT)
    # The same float32 arithmetic, fused in another way.
    assert joint.item() == pytest.approx(each[0] / 2, abs=1e-5)


@pytest.mark.parametrize("shift_m", [(0.07, 0.07, 0.07), (-0.05, 0.03, -0.02), (1.9, -1.1, 0.3)])
def test_fitness_equals_the_oracle(shift_m):
    """With windows inside the images and across their borders."""
    place_m = TRUTH_M + shift_m
    offset_m = np.array([[0.01, 0.02, -0.03], [0.0, -0.02, 0.04]])
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        found = np.asarray(_soft_fitness(RIG.cameras, place_m, SIZES_M, offset_m))
    for drone, middle_m in enumerate(place_m + offset_m):
        expected = numpy_fitness(RIG, IMAGES, middle_m, SIZES_M[drone], SOFT)
        np.testing.assert_allclose(found[drone], expected, atol=1e-9)


@settings(max_examples=15)
@given(
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.6, 2)),
    st.tuples(st.floats(0.25, 0.7), st.floats(0.3, 0.8)),
)
def test_fitness_is_highest_at_the_drone(place_m, shape):
    """The maximum is no plateau: a tenth of the drone's width away in any direction, fitness is clearly lower."""
    place_m = np.array([place_m])
    width_m, flatness = shape
    size_m = np.array([[width_m, width_m, width_m * flatness]])
    images = draw_coverage(RIG, place_m, size_m, reduction=2)
    patches = cut_at(RIG, images, place_m, size_m, reach_m=0.15, reduction=2)
    best_m = best_place(RIG, patches, place_m + 0.03, size_m)
    # A silhouette's pixel is 3 cm wide at 4 m; five cameras locate the middle of an ellipse to a third of a pixel.
    assert np.abs(best_m - place_m).max() < 0.012
    away_m = 0.1 * width_m * np.eye(3)
    around = np.concatenate([np.zeros((1, 3)), away_m, -away_m])[:, None]
    fitness = evaluate(drone_fitness, RIG, images, best_m + around, size_m, SOFT)[:, 0]
    assert fitness[0] > 0.45
    # Measured: at least 2.8 % lower.
    assert (fitness[1:] < 0.98 * fitness[0]).all()


# --- the vertex of the score, compared with least squares in float64 and with silhouettes of known ellipsoids

LENS_RIG = ring_rig(6, image_size_wh=(480, 360), coefficients=5)
FLAT_M = np.array([[0.5, 0.5, 0.2]])
PLACE_M = np.array([[0.1, 0.2, 1.2]])


def vertex_of(inputs, position_m):
    return find_vertex(inputs, position_m, inputs.extents.size_m)


def shown(truth_m, rig=LENS_RIG):
    return draw_coverage(rig, truth_m, FLAT_M, reduction=2)


def vertex(images, position_m, rig=LENS_RIG):
    return evaluate(vertex_of, rig, images, position_m, FLAT_M, SOFT)


def test_the_vertex_is_that_of_the_least_squares_paraboloid():
    """Vertex, curvature and dispersion, from NumPy's least squares through the 27 scores of each camera."""
    truth = np.array([[0.31, -0.22, 1.17]])
    images = shown(truth)
    start = truth + np.array([0.012, -0.008, 0.006])
    span = SPAN * FLAT_M[0]
    grid = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
    places = start + span * grid[:, None, :]
    scores, weights = np.float64(evaluate(camera_scores, LENS_RIG, images, places, FLAT_M, SOFT))
    share = weights[13, 0] / weights[13, 0].sum()
    x, y, z = grid.T
    terms = [np.ones(27), x, y, z, x * x / 2, y * y / 2, z * z / 2, x * y, x * z, y * z]
    fitted, *_ = np.linalg.lstsq(np.transpose(terms), scores[:, 0], rcond=None)
    fitted = (share * fitted).T
    slope = fitted[:, 1:4]
    # Second derivatives: the places of xx, yy, zz, xy, xz and yz in a symmetric matrix.
    bent = -fitted[:, [[4, 7, 8], [7, 5, 9], [8, 9, 6]]]
    inverse = np.linalg.inv(bent.sum(axis=0))
    to_vertex = inverse @ slope.sum(axis=0)
    left = slope - bent @ to_vertex
    cameras = 1 / np.square(share).sum()
    dispersion = np.einsum("ci,ij,cj->", left, inverse, left) / 3 * cameras / (cameras - 1.5)

    found = vertex(images, start)
    # Scores have float32 errors of 1e-7; vertex and curvature divide score differences by a curvature of about 0.1.
    np.testing.assert_allclose(found.position_m[0], start[0] + span * to_vertex, atol=2e-6)
    inverse_m2 = inverse * np.outer(span, span)
    atol_m2 = 1e-5 * np.trace(inverse_m2)
    np.testing.assert_allclose(found.inverse_curvature_m2[0], inverse_m2, rtol=1e-3, atol=atol_m2)
    # Residual slopes are small differences of large ones.
    np.testing.assert_allclose(found.dispersion[0], dispersion, rtol=0.02)


def test_cameras_on_one_side_know_that_the_depth_is_uncertain():
    """Three cameras within nine degrees. Regression: variances were limited to a ratio of 50."""
    cameras, lens = [], simple_lens(450.0, (480, 360))
    for angle in (-0.08, 0.0, 0.08):
        place_m = (4 * np.cos(angle), 4 * np.sin(angle), 1.2)
        cameras.append(posed(lens, place_m, (0.0, 0.0, 1.2)))
    rig = make_unnamed_rig(*cameras)
    truth = np.array([[0.02, -0.03, 1.21]])
    found = vertex(shown(truth, rig), truth, rig)
    variance, axes = np.linalg.eigh(found.inverse_curvature_m2[0])
    # The worst axis is the line of sight; rays alone would give a ratio of 1 / mean of squared sines, 230.
    assert abs(axes[0, -1]) > 0.95
    assert variance[-1] > 80 * np.sqrt(variance[0] * variance[1])


SHOWN = shown(PLACE_M)


def test_the_vertex_stays_within_the_grid_and_one_camera_has_no_dispersion():
    start = PLACE_M + np.array([0.3, 0.0, 0.0])
    moved = np.abs(vertex(SHOWN, start).position_m - start)
    assert (moved <= SPAN * FLAT_M * (1 + 1e-5)).all()
    one_camera = vertex(SHOWN[:1], PLACE_M, LENS_RIG.select(LENS_RIG.names[:1]))
    assert np.isinf(one_camera.dispersion[0])


@settings(max_examples=25)
@given(st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 6)))
@example((0.0, 0.0, 1.0))
def test_the_vertex_is_finite_everywhere(position_m):
    """Beside the drone, outside of images and behind cameras: finite numbers, and a positive definite matrix."""
    found = vertex(SHOWN, np.array([position_m]))
    assert np.isfinite(found.position_m).all()
    inverse = np.float64(found.inverse_curvature_m2[0])
    # The inverse of a 3 x 3 matrix in float32: each element has a few roundings of 6e-8 of the largest element.
    np.testing.assert_allclose(inverse, inverse.T, rtol=0, atol=1e-6 * np.abs(inverse).max())
    assert np.linalg.eigvalsh((inverse + inverse.T) / 2)[0] > 0
    assert not np.isnan(found.dispersion).any()
