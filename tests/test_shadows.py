"""Shadows on the floor: which pixels show a shadow, and how shadows change the position of a drone.

A ray caster in NumPy is the oracle for the pixels. Drones are drawn as a body with four rotors, because foreground
in front of a shadow is judged by the share of a drone's box that foreground fills.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import draw_coverage, float32, ring_rig
from windows import best_place, cut_at, evaluate, occluded_pixels, pixels

from psotrack.geometry import make_extents, project, project_boxes, undistort
from psotrack.tracking import sizes
from psotrack.tracking.fitness import drone_fitness
from psotrack.tracking.occlusion import OCCLUDER_SCALE, find_occluders
from psotrack.tracking.shadows import CAST, LOW, FloorView, is_low, shadowed_pixels

pytestmark = pytest.mark.slow

REDUCTION = 2
#: In the middle of the room, a pixel of the silhouettes is 2.4 cm wide.
RIG = ring_rig(8, image_size_wh=(480, 270), radius_m=4.5)
#: No floor, so that no shadow is searched; and the height of a floor far below all drones, metres.
NO_FLOOR, FAR_BELOW_M = None, -50.0
#: Centres of a drone's body and its four rotors, relative to the drone's centre, metres.
PARTS_M = np.array([[0, 0, 0], [1, 1, 0.2], [1, -1, 0.2], [-1, 1, 0.2], [-1, -1, 0.2]]) * [0.12, 0.12, 0.1]
PART_SIZES_M = np.array([[0.2, 0.2, 0.1]] + [[0.17, 0.17, 0.03]] * 4)
#: Lamps as displacements (x, y) of a shadow, in units of the drone's height above the floor: right above the drone,
#: to the side, three lamps, at 45 degrees.
LAMPS = {
    "above": [(0, 0)],
    "aside": [(0.7, 0)],
    "three": [(0.5, 0.5), (-0.6, 0.2), (0, -0.7)],
    "slant": [(1.0, -0.2)],
}


def position_at(height_m):
    return np.array([0.3, -0.2, height_m])


def draw_silhouettes(position_m, lamps=()):
    """Draw silhouettes of a drone and of its shadows on the floor z = 0: a shadow is the drone's parts, flattened."""
    parts, flat = position_m + PARTS_M, PART_SIZES_M * [1, 1, 0] + [0, 0, 0.005]
    places, part_sizes = [parts], [PART_SIZES_M]
    for lamp in lamps:
        places.append(np.column_stack([parts[:, :2] + np.array(lamp) * parts[:, 2:], np.zeros(len(parts))]))
        part_sizes.append(flat)
    return draw_coverage(RIG, np.concatenate(places), np.concatenate(part_sizes), REDUCTION)


@pytest.fixture(scope="module")
def size_m():
    """Size of the drone as the tracker measures it high above the floor, (1, 3), metres."""
    high = position_at(1.5)[None, None]
    size_state = sizes.measure_sizes(
        jnp.asarray(draw_silhouettes(high[0, 0])[None]),
        *float32((high,)),
        *float32((np.array([[0.45, 0.45, 0.12]]), RIG.cameras)),
        sizes.SizeProgram(reduction=REDUCTION),
    )
    return np.asarray(size_state.size_m, np.float64)[0]


def cut_room_patches(images, expected_m, size_m, **how):
    return cut_at(RIG, images, expected_m, size_m, reach_m=0.15, reduction=REDUCTION, **how)


def find_place(images, expected_m, size_m, floor_z_m=0.0):
    patches = cut_room_patches(images, expected_m[None], size_m, floor_z_m=floor_z_m)
    return best_place(RIG, patches, expected_m[None], size_m)[0]


# Which pixels show a shadow.

DRONES_M = np.array([[0.2, -0.1, 0.12], [0.55, 0.1, 0.3], [-0.4, 0.3, 1.1]])
SIZES_M = np.array([[0.4, 0.4, 0.15], [0.5, 0.5, 0.2], [0.4, 0.4, 0.2]])
FLOOR_Z_M, SIDE, CELLS = -0.05, 24, 32


def window_pixels(boxes, side_px):
    """Return x (drones, cameras, 1, side) and y (drones, cameras, side, 1) of pixels in windows centred on boxes."""
    steps = (np.arange(SIDE) + 0.5 - SIDE / 2) * side_px / SIDE
    x_px, y_px = (np.asarray(middle)[..., None] + steps for middle in (boxes.x_middle, boxes.y_middle))
    return x_px[..., None, :], y_px[..., :, None]


def in_ellipse(pixel, boxes, drone, camera):
    middle = np.array([boxes.x_middle[drone, camera], boxes.y_middle[drone, camera]])
    half = OCCLUDER_SCALE * np.array([boxes.x_half[drone, camera], boxes.y_half[drone, camera]])
    return (((pixel - middle) / half) ** 2).sum(axis=-1) < 1


def ray_cast_shadowed(rig, images, boxes, drone, x_px, y_px):
    """Return which pixels of a drone's window show a shadow, (cameras, side, side) bool.

    A pixel's ray meets a cell of the floor; the cell is dark if at least half of the cameras that see the cell
    see foreground there. Computed in float64.
    """
    half_m = OCCLUDER_SCALE * SIZES_M[drone, 0] / 2 + CAST * (DRONES_M[drone, 2] - FLOOR_Z_M)
    line = (np.arange(CELLS) + 0.5) * 2 / CELLS - 1
    x, y = np.meshgrid(line, line)
    cells = np.stack([x, y, np.zeros_like(x)], axis=-1) * half_m + [*DRONES_M[drone, :2], FLOOR_Z_M]
    votes = np.zeros((CELLS, CELLS))
    for camera in range(len(rig)):
        pixel, depth = project(rig.cameras[camera], cells)
        pixel = pixel + 0.5
        column, row = np.floor(pixel / REDUCTION).astype(int).transpose(2, 0, 1)
        height, width = images.shape[1:]
        sees = (depth > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        for other in range(len(DRONES_M)):
            sees &= ~in_ellipse(pixel, boxes, other, camera)
        value = images[camera, np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        votes += np.where(sees, np.where(value >= 64, 1, -1), 0)
    dark = np.zeros((len(rig), SIDE, SIDE), bool)
    for camera in range(len(rig)):
        rig_camera = rig.cameras[camera]
        grid = np.stack(np.broadcast_arrays(x_px[drone, camera], y_px[drone, camera]), axis=-1) - 0.5
        ray = np.concatenate([undistort(rig_camera, grid), np.ones((SIDE, SIDE, 1))], axis=-1)
        ray = ray @ rig_camera.T_cam_world[:3, :3]
        along = (FLOOR_Z_M - rig_camera.centre_world[2]) / ray[..., 2]
        meets = (rig_camera.centre_world + along[..., None] * ray)[..., :2]
        cell = np.floor(((meets - DRONES_M[drone, :2]) / half_m + 1) / 2 * CELLS).astype(int)
        inside = (along > 0) & (cell >= 0).all(axis=-1) & (cell < CELLS).all(axis=-1)
        column, row = np.where(inside[..., None], cell, 0).transpose(2, 0, 1)
        dark[camera] = inside & (votes[row, column] >= 0)
    return dark


@pytest.mark.parametrize("coefficients", [0, 5])
def test_shadowed_pixels_agree_with_a_ray_caster(coefficients):
    """The silhouettes are noise, so that neighbouring cells differ."""
    rig = ring_rig(5, coefficients=coefficients, height_m=1.2)
    images = np.random.default_rng(1).choice([0, 63, 64, 255], (5, 120, 160)).astype(np.uint8)
    extents = make_extents(*float32((rig.cameras, SIZES_M)))
    boxes = project_boxes(extents, *float32((DRONES_M,)))
    x_px, y_px = window_pixels(boxes, 150.0)
    # The first camera looks horizontally, so its windows reach above the horizon.
    assert y_px[:, 0].min() < 60

    @jax.jit
    def compute_shadowed(images, extents, boxes, expected_m, at_px, floor_z_m):
        nothing = jnp.zeros_like(boxes.x_middle)
        occluders = find_occluders(boxes, occluding=jnp.ones(3, bool), pixel_px=nothing)
        view = FloorView(extents, boxes, occluders, expected_m, floor_z_m)
        return shadowed_pixels(images, view, at_px, REDUCTION)

    dark = np.asarray(compute_shadowed(images, extents, boxes, *float32((DRONES_M, (x_px, y_px), FLOOR_Z_M))))
    boxes = jax.tree.map(np.asarray, boxes)
    for drone in range(3):
        expected = ray_cast_shadowed(rig, images, boxes, drone, x_px, y_px)
        assert 0.02 < expected.mean() < 0.9
        # Float32 may put a pixel at a cell's border into the neighbouring cell; measured 0 of 2880 pixels.
        assert (dark[drone] != expected).mean() < 0.003


def test_is_low_compares_the_height_with_the_width():
    size_m, heights_m = np.array([0.5, 0.5, 0.1]), np.array([0.0, 0.49, 0.51, 2.0]) * LOW
    position_m = np.stack([np.zeros(4), np.ones(4), heights_m - 1.0], axis=-1)
    found = is_low(*float32((position_m, size_m[None], -1.0)))
    np.testing.assert_array_equal(found, [True, True, False, False])


# How shadows change the position.


@pytest.mark.parametrize("lamps", LAMPS)
@pytest.mark.parametrize("height_m", [0.1, 0.15, 0.2, 0.3])
def test_a_shadow_on_the_floor_does_not_move_the_place(lamps, height_m, size_m):
    """The largest measured shift is 9 mm, a third of a silhouette pixel.

    Without the treatment of shadows the shift is up to 113 mm; if a disc of the floor is left out instead, up to
    18 mm.
    """
    true_m = position_at(height_m)
    images = draw_silhouettes(true_m, LAMPS[lamps])
    without_shadow = find_place(draw_silhouettes(true_m), true_m, size_m, FAR_BELOW_M)
    assert np.linalg.norm(find_place(images, true_m, size_m) - without_shadow) < 0.011
    if height_m < 0.15:
        assert np.linalg.norm(find_place(images, true_m, size_m, FAR_BELOW_M) - without_shadow) > 0.03


@pytest.mark.parametrize("height_m", [0.1, 0.15, 0.2, 0.3])
def test_without_a_shadow_the_place_does_not_move(height_m, size_m):
    """At 0.1 m no camera sees the floor right below the drone, and the shift is 6 mm (measured).

    At larger heights the cameras see that the floor is bright, and the shift is 0 mm.
    """
    true_m = position_at(height_m)
    images = draw_silhouettes(true_m)
    moved = find_place(images, true_m, size_m) - find_place(images, true_m, size_m, FAR_BELOW_M)
    assert np.linalg.norm(moved) < (0.009 if height_m < 0.15 else 0.001)


@pytest.mark.parametrize("offset_m", [(0, 0.03, -0.05), (0.04, -0.03, 0.03), (0, 0, -0.15)])
def test_a_wrong_expected_position_is_corrected_over_frames(offset_m, size_m):
    """The shadow is computed from the expected position, so each frame corrects only a part of an error.

    One case expects the drone inside the floor, where it hides no shadow. The error after 8 frames is 15 mm
    (measured), mostly upwards; without the treatment of shadows it is 69 mm.
    """
    true_m = position_at(0.12)
    images = draw_silhouettes(true_m, LAMPS["above"])
    without_shadow = find_place(draw_silhouettes(true_m), true_m, size_m, FAR_BELOW_M)
    found = true_m + offset_m
    for _ in range(8):
        found = find_place(images, found, size_m)
    assert np.linalg.norm(found - without_shadow) < 0.02


def test_a_drone_on_the_floor_keeps_its_score_and_place(size_m):
    """A drone on the floor hides its whole shadow."""
    true_m = position_at(0.05)
    images = draw_silhouettes(true_m, LAMPS["above"])
    patches, without_floor = (
        cut_room_patches(images, true_m[None], size_m, floor_z_m=floor_z_m)
        for floor_z_m in (0.0, FAR_BELOW_M)
    )
    np.testing.assert_array_equal(patches.clear, 1)
    fitness, unbalanced = (
        evaluate(drone_fitness, RIG, windows, true_m[None], size_m) for windows in (patches, without_floor)
    )
    assert fitness > 0.7 * unbalanced
    # Measured 6 mm; 32 mm without the treatment of shadows.
    assert (
        np.linalg.norm(
            find_place(images, true_m, size_m)
            - find_place(draw_silhouettes(true_m), true_m, size_m, FAR_BELOW_M)
        )
        < 0.015
    )


def test_windows_of_high_and_of_non_occluding_drones_do_not_change(size_m):
    """Only the window of the low drone changes; the other two windows are equal to the last bit."""
    images = draw_silhouettes(position_at(0.15), LAMPS["three"])
    expected_m = np.stack([position_at(0.15), position_at(0.8), position_at(0.3)])
    occluding = np.array([True, True, False])
    cut_here = partial(cut_room_patches, images, expected_m, size_m.repeat(3, axis=0), occluding=occluding)
    with_floor, without = cut_here(floor_z_m=0.0), cut_here(floor_z_m=NO_FLOOR)
    same = [np.array_equal(*pair) for pair in zip(pixels(with_floor), pixels(without), strict=True)]
    assert same == [False, True, True]
    np.testing.assert_array_equal(occluded_pixels(with_floor), occluded_pixels(without))
    np.testing.assert_array_equal(with_floor.clear, without.clear)
    high = cut_here(floor_z_m=FAR_BELOW_M)
    np.testing.assert_array_equal(high.tables, without.tables)


def test_balancing_only_removes_foreground(size_m):
    """Balancing never adds foreground, and removes foreground only in front of the dark part of the floor."""
    images = draw_silhouettes(position_at(0.15), LAMPS["above"])
    expected_m = position_at(0.15)[None]
    shown, without_floor = (
        pixels(cut_room_patches(images, expected_m, size_m, floor_z_m=floor_z_m))
        for floor_z_m in (0.0, FAR_BELOW_M)
    )
    assert (shown <= without_floor).all()
    less = shown < without_floor
    # All views show the shadow below the drone; above the drone's centre only the shadow's far side changes pixels.
    assert less[:, :, 36:].sum() > 10 * less[:, :, :28].sum()
    assert not less[without_floor == 0].any()


def test_a_neighbouring_drone_is_not_taken_for_a_shadow(size_m):
    """A second low drone hides part of a bright floor; the hidden part does not count as dark."""
    pair = position_at(0.2) + np.array([[0.0, 0.0, 0.0], [0.55, 0.1, 0.0]])
    images = draw_coverage(
        RIG, np.concatenate([drone_m + PARTS_M for drone_m in pair]), np.tile(PART_SIZES_M, (2, 1)), REDUCTION
    )
    both = size_m.repeat(2, axis=0)
    found = [
        best_place(RIG, cut_room_patches(images, pair, both, floor_z_m=floor_z_m), pair, both)
        for floor_z_m in (0.0, FAR_BELOW_M)
    ]
    # Largest measured difference 2 mm.
    assert np.linalg.norm(found[0] - found[1], axis=-1).max() < 0.004
