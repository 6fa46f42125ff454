"""A background that lives: light, clouds, leaves and screens change, ghosts go, and hovering drones stay foreground."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.foreground.silhouettes import ForegroundSettings, Living, LivingBackground
from psotrack.foreground.silhouettes.lighting import light_of, remove_light
from psotrack.foreground.silhouettes.object_blobs import find_objects, largest

HEIGHT, WIDTH = 120, 160
SETTINGS = ForegroundSettings(working_reduction=1, min_blob_px=9)
NOISE = 2.0


def _smooth(rng: np.random.Generator, height: int, width: int, *, cells: int = 8) -> np.ndarray:
    """Smooth random values, 0 to 1."""
    coarse = rng.uniform(0, 1, (max(2, cells * height // width), cells)).astype(np.float32)
    return np.clip(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC), 0, 1)


def _room(rng: np.random.Generator) -> np.ndarray:
    """A wall with posters, grey levels in float."""
    image = np.dstack([110 + 60 * _smooth(rng, HEIGHT, WIDTH)] * 3)
    for _ in range(6):
        x, y = rng.integers(0, (WIDTH - 30, HEIGHT - 30))
        image[y : y + 22, x : x + 16] = rng.uniform(60, 220, 3)
    return image


def _with_drone(
    image: np.ndarray, x: float, y: float, *, width_px: float = 20.0
) -> tuple[np.ndarray, np.ndarray]:
    """The image with a dark cross-shaped drone, and the drone's pixels."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    across, down = np.abs(columns - x), np.abs(rows - y)
    half = width_px / 2
    drone = ((across <= half) & (down <= half / 6)) | ((across <= half / 3) & (down <= half / 2))
    return np.where(drone[..., None], 30.0, image), drone


def _exposed(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.clip(image + rng.normal(0, NOISE, image.shape), 0, 255).round().astype(np.uint8)


def _f1(mask: np.ndarray, truth: np.ndarray) -> float:
    seen = mask > 127
    return 2 * np.count_nonzero(seen & truth) / (np.count_nonzero(seen) + np.count_nonzero(truth))


def _flight(
    change: Callable[[np.ndarray, int], np.ndarray], *, num_frames: int = 120, seed: int = 0
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Frames of a room that `change` alters at each frame, with a drone that crosses it, and the drone's pixels."""
    rng = np.random.default_rng(seed)
    room = _room(rng)
    frames, truth = [], []
    for index in range(num_frames):
        place = (20 + 120 * index / num_frames, 60 + 30 * np.sin(index / 15))
        image, drone = _with_drone(change(room, index), *place)
        frames.append(_exposed(image, rng))
        truth.append(drone)
    return frames, truth


def _gain(room: np.ndarray, index: int) -> np.ndarray:
    return room * (1 + 0.15 * np.sin(2 * np.pi * index / 175 + 1))


def _lamp(room: np.ndarray, index: int) -> np.ndarray:
    lit = room.copy()
    if index >= 60:
        lit[:, : WIDTH // 2] *= 0.88
    return lit


def _screen(room: np.ndarray, index: int) -> np.ndarray:
    shown = room.copy()
    rng = np.random.default_rng(index // 10)
    shown[10:40, 110:150] = cv2.resize(
        rng.uniform(0, 255, (3, 4, 3)), (40, 30), interpolation=cv2.INTER_CUBIC
    )
    shown[10:40, 110:150] = np.roll(shown[10:40, 110:150], 3 * index, axis=1)
    return shown


def _leaves(room: np.ndarray, index: int) -> np.ndarray:
    swaying = room.copy()
    leaves = _smooth(np.random.default_rng(4), 70, 70, cells=20)
    shift = round(4 * np.sin(index / 4))
    window = np.roll(leaves, shift, axis=1)[:50, 10:60, None]
    swaying[60:110, 5:55] = np.where(window > 0.5, 40 + 120 * window, swaying[60:110, 5:55])
    return swaying


@pytest.mark.parametrize("change", [lambda room, index: room, _gain, _lamp, _screen, _leaves])
def test_the_drone_is_the_foreground_whatever_changes(
    change: Callable[[np.ndarray, int], np.ndarray],
) -> None:
    frames, truth = _flight(change)
    masks = list(Living(SETTINGS).foreground(frames[::3], frames))
    found = [_f1(mask, drone) for mask, drone in zip(masks, truth, strict=True)]
    # Leaves and screens are known to be restless after two seconds, and a drone in front of them may be missed.
    assert np.mean(np.array(found[50:]) > 0.75) > 0.9
    false_px = [
        np.count_nonzero((mask > 0) & ~cv2.dilate(drone.astype(np.uint8), np.ones((7, 7))).astype(bool))
        for mask, drone in zip(masks[50:], truth[50:], strict=True)
    ]
    assert np.median(false_px) <= 10


@pytest.mark.slow
def test_a_drone_that_hovers_for_minutes_is_not_absorbed() -> None:
    """Causal, as for a live camera: 40 s at one place; MOG2 alone learns a drone in a second."""
    rng = np.random.default_rng(1)
    room = _room(rng)
    background = LivingBackground(SETTINGS, _exposed(room, rng))
    for index in range(1000):
        image, drone = _with_drone(room, min(10 + 2 * index, 80) + np.sin(index / 7), 50)
        mask = background.step(_exposed(image, rng))
    assert _f1(mask, drone) > 0.8


def test_a_ghost_is_gone_after_two_seconds() -> None:
    """The first frame shows a drone that flies off; where it stood, the room comes to light."""
    rng = np.random.default_rng(2)
    room = _room(rng)
    background = LivingBackground(SETTINGS, _exposed(_with_drone(room, 80, 60)[0], rng))
    for index in range(50):
        image, _ = _with_drone(room, 80 + 3 * index, 60 - index)
        mask = background.step(_exposed(image, rng))
    assert not mask[50:70, 65:95].any()


def test_the_two_passes_of_a_file_show_a_drone_that_stands_at_first_from_frame_0() -> None:
    rng = np.random.default_rng(3)
    room = _room(rng)
    places = [(80.0, 60.0)] * 60 + [(80.0 + index, 60.0 - index / 2) for index in range(100)]
    drawn = [_with_drone(room, *place) for place in places]
    frames = [_exposed(image, rng) for image, _ in drawn]
    masks = list(Living(SETTINGS).foreground(frames[::4], frames))
    assert min(_f1(masks[index], drawn[index][1]) for index in (0, 30, 59, 70, 100)) > 0.75
    assert not masks[100][50:70, 65:95].any()


def test_clouds_that_drift_are_background_and_a_shrinking_drone_is_found() -> None:
    rng = np.random.default_rng(5)
    clouds = cv2.GaussianBlur(_smooth(rng, HEIGHT, 2 * WIDTH, cells=10), (0, 0), 4)
    clouds = np.clip((clouds - clouds.mean()) * 1.5 + 0.5, 0, 1)
    frames, truth = [], []
    for index in range(150):
        x = 0.2 * index
        sky = cv2.warpAffine(clouds, np.array([[1, 0, -x], [0, 1, 0]]), (WIDTH, HEIGHT))
        image = np.dstack([220 + 15 * sky, 170 + 60 * sky, 130 + 95 * sky])
        width_px = 30 * (8 / 30) ** (index / 149)
        image, drone = _with_drone(image, 20 + 0.8 * index, 60 + 30 * np.sin(index / 20), width_px=width_px)
        frames.append(_exposed(image, rng))
        truth.append(drone)
    found, false_blobs = 0, 0
    for mask, drone in zip(Living(SETTINGS).foreground(frames[::3], frames), truth, strict=True):
        _, _, _, centre = cv2.connectedComponentsWithStats(mask)
        near = np.hypot(*(centre[1:] - np.argwhere(drone).mean(axis=0)[::-1]).T) < 3
        found += near.any()
        false_blobs += np.count_nonzero(~near)
    assert found >= 0.98 * len(frames)
    assert false_blobs <= 0.5 * len(frames)


def test_a_place_that_drones_cross_stays_calm() -> None:
    """A pale drone is found in full where dark drones crossed before: each of them is no change that goes on."""
    rng = np.random.default_rng(3)
    wall = np.full((HEIGHT, WIDTH, 3), 100.0)
    background = LivingBackground(SETTINGS, _exposed(wall, rng), 100)
    for index in range(160):
        image, _ = _with_drone(wall, 4 * (index % 60) - 80, 60)
        background.step(_exposed(image, rng))
    pale, drone = wall.copy(), _with_drone(wall, 80, 60)[1]
    pale[drone] -= 16
    # Before such changes were limited, the drone was not found at all.
    assert _f1(background.step(_exposed(pale, rng)), drone) > 0.9


def test_flashes_that_were_learned_long_ago_leave_no_invalid_numbers() -> None:
    """OpenCV's blur gave numbers below 0 after some minutes, and their roots were no numbers."""
    rng = np.random.default_rng(0)
    calm = np.full((60, 80, 3), 100, np.uint8)
    background = LivingBackground(ForegroundSettings(), calm)
    with np.errstate(invalid="raise"):
        for frame in range(2500):
            image = calm.copy()
            if frame % 300 == 0:
                image[rng.random((60, 80)) < 0.02] = rng.integers(0, 255)
            background.step(image, num_frames=3)


def test_what_a_tracker_knows_is_not_learned() -> None:
    """Where a tracker says that a drone is, even a difference without edges of its own stays."""
    rng = np.random.default_rng(6)
    room = _room(rng)
    shown, drone = _with_drone(room, 80, 60)
    known = 255 * cv2.dilate(drone.astype(np.uint8), np.ones((5, 5)))
    last = []
    for protect in (None, known):
        background = LivingBackground(SETTINGS, _exposed(shown, rng))
        for _ in range(100):
            mask = background.step(_exposed(room, rng), protect)
        last.append(mask)
    assert not last[0].any()
    assert last[1][drone].mean() > 0.9 * 255


@given(gain=st.floats(0.7, 1.4), seed=st.integers(0, 20))
@settings(max_examples=30, deadline=None)
def test_a_gain_of_the_whole_image_is_removed(gain: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    room = np.clip(_room(rng), 40, 170)
    lit = np.clip(room * gain, 0, 255).round().astype(np.uint8)
    without = remove_light(lit, light_of(room.astype(np.float32)), np.zeros((HEIGHT, WIDTH), np.uint8))
    # The offset for the dark and the rounding to whole grey levels cost up to 2 levels each.
    assert np.abs(without - room).max() < 4


def test_an_object_is_no_change_of_the_light() -> None:
    rng = np.random.default_rng(8)
    room = _room(rng)
    image, drone = _with_drone(room, 80, 60, width_px=40)
    without = remove_light(
        image.round().astype(np.uint8), light_of(room.astype(np.float32)), np.zeros((HEIGHT, WIDTH), np.uint8)
    )
    assert np.abs(without[~drone] - room[~drone]).max() < 2
    assert without[drone].max() < 35


def test_a_drone_does_not_grow_together_with_a_faint_change_around_it() -> None:
    """A cloud that comes changes the image faintly: the drone before it keeps its size, and the cloud is no object."""
    rng = np.random.default_rng(9)
    sky = np.full((HEIGHT, WIDTH, 3), 150.0)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    cloud = 10 * np.exp(-((columns - 80) ** 2 + (rows - 60) ** 2) / (2 * 10**2))[..., None]
    background = LivingBackground(SETTINGS, _exposed(sky, rng))
    for _ in range(20):
        background.step(_exposed(sky, rng))
    image, drone = _with_drone(sky + cloud, 80, 60, width_px=8)
    mask = background.step(_exposed(image, rng))
    assert _f1(mask, drone) > 0.9


@given(seed=st.integers(0, 1000), strength=st.floats(20, 200))
@settings(max_examples=20, deadline=None)
def test_all_foreground_belongs_to_blobs_that_changed(seed: int, strength: float) -> None:
    """Objects are made of changed pixels, and objects with edges of their own are among them."""
    rng = np.random.default_rng(seed)
    background = _exposed(_room(rng), rng)
    image = background.copy()
    x, y = rng.integers(0, (WIDTH - 20, HEIGHT - 20))
    image[y : y + 15, x : x + 20] = np.clip(image[y : y + 15, x : x + 20] + strength, 0, 255).astype(np.uint8)
    difference = largest(cv2.absdiff(image, background))
    changed, strong = (np.where(difference > level, np.uint8(255), np.uint8(0)) for level in (3, 8))
    found = find_objects(changed, strong, difference, np.zeros((HEIGHT, WIDTH), bool), 9)
    assert not (found.mask & ~changed).any()
    assert not (found.with_own_edges(image, background) & ~found.mask).any()


def test_a_pixel_at_a_contour_has_the_share_that_the_object_covers() -> None:
    rng = np.random.default_rng(5)
    wall = np.full((HEIGHT, WIDTH, 3), 150.0)
    background = LivingBackground(
        ForegroundSettings(working_reduction=2, reduction=2), _exposed(wall, rng), 100
    )
    for _ in range(10):
        background.step(_exposed(wall, rng))
    scene = wall.copy()
    scene[40:60, 50:80] = 50
    scene[40:60, 80] = 50 + 100 * 0.25  # three quarters of these pixels show the object
    mask = background.step(_exposed(scene, rng))
    assert (mask[42:58, 52:78] == 255).all()
    # The largest of three channels' noise of two grey levels is a fiftieth of the contrast.
    assert mask[42:58, 80].mean() / 255 == pytest.approx(0.75, abs=0.05)
    assert mask[42:58, 81].mean() / 255 < 0.04
    assert not mask[:, 90:].any()
