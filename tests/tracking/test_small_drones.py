"""Drones of at most a dozen pixels: a few cells of a silhouette, with rough edges and gaps."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import ROOM_M, draw_coverage, ring_rig, silhouettes_in_memory, track_settings
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.foreground.silhouettes import find_blobs
from psotrack.geometry import Rig
from psotrack.tracking.swarm import RunInputs, track_silhouettes, tracker_settings

pytestmark = pytest.mark.slow

FPS = 25.0
REDUCTION = 2
#: Half a metre at 4 m is six to nine pixels: three or four cells wide, and one or two high.
SMALL = ring_rig(6, image_size_wh=(64, 48))
CELL_M = 0.16
SIZE_M = (0.5, 0.5, 0.25)
TIME_S = np.arange(25)[:, None] / FPS
ONE = np.array((0.6, -0.5, 1.5)) + TIME_S * (0.8, 0.2, 0.1)
OTHER = np.array((-0.7, 0.6, 0.9)) + TIME_S * (0.3, -1.0, 0.2)


def draw_silhouettes(*paths_m, size_m=SIZE_M, rig=SMALL):
    images = np.stack([draw_coverage(rig, places, size_m, REDUCTION) for places in np.stack(paths_m, axis=1)])
    images.flags.writeable = False
    return images


@pytest.fixture(scope="module")
def two_drones():
    return draw_silhouettes(ONE, OTHER)


def magnify(rig: Rig, times: int) -> Rig:
    """The rig with `times` times the number of pixels along each side."""
    K = rig.cameras.K * np.array([[times], [times], [1]])
    # The corner of the image stays half a pixel before the middle of the first pixel.
    K[:, :2, 2] += (times - 1) / 2
    return Rig(
        rig.names, replace(rig.cameras, K=K, image_size_wh=times * np.asarray(rig.cameras.image_size_wh))
    )


def track(coverage, rig=SMALL, reduction=REDUCTION):
    """The tracks of drones that the tracker finds itself."""
    runs = [RunInputs(ROOM_M, tracker_settings(track_settings(particles=20, iterations=15)))]
    silhouettes = silhouettes_in_memory(rig, coverage, reduction)
    ((tracks, _),) = track_silhouettes(rig, silhouettes, runs, fps=FPS)
    return tracks


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_blobs_do_not_depend_on_the_pixels_per_cell(seed, times):
    """Regression: the smallest area was in image pixels, so fine silhouettes had no small blobs."""
    rng = np.random.default_rng(seed)
    image = 255 * (rng.random((20, 30)) < 0.1).astype(np.uint8)
    one, other = find_blobs(image, 1), find_blobs(image, times)
    assert (times * one.size_px == other.size_px).all()
    assert (times * (one.centre_px + 0.5) == other.centre_px + 0.5).all()


def test_a_single_cell_is_noise():
    image = np.zeros((12, 12), np.uint8)
    image[3, 3] = image[8, 7:9] = 255
    assert find_blobs(image, 4).size_px.tolist() == [[8, 4]]


@pytest.mark.parametrize("times", [1, 2])
def test_drones_of_a_few_cells_are_tracked(two_drones, times):
    tracks = track(two_drones, magnify(SMALL, times), times * REDUCTION)
    assert tracks.position_m.shape[1] == 2
    apart_m = np.linalg.norm(tracks.position_m[:, :, None] - np.stack([ONE, OTHER], axis=1)[:, None], axis=-1)
    assert np.median(apart_m.min(axis=1), axis=0).max() < CELL_M / 2


def thin_out(coverage, share, seed=0):
    """Keep a random share of the cells in every frame."""
    return coverage * (np.random.default_rng(seed).random(coverage.shape) < share)


@pytest.mark.parametrize("seed", range(3))
def test_a_silhouette_with_many_gaps_is_a_drone(seed):
    """Regression: a camera that showed less than a quarter of the drone did not count."""
    rig = ring_rig(6, image_size_wh=(240, 180))
    tracks = track(thin_out(draw_silhouettes(OTHER, rig=rig), 0.22, seed), rig)
    assert tracks.position_m.shape[1] == 1
    assert np.nanmedian(np.linalg.norm(tracks.position_m[:, 0] - OTHER, axis=-1)) < CELL_M / 2


@pytest.mark.parametrize("seed", range(2))
def test_noise_everywhere_is_no_drone(seed):
    """A few random cells in every image: no place has more foreground than its surroundings."""
    rng = np.random.default_rng(seed)
    noise = 255 * (rng.random((25, 6, 45, 60)) < 0.03).astype(np.uint8)
    assert track(noise, ring_rig(6, image_size_wh=(120, 90))).position_m.shape[1] == 0
