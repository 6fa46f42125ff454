"""Shadows on the floor: a ray caster in NumPy is the oracle for which pixels look at one, then what they do to a place.

Drones are drawn as bodies with four rotors: what is before a shadow is judged by how full of foreground drones are.
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

REDUCTION = 2
#: A silhouette's pixel is 2.4 cm in the middle of the room.
RIG = ring_rig(8, image_size_wh=(480, 270), radius_m=4.5)
#: A floor below which no shadow is in anybody's window, and one that all drones are high above.
NO_FLOOR, FAR_BELOW_M = None, -50.0
#: A body and four rotors, from its middle.
PARTS_M = np.array([[0, 0, 0], [1, 1, 0.2], [1, -1, 0.2], [-1, 1, 0.2], [-1, -1, 0.2]]) * [0.12, 0.12, 0.1]
PART_SIZES_M = np.array([[0.2, 0.2, 0.1]] + [[0.17, 0.17, 0.03]] * 4)
#: Where lamps are: how far shadows are moved along x and y, in heights. Right above; aside; three; at 45 degrees.
LAMPS = {
    "above": [(0, 0)],
    "aside": [(0.7, 0)],
    "three": [(0.5, 0.5), (-0.6, 0.2), (0, -0.7)],
    "slant": [(1.0, -0.2)],
}


def at(height_m):
    return np.array([0.3, -0.2, height_m])


def drawn(position_m, lamps=()):
    """Silhouettes of a drone, and of its shadows on the floor at z = 0: its parts, moved and flat."""
    parts, flat = position_m + PARTS_M, PART_SIZES_M * [1, 1, 0] + [0, 0, 0.005]
    places, part_sizes = [parts], [PART_SIZES_M]
    for lamp in lamps:
        places.append(np.column_stack([parts[:, :2] + np.array(lamp) * parts[:, 2:], np.zeros(len(parts))]))
        part_sizes.append(flat)
    return draw_coverage(RIG, np.concatenate(places), np.concatenate(part_sizes), REDUCTION)


@pytest.fixture(scope="module")
def size_m():
    """What the tracker takes the drone's size for: learned where it is high."""
    high = at(1.5)[None, None]
    looks = sizes.measure_sizes(
        jnp.asarray(drawn(high[0, 0])[None]),
        *float32((high,)),
        jnp.ones((1, 1), bool),
        *float32((np.array([[0.45, 0.45, 0.12]]), RIG.cameras)),
        sizes.SizeProgram(reduction=REDUCTION),
    )
    return np.asarray(looks.size_m, np.float64)[0]


def cut_in_room(images, expected_m, size_m, **how):
    return cut_at(RIG, images, expected_m, size_m, reach_m=0.15, reduction=REDUCTION, **how)


def place(images, expected_m, size_m, floor_z_m=0.0):
    patches = cut_in_room(images, expected_m[None], size_m, floor_z_m=floor_z_m)
    return best_place(RIG, patches, expected_m[None], size_m)[0]


# Which pixels look at a shadow.

DRONES_M = np.array([[0.2, -0.1, 0.12], [0.55, 0.1, 0.3], [-0.4, 0.3, 1.1]])
SIZES_M = np.array([[0.4, 0.4, 0.15], [0.5, 0.5, 0.2], [0.4, 0.4, 0.2]])
FLOOR_Z_M, SIDE, CELLS = -0.05, 24, 32


def windows_about(boxes, side_px):
    """x and y of pixels about the middles of boxes, (drones, cameras, 1, side) and (drones, cameras, side, 1)."""
    steps = (np.arange(SIDE) + 0.5 - SIDE / 2) * side_px / SIDE
    x_px, y_px = (np.asarray(middle)[..., None] + steps for middle in (boxes.x_middle, boxes.y_middle))
    return x_px[..., None, :], y_px[..., :, None]


def in_ellipse(pixel, boxes, drone, camera):
    middle = np.array([boxes.x_middle[drone, camera], boxes.y_middle[drone, camera]])
    half = OCCLUDER_SCALE * np.array([boxes.x_half[drone, camera], boxes.y_half[drone, camera]])
    return (((pixel - middle) / half) ** 2).sum(axis=-1) < 1


def dark_by_rays(rig, images, boxes, drone, x_px, y_px):
    """(cameras, side, side), float64: rays to the floor, and the votes of all cameras for the cell that they meet."""
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
        one = rig.cameras[camera]
        grid = np.stack(np.broadcast_arrays(x_px[drone, camera], y_px[drone, camera]), axis=-1) - 0.5
        ray = np.concatenate([undistort(one, grid), np.ones((SIDE, SIDE, 1))], axis=-1)
        ray = ray @ one.T_cam_world[:3, :3]
        along = (FLOOR_Z_M - one.centre_world[2]) / ray[..., 2]
        meets = (one.centre_world + along[..., None] * ray)[..., :2]
        cell = np.floor(((meets - DRONES_M[drone, :2]) / half_m + 1) / 2 * CELLS).astype(int)
        inside = (along > 0) & (cell >= 0).all(axis=-1) & (cell < CELLS).all(axis=-1)
        column, row = np.where(inside[..., None], cell, 0).transpose(2, 0, 1)
        dark[camera] = inside & (votes[row, column] >= 0)
    return dark


@pytest.mark.parametrize("coefficients", [0, 5])
def test_dark_pixels_are_those_of_a_ray_caster(coefficients):
    """Silhouettes of noise, so that every cell has another answer."""
    rig = ring_rig(5, coefficients=coefficients, height_m=1.2)
    images = np.random.default_rng(1).choice([0, 63, 64, 255], (5, 120, 160)).astype(np.uint8)
    seen = make_extents(*float32((rig.cameras, SIZES_M)))
    boxes = project_boxes(seen, *float32((DRONES_M,)))
    x_px, y_px = windows_about(boxes, 150.0)
    # The first camera is level: windows reach above its horizon.
    assert y_px[:, 0].min() < 60

    @jax.jit
    def dark_of(images, seen, boxes, expected_m, at_px, floor_z_m):
        nothing = jnp.zeros_like(boxes.x_middle)
        occluders = find_occluders(boxes, occluding=jnp.ones(3, bool), pixel_px=nothing)
        view = FloorView(seen, boxes, occluders, expected_m, floor_z_m)
        return shadowed_pixels(images, view, at_px, REDUCTION)

    dark = np.asarray(dark_of(images, seen, boxes, *float32((DRONES_M, (x_px, y_px), FLOOR_Z_M))))
    boxes = jax.tree.map(np.asarray, boxes)
    for drone in range(3):
        expected = dark_by_rays(rig, images, boxes, drone, x_px, y_px)
        assert 0.02 < expected.mean() < 0.9
        # Float32 may put a pixel at the border of a cell on the other side; measured none of 2880.
        assert (dark[drone] != expected).mean() < 0.003


def test_low_is_less_high_than_wide():
    size_m, heights_m = np.array([0.5, 0.5, 0.1]), np.array([0.0, 0.49, 0.51, 2.0]) * LOW
    position_m = np.stack([np.zeros(4), np.ones(4), heights_m - 1.0], axis=-1)
    found = is_low(*float32((position_m, size_m[None], -1.0)))
    np.testing.assert_array_equal(found, [True, True, False, False])


# What shadows do to a place.


@pytest.mark.parametrize("lamps", LAMPS)
@pytest.mark.parametrize("height_m", [0.1, 0.15, 0.2, 0.3])
def test_a_shadow_on_the_floor_does_not_move_the_place(lamps, height_m, size_m):
    """Measured up to 9 mm, a third of a pixel of the silhouettes. With nothing done, up to 113 mm; with a disc of the
    floor left out, which was the rule before, up to 18 mm."""
    there = at(height_m)
    images = drawn(there, LAMPS[lamps])
    truth = place(drawn(there), there, size_m, FAR_BELOW_M)
    assert np.linalg.norm(place(images, there, size_m) - truth) < 0.011
    if height_m < 0.15:
        assert np.linalg.norm(place(images, there, size_m, FAR_BELOW_M) - truth) > 0.03


@pytest.mark.parametrize("height_m", [0.1, 0.15, 0.2, 0.3])
def test_where_there_is_no_shadow_nothing_moves(height_m, size_m):
    """At 0.1 m no camera sees the floor right below the drone: measured 6 mm. Elsewhere the floor is seen to be
    bright: 0 mm. (The rule before: 5 to 13 mm.)"""
    there = at(height_m)
    images = drawn(there)
    moved = place(images, there, size_m) - place(images, there, size_m, FAR_BELOW_M)
    assert np.linalg.norm(moved) < (0.009 if height_m < 0.15 else 0.001)


@pytest.mark.parametrize("off_m", [(0, 0.03, -0.05), (0.04, -0.03, 0.03), (0, 0, -0.15)])
def test_a_drone_that_was_expected_elsewhere_comes_to_its_place(off_m, size_m):
    """What is before a shadow is taken from where the drone is expected: half of an error is left in every frame, not
    all of it. A drone is even expected in the floor (which hides no shadow). Measured 15 mm after 8 frames, most of it
    upwards; where nothing is done 69 mm."""
    there = at(0.12)
    images = drawn(there, LAMPS["above"])
    truth = place(drawn(there), there, size_m, FAR_BELOW_M)
    found = there + off_m
    for _ in range(8):
        found = place(images, found, size_m)
    assert np.linalg.norm(found - truth) < 0.02


def test_a_drone_on_the_floor_keeps_its_score_and_place(size_m):
    """It hides all of its shadow."""
    there = at(0.05)
    images = drawn(there, LAMPS["above"])
    patches, free = (
        cut_in_room(images, there[None], size_m, floor_z_m=floor_z_m) for floor_z_m in (0.0, FAR_BELOW_M)
    )
    np.testing.assert_array_equal(patches.clear, 1)
    fitness, unbalanced = (evaluate(drone_fitness, RIG, of, there[None], size_m) for of in (patches, free))
    assert fitness > 0.7 * unbalanced
    # Measured 6 mm; and 32 mm where nothing is done.
    assert (
        np.linalg.norm(place(images, there, size_m) - place(drawn(there), there, size_m, FAR_BELOW_M)) < 0.015
    )


def test_windows_of_high_drones_and_of_those_that_do_not_claim_stay_as_they_are(size_m):
    """Beside a low drone, whose window does change; bit for bit."""
    images = drawn(at(0.15), LAMPS["three"])
    expected_m = np.stack([at(0.15), at(0.8), at(0.3)])
    occluding = np.array([True, True, False])
    cut_here = partial(cut_in_room, images, expected_m, size_m.repeat(3, axis=0), occluding=occluding)
    with_floor, without = cut_here(floor_z_m=0.0), cut_here(floor_z_m=NO_FLOOR)
    same = [np.array_equal(*pair) for pair in zip(pixels(with_floor), pixels(without), strict=True)]
    assert same == [False, True, True]
    np.testing.assert_array_equal(occluded_pixels(with_floor), occluded_pixels(without))
    np.testing.assert_array_equal(with_floor.clear, without.clear)
    high = cut_here(floor_z_m=FAR_BELOW_M)
    np.testing.assert_array_equal(high.tables, without.tables)


def test_foreground_only_goes(size_m):
    """Balancing takes foreground away, between none and all of it, and only before the floor's dark part."""
    images = drawn(at(0.15), LAMPS["above"])
    expected_m = at(0.15)[None]
    shown, free = (
        pixels(cut_in_room(images, expected_m, size_m, floor_z_m=floor_z_m))
        for floor_z_m in (0.0, FAR_BELOW_M)
    )
    assert (shown <= free).all()
    less = shown < free
    # The shadow is below the drone in all views; above its middle only what is before the far side of it changes.
    assert less[:, :, 36:].sum() > 10 * less[:, :, :28].sum()
    assert not less[free == 0].any()


def test_a_neighbour_is_no_shadow(size_m):
    """Low beside a low drone, over a bright floor: it hides the floor, and darkens none of it."""
    pair = at(0.2) + np.array([[0.0, 0.0, 0.0], [0.55, 0.1, 0.0]])
    images = draw_coverage(
        RIG, np.concatenate([one + PARTS_M for one in pair]), np.tile(PART_SIZES_M, (2, 1)), REDUCTION
    )
    both = size_m.repeat(2, axis=0)
    found = [
        best_place(RIG, cut_in_room(images, pair, both, floor_z_m=floor_z_m), pair, both)
        for floor_z_m in (0.0, FAR_BELOW_M)
    ]
    # Measured 2 mm.
    assert np.linalg.norm(found[0] - found[1], axis=-1).max() < 0.004
