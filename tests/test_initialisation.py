"""Initial states of drones from the silhouettes of the first frames; silhouettes are drawn by ray casting."""

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
from psotrack.silhouettes import border_cells, find_blobs, stack_blobs
from psotrack.silhouettes.blobs import Blobs

FPS = 25.0
REDUCTION = 2
RIG = ring_rig(5, coefficients=5)
#: Side of a silhouette's cell in the room, metres: 2 px at 4 m and a focal length of 260 px are 3 cm.
CELL_M = 0.03


def flight(position_m, velocity_m_s, num_frames=7):
    """(frames, drones, 3), positions of drones with constant velocities."""
    time_s = np.arange(num_frames)[:, None, None] / FPS
    return np.asarray(position_m) + time_s * np.asarray(velocity_m_s)


def draw_frames(path_m, size_m, rig=RIG):
    """(frames, cameras, height, width), silhouettes of drones on a path (frames, drones, 3)."""
    return np.stack([draw_coverage(rig, positions, size_m, REDUCTION) for positions in path_m])


def find_in(coverage, rig=RIG):
    return find_drones(
        rig.cameras, coverage, reduction=REDUCTION, fps=FPS, bounds_m=ROOM_M, max_speed_m_s=6.0
    )


def match_rows(start, position_m):
    """Rows of the initial state in the order of the true positions; each drone must be found exactly once."""
    assert len(start.position_m) == len(position_m)
    nearest = np.linalg.norm(start.position_m - np.asarray(position_m)[:, None], axis=-1).argmin(axis=1)
    assert len(set(nearest.tolist())) == len(position_m)
    return nearest


DRONES_M = [[0.5, -0.4, 1.4], [-0.7, 0.3, 0.8], [0.1, 0.9, 1.9]]
VELOCITIES_M_S = [[1.0, 0.0, 0.2], [0.0, -1.5, 0.0], [0.0, 0.0, 0.0]]
SIZES_M = [[0.5, 0.5, 0.3], [0.6, 0.6, 0.25], [0.4, 0.4, 0.4]]


@pytest.mark.parametrize("num_drones", [1, 2, 3])
def test_position_velocity_and_size(num_drones):
    """Three drones have merged blobs in some images, whose middles are not at a drone."""
    drones = slice(num_drones)
    coverage = draw_frames(flight(DRONES_M[drones], VELOCITIES_M_S[drones]), SIZES_M[drones])
    start = find_in(coverage)
    rows = match_rows(start, DRONES_M[drones])
    # The error of a blob's middle is half a cell in each of five views and seven frames; limit one cell.
    np.testing.assert_allclose(start.position_m[rows], DRONES_M[drones], atol=CELL_M)
    # The error is half a cell in 0.12 s, half the duration, because it is the velocity at the end of a fitted parabola.
    np.testing.assert_allclose(start.velocity_m_s[rows], VELOCITIES_M_S[drones], atol=0.5 * CELL_M / 0.12)
    # A cell belongs to a blob if a quarter of it is covered, so a blob is at most half a cell too wide at each end.
    # The height is computed from a difference of squares; limit two cells.
    np.testing.assert_allclose(start.size_m[rows, :2], np.array(SIZES_M)[drones, :2], atol=1.5 * CELL_M)
    np.testing.assert_allclose(start.size_m[rows, 2], np.array(SIZES_M)[drones, 2], atol=2 * CELL_M)
    assert (start.num_cameras >= 3).all()
    assert (np.diff(start.num_cameras) <= 0).all()


def test_no_foreground_gives_no_drones():
    start = find_in(np.zeros((5, 5, 120, 160), np.uint8))
    assert [value.shape for value in vars(start).values()] == [(0, 3), (0, 3), (0, 3), (0,)]


def test_no_frames_give_no_drones():
    assert find_in(np.zeros((0, 5, 120, 160), np.uint8)).position_m.shape == (0, 3)


def test_one_frame_is_enough_for_positions():
    start = find_in(draw_frames(flight(DRONES_M, VELOCITIES_M_S, num_frames=1), SIZES_M))
    np.testing.assert_allclose(start.position_m[match_rows(start, DRONES_M)], DRONES_M, atol=CELL_M)
    assert not start.velocity_m_s.any()


def test_noise_that_does_not_persist_is_no_drone():
    """A drone, and noise blobs at different places in every frame."""
    coverage = draw_frames(flight(DRONES_M[:1], VELOCITIES_M_S[:1]), SIZES_M[:1])
    rng = np.random.default_rng(0)
    for image in coverage.reshape(-1, 120, 160):
        x, y = rng.integers(0, 150), rng.integers(0, 110)
        image[y : y + 6, x : x + 6] = 255
    start = find_in(coverage)
    np.testing.assert_allclose(start.position_m[match_rows(start, DRONES_M[:1])], DRONES_M[:1], atol=CELL_M)


def test_a_shadow_on_the_floor_is_no_drone():
    """Shadows are consistent in all views and move like their drones; they differ only by their height."""
    drone, speed, shadow_size = [0.2, 0.1, 1.5], [1.0, 0.0, 0.0], [0.4, 0.4, 0.02]
    shadows = [[0.25, 0.1, 0.0], [-0.8, -0.6, 0.0], [0.9, -0.5, 0.0]]
    path = flight([drone, *shadows], [speed] * 4)
    start = find_in(draw_frames(path, [SIZES_M[0], *[shadow_size] * 3]))
    assert len(start.position_m) == 1
    np.testing.assert_allclose(start.position_m[0], drone, atol=CELL_M)


def test_blobs_at_the_border_are_not_used():
    """The borders of two images cut off the drone, so its position and size come from the other cameras."""
    height, width = 240, 320
    rng = np.random.default_rng(0)
    for _ in range(2000):
        position = rng.uniform((-1.9, -1.9, 0.4), (1.9, 1.9, 2.3))
        (u, v), depth = project(RIG.cameras, position)[0].T, project(RIG.cameras, position)[1]
        margin = np.minimum.reduce([u, v, width - u, height - v]) - 260 * 0.25 / depth
        if (margin > 10).sum() == 3 and ((margin < -5) & (margin > -0.8 * 260 * 0.25 / depth)).sum() == 2:
            break
    else:
        raise AssertionError(
            "expected a position that two cameras see at the border, found none in 2000 draws"
        )
    start = find_in(draw_frames(flight([position], [[0.0, 0, 0]]), SIZES_M[:1]))
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
    start = find_in(draw_frames(flight([near, far], np.zeros((2, 3))), SIZES_M[:2]))
    rows = match_rows(start, [near, far])
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
    # The same image in an array that a larger image of another camera needs.
    filled_up = np.pad(image, ((0, 10), (0, 10)))
    assert find_blobs(filled_up, 4).whole.tolist() == [True, True]
    border = border_cells(np.array([118.0, 80.0]), 4)
    assert find_blobs(filled_up, 4, border).whole.tolist() == [True, False]


def select_cameras(*names):
    """The rig of the named cameras, and the indices of these cameras in `RIG`."""
    return RIG.select(names), [RIG.names.index(name) for name in names]


@cache
def three_drones(num_frames):
    return draw_frames(flight(DRONES_M, VELOCITIES_M_S, num_frames), SIZES_M)


@settings(max_examples=5)
@given(st.permutations(range(5)))
@pytest.mark.slow
def test_the_order_of_the_cameras_does_not_matter(order):
    coverage = three_drones(10)[:3]
    start = find_in(coverage)
    mixed = find_in(coverage[:, order], RIG.select([RIG.names[i] for i in order]))
    rows = match_rows(mixed, start.position_m)
    # Paths that end in the same cube of 2 cm are merged before the final fits; which of them is kept may differ.
    np.testing.assert_allclose(mixed.position_m[rows], start.position_m, atol=0.005)
    np.testing.assert_allclose(mixed.size_m[rows], start.size_m, atol=0.01)
    np.testing.assert_allclose(mixed.num_cameras[rows], start.num_cameras, atol=0.5)


@pytest.mark.parametrize("names", [("c0", "c1", "c2"), ("c0", "c1", "c3"), ("c1", "c2", "c3", "c4")])
def test_three_or_four_cameras(names):
    rig, rows = select_cameras(*names)
    coverage = three_drones(10)[:, rows]
    start = find_in(coverage, rig)
    found = match_rows(start, DRONES_M)
    # The error is half a cell, in three views instead of five, and geometry increases it by 1.3: limit two cells.
    np.testing.assert_allclose(start.position_m[found], DRONES_M, atol=2 * CELL_M)
    np.testing.assert_allclose(start.size_m[found, :2], np.array(SIZES_M)[:, :2], atol=2 * CELL_M)


@pytest.mark.parametrize(("num_frames", "num_found"), [(1, 0), (7, 0), (8, 2), (10, 2)])
def test_two_viewpoints_need_time(num_frames, num_found):
    """Two drones in two views, where rays to different drones do not cross."""
    rig, rows = select_cameras("c0", "c1")
    drones = [[0.5, -0.4, 1.6], [-0.2, 0.3, 0.9]]
    start = find_in(draw_frames(flight(drones, VELOCITIES_M_S[:2], num_frames), SIZES_M[:2])[:, rows], rig)
    assert len(start.position_m) == num_found
    if num_found:
        np.testing.assert_allclose(start.position_m[match_rows(start, drones)], drones, atol=2 * CELL_M)


def coplanar_with(one, other, spread_m=0.5):
    """Two positions in a plane with two cameras, so that rays to different drones cross too."""
    centre = RIG.cameras.centre_world[[RIG.names.index(name) for name in (one, other)]]
    middle, along = np.array([0.1, -0.1, 1.2]), centre[1] - centre[0]
    return [middle + sign * spread_m * along / np.linalg.norm(along) for sign in (-1, 1)]


def test_drones_that_are_ambiguous_in_two_views_are_not_found():
    """Two drones hover at two of four crossings of rays; two views cannot decide which two."""
    rig, rows = select_cameras("c0", "c1")
    drones = coplanar_with("c0", "c1")
    coverage = draw_frames(flight(drones, np.zeros((2, 3)), 10), SIZES_M[0])
    assert len(find_in(coverage[:, rows], rig).position_m) == 0
    three = find_in(coverage[:, [*rows, 3]], select_cameras("c0", "c1", "c3")[0])
    np.testing.assert_allclose(three.position_m[match_rows(three, drones)], drones, atol=2 * CELL_M)


def test_motion_resolves_the_ambiguity_of_two_views():
    """The positions in the first frame are the same as above; then one drone rises and the other sinks."""
    rig, rows = select_cameras("c0", "c1")
    drones = coplanar_with("c0", "c1")
    coverage = draw_frames(flight(drones, [[0, 0, 1.0], [0, 0, -1.0]], 10), SIZES_M[0])
    start = find_in(coverage[:, rows], rig)
    np.testing.assert_allclose(start.position_m[match_rows(start, drones)], drones, atol=2 * CELL_M)


def test_a_camera_without_a_blob_rejects_a_drone_in_its_view():
    """The third of three cameras has no blob: there is no drone within its view, but there may be one outside."""
    rig, rows = select_cameras("c0", "c1", "c3")
    coverage = draw_frames(flight(DRONES_M[:1], VELOCITIES_M_S[:1], 10), SIZES_M[:1])[:, rows]
    coverage[:, 2] = 0
    assert len(find_in(coverage, rig).position_m) == 0
    away = rig.cameras.T_cam_world.copy()
    away[2, :3] = np.diag([-1.0, 1.0, -1.0]) @ away[2, :3]
    elsewhere = Rig(rig.names, replace(rig.cameras, T_cam_world=away))
    assert len(find_in(coverage, elsewhere).position_m) == 1


def point_behind(near, camera, gap_m):
    """(3,), the point `gap_m` metres behind the point `near` on the ray of a camera."""
    ray = np.asarray(near) - RIG.cameras.centre_world[camera]
    return near + gap_m * ray / np.linalg.norm(ray)


def test_two_drones_in_one_blob_of_three_cameras():
    """Each drone has two separate blobs and one merged blob; its position and size come from the separate blobs."""
    rig, rows = select_cameras("c0", "c1", "c3")
    near = np.array([0.4, 0.1, 1.4])
    drones = [near, point_behind(near, 0, 0.9)]
    start = find_in(draw_frames(flight(drones, np.zeros((2, 3)), 10), SIZES_M[:2])[:, rows], rig)
    found = match_rows(start, drones)
    np.testing.assert_allclose(start.position_m[found], drones, atol=2 * CELL_M)
    np.testing.assert_allclose(start.size_m[found, :2], np.array(SIZES_M)[:2, :2], atol=2 * CELL_M)


@pytest.mark.slow
def test_a_given_number_of_drones_finds_a_hidden_drone():
    """One of two drones has only one separate blob; it is found if and only if the number of drones is given."""
    rig, rows = select_cameras("c0", "c1")
    near = np.array([0.4, 0.1, 1.4])
    drones = [near, point_behind(near, 0, 1.1)]
    coverage = draw_frames(flight(drones, np.zeros((2, 3)), 10), SIZES_M[1])[:, rows]

    def count_found(drones=None):
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

    assert [count_found(), count_found(1), count_found(2), count_found(3)] == [1, 1, 2, 2]


def test_a_drone_without_separate_blobs_gets_the_usual_size():
    sizes = np.array([[0.4, 0.4, 0.3], [np.nan] * 3, [0.6, 0.6, 0.2]])
    assert fill_unknown_sizes(sizes)[1].tolist() == [0.5, 0.5, 0.25]
    assert np.isnan(fill_unknown_sizes(np.full((2, 3), np.nan))).all()
    assert fill_unknown_sizes(np.empty((0, 3))).shape == (0, 3)


def test_blobs_that_are_inconsistent_are_no_drones():
    """Regression: if no proposed path was a drone, the refinement of zero paths failed."""
    coverage = np.zeros((10, 5, 120, 160), np.uint8)
    coverage[:, 0, 40:60, 50:70] = coverage[:, 1, 30:50, 90:110] = 255
    assert find_in(coverage).position_m.shape == (0, 3)


@settings(max_examples=5)
@given(st.randoms(use_true_random=False))
def test_the_order_of_the_blobs_does_not_matter(random):
    frames = [[find_blobs(image, REDUCTION) for image in images] for images in three_drones(10)[:3]]
    time_s, viewpoint = np.arange(3) / FPS, np.arange(5)

    def choose_positions(images):
        paths = propose_paths(RIG.cameras, stack_blobs(images, 5, REDUCTION), time_s, ROOM_M, 6.0)
        return paths[choose_paths(paths, viewpoint)].position_m[:, 0]

    def shuffled(blobs):
        order = random.sample(range(len(blobs.whole)), len(blobs.whole))
        return Blobs(blobs.centre_px[order], blobs.size_px[order], blobs.whole[order])

    found = choose_positions(frames)
    again = choose_positions([[shuffled(blobs) for blobs in images] for images in frames])
    # As with the order of the cameras, another path may be kept before the final fits.
    np.testing.assert_allclose(again[np.lexsort(again.T)], found[np.lexsort(found.T)], atol=0.01)


def test_all_blobs_of_a_silhouette_count_from_large_to_small():
    """An image has 70 blobs of increasing width. Regression: only the 50 largest counted, without a word."""
    image = np.zeros((70 * 5 + 4, 90), np.uint8)
    for row in range(70):
        image[5 * row + 4 : 5 * row + 6, 4 : 6 + row] = 255
    many = find_blobs(image, 3)
    assert (many.size_px[:, 0] / 3).tolist() == list(range(71, 1, -1))
    few = Blobs(np.zeros((1, 2)), np.ones((1, 2)), np.zeros(1, bool))
    stacked = stack_blobs([[many, few]], 2, 3)
    assert stacked.whole.shape == (1, 2, 70)
    assert np.isfinite(stacked.half_px[0, 1]).all(axis=-1).tolist() == [True] + [False] * 69
    assert not stacked.whole[0, 1].any()


@pytest.mark.slow
def test_the_height_of_a_low_drone_does_not_include_its_shadow():
    """Near the floor, a drone and its shadow are one blob; the same blob in the air is a tall drone."""
    size_m, disc_m = np.array([0.5, 0.5, 0.14]), np.array([0.5, 0.5, 0.02])
    heights = {}
    for z_m in (0.2, 1.4):
        path_m = flight([[0.2, -0.3, z_m], [0.2, -0.3, z_m - 0.19]], [[0.4, 0.2, 0.0]] * 2)
        start = find_in(draw_frames(path_m, np.stack([size_m, disc_m])))
        assert len(start.position_m) == 1
        heights[z_m] = start.size_m[0, 2] / start.size_m[0, 0]
    assert heights[1.4] > 0.4
    assert heights[0.2] <= 0.3
