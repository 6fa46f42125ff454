"""Functions that cut, unpack and score windows of the silhouettes, and search them for the best position of a drone."""

from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from helpers import far_camera, float32, make_unnamed_rig

from psotrack.foreground.silhouettes import LOW_BITS, summed_area_table
from psotrack.geometry import make_extents
from psotrack.tracking.swarm import SoftIoU
from psotrack.tracking.swarm.fitness import ScoreInputs, drone_fitness, score_inputs
from psotrack.tracking.swarm.patches import SIDE, ExpectedDrones, cut, make_pyramid

RING = SoftIoU().ring

# Cameras so far away that their images are parallel projections, one camera per level of the pyramid: 15 to 188
# silhouette pixels from the middle of a drone of 1 m to the ring's border. No side of the silhouettes is a multiple
# of 8.
SHAPE = (213, 301)
PIXELS_PER_M = np.array([20.0, 60.0, 120.0, 250.0])
NOISE = np.random.default_rng(0).integers(0, 256, (4, *SHAPE)).astype(np.uint8)


def far_rig(reduction):
    height, width = SHAPE
    sides = (width * reduction, height * reduction)
    return make_unnamed_rig(
        *(far_camera(image_size_wh=sides, pixels_per_m=reduction * ppm) for ppm in PIXELS_PER_M)
    )


def middle_px(position_m, pixels_per_m):
    """(x, y) of a position in silhouette pixels from the upper left corner; the world's x is to the right, z is up."""
    return SHAPE[1] / 2 + pixels_per_m * position_m[0], SHAPE[0] / 2 - pixels_per_m * position_m[2]


def cut_at(rig, images, expected_m, size_m, *, reduction=1, reach_m=0.1, occluding=True):
    """Cut windows, as NumPy arrays; `reach_m` and `occluding` have one value for all drones or one per drone."""
    count = len(expected_m)
    cameras, size_m, position_m = float32((rig.cameras, np.asarray(size_m), np.asarray(expected_m)))
    expected = ExpectedDrones(
        position_m,
        np.broadcast_to(np.float32(reach_m), count),
        None if occluding is None else np.broadcast_to(occluding, count),
    )
    return jax.tree.map(np.asarray, _cut(images, cameras, size_m, expected, reduction))


def pyramid_of(images):
    """The pyramid of one frame, (cameras, height, width)."""
    return jax.tree.map(lambda level: level[0], make_pyramid(images[None]))


@partial(jax.jit, static_argnames="reduction")
def _cut(images, cameras, size_m, expected, reduction):
    extents = make_extents(cameras, size_m)
    return cut(pyramid_of(images), extents, expected, reduction=reduction, ring=RING)[0]


def pixels(patches):
    """(drones, cameras, rows, columns), foreground of the windows' pixels, 0..255, from the summed-area tables."""
    return _words(patches) & (2**LOW_BITS - 1)


def occluded_pixels(patches):
    """(drones, cameras, rows, columns), whether a pixel of a window is occluded foreground."""
    return _words(patches) >> LOW_BITS


def _words(patches):
    # Sums of packed numbers may overflow; their differences are exact nevertheless.
    windows = np.diff(np.diff(patches.tables, axis=0), axis=2).swapaxes(0, 1)
    return windows.reshape(*patches.x_px.shape, SIDE, SIDE)


def enumerate_windows(windows):
    """Iterate over ((drone, camera), window)."""
    for index in np.ndindex(windows.shape[:2]):
        yield index, windows[index]


def evaluate(function, rig, patches, position_m, size_m):
    arrays = float32((rig.cameras, np.asarray(position_m), np.asarray(size_m)))
    return jax.tree.map(np.asarray, _evaluate(function, SoftIoU(), patches, *arrays))


@partial(jax.jit, static_argnums=(0, 1))
def _evaluate(function, settings, patches, cameras, position_m, size_m):
    return function(ScoreInputs(make_extents(cameras, size_m), patches, settings), position_m)


@partial(jax.jit, static_argnums=(0, 1))
def evaluate_whole(function, reduction, images, cameras, position_m, size_m):
    inputs = score_inputs(cameras, size_m, summed_area_table(images), SoftIoU(), reduction=reduction)
    return function(inputs, position_m)


def best_place(rig, patches, about_m, size_m):
    """(drones, 3), positions of highest fitness, by four searches of a grid of 9 x 9 x 9, each three times finer."""
    arrays = float32((rig.cameras, np.asarray(about_m), np.asarray(size_m)))
    return np.asarray(_best_place(SoftIoU(), patches, *arrays), np.float64)


@partial(jax.jit, static_argnums=0)
def _best_place(settings, patches, cameras, best_m, size_m):
    view = ScoreInputs(make_extents(cameras, size_m), patches, settings)
    unit = np.array(list(product(range(-4, 5), repeat=3)))[:, None]

    def closer(best_m, step_m):
        places = best_m + step_m * jnp.asarray(unit, jnp.float32)
        best = jnp.nan_to_num(drone_fitness(view, places)).argmax(axis=0)
        return places[best, jnp.arange(len(best))], None

    steps_m = jnp.asarray([0.02, 0.006, 0.002, 0.0006], jnp.float32)
    best_m, _ = jax.lax.scan(closer, best_m, steps_m)
    return best_m
