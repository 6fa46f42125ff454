"""Correspondence of detections: OpenCV's epipolar lines, all assignments of small scenes, and merged detections."""

from dataclasses import replace
from itertools import product

import cv2
import numpy as np
import pytest
from helpers import LENSES, make_unnamed_rig, move_world, opencv_pixels, project_points, ring_rig
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from psotrack.geometry import make_camera, project, undistort
from psotrack.recordings import Detections
from psotrack.tracking.matching import (
    NEW_GROUP_COST,
    SHARED_COST,
    UNEXPLAINED_COST,
    Sightings,
    epipolar_distance,
    from_detections,
    match,
    straightened,
)

BOUNDS_M = np.array([[-4.0, -4.0, -1.0], [4.0, 4.0, 4.0]])
LARGE_WH = (1280, 960)


def separate_points(count, rng, least_m=0.6):
    """(count, 3), points in the room with distances of at least `least_m`, metres."""
    points = np.empty((0, 3))
    while len(points) < count:
        point = rng.uniform((-1.5, -1.5, 0.3), (1.5, 1.5, 2.3))
        if np.linalg.norm(points - point, axis=-1).min(initial=np.inf) > least_m:
            points = np.vstack([points, point])
    return points


def observe(rig, drones, rng, *, noise_px, missed=0.0, false=0):
    """Simulate detections: per camera, their pixels in random order, and the number of each one's drone (-1: none)."""
    pixels = project_points(rig, drones)
    points, owners = [], []
    for camera in range(len(rig)):
        seen = np.flatnonzero(rng.random(len(drones)) >= missed)
        real_px = pixels[seen, camera] + noise_px * rng.normal(size=(len(seen), 2))
        false_px = rng.uniform((0, 0), rig.cameras.image_size_wh[camera], (false, 2))
        order = rng.permutation(len(seen) + false)
        points.append(np.vstack([real_px, false_px])[order])
        owner = np.concatenate([seen, np.full(false, -1)])
        owners.append(owner[order])
    return points, owners


def points_by_camera(rig, drones):
    """The pixels of the drones, as a list over the cameras."""
    return list(project_points(rig, drones).swapaxes(0, 1))


def match_points(rig, points, noise_px, bounds_m=BOUNDS_M, **options):
    """Match detections, per camera; all have the same noise."""
    counts = np.array([len(each) for each in points])
    there = np.arange(counts.max()) < counts[:, None]
    points_px = np.full((*there.shape, 2), np.nan)
    points_px[there] = np.concatenate(points)
    noise = np.where(there, noise_px, np.nan)
    return match(rig.cameras, points_px, noise, bounds_m=bounds_m, **options)


def groups_of(matches):
    """Set of the groups; a group is a tuple with a detection's index per camera, or -1."""
    return {tuple(row) for row in matches.detection.tolist()}


# --- sightings: the boxes of a detector, and blobs of foreground, as arrays


def test_a_sighting_is_at_the_middle_of_its_box_and_is_less_certain_at_the_image_border():
    rig = ring_rig(8, coefficients=4, image_size_wh=(1920, 1080))
    boxes = np.array([[10.0, 20.0, 30.0, 60.0], [0.0, 20.0, 20.0, 60.0]])
    given = {rig.names[2]: Detections(np.array([1, 1]), boxes, np.ones(2))}
    sightings = from_detections(given, rig, 3)
    assert sightings.centre_px.shape == (3, 8, 2, 2)
    # The box covers columns 10 to 29; the middle of column 0 is at 0, so the box's middle is at 19.5.
    np.testing.assert_array_equal(sightings.centre_px[1, 2], [[19.5, 39.5], [9.5, 39.5]])
    np.testing.assert_array_equal(sightings.size_px[1, 2], [[20, 40], [20, 40]])
    assert sightings.noise_px[1, 2, 1] > 3 * sightings.noise_px[1, 2, 0]
    assert np.isnan(sightings.centre_px[[0, 2]]).all()
    assert np.isnan(np.delete(sightings.noise_px[1], 2, axis=0)).all()
    # Boxes of frames that no video has do not count.
    assert np.isnan(from_detections(given, rig, 1).centre_px).all()


# --- epipolar lines


def distort_by_opencv(cam, straight):
    """Pixels after distortion by OpenCV, from pixels without distortion."""
    rays = np.column_stack([straight, np.ones(len(straight))]) @ np.linalg.inv(cam.K).T
    return opencv_pixels(replace(cam, T_cam_world=np.eye(4)), rays)


def opencv_distance(points, image, F, others):
    """(points, others), distances of the others from the epipolar lines of points in the image of this number."""
    lines = cv2.computeCorrespondEpilines(points[:, None], image, F)[:, 0]
    return np.abs(lines[:, :2] @ others.T + lines[:, 2:])


@pytest.mark.parametrize("coefficients", sorted(LENSES))
def test_distances_from_epipolar_lines_equal_opencvs(coefficients):
    rig = ring_rig(5, coefficients=coefficients)
    rng = np.random.default_rng(0)
    a, b = rig.cameras[1], rig.cameras[3]
    straight_a = rng.uniform((60, 60), (260, 180), (7, 2))
    straight_b = rng.uniform((60, 60), (260, 180), (3, 2))
    R = b.T_cam_world[:3, :3] @ a.T_cam_world[:3, :3].T
    x, y, z = b.T_cam_world[:3, 3] - R @ a.T_cam_world[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    F = np.linalg.inv(b.K).T @ cross @ R @ np.linalg.inv(a.K)
    found = epipolar_distance(a, b, distort_by_opencv(a, straight_a), distort_by_opencv(b, straight_b))
    # Distortion is inverted to 1e-8 (see test_cameras), which is 3e-6 px.
    in_b = opencv_distance(straight_a, 1, F, straight_b)
    np.testing.assert_allclose(found[..., 0], in_b, atol=1e-5)
    in_a = opencv_distance(straight_b, 2, F, straight_a)
    np.testing.assert_allclose(found[..., 1], in_a.T, atol=1e-5)


# --- the least total cost


def reprojection_cost(rig, points, group, noise_px):
    """Least sum of squared reprojection errors of a group, in standard deviations, by SciPy."""
    seen = [camera for camera, index in enumerate(group) if index >= 0]
    picked_px = np.array([points[camera][group[camera]] for camera in seen])
    cameras = rig.cameras[np.array(seen)]

    def residual(point):
        pixels, _ = project(cameras, point)
        return ((pixels - picked_px) / noise_px).ravel()

    return 2 * least_squares(residual, np.array([0.0, 0.0, 1.3]), method="lm").cost


def least_total(rig, points, noise_px):
    """Groups with the least total cost for three cameras, by a search of all assignments."""
    triples = {}
    for triple in product(*(range(len(each)) for each in points)):
        cost = reprojection_cost(rig, points, triple, noise_px)
        if cost < 3 * UNEXPLAINED_COST:
            triples[triple] = cost
    best = {}

    def search(number, groups, total):
        best[frozenset(groups)] = total
        used = set().union(*map(set, map(enumerate, groups)))
        for next_number in range(number, len(triples)):
            triple = list(triples)[next_number]
            shared = len(used & set(enumerate(triple)))
            # A group may share at most one of its three detections.
            if shared < 2:
                explained = UNEXPLAINED_COST * (3 - shared)
                cost = NEW_GROUP_COST + triples[triple] + SHARED_COST * shared - explained
                search(next_number + 1, [*groups, triple], total + cost)

    search(0, [], 0.0)
    return set(min(best, key=best.get))


@pytest.mark.parametrize("seed", range(10))
def test_groups_have_the_least_total_cost_of_all_assignments(seed):
    """Three cameras, two or three drones, and at most one false detection per camera."""
    rng = np.random.default_rng(seed)
    rig = ring_rig(3, image_size_wh=LARGE_WH, coefficients=(0, 5)[seed % 2])
    drones = separate_points(2 + seed % 2, rng)
    points, _ = observe(rig, drones, rng, noise_px=3.0, missed=0.1, false=seed // 2 % 2)
    assert groups_of(match_points(rig, points, 3.0)) == least_total(rig, points, 3.0)


# --- groups with two views


def test_two_views_are_no_group_without_a_prediction():
    rig = ring_rig(5, image_size_wh=LARGE_WH)
    drones = separate_points(2, np.random.default_rng(0))
    points = points_by_camera(rig, drones)
    points[1] = points[3] = points[4] = np.empty((0, 2))
    assert not len(match_points(rig, points, 1.0).position_m)
    # A prediction of one drone permits a group for that drone only.
    prediction = drones[1:], 0.01 * np.eye(3)[None]
    with_prediction = match_points(rig, points, 1.0, expected=prediction)
    assert with_prediction.detection.tolist() == [[1, -1, 1, -1, -1]]
    assert with_prediction.expected.tolist() == [0]
    np.testing.assert_allclose(with_prediction.position_m, drones[1:], atol=1e-6)
    # If no camera has two detections, no detections can be confused.
    alone = match_points(rig, [detections[:1] for detections in points], 1.0)
    assert alone.detection.tolist() == [[0, -1, 0, -1, -1]]
    assert alone.expected.tolist() == [-1]


def test_detections_that_are_not_finite_and_drones_out_of_bounds_are_ignored():
    """The first drone is near the middle of all images, where NaN could be mistaken for a valid detection."""
    rig = ring_rig(4, image_size_wh=LARGE_WH, coefficients=4)
    drones = np.array([[0.1, -0.1, 1.2], [1.0, 0.5, 2.0]])
    points = points_by_camera(rig, drones)
    points[1][0], points[2][1, 0] = np.nan, np.inf
    assert groups_of(match_points(rig, points, 1.0)) == {(0, -1, 0, 0), (1, 1, -1, 1)}
    upper = np.array([[-4.0, -4.0, 1.5], [4.0, 4.0, 4.0]])
    assert groups_of(match_points(rig, points, 1.0, bounds_m=upper)) == {(1, 1, -1, 1)}


@pytest.mark.parametrize("least", [3, 4])
def test_cameras_at_one_place_count_as_one_view(least):
    rig = ring_rig(5, image_size_wh=LARGE_WH)
    drones = separate_points(2, np.random.default_rng(1))

    def num_groups(places):
        placed = make_unnamed_rig(*(rig.cameras[place] for place in places))
        return len(match_points(placed, points_by_camera(placed, drones), 1.0, min_views=least).position_m)

    assert num_groups(range(least)) == 2
    assert num_groups([0, 0, *range(least - 1)]) == 0


def test_groups_have_the_number_of_their_prediction():
    """Predictions may have any order; a prediction far from its drone has no group, and the drone's group is new."""
    rng = np.random.default_rng(2)
    rig = ring_rig(5, image_size_wh=LARGE_WH)
    drones = separate_points(4, rng)
    points, owners = observe(rig, drones, rng, noise_px=1.0, false=1)
    order = np.array([2, 0, 3])
    expected_m = drones[order] + rng.normal(scale=0.03, size=(3, 3))
    expected_m[2] += (0.0, 0.0, 1.5)
    spread = np.broadcast_to(0.05**2 * np.eye(3), (3, 3, 3))
    matches = match_points(rig, points, 1.0, expected=(expected_m, spread))
    numbers = matches.expected.tolist()
    assert sorted(numbers) == [-1, -1, 0, 1]
    for number in (0, 1):
        group = numbers.index(number)
        # A pixel is 4 mm, and a group has five views.
        assert np.linalg.norm(matches.position_m[group] - drones[order[number]]) < 0.02
        for camera, index in enumerate(matches.detection[group]):
            assert index < 0 or owners[camera][index] == order[number]


# --- merged, false and ambiguous detections


def test_a_merged_detection_is_shared():
    """Two drones in line with the second of three cameras, which has one detection between them."""
    rig = ring_rig(5, image_size_wh=LARGE_WH).select(["c0", "c1", "c3"])
    near = np.array([0.1, 0.3, 1.2])
    ray = near - rig.cameras.centre_world[1]
    far = near + 0.8 * ray / np.linalg.norm(ray) + np.array([0.0, 0.0, 0.01])
    points = points_by_camera(rig, np.stack([near, far]))
    width_px = np.linalg.norm(points[1][0] - points[1][1])
    points[1] = points[1].mean(axis=0)[None]
    assert groups_of(match_points(rig, points, width_px / 3.0)) == {(0, 0, 0), (1, 0, 1)}
    # If the merged detection is too far from both drones, it is cheaper to leave a drone's detections unexplained.
    assert len(match_points(rig, points, width_px / 8.0).position_m) < 2


def test_random_detections_or_none_give_no_groups():
    rig = ring_rig(6, image_size_wh=LARGE_WH)
    points = np.random.default_rng(0).uniform((0, 0), LARGE_WH, (6, 2, 2))
    assert not len(match_points(rig, points, 1.0).position_m)
    none = np.empty((6, 0, 2))
    assert not len(match_points(rig, none, 1.0).position_m)
    prediction = np.zeros((2, 3)), np.broadcast_to(np.eye(3), (2, 3, 3))
    assert not len(match_points(rig, none, 1.0, expected=prediction).position_m)


@pytest.mark.parametrize("off_px", [1.0, 2.0, 4.0])
def test_ambiguity_is_a_likelihood_ratio(off_px):
    """A false detection is near the crossing of a ray of each of two drones: SciPy gives the cost of that group.

    Both drones would keep three views, so only this cost decides between the two assignments.
    """
    rig = ring_rig(7, image_size_wh=LARGE_WH).select(["c0", "c1", "c3", "c5"])
    crossing = np.array([0.3, -0.2, 1.1])
    drones = 0.8 * crossing + 0.2 * rig.cameras.centre_world[:2]
    points = points_by_camera(rig, drones)
    alone = match_points(rig, points, 1.0)
    assert alone.ambiguity.tolist() == [0.0, 0.0]
    beside_px = project_points(rig, crossing)[2] + (0.0, off_px)
    points[2] = np.vstack([points[2], beside_px])
    matches = match_points(rig, points, 1.0)
    assert groups_of(matches) == groups_of(alone)
    expected = np.exp(-reprojection_cost(rig, points, (0, 1, 2, -1), 1.0) / 2)
    # `match` computes points from weighted linear equations, not from the least reprojection error: limit 5 %.
    np.testing.assert_allclose(matches.ambiguity, expected, rtol=0.05)


# --- properties


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_order_and_world_frame_do_not_matter(seed):
    """Groups are the same with cameras in another order, and in a turned and shifted world."""
    rng = np.random.default_rng(seed)
    rig = ring_rig(6, image_size_wh=LARGE_WH)
    drones = separate_points(int(rng.integers(1, 6)), rng)
    points, _ = observe(rig, drones, rng, noise_px=2.0, missed=0.1, false=1)
    matches = match_points(rig, points, 2.0)
    order = rng.permutation(6)
    mixed = match_points(rig.select([rig.names[c] for c in order]), [points[c] for c in order], 2.0)
    back = np.empty_like(mixed.detection)
    back[:, order] = mixed.detection
    assert {tuple(row) for row in back.tolist()} == groups_of(matches)

    R = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0, 2 * np.pi)]).as_matrix()
    shift_m = rng.uniform(-5, 5, 3)
    wide = np.stack([shift_m - 6.0, shift_m + 6.0])
    there = match_points(move_world(rig, R, shift_m), points, 2.0, bounds_m=wide)
    here = match_points(rig, points, 2.0, bounds_m=wide - shift_m)
    assert groups_of(there) == groups_of(here)


def test_a_lens_that_folds_within_the_image_is_continued():
    """A published lens has no ray for pixels near the border; the camera shows a drone there."""
    K, pose = np.array([[1570.0, 0, 960], [0, 1570, 540], [0, 0, 1]]), {"R": np.eye(3), "t_m": np.zeros(3)}
    lenses = ((0.013, 0.96, 0.0, 0.0, -4.15), (-0.1, 0.01, 0.0, 0.0, 0.0))
    cameras = [make_camera(**pose, K=K, dist=dist, image_size_wh=(1920, 1080)) for dist in lenses]
    pixels = np.array([[[[500.0, 400.0], [60.0, 250.0]]] * 2])
    sightings = Sightings(pixels, np.full(pixels.shape, 10.0), np.full(pixels.shape[:-1], 2.0))
    straight, seen, _ = straightened(make_unnamed_rig(*cameras), sightings)
    assert straight.cameras.dist.any(axis=-1).tolist() == [False, True]
    rays = undistort(cameras[0], pixels[0, 0])
    assert np.isnan(rays[1]).all()
    np.testing.assert_allclose(seen.centre_px[0, 0, 0], rays[0] * 1570 + K[:2, 2])
    np.testing.assert_allclose(seen.centre_px[0, 0, 1], pixels[0, 0, 1], atol=0.03 * 945)
