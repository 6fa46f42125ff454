"""The vertex of the score, compared with least squares in float64 and with silhouettes of known ellipsoids."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import draw_coverage, float32, make_unnamed_rig, ring_rig
from hypothesis import example, given, settings
from hypothesis import strategies as st

from psotrack.foreground.silhouettes import summed_area_table
from psotrack.geometry import look_at, make_camera
from psotrack.tracking.swarm import SoftIoU
from psotrack.tracking.swarm.fitness import camera_scores, score_inputs
from psotrack.tracking.swarm.vertex import SPAN, find_vertex

REDUCTION = 2
SIZE_M = np.array([[0.5, 0.5, 0.2]])
RIG = ring_rig(6, image_size_wh=(480, 360), coefficients=5)


def score_view(truth_m, *, rig=RIG, size_m=SIZE_M):
    coverage = draw_coverage(rig, truth_m, size_m, REDUCTION)
    tables = summed_area_table(jnp.asarray(coverage))
    return score_inputs(float32(rig.cameras), float32(size_m), tables, SoftIoU(), reduction=REDUCTION)


def found(view, position_m, size_m=SIZE_M):
    return jax.jit(find_vertex)(view, *float32((np.asarray(position_m, float), size_m)))


def test_the_vertex_is_that_of_the_least_squares_paraboloid():
    """Vertex, curvature and dispersion, from NumPy's least squares through the 27 scores of each camera."""
    truth = np.array([[0.31, -0.22, 1.17]])
    view = score_view(truth)
    start = truth + np.array([0.012, -0.008, 0.006])
    grid = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], float)
    scores, weights = (
        np.asarray(of, np.float64)
        for of in camera_scores(view, float32(start + SPAN * SIZE_M * grid[:, None, :]))
    )
    share = weights[13, 0] / weights[13, 0].sum()
    x, y, z = grid.T
    terms = np.stack([np.ones(27), x, y, z, x * x / 2, y * y / 2, z * z / 2, x * y, x * z, y * z], axis=-1)
    solved = np.linalg.lstsq(terms, scores[:, 0], rcond=None)[0]
    slope = (share * solved[1:4]).T
    xx, yy, zz, xy, xz, yz = share * solved[4:]
    bent = -np.stack([np.stack(row, -1) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))], axis=-2)
    whole = bent.sum(axis=0)
    to_vertex = np.linalg.solve(whole, slope.sum(axis=0))
    left = slope - bent @ to_vertex
    cameras = 1 / np.square(share).sum()
    phi = np.einsum("ci,ij,cj->", left, np.linalg.inv(whole), left) / 3 * cameras / (cameras - 1.5)

    answer = found(view, start)
    span = SPAN * SIZE_M[0]
    # Scores have float32 errors of 1e-7; vertex and curvature divide score differences by a curvature of about 0.1.
    np.testing.assert_allclose(answer.position_m[0], start[0] + span * to_vertex, atol=2e-6)
    inverse = np.linalg.inv(whole) * np.outer(span, span)
    np.testing.assert_allclose(
        answer.inverse_curvature_m2[0], inverse, rtol=1e-3, atol=1e-5 * np.trace(inverse)
    )
    # Residual slopes are small differences of large ones.
    np.testing.assert_allclose(answer.dispersion[0], phi, rtol=0.02)


def test_cameras_on_one_side_know_that_the_depth_is_uncertain():
    """Three cameras within nine degrees. Regression: variances were limited to a ratio of 50."""
    cameras = []
    for angle in (-0.08, 0.0, 0.08):
        R, t_m = look_at((4 * np.cos(angle), 4 * np.sin(angle), 1.2), (0.0, 0.0, 1.2))
        K = np.array([[450.0, 0, 239.5], [0, 450.0, 179.5], [0, 0, 1]])
        cameras.append(make_camera(R=R, t_m=t_m, K=K, image_size_wh=(480, 360)))
    rig, truth = make_unnamed_rig(*cameras), np.array([[0.02, -0.03, 1.21]])
    covariance = np.asarray(found(score_view(truth, rig=rig), truth).inverse_curvature_m2[0])
    variance, axes = np.linalg.eigh(covariance)
    # The worst axis is the line of sight; rays alone would give a ratio of 1 / mean of squared sines, 230.
    assert abs(axes[0, -1]) > 0.95
    assert variance[-1] > 80 * np.sqrt(variance[0] * variance[1])


def test_the_vertex_stays_within_the_grid_and_one_camera_has_no_dispersion():
    truth = np.array([[0.1, 0.2, 1.2]])
    start = truth + np.array([0.3, 0.0, 0.0])
    moved = np.abs(np.asarray(found(score_view(truth), start).position_m) - start)
    assert (moved <= SPAN * SIZE_M * (1 + 1e-5)).all()
    alone = RIG.select(RIG.names[:1])
    assert np.isinf(found(score_view(truth, rig=alone), truth).dispersion[0])


@settings(max_examples=25, deadline=None)
@given(st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 6)))
@example((0.0, 0.0, 1.0))
def test_the_result_is_finite_everywhere(position_m):
    """Beside the drone, outside of images and behind cameras: finite numbers, and a positive definite matrix."""
    result = found(VIEW, np.array([position_m]))
    assert np.isfinite(result.position_m).all()
    inverse = np.asarray(result.inverse_curvature_m2[0], float)
    # The inverse of a 3 x 3 matrix in float32: each element has a few roundings of 6e-8 of the largest element.
    np.testing.assert_allclose(inverse, inverse.T, rtol=0, atol=1e-6 * np.abs(inverse).max())
    assert np.linalg.eigvalsh((inverse + inverse.T) / 2)[0] > 0
    assert not np.isnan(result.dispersion).any()


VIEW = score_view(np.array([[0.1, 0.2, 1.2]]))
