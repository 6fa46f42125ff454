"""Correspondence of detections: OpenCV's epipolar lines, all assignments of small scenes, and merged detections."""

from itertools import product

import cv2
import numpy as np
import pytest
from helpers import (
    LENSES,
    draw_coverage,
    make_unnamed_rig,
    move_world,
    project_points,
    ring_rig,
    silhouettes_in_memory,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from psotrack.geometry import project
from psotrack.recordings import Detections
from psotrack.tracking.matching import (
    NEW_GROUP_COST,
    SHARED_COST,
    UNEXPLAINED_COST,
    epipolar_distance,
    from_detections,
    from_silhouettes,
    match,
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
    for c in range(len(rig)):
        seen = np.flatnonzero(rng.random(len(drones)) >= missed)
        real = pixels[seen, c] + noise_px * rng.normal(size=(len(seen), 2))
        ghosts = rng.uniform((0, 0), rig.cameras.image_size_wh[c], (false, 2))
        order = rng.permutation(len(seen) + false)
        points.append(np.vstack([real, ghosts])[order])
        owners.append(np.concatenate([seen, np.full(false, -1)])[order])
    return points, owners


def match_points(rig, points, noise_px, bounds_m=BOUNDS_M, **options):
    """Match detections, per camera; all have the same noise, or there is one noise for each."""
    counts = list(map(len, points))
    there = np.arange(max(counts)) < np.array(counts)[:, None]
    points_px, noise = np.full((*there.shape, 2), np.nan), np.full(there.shape, np.nan)
    points_px[there] = np.concatenate(points)
    noise[there] = noise_px if np.isscalar(noise_px) else np.concatenate(noise_px)
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


def test_blobs_of_silhouettes_are_sightings():
    rig, reduction, position_m = ring_rig(4), 2, np.array([[0.2, -0.3, 1.2]])
    image = draw_coverage(rig, position_m, [0.6, 0.6, 0.6], reduction)
    silhouettes = silhouettes_in_memory(rig, np.repeat(image[None], 30, axis=0), reduction)
    sightings = from_silhouettes(silhouettes)
    assert sightings.centre_px.shape == (30, 4, 1, 2)
    # The image of a sphere is not exactly centred on the image of its middle, and cells are 2 px wide.
    np.testing.assert_allclose(sightings.centre_px[-1, :, 0], project(rig.cameras, position_m)[0], atol=1.5)


# --- epipolar lines


def distort_by_opencv(cam, straight):
    """Pixels after distortion by OpenCV, from pixels without distortion."""
    rays = np.column_stack([straight, np.ones(len(straight))]) @ np.linalg.inv(cam.K).T
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), cam.K, np.array(cam.dist))[0][:, 0]


@pytest.mark.parametrize("coefficients", sorted(LENSES))
def test_distances_from_epipolar_lines_equal_opencvs(coefficients):
    rig = ring_rig(5, coefficients=coefficients)
    rng = np.random.default_rng(0)
    a, b = rig.cameras[1], rig.cameras[3]
    straight = [rng.uniform((60, 60), (260, 180), (count, 2)) for count in (7, 3)]
    bent = [distort_by_opencv(cam, points) for cam, points in zip((a, b), straight, strict=True)]
    R = b.T_cam_world[:3, :3] @ a.T_cam_world[:3, :3].T
    t = b.T_cam_world[:3, 3] - R @ a.T_cam_world[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    F = np.linalg.inv(b.K).T @ cross @ R @ np.linalg.inv(a.K)
    found = epipolar_distance(a, b, *bent)
    for side, (first, second) in enumerate(((0, 1), (1, 0))):
        lines = cv2.computeCorrespondEpilines(straight[first][:, None], first + 1, F)[:, 0]
        off = np.abs(lines[:, :2] @ straight[second].T + lines[:, 2:])
        # Distortion is inverted to 1e-8 (see test_cameras), which is 3e-6 px.
        np.testing.assert_allclose(found[..., side], off if side == 0 else off.T, atol=1e-5)


# --- the least total cost


def reprojection_cost(rig, points, group, noise_px):
    """Least sum of squared reprojection errors of a group, in standard deviations, by SciPy."""
    seen = [c for c, index in enumerate(group) if index >= 0]
    picked = np.array([points[c][group[c]] for c in seen])

    def residual(point):
        return ((project(rig.cameras[np.array(seen)], point)[0] - picked) / noise_px).ravel()

    return 2 * least_squares(residual, np.array([0.0, 0.0, 1.3]), method="lm").cost


def least_total(rig, points, noise_px):
    """Groups with the least total cost for three cameras, and this cost, by a search of all assignments."""
    triples = [
        (triple, cost)
        for triple in product(*(range(len(detections)) for detections in points))
        if (cost := reprojection_cost(rig, points, triple, noise_px)) < 3 * UNEXPLAINED_COST
    ]
    best, chosen = UNEXPLAINED_COST * sum(map(len, points)), frozenset()

    def search(start, used, groups, total):
        nonlocal best, chosen
        if total < best:
            best, chosen = total, frozenset(groups)
        for number in range(start, len(triples)):
            triple, cost = triples[number]
            shared = len(used & set(enumerate(triple)))
            # A group may share at most one of its three detections.
            if shared < 2:
                change = NEW_GROUP_COST + cost + SHARED_COST * shared - UNEXPLAINED_COST * (3 - shared)
                search(number + 1, used | set(enumerate(triple)), [*groups, triple], total + change)

    search(0, frozenset(), [], best)
    return set(chosen), best


@pytest.mark.parametrize("seed", range(10))
def test_groups_have_the_least_total_cost_of_all_assignments(seed):
    """Three cameras, two or three drones, and at most one false detection per camera."""
    rng = np.random.default_rng(seed)
    rig = ring_rig(3, image_size_wh=LARGE_WH, coefficients=(0, 5)[seed % 2])
    drones = separate_points(2 + seed % 2, rng)
    points, _ = observe(rig, drones, rng, noise_px=3.0, missed=0.1, false=seed // 2 % 2)
    expected, _ = least_total(rig, points, 3.0)
    assert groups_of(match_points(rig, points, 3.0)) == expected


# --- groups with two views


def test_two_views_are_no_group_without_a_prediction():
    rig = ring_rig(5, image_size_wh=LARGE_WH)
    drones = separate_points(2, np.random.default_rng(0))
    points = list(project_points(rig, drones).swapaxes(0, 1))
    points[1] = points[3] = points[4] = np.empty((0, 2))
    assert not len(match_points(rig, points, 1.0).position_m)
    # A prediction of one drone permits a group for that drone only.
    with_prediction = match_points(rig, points, 1.0, expected=(drones[1:], 0.01 * np.eye(3)[None]))
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
    points = list(project_points(rig, drones).swapaxes(0, 1))
    points[1][0], points[2][1, 0] = np.nan, np.inf
    assert groups_of(match_points(rig, points, 1.0)) == {(0, -1, 0, 0), (1, 1, -1, 1)}
    upper = np.array([[-4.0, -4.0, 1.5], [4.0, 4.0, 4.0]])
    assert groups_of(match_points(rig, points, 1.0, bounds_m=upper)) == {(1, 1, -1, 1)}


@pytest.mark.parametrize("least", [3, 4])
def test_cameras_at_one_place_count_as_one_view(least):
    rig = ring_rig(5, image_size_wh=LARGE_WH)
    drones = separate_points(2, np.random.default_rng(1))
    for places, enough in (((0,) * 3 + tuple(range(1, least - 1)), False), (range(least), True)):
        placed = make_unnamed_rig(*(rig.cameras[i] for i in places))
        points = list(project_points(placed, drones).swapaxes(0, 1))
        assert len(match_points(placed, points, 1.0, min_views=least).position_m) == (2 if enough else 0)


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
    named = dict(zip(matches.expected.tolist(), matches.position_m, strict=False))
    assert sorted(matches.expected.tolist()) == [-1, -1, 0, 1]
    for number in (0, 1):
        # A pixel is 4 mm, and a group has five views.
        assert np.linalg.norm(named[number] - drones[order[number]]) < 0.02
        row = matches.detection[matches.expected == number][0]
        assert all(owners[c][i] == order[number] for c, i in enumerate(row) if i >= 0)


# --- merged, false and ambiguous detections


def test_a_merged_detection_is_shared():
    """Two drones in line with the second of three cameras, which has one detection between them."""
    rig = make_unnamed_rig(*(ring_rig(5, image_size_wh=LARGE_WH).cameras[i] for i in (0, 1, 3)))
    centre, near = rig.cameras.centre_world[1], np.array([0.1, 0.3, 1.2])
    far = near + 0.8 * (near - centre) / np.linalg.norm(near - centre) + np.array([0.0, 0.0, 0.01])
    points = list(project_points(rig, np.stack([near, far])).swapaxes(0, 1))
    width_px = np.linalg.norm(points[1][0] - points[1][1])
    points[1] = points[1].mean(axis=0)[None]
    assert groups_of(match_points(rig, points, width_px / 3.0)) == {(0, 0, 0), (1, 0, 1)}
    # If the merged detection is too far from both drones, it is cheaper to leave a drone's detections unexplained.
    assert len(match_points(rig, points, width_px / 8.0).position_m) < 2


def test_random_detections_or_none_give_no_groups():
    rig = ring_rig(6, image_size_wh=LARGE_WH)
    rng = np.random.default_rng(0)
    points = [rng.uniform((0, 0), LARGE_WH, (2, 2)) for _ in range(6)]
    assert not len(match_points(rig, points, 1.0).position_m)
    assert not len(match_points(rig, [np.empty((0, 2))] * 6, 1.0).position_m)
    one_camera = [points[0], *[np.empty((0, 2))] * 5]
    assert match_points(rig, one_camera, 1.0).detection.shape == (0, 6)
    prediction = np.zeros((2, 3)), np.broadcast_to(np.eye(3), (2, 3, 3))
    predicted_only = match_points(rig, [np.empty((0, 2))] * 6, 1.0, expected=prediction)
    assert predicted_only.expected.shape == (0,)


@pytest.mark.parametrize("off_px", [1.0, 2.0, 4.0])
def test_ambiguity_is_a_likelihood_ratio(off_px):
    """A false detection is near the crossing of a ray of each of two drones: SciPy gives the cost of that group.

    Both drones would keep three views, so only this cost decides between the two assignments.
    """
    rig = make_unnamed_rig(*(ring_rig(7, image_size_wh=LARGE_WH).cameras[i] for i in (0, 1, 3, 5)))
    crossing = np.array([0.3, -0.2, 1.1])
    drones = np.stack([0.8 * crossing + 0.2 * centre for centre in rig.cameras.centre_world[:2]])
    points = list(project_points(rig, drones).swapaxes(0, 1))
    alone = match_points(rig, points, 1.0)
    assert alone.ambiguity.tolist() == [0.0, 0.0]
    points[2] = np.vstack([points[2], project_points(rig, crossing)[2] + (0.0, off_px)])
    matches = match_points(rig, points, 1.0)
    assert groups_of(matches) == groups_of(alone) == {(0, 0, 0, 0), (1, 1, 1, 1)}
    expected = np.exp(-reprojection_cost(rig, points, (0, 1, 2, -1), 1.0) / 2)
    # `match` computes points from weighted linear equations, not from the least reprojection error: limit 5 %.
    np.testing.assert_allclose(matches.ambiguity, expected, rtol=0.05)


def test_two_boxes_of_one_drone_are_not_ambiguous():
    """Three of five cameras have a second box 1 cm higher; whichever box is in the group, the drone is the same."""
    rig = ring_rig(5, image_size_wh=LARGE_WH)
    drones = separate_points(2, np.random.default_rng(0))
    points = list(project_points(rig, drones).swapaxes(0, 1))
    higher = project_points(rig, drones[0] + np.array([0.0, 0.0, 0.01]))
    for c in range(3):
        points[c] = np.vstack([points[c], higher[c]])
    matches = match_points(rig, points, 2.0)
    assert groups_of(matches) >= {(0,) * 5, (1,) * 5}
    assert not matches.ambiguity.any()


# --- properties


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_order_and_world_frame_do_not_matter(seed):
    """Groups are the same with cameras and detections in another order, and in a turned and shifted world."""
    rng = np.random.default_rng(seed)
    rig = ring_rig(6, image_size_wh=LARGE_WH)
    drones = separate_points(int(rng.integers(1, 6)), rng)
    points, _ = observe(rig, drones, rng, noise_px=2.0, missed=0.1, false=1)
    matches = match_points(rig, points, 2.0)
    order = rng.permutation(6)
    within = [rng.permutation(len(detections)) for detections in points]
    mixed_rig = rig.select([rig.names[c] for c in order])
    mixed = match_points(mixed_rig, [points[c][within[c]] for c in order], 2.0)
    back = np.full_like(mixed.detection, -1)
    for place, c in enumerate(order):
        seen = mixed.detection[:, place] >= 0
        back[seen, c] = within[c][mixed.detection[seen, place]]
    assert {tuple(row) for row in back.tolist()} == groups_of(matches)

    R = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0, 2 * np.pi)]).as_matrix()
    shift_m = rng.uniform(-5, 5, 3)
    wide = np.stack([shift_m - 6.0, shift_m + 6.0])
    there = match_points(move_world(rig, R, shift_m), points, 2.0, bounds_m=wide)
    here = match_points(rig, points, 2.0, bounds_m=wide - shift_m)
    assert groups_of(there) == groups_of(here)
