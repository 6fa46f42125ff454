"""Drones in the first frames, from silhouettes that are drawn by casting rays at ellipsoids."""

import numpy as np
import pytest
from helpers import ROOM_M, draw_coverage, ring_rig

from psotrack.cameras import project
from psotrack.initialisation import find_blobs, find_drones

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
    """Rows of the start in the order of the known drones; every drone once."""
    assert len(start.position_m) == len(position_m)
    nearest = np.linalg.norm(start.position_m - np.asarray(position_m)[:, None], axis=-1).argmin(axis=1)
    assert len(set(nearest.tolist())) == len(position_m)
    return nearest


DRONES_M = [[0.5, -0.4, 1.4], [-0.7, 0.3, 0.8], [0.1, 0.9, 1.9]]
VELOCITIES_M_S = [[1.0, 0.0, 0.2], [0.0, -1.5, 0.0], [0.0, 0.0, 0.0]]
SIZES_M = [[0.5, 0.5, 0.3], [0.6, 0.6, 0.25], [0.4, 0.4, 0.4]]


@pytest.mark.parametrize("num_drones", [1, 2, 3])
def test_position_velocity_and_size(num_drones):
    """Three of them touch in some of the images: the middle of a blob that two share places neither."""
    drones = slice(num_drones)
    coverage = drawn(flight(DRONES_M[drones], VELOCITIES_M_S[drones]), SIZES_M[drones])
    start = found_in(coverage)
    rows = matched(start, DRONES_M[drones])
    # A blob's middle is good to half a cell in each of five views and seven frames; limit one cell.
    np.testing.assert_allclose(start.position_m[rows], DRONES_M[drones], atol=CELL_M)
    # Half a cell over a quarter of a second.
    np.testing.assert_allclose(start.velocity_m_s[rows], VELOCITIES_M_S[drones], atol=0.5 * CELL_M / 0.24)
    # A cell belongs to the blob from a quarter of its area on: at most one cell too wide, half a cell at each end.
    # The height is a difference of squares of such numbers, good to two cells.
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
    """Blobs at other places in every frame, besides a drone."""
    coverage = drawn(flight(DRONES_M[:1], VELOCITIES_M_S[:1]), SIZES_M[:1])
    rng = np.random.default_rng(0)
    for image in coverage.reshape(-1, 120, 160):
        x, y = rng.integers(0, 150), rng.integers(0, 110)
        image[y : y + 6, x : x + 6] = 255
    start = found_in(coverage)
    np.testing.assert_allclose(start.position_m[matched(start, DRONES_M[:1])], DRONES_M[:1], atol=CELL_M)


def test_a_shadow_on_the_floor_is_no_drone():
    """Shadows agree between all views and move as their drones do: only their height tells them."""
    drone, speed, shadow_size = [0.2, 0.1, 1.5], [1.0, 0.0, 0.0], [0.4, 0.4, 0.02]
    shadows = [[0.25, 0.1, 0.0], [-0.8, -0.6, 0.0], [0.9, -0.5, 0.0]]
    path = flight([drone, *shadows], [speed] * 4)
    start = found_in(drawn(path, [SIZES_M[0], *[shadow_size] * 3]))
    assert len(start.position_m) == 1
    np.testing.assert_allclose(start.position_m[0], drone, atol=CELL_M)


def test_blobs_at_the_border_do_not_count():
    """A drone that two images cut: its place and size come from the other cameras."""
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
    """Both on one ray of camera 0, which sees one blob: the others tell them apart."""
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
