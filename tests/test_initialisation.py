"""Drones in the first frames, from silhouettes of ellipsoids that are drawn by ray casting."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers import ROOM_M, draw_coverage, ring_rig
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.geometry import Rig, project
from psotrack.initiation.initialisation import choose_paths, fill_unknown_sizes, find_drones
from psotrack.initiation.paths import propose_paths
from psotrack.silhouettes import find_blobs, stack_blobs
from psotrack.silhouettes.blobs import MOST_BLOBS, Blobs

FPS = 25.0
REDUCTION = 2
RIG = ring_rig(5, coefficients=5)
#: One cell of a silhouette is 2 px; at 4 m and a focal length of 260 px that is 3 cm.
CELL_M = 0.03


def flight(position_m, velocity_m_s, num_frames=7):
    time_s = np.arange(num_frames)[:, None, None] / FPS
    return np.asarray(position_m) + time_s * np.asarray(velocity_m_s)


def drawn(path_m, size_m, rig=RIG):
    return np.stack([draw_coverage(rig, positions, size_m, REDUCTION) for positions in path_m])


def found_in(coverage, rig=RIG):
    return find_drones(
        rig.cameras, coverage, reduction=REDUCTION, fps=FPS, bounds_m=ROOM_M, max_speed_m_s=6.0
    )


def matched(start, position_m):
    """Rows of the initial state in the order of the known drones; each drone is found once."""
    assert len(start.position_m) == len(position_m)
    nearest = np.linalg.norm(start.position_m - np.asarray(position_m)[:, None], axis=-1).argmin(axis=1)
    assert len(set(nearest.tolist())) == len(position_m)
    return nearest


DRONES_M = [[0.5, -0.4, 1.4], [-0.7, 0.3, 0.8], [0.1, 0.9, 1.9]]
VELOCITIES_M_S = [[1.0, 0.0, 0.2], [0.0, -1.5, 0.0], [0.0, 0.0, 0.0]]
SIZES_M = [[0.5, 0.5, 0.3], [0.6, 0.6, 0.25], [0.4, 0.4, 0.4]]


@pytest.mark.parametrize("num_drones", [1, 2, 3])
def test_position_velocity_and_size(num_drones):
    """Three drones share blobs in some images; the middle of a shared blob is at no drone."""
    drones = slice(num_drones)
    coverage = drawn(flight(DRONES_M[drones], VELOCITIES_M_S[drones]), SIZES_M[drones])
    start = found_in(coverage)
    rows = matched(start, DRONES_M[drones])
    # The error of a blob's middle is half a cell in each of five views and seven frames; limit one cell.
    np.testing.assert_allclose(start.position_m[rows], DRONES_M[drones], atol=CELL_M)
    # Half a cell over half of a quarter of a second, because it is the velocity at the end of a parabola.
    np.testing.assert_allclose(start.velocity_m_s[rows], VELOCITIES_M_S[drones], atol=0.5 * CELL_M / 0.12)
    # A cell belongs to a blob if a quarter is covered, so a blob is at most half a cell too wide at each end.
    # The height is computed from a difference of squares; limit two cells.
    np.testing.assert_allclose(start.size_m[rows, :2], np.array(SIZES_M)[drones, :2], atol=1.5 * CELL_M)
    np.testing.assert_allclose(start.size_m[rows, 2], np.array(SIZES_M)[drones, 2], atol=2 * CELL_M)
    assert (start.num_cameras >= 3).all()
    assert (np.diff(start.num_cameras) <= 0).all()


def test_no_foreground_no_drones():
    start = found_in(np.zeros((5, 5, 120, 160), np.uint8))
    assert [value.shape for value in vars(start).values()] == [(0, 3), (0, 3), (0, 3), (0,)]


def test_no_frames_no_drones():
    assert found_in(np.zeros((0, 5, 120, 160), np.uint8)).position_m.shape == (0, 3)


def test_one_frame_is_enough_for_positions():
    start = found_in(drawn(flight(DRONES_M, VELOCITIES_M_S, num_frames=1), SIZES_M))
    np.testing.assert_allclose(start.position_m[matched(start, DRONES_M)], DRONES_M, atol=CELL_M)
    assert not start.velocity_m_s.any()


def test_noise_that_does_not_persist_is_no_drone():
    """A drone, and noise blobs at different places in every frame."""
    coverage = drawn(flight(DRONES_M[:1], VELOCITIES_M_S[:1]), SIZES_M[:1])
    rng = np.random.default_rng(0)
    for image in coverage.reshape(-1, 120, 160):
        x, y = rng.integers(0, 150), rng.integers(0, 110)
        image[y : y + 6, x : x + 6] = 255
    start = found_in(coverage)
    np.testing.assert_allclose(start.position_m[matched(start, DRONES_M[:1])], DRONES_M[:1], atol=CELL_M)


def test_a_shadow_on_the_floor_is_no_drone():
    """Shadows look the same in all views and move like their drones; only their height differs."""
    drone, speed, shadow_size = [0.2, 0.1, 1.5], [1.0, 0.0, 0.0], [0.4, 0.4, 0.02]
    shadows = [[0.25, 0.1, 0.0], [-0.8, -0.6, 0.0], [0.9, -0.5, 0.0]]
    path = flight([drone, *shadows], [speed] * 4)
    start = found_in(drawn(path, [SIZES_M[0], *[shadow_size] * 3]))
    assert len(start.position_m) == 1
    np.testing.assert_allclose(start.position_m[0], drone, atol=CELL_M)


def test_blobs_at_the_border_do_not_count():
    """Two images cut the drone off; its place and size come from the other cameras."""
    height, width = 240, 320
    rng = np.random.default_rng(0)
    for _ in range(2000):
        position = rng.uniform((-1.9, -1.9, 0.4), (1.9, 1.9, 2.3))
        (u, v), depth = project(RIG.cameras, position)[0].T, project(RIG.cameras, position)[1]
        margin = np.minimum.reduce([u, v, width - u, height - v]) - 260 * 0.25 / depth
        if (margin > 10).sum() == 3 and ((margin < -5) & (margin > -0.8 * 260 * 0.25 / depth)).sum() == 2:
            break
    else:
        raise AssertionError("no such place in this room")
    start = found_in(drawn(flight([position], [[0.0, 0, 0]]), SIZES_M[:1]))
    assert len(start.position_m) == 1
    np.testing.assert_allclose(start.position_m[0], position, atol=CELL_M)
    np.testing.assert_allclose(start.size_m[0, :2], SIZES_M[0][:2], atol=1.5 * CELL_M)


def test_two_drones_that_hide_each_other_in_one_view():
    """Two drones on one ray of camera 0, which shows one blob; the other cameras separate them."""
    near = np.array([0.4, 0.1, 1.4])
    ray = near - RIG.cameras.centre_world[0]
    far = near + 1.1 * ray / np.linalg.norm(ray)
    pixels, _ = project(RIG.cameras, np.stack([near, far])[:, None, :])
    assert np.abs(pixels[0, 0] - pixels[1, 0]).max() < 1
    start = found_in(drawn(flight([near, far], np.zeros((2, 3))), SIZES_M[:2]))
    rows = matched(start, [near, far])
    np.testing.assert_allclose(start.position_m[rows], [near, far], atol=CELL_M)
    np.testing.assert_allclose(start.size_m[rows, :2], np.array(SIZES_M)[:2, :2], atol=2 * CELL_M)


def test_blobs_by_hand():
    """Cells of 4 x 4 px: the middle of a box of cells, with pixel centres at whole numbers."""
    image = np.zeros((20, 30), np.uint8)
    image[4:8, 10:16] = 255
    image[12:16, 27:30] = 255
    image[15, 3] = 255  # 16 px: a speckle.
    image[0:3, 0:9] = 20  # hardly covered.
    blobs = find_blobs(image, 4)
    assert blobs.centre_px.tolist() == [[51.5, 23.5], [113.5, 55.5]]
    assert blobs.size_px.tolist() == [[24, 16], [12, 16]]
    assert blobs.whole.tolist() == [True, False]


def seen_by(*names):
    """The rig of some of the five cameras, and the silhouettes of these cameras."""
    return RIG.select(names), [RIG.names.index(name) for name in names]


@cache
def three_drones(num_frames):
    return drawn(flight(DRONES_M, VELOCITIES_M_S, num_frames), SIZES_M)


@settings(max_examples=5)
@given(st.permutations(range(5)))
def test_the_order_of_the_cameras_does_not_matter(order):
    coverage = three_drones(10)[:3]
    start = found_in(coverage)
    mixed = found_in(coverage[:, order], RIG.select([RIG.names[i] for i in order]))
    rows = matched(mixed, start.position_m)
    # Paths that end in the same cube of 2 cm are merged, and which path stays may differ before the last fits.
    np.testing.assert_allclose(mixed.position_m[rows], start.position_m, atol=0.005)
    np.testing.assert_allclose(mixed.size_m[rows], start.size_m, atol=0.01)
    np.testing.assert_allclose(mixed.num_cameras[rows], start.num_cameras, atol=0.5)


@pytest.mark.parametrize("names", [("c0", "c1", "c2"), ("c0", "c1", "c3"), ("c1", "c2", "c3", "c4")])
def test_three_or_four_cameras(names):
    rig, rows = seen_by(*names)
    coverage = three_drones(10)[:, rows]
    start = found_in(coverage, rig)
    found = matched(start, DRONES_M)
    # Half a cell in three views instead of five, and the middles of a row of 50° are stretched by 1.3: limit two cells.
    np.testing.assert_allclose(start.position_m[found], DRONES_M, atol=2 * CELL_M)
    np.testing.assert_allclose(start.size_m[found, :2], np.array(SIZES_M)[:, :2], atol=2 * CELL_M)


@pytest.mark.parametrize(("num_frames", "num_found"), [(1, 0), (7, 0), (8, 2), (10, 2)])
def test_two_viewpoints_need_time(num_frames, num_found):
    """Two drones in two views, without crossings of rays to different drones."""
    rig, rows = seen_by("c0", "c1")
    drones = [[0.5, -0.4, 1.6], [-0.2, 0.3, 0.9]]
    start = found_in(drawn(flight(drones, VELOCITIES_M_S[:2], num_frames), SIZES_M[:2])[:, rows], rig)
    assert len(start.position_m) == num_found
    if num_found:
        np.testing.assert_allclose(start.position_m[matched(start, drones)], drones, atol=2 * CELL_M)


def coplanar_with(one, other, spread_m=0.5):
    """Two places in a plane with two cameras, so that rays to different drones cross too."""
    centre = RIG.cameras.centre_world[[RIG.names.index(name) for name in (one, other)]]
    middle, along = np.array([0.1, -0.1, 1.2]), centre[1] - centre[0]
    return [middle + sign * spread_m * along / np.linalg.norm(along) for sign in (-1, 1)]


def test_what_two_views_cannot_tell_is_not_found():
    """Four rays with four crossings that do not move: two drones, at unknown crossings."""
    rig, rows = seen_by("c0", "c1")
    drones = coplanar_with("c0", "c1")
    coverage = drawn(flight(drones, np.zeros((2, 3)), 10), SIZES_M[0])
    assert len(found_in(coverage[:, rows], rig).position_m) == 0
    three = found_in(coverage[:, [*rows, 3]], seen_by("c0", "c1", "c3")[0])
    np.testing.assert_allclose(three.position_m[matched(three, drones)], drones, atol=2 * CELL_M)


def test_motion_tells_what_two_views_cannot():
    """The same places in the first frame; then one drone rises and the other sinks."""
    rig, rows = seen_by("c0", "c1")
    drones = coplanar_with("c0", "c1")
    coverage = drawn(flight(drones, [[0, 0, 1.0], [0, 0, -1.0]], 10), SIZES_M[0])
    start = found_in(coverage[:, rows], rig)
    np.testing.assert_allclose(start.position_m[matched(start, drones)], drones, atol=2 * CELL_M)


def test_a_view_that_shows_nothing_speaks_against_two_that_agree():
    """The third of three cameras does not see a drone: so there is none within its view, but one may be outside."""
    rig, rows = seen_by("c0", "c1", "c3")
    coverage = drawn(flight(DRONES_M[:1], VELOCITIES_M_S[:1], 10), SIZES_M[:1])[:, rows]
    coverage[:, 2] = 0
    assert len(found_in(coverage, rig).position_m) == 0
    away = rig.cameras.T_cam_world.copy()
    away[2, :3] = np.diag([-1.0, 1.0, -1.0]) @ away[2, :3]
    elsewhere = Rig(rig.names, replace(rig.cameras, T_cam_world=away))
    assert len(found_in(coverage, elsewhere).position_m) == 1


def behind(near, camera, gap_m):
    ray = np.asarray(near) - RIG.cameras.centre_world[camera]
    return near + gap_m * ray / np.linalg.norm(ray)


def test_two_drones_in_one_blob_of_three_cameras():
    """Each drone has two views of its own and a shared view; its place and size come from its own views."""
    rig, rows = seen_by("c0", "c1", "c3")
    near = np.array([0.4, 0.1, 1.4])
    drones = [near, behind(near, 0, 0.9)]
    start = found_in(drawn(flight(drones, np.zeros((2, 3)), 10), SIZES_M[:2])[:, rows], rig)
    found = matched(start, drones)
    np.testing.assert_allclose(start.position_m[found], drones, atol=2 * CELL_M)
    np.testing.assert_allclose(start.size_m[found, :2], np.array(SIZES_M)[:2, :2], atol=2 * CELL_M)


def test_the_number_of_drones_is_knowledge():
    """One of two drones has only one view of its own; it is found if and only if the number of drones is given."""
    rig, rows = seen_by("c0", "c1")
    near = np.array([0.4, 0.1, 1.4])
    drones = [near, behind(near, 0, 1.1)]
    coverage = drawn(flight(drones, np.zeros((2, 3)), 10), SIZES_M[1])[:, rows]

    def number(drones=None):
        found = find_drones(
            rig.cameras,
            coverage,
            reduction=REDUCTION,
            fps=FPS,
            bounds_m=ROOM_M,
            max_speed_m_s=6.0,
            drones=drones,
        )
        return len(found.position_m)

    assert [number(), number(1), number(2), number(3)] == [1, 1, 2, 2]


def test_one_that_no_camera_sees_by_itself_has_the_size_of_the_others():
    sizes = np.array([[0.4, 0.4, 0.3], [np.nan] * 3, [0.6, 0.6, 0.2]])
    assert fill_unknown_sizes(sizes)[1].tolist() == [0.5, 0.5, 0.25]
    assert np.isnan(fill_unknown_sizes(np.full((2, 3), np.nan))).all()
    assert fill_unknown_sizes(np.empty((0, 3))).shape == (0, 3)


def test_blobs_that_agree_on_nothing_are_no_drones():
    """Regression: if no proposed path is a drone, refining no paths failed."""
    coverage = np.zeros((10, 5, 120, 160), np.uint8)
    coverage[:, 0, 40:60, 50:70] = coverage[:, 1, 30:50, 90:110] = 255
    assert found_in(coverage).position_m.shape == (0, 3)


@settings(max_examples=5)
@given(st.randoms(use_true_random=False))
def test_the_order_of_the_blobs_does_not_matter(random):
    frames = [[find_blobs(image, REDUCTION) for image in images] for images in three_drones(10)[:3]]
    time_s, viewpoint = np.arange(3) / FPS, np.arange(5)

    def chosen(images):
        paths = propose_paths(RIG.cameras, stack_blobs(images, 5, REDUCTION), time_s, ROOM_M, 6.0)
        return paths[choose_paths(paths, viewpoint)].position_m[:, 0]

    def mixed(blobs):
        order = random.sample(range(len(blobs.whole)), len(blobs.whole))
        return Blobs(blobs.centre_px[order], blobs.size_px[order], blobs.whole[order])

    found = chosen(frames)
    again = chosen([[mixed(blobs) for blobs in images] for images in frames])
    # As with the order of the cameras: before the last fits, another path may stay.
    np.testing.assert_allclose(again[np.lexsort(again.T)], found[np.lexsort(found.T)], atol=0.01)


def test_silhouettes_full_of_noise_take_no_more_than_their_largest_blobs():
    """70 blobs, each wider than the one before. A bug of the first version: a search for newcomers took them all."""
    image = np.zeros((70 * 5, 90), np.uint8)
    for row in range(70):
        image[5 * row + 1 : 5 * row + 3, 2 : 4 + row] = 255
    many = find_blobs(image, 3)
    assert (many.size_px[:, 0] / 3).tolist() == list(range(71, 71 - MOST_BLOBS, -1))
    few = Blobs(np.zeros((1, 2)), np.ones((1, 2)), np.zeros(1, bool))
    seen = stack_blobs([[many, few]], 2, 3)
    assert seen.whole.shape == (1, 2, MOST_BLOBS)
    assert np.isfinite(seen.half_px[0, 1]).all(axis=-1).tolist() == [True] + [False] * (MOST_BLOBS - 1)
    assert not seen.whole[0, 1].any()


def test_the_height_of_a_low_drone_has_no_shadow_in_it():
    """A drone near the floor and its shadow are one blob; the same blob in the air is one tall drone."""
    size_m, disc_m = np.array([0.5, 0.5, 0.14]), np.array([0.5, 0.5, 0.02])
    heights = {}
    for z_m in (0.2, 1.4):
        path_m = flight([[0.2, -0.3, z_m], [0.2, -0.3, z_m - 0.19]], [[0.4, 0.2, 0.0]] * 2)
        start = found_in(drawn(path_m, np.stack([size_m, disc_m])))
        assert len(start.position_m) == 1
        heights[z_m] = start.size_m[0, 2] / start.size_m[0, 0]
    assert heights[1.4] > 0.4
    assert heights[0.2] <= 0.3
