"""Triangulation against exact cases, OpenCV (two cameras) and explicit least squares; matching of views."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from helpers import LENSES, ROOM_M, make_unnamed_rig, ring_rig
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.geometry import (
    Rig,
    match_views,
    project,
    triangulate_candidates,
    triangulate_linearly,
    triangulate_paths,
    viewpoints,
)


def points_in_room(*shape, seed=0):
    return np.random.default_rng(seed).uniform((-1.5, -1.5, 0.3), (1.5, 1.5, 2.3), (*shape, 3))


def project_points(rig, points):
    return project(rig.cameras, points[..., None, :])[0]


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


def test_the_pseudoinverse_of_the_paper():
    """Equations (3)-(6) in pixels as they are printed, X = pinv(L) B with p1, p2, p3 the rows of K [R | t].

    A row in pixels is the row in normalised coordinates times the focal length, which all cameras share, as in the
    paper.
    """
    rig, points = ring_rig(5), points_in_room(11)
    one = np.broadcast_to(rig.cameras.K[0], (5, 3, 3)).copy()
    one[:, 1, 1] = one[:, 0, 0]
    rig = Rig(rig.names, replace(rig.cameras, K=one))
    pixels = project_points(rig, points) + np.random.default_rng(4).normal(0, 1.0, (11, 5, 2))
    P = one @ rig.cameras.T_cam_world[:, :3]
    for n in range(11):
        L = [pixels[n, c, i] * P[c, 2, :3] - P[c, i, :3] for c in range(5) for i in range(2)]
        B = [P[c, i, 3] - pixels[n, c, i] * P[c, 2, 3] for c in range(5) for i in range(2)]
        # As above: two ways of solving one system of condition 10.
        np.testing.assert_allclose(
            triangulate_linearly(rig.cameras, pixels)[n],
            np.linalg.pinv(np.array(L)) @ np.array(B),
            atol=1e-10,
        )


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


TIME_S = np.arange(7) / 25


def positions_on_paths(coefficient, time_s=TIME_S):
    """(..., frames, 3) positions on paths that are polynomials of time."""
    powers = time_s[:, None] ** np.arange(coefficient.shape[-2])
    return np.einsum("fk,...ki->...fi", powers, coefficient)


def random_paths(*shape, seed=0):
    rng = np.random.default_rng(seed)
    return np.stack([points_in_room(*shape, seed=seed), *rng.normal(size=(2, *shape, 3))], axis=-2)


@pytest.mark.parametrize("coefficients", [0, 5])
def test_exact_pixels_give_the_path(coefficients):
    rig, paths = ring_rig(3, coefficients=coefficients), random_paths(5)
    found = triangulate_paths(
        rig.cameras, project_points(rig, positions_on_paths(paths)), TIME_S, noise_m=1e-6
    )
    assert found.shape == paths.shape
    # As for points, undistortion is exact to 4e-8 m; two derivatives over a quarter of a second increase this to 1e-5.
    np.testing.assert_allclose(found, paths, atol=1e-4)


def test_paths_by_least_squares():
    """The equations of the views and of the priors, written out and solved by `lstsq`."""
    rig, paths = ring_rig(5), random_paths(3)
    rng = np.random.default_rng(2)
    pixels = project_points(rig, positions_on_paths(paths)) + rng.normal(0, 1.0, (3, 7, 5, 2))
    pixels[rng.random((3, 7, 5)) < 0.3] = np.nan
    weights = rng.uniform(0.1, 2, (3, 7, 5))
    found = triangulate_paths(rig.cameras, pixels, TIME_S, weights, noise_m=0.05, expected=(2.0, 3.0))
    for n in range(3):
        rows, right = [], []
        for f, c in zip(*np.nonzero(np.isfinite(pixels[n]).all(axis=-1)), strict=True):
            x, y, _ = np.linalg.inv(rig.cameras.K[c]) @ (*pixels[n, f, c], 1)
            r1, r2, r3, _ = rig.cameras.T_cam_world[c]
            for r, value in ((r1, x), (r2, y)):
                row = np.sqrt(weights[n, f, c]) * (value * r3[:3] - r[:3])
                rows.append(np.concatenate([row * TIME_S[f] ** k for k in range(3)]))
                right.append(np.sqrt(weights[n, f, c]) * (r[3] - value * r3[3]))
        for k, std in ((1, 2.0), (2, 3.0)):
            for i in range(3):
                rows.append(0.05 / std * np.eye(9)[3 * k + i])
                right.append(0.0)
        expected = np.linalg.lstsq(np.array(rows), np.array(right))[0].reshape(3, 3)
        # Normal equations square the condition number, here below 1e4.
        np.testing.assert_allclose(found[n], expected, atol=1e-7)


def test_frames_with_one_camera_each_make_a_path():
    """Two cameras take turns: no single frame determines a point, but all frames together determine the path."""
    rig, paths = ring_rig(3), random_paths(3)[:, :2]
    pixels = project_points(rig, positions_on_paths(paths))
    pixels[:, ::2, 0] = pixels[:, 1::2, 1] = pixels[:, :, 2] = np.nan
    assert np.isnan(triangulate_linearly(rig.cameras, pixels)).all()
    found = triangulate_paths(rig.cameras, pixels, TIME_S, noise_m=1e-6, expected=(3.0,))
    np.testing.assert_allclose(found, paths, atol=1e-4)


def test_one_frame_gives_a_path_at_rest():
    rig, points = ring_rig(3), points_in_room(4)
    found = triangulate_paths(rig.cameras, project_points(rig, points)[:, None], np.zeros(1))
    np.testing.assert_allclose(found[:, 0], points, atol=1e-6)
    assert not found[:, 1:].any()


def test_a_path_that_one_camera_sees_is_nan():
    rig = ring_rig(3)
    pixels = project_points(rig, positions_on_paths(random_paths(2)))
    pixels[1, :, 1:] = np.nan
    found = triangulate_paths(rig.cameras, pixels, TIME_S)
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1]).all()
    assert triangulate_paths(rig.cameras, pixels[:0], TIME_S).shape == (0, 3, 3)


def test_cameras_side_by_side_share_a_viewpoint():
    rig = ring_rig(4)
    doubled = make_unnamed_rig(*(rig.cameras[i] for i in (0, 1, 0, 2, 1, 3)))
    label = viewpoints(doubled.cameras)
    assert label[0] == label[2]
    assert label[1] == label[4]
    assert len(set(label.tolist())) == 4


def separated_points(count, seed, least_m=0.6):
    """Points in the room with distances of at least `least_m`."""
    rng = np.random.default_rng(seed)
    points = np.empty((0, 3))
    while len(points) < count:
        point = rng.uniform((-1.5, -1.5, 0.3), (1.5, 1.5, 2.3))
        if not len(points) or np.linalg.norm(points - point, axis=-1).min() > least_m:
            points = np.vstack([points, point])
    return points


def simulate_detections(rig, drones, seed, *, missing=0.0, false=0, noise_px=0.5):
    """For each camera its 2D points in random order, and the drone of each 2D point (-1: false point)."""
    rng = np.random.default_rng(seed)
    pixels = project_points(rig, drones)
    points, owners = [], []
    for c in range(len(rig)):
        seen = np.flatnonzero(rng.random(len(drones)) >= missing)
        real = pixels[seen, c] + rng.normal(0, noise_px, (len(seen), 2))
        ghosts = rng.uniform((0, 0), (320, 240), (false, 2))
        order = rng.permutation(len(seen) + false)
        points.append(np.vstack([real, ghosts])[order])
        owners.append(np.concatenate([seen, np.full(false, -1)])[order])
    return points, owners


def check_match(rig, drones, points, owners, enough):
    found, support = match_views(rig.cameras, points, [np.full(len(p), 4.0) for p in points], ROOM_M)
    assert support.shape == (len(found), len(rig))
    distance = np.linalg.norm(found[:, None] - drones, axis=-1).reshape(len(found), len(drones))
    nearest = distance.argmin(axis=1) if len(drones) else np.empty(0, int)
    assert sorted(nearest.tolist()) == np.flatnonzero(enough).tolist()
    # Noise of 0.5 px at 4 m and 260 px of focal length is 8 mm in each of three or more views; limit 4 sigma.
    assert (distance.min(axis=1, initial=np.inf) < 0.032).all()
    for row, drone in enumerate(nearest):
        owner = [owners[c][index] if index >= 0 else None for c, index in enumerate(support[row])]
        assert owner.count(int(drone)) >= 3


@pytest.mark.parametrize("num_drones", range(1, 7))
@pytest.mark.parametrize("seed", range(3))
def test_drones_on_a_ring_of_cameras(num_drones, seed):
    """Every drone is found once, at its position, and nothing else is found."""
    rig, drones = ring_rig(7), separated_points(num_drones, seed)
    points, owners = simulate_detections(rig, drones, seed)
    check_match(rig, drones, points, owners, np.ones(num_drones, bool))


@pytest.mark.parametrize("seed", range(5))
def test_missing_and_false_points(seed):
    """One 2D point in seven is missing, and every camera has a false point: drones seen by four cameras are found."""
    rig, drones = ring_rig(7), separated_points(3, seed)
    points, owners = simulate_detections(rig, drones, seed, missing=1 / 7, false=1)
    seen_by = np.array([sum((owner == drone).any() for owner in owners) for drone in range(3)])
    assert seen_by.min() >= 4
    check_match(rig, drones, points, owners, seen_by >= 4)


def test_two_cameras_at_one_position_do_not_count_twice():
    """Three cameras at two positions see a point: two viewpoints are too few."""
    rig, drones = ring_rig(5), points_in_room(1)
    doubled = make_unnamed_rig(*(rig.cameras[i] for i in (0, 0, 2)))
    points, _ = simulate_detections(doubled, drones, 0)
    radius = [np.full(len(p), 4.0) for p in points]
    assert match_views(doubled.cameras, points, radius, ROOM_M)[0].shape == (0, 3)
    assert len(match_views(doubled.cameras, points, radius, ROOM_M, min_viewpoints=2)[0]) == 1
    third = make_unnamed_rig(*(rig.cameras[i] for i in (0, 1, 2)))
    points, _ = simulate_detections(third, drones, 0)
    assert len(match_views(third.cameras, points, radius, ROOM_M)[0]) == 1


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_of_cameras_and_points_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    drones = separated_points(int(rng.integers(1, 5)), seed)
    rig = ring_rig(4)
    points, _ = simulate_detections(rig, drones, seed, missing=0.1, false=1)
    cameras = rng.permutation(4)
    mixed = [points[c][rng.permutation(len(points[c]))] for c in cameras]
    radius, mixed_radius = ([np.full(len(p), 4.0) for p in of] for of in (points, mixed))
    first, _ = triangulate_candidates(rig.cameras, points, radius, ROOM_M)
    second, _ = triangulate_candidates(rig.cameras[cameras], mixed, mixed_radius, ROOM_M)
    for one, other in ((first, second), (second, first)):
        distance = np.linalg.norm(one[:, None] - other, axis=-1).min(axis=1, initial=np.inf)
        # One candidate is kept per cube of a centimetre, and the order may decide which one.
        assert (distance < 0.01 * 3**0.5).all()


def test_a_point_that_two_drones_share_does_not_hide_them():
    """One camera sees the middle of two drones. The point on which the other two cameras agree remains a candidate."""
    rig = make_unnamed_rig(*(ring_rig(5).cameras[i] for i in (0, 1, 3)))
    drones = np.array([[0.3, 0.2, 1.4], [0.1, -0.1, 1.3]])
    pixels = project_points(rig, drones)
    points = [pixels[:, 0].mean(axis=0)[None], pixels[:, 1], pixels[:, 2]]
    wide = np.linalg.norm(pixels[0, 0] - pixels[1, 0]) / 2 / 0.9
    found, _ = triangulate_candidates(rig.cameras, points, [np.full(len(p), wide) for p in points], ROOM_M)
    for drone in drones:
        # At 0.9 of its radius a 2D point has 4 % of the weight: the error is 3 cm. With equal weights it would be 9 cm.
        assert np.linalg.norm(found - drone, axis=-1).min() < 0.05
    equal = triangulate_linearly(
        rig.cameras, np.stack([np.stack([points[0][0], p[k], q[k]]) for p, q in [points[1:]] for k in (0, 1)])
    )
    assert (np.linalg.norm(equal - drones, axis=-1) > 0.05).all()


def test_nothing_to_match():
    rig = ring_rig(3)
    nothing = [np.empty((0, 2))] * 3
    found, support = match_views(rig.cameras, nothing, [np.empty(0)] * 3, ROOM_M)
    assert found.shape == (0, 3)
    assert support.shape == (0, 3)


def test_nothing_is_found_outside_the_bounds():
    rig = ring_rig(5)
    points, _ = simulate_detections(rig, np.array([[0.0, 0, 1]]), 0)
    radius = [np.full(len(p), 4.0) for p in points]
    upper_half = np.array([[-3.0, -3, 1.5], [3, 3, 3]])
    assert len(match_views(rig.cameras, points, radius, upper_half)[0]) == 0
    assert len(match_views(rig.cameras, points, radius, ROOM_M)[0]) == 1


@pytest.mark.parametrize("seed", range(5))
def test_no_point_is_found_out_of_bounds(seed):
    """Noisy pairs may propose a point inside the bounds that the refinement by all views moves outside."""
    rig = ring_rig(6)
    rng = np.random.default_rng(seed)
    on_the_floor = np.array([[0.3, -0.2, 0.0]])
    pixels = project(rig.cameras, on_the_floor[:, None, :])[0][0] + rng.normal(scale=3.0, size=(6, 2))
    bounds_m = np.array([[-3.0, -3.0, 0.05], [3.0, 3.0, 3.0]])
    points, _ = match_views(rig.cameras, [pixel[None] for pixel in pixels], [np.array([20.0])] * 6, bounds_m)
    assert (points >= bounds_m[0]).all()


def test_no_paths_at_all():
    rig = ring_rig(4)
    for times in (np.arange(5.0), np.zeros((5, 4))):
        none = triangulate_paths(
            rig.cameras, np.zeros((0, 5, 4, 2)), times, noise_m=0.01, expected=(1.0, 1.0)
        )
        assert none.shape == (0, 3, 3)
