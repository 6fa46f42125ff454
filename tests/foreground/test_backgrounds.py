"""Foreground of drawn scenes with known shapes, by MOG2 and by the background that lives; the first look at a video.

MOG2 and its parts are compared with OpenCV, NumPy and SciPy. Where the background lives, light, clouds, leaves and
screens change, ghosts go, and hovering drones stay foreground.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from psotrack.foreground.silhouettes import (
    ForegroundSettings,
    Living,
    LivingBackground,
    Mog2,
    coverage,
    first_look,
    look_first,
    reduce_frame,
)
from psotrack.foreground.silhouettes.object_blobs import find_objects
from psotrack.recordings import VideoWriter, probe, read_frames

HEIGHT, WIDTH = 120, 160
#: OpenCV's label of pixels in a shadow.
OPENCV_SHADOW = 127
SETTINGS = ForegroundSettings(working_reduction=1, min_blob_px=9)


def _smooth(rng: np.random.Generator, height: int, width: int, *, cells: int = 8) -> np.ndarray:
    """Smooth random values, 0 to 1."""
    rows = max(2, cells * height // width)
    coarse = rng.uniform(0, 1, (rows, cells)).astype(np.float32)
    fine = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(fine, 0, 1)


def _room(rng: np.random.Generator) -> np.ndarray:
    """A wall with posters, grey levels in float."""
    image = np.dstack([110 + 60 * _smooth(rng, HEIGHT, WIDTH)] * 3)
    for _ in range(6):
        x, y = rng.integers(0, (WIDTH - 30, HEIGHT - 30))
        image[y : y + 22, x : x + 16] = rng.uniform(60, 220, 3)
    return image


def _exposed(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noisy = image + rng.normal(0, 2.0, image.shape)
    return np.clip(noisy, 0, 255).round().astype(np.uint8)


class TestMog2:
    @given(
        seed=st.integers(0, 99),
        num_frames=st.integers(1, 12),
        threshold=st.sampled_from([8.0, 16.0]),
        rate=st.sampled_from([0.0, 0.1]),
        shadows=st.sampled_from(["keep", "drop", "weight"]),
    )
    @settings(max_examples=30)
    def test_foreground_is_that_of_opencv_which_learned_the_mean(
        self, seed, num_frames, threshold, rate, shadows
    ):
        """At rate 0, the background is constant: what hovers stays foreground, and leaves no ghost."""
        rng = np.random.default_rng(seed)
        scene = rng.integers(100, 120, (24, 32, 3), dtype=np.uint8)
        frames = scene + rng.integers(0, 10, (num_frames, 24, 32, 3), dtype=np.uint8)
        model = cv2.createBackgroundSubtractorMOG2(varThreshold=threshold)
        model.setBackgroundRatio(0.5)
        for number, frame in enumerate(frames, 1):
            model.apply(frame, learningRate=1 / number)
        level = {"keep": 255, "drop": 0, "weight": 64}[shadows]
        shaded = (0.65 * frames.mean(axis=0)).astype(np.uint8)
        shown = [frames[0] + np.uint8(25), shaded, frames[-1], shaded]
        expected = []
        for frame in shown:
            labels = model.apply(frame, learningRate=rate)
            expected.append(np.where(labels == OPENCV_SHADOW, level, labels))
        fg_settings = ForegroundSettings(
            working_reduction=1,
            min_blob_px=0,
            var_threshold=threshold,
            learning_rate=rate,
            shadows=shadows,
            shadow_weight=0.25,
        )
        masks = list(Mog2(fg_settings).foreground(frames, shown))
        np.testing.assert_array_equal(masks, expected)

    def test_min_blob_px_counts_pixels_of_the_full_image(self):
        rng = np.random.default_rng(11)
        background = _room(rng)
        empty = [_exposed(background, rng) for _ in range(20)]
        background[40:46, 40:44] = 25  # 24 px, 6 at half the size
        frame = _exposed(background, rng)
        for min_blob_px, is_seen in ((12, True), (100, False)):
            fg_settings = ForegroundSettings(working_reduction=2, min_blob_px=min_blob_px)
            (mask,) = Mog2(fg_settings).foreground(empty, [frame])
            assert mask.any() == is_seen


@given(
    height=st.integers(1, 23), width=st.integers(1, 23), reduction=st.integers(1, 6), seed=st.integers(0, 99)
)
def test_coverage_and_reduced_frames_are_means_of_pixels(height, width, reduction, seed):
    """The oracle is the mean of a NumPy slice; beyond the image border is background, or the border's pixels."""
    rng = np.random.default_rng(seed)
    mask = rng.choice(np.array([0, 127, 255], np.uint8), (height, width))
    frame = rng.integers(0, 256, (height, width, 3), np.uint8)
    cells = coverage(mask, reduction)
    fg_settings = ForegroundSettings(working_reduction=reduction, reduction=reduction)
    reduced = reduce_frame(frame, fg_settings).astype(float)
    below = -height % reduction
    right = -width % reduction
    assert cells.shape == ((height + below) // reduction, (width + right) // reduction)
    assert reduced.shape[:2] == cells.shape
    padded = np.pad(frame, ((0, below), (0, right), (0, 0)), mode="edge")
    for i, j in np.ndindex(*cells.shape):
        top, left = reduction * i, reduction * j
        rows = slice(top, top + reduction)
        columns = slice(left, left + reduction)
        # Halving twice rounds to whole grey levels twice.
        colour = padded[rows, columns].mean(axis=(0, 1))
        assert np.abs(reduced[i, j] - colour).max() <= 1
        # Coverage is rounded to a whole number, and a half may go up or down; 1e-4 covers float32's rounding.
        covered = mask[rows, columns].sum(dtype=int) / reduction**2
        assert abs(float(cells[i, j]) - covered) <= 0.5 + 1e-4


# --- a background that lives


def _with_drone(
    image: np.ndarray, x: float, y: float, width_px: float = 20.0
) -> tuple[np.ndarray, np.ndarray]:
    """The image with a dark cross-shaped drone, and the drone's pixels."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    across, down = np.abs(columns - x), np.abs(rows - y)
    half = width_px / 2
    arms = (across <= half) & (down <= half / 6)
    body = (across <= half / 3) & (down <= half / 2)
    drone = arms | body
    return np.where(drone[..., None], 30.0, image), drone


def _f1(mask: np.ndarray, truth: np.ndarray) -> float:
    seen = mask > 127
    both = np.count_nonzero(seen & truth)
    return 2 * both / (np.count_nonzero(seen) + np.count_nonzero(truth))


def _gain(room: np.ndarray, index: int) -> np.ndarray:
    angle = 2 * np.pi * index / 175 + 1
    return room * (1 + 0.15 * np.sin(angle))


def _lamp(room: np.ndarray, index: int) -> np.ndarray:
    lit = room.copy()
    if index >= 60:
        lit[:, : WIDTH // 2] *= 0.88
    return lit


def _screen_and_leaves(room: np.ndarray, index: int) -> np.ndarray:
    """A screen that plays a film, and leaves that sway before a window."""
    shown = room.copy()
    colours = np.random.default_rng(index // 10).uniform(0, 255, (3, 4, 3))
    film = cv2.resize(colours, (40, 30), interpolation=cv2.INTER_CUBIC)
    shown[10:40, 110:150] = np.roll(film, 3 * index, axis=1)
    leaves = _smooth(np.random.default_rng(4), 70, 70, cells=20)
    sway = round(4 * np.sin(index / 4))
    leaves = np.roll(leaves, sway, axis=1)[:50, 10:60, None]
    window = shown[60:110, 5:55]
    shown[60:110, 5:55] = np.where(leaves > 0.5, 40 + 120 * leaves, window)
    return shown


class TestLiving:
    @pytest.mark.parametrize("change", [_gain, _lamp, _screen_and_leaves])
    def test_the_drone_is_the_foreground_whatever_changes(self, change):
        """A drone crosses a room in which something changes at each frame."""
        rng = np.random.default_rng(0)
        room = _room(rng)
        frames, truth = [], []
        for index in range(120):
            y = 60 + 30 * np.sin(index / 15)
            image, drone = _with_drone(change(room, index), 20 + index, y)
            frames.append(_exposed(image, rng))
            truth.append(drone)
        masks = list(Living(SETTINGS).foreground(frames[::3], frames))
        # Leaves and screens are known to be restless after two seconds, and a drone in front of them may be missed.
        is_found, false_px = [], []
        for mask, drone in zip(masks[50:], truth[50:], strict=True):
            is_found.append(_f1(mask, drone) > 0.75)
            near = ndimage.binary_dilation(drone, np.ones((7, 7)))
            false_px.append(np.count_nonzero((mask > 0) & ~near))
        assert np.mean(is_found) > 0.9
        assert np.median(false_px) <= 10

    @pytest.mark.slow
    def test_a_drone_that_hovers_for_minutes_is_not_absorbed(self):
        """Causal, as for a live camera: 40 s at one place; MOG2 alone learns a drone in a second."""
        rng = np.random.default_rng(1)
        room = _room(rng)
        background = LivingBackground(SETTINGS, _exposed(room, rng))
        for index in range(1000):
            x = min(10 + 2 * index, 80) + np.sin(index / 7)
            image, drone = _with_drone(room, x, 50)
            mask = background.step(_exposed(image, rng))
        assert _f1(mask, drone) > 0.8

    def test_the_two_passes_of_a_file_show_a_drone_that_stands_at_first_from_frame_0(self):
        rng = np.random.default_rng(3)
        room = _room(rng)
        frames, truth = [], []
        for index in range(160):
            flown = max(index - 60, 0)
            image, drone = _with_drone(room, 80.0 + flown, 60.0 - flown / 2)
            frames.append(_exposed(image, rng))
            truth.append(drone)
        masks = list(Living(SETTINGS).foreground(frames[::4], frames))
        for index in (0, 30, 59, 70, 100):
            assert _f1(masks[index], truth[index]) > 0.75
        assert not masks[100][50:70, 65:95].any()

    def test_clouds_that_drift_are_background_and_a_shrinking_drone_is_found(self):
        rng = np.random.default_rng(5)
        clouds = cv2.GaussianBlur(_smooth(rng, HEIGHT, 2 * WIDTH, cells=10), (0, 0), 4)
        clouds = np.clip((clouds - clouds.mean()) * 1.5 + 0.5, 0, 1)
        frames, truth = [], []
        for index in range(150):
            moved = np.array([[1, 0, -0.2 * index], [0, 1, 0]])
            sky = cv2.warpAffine(clouds, moved, (WIDTH, HEIGHT))
            image = np.dstack([220 + 15 * sky, 170 + 60 * sky, 130 + 95 * sky])
            width_px = 30 * (8 / 30) ** (index / 149)
            y = 60 + 30 * np.sin(index / 20)
            image, drone = _with_drone(image, 20 + 0.8 * index, y, width_px)
            frames.append(_exposed(image, rng))
            truth.append(drone)
        found, false_blobs = 0, 0
        for mask, drone in zip(Living(SETTINGS).foreground(frames[::3], frames), truth, strict=True):
            _, _, _, centre = cv2.connectedComponentsWithStats(mask)
            row, column = np.argwhere(drone).mean(axis=0)
            near = np.linalg.norm(centre[1:] - [column, row], axis=1) < 3
            found += near.any()
            false_blobs += np.count_nonzero(~near)
        assert found >= 0.98 * len(frames)
        assert false_blobs <= 0.5 * len(frames)

    def test_a_fast_body_beside_a_person_is_found(self):
        """Ten bodies of 9 px fly at 20 px a frame, blurred over 18 px, past a person who walks.

        Found: of the balls in a video, 7 of 17 and 4 of 9 were found; their soft ends were taken for those of clouds.
        """
        rng = np.random.default_rng(2)
        wall = np.dstack([55 + 60 * _smooth(rng, HEIGHT, WIDTH)] * 3)
        path = [(10.0 + 20 * step, y) for y in rng.uniform(8, 40, 10) for step in range(8)]
        frames = []
        for x, y in path:
            image = np.mean([_with_drone(wall, x + moved, y, 9)[0] for moved in range(-9, 10)], axis=0)
            image[68:, 30 + len(frames) : 48 + len(frames)] = 60
            frames.append(_exposed(image, rng))
        is_found = []
        for mask, middle in zip(Living(SETTINGS).foreground(frames[::2], frames), path, strict=True):
            off_px = cv2.connectedComponentsWithStats(mask)[3][1:] - middle
            is_found.append((np.linalg.norm(off_px, axis=1) < 6).any())
        assert np.mean(is_found) >= 0.9

    def test_a_place_that_drones_cross_stays_calm(self):
        """A pale drone is found in full where dark drones crossed before: each of them is no change that goes on."""
        rng = np.random.default_rng(3)
        wall = np.full((HEIGHT, WIDTH, 3), 100.0)
        background = LivingBackground(SETTINGS, _exposed(wall, rng), 100)
        for index in range(160):
            image, _ = _with_drone(wall, 4 * (index % 60) - 80, 60)
            background.step(_exposed(image, rng))
        _, drone = _with_drone(wall, 80, 60)
        pale = wall.copy()
        pale[drone] -= 16
        mask = background.step(_exposed(pale, rng))
        # Before such changes were limited, the drone was not found at all.
        assert _f1(mask, drone) > 0.9

    @pytest.mark.slow
    def test_flashes_that_were_learned_long_ago_leave_no_invalid_numbers(self):
        """OpenCV's blur gave numbers below 0 after some minutes, and their roots were no numbers."""
        rng = np.random.default_rng(0)
        calm = np.full((60, 80, 3), 100, np.uint8)
        background = LivingBackground(ForegroundSettings(), calm)
        with np.errstate(invalid="raise"):
            for frame in range(2500):
                image = calm.copy()
                if frame % 300 == 0:
                    bright = rng.random((60, 80)) < 0.02
                    image[bright] = rng.integers(0, 255)
                background.step(image, num_frames=3)

    def test_a_ghost_is_gone_after_two_seconds_and_what_a_tracker_knows_is_not_learned(self):
        """Where a tracker says that a drone is, even a difference without edges of its own stays.

        The first frame shows a drone that goes; where it stood, the room comes to light.
        """
        rng = np.random.default_rng(6)
        room = _room(rng)
        shown, drone = _with_drone(room, 80, 60)
        known = 255 * cv2.dilate(drone.astype(np.uint8), np.ones((5, 5)))
        background = LivingBackground(SETTINGS, _exposed(shown, rng))
        for _ in range(50):
            mask = background.step(_exposed(room, rng))
        assert not mask.any()
        background = LivingBackground(SETTINGS, _exposed(shown, rng))
        for _ in range(100):
            mask = background.step(_exposed(room, rng), known)
        assert mask[drone].mean() > 0.9 * 255

    def test_a_pixel_at_a_contour_has_the_share_that_the_object_covers(self):
        rng = np.random.default_rng(5)
        wall = np.full((HEIGHT, WIDTH, 3), 150.0)
        soft = ForegroundSettings(working_reduction=2, reduction=2)
        background = LivingBackground(soft, _exposed(wall, rng), 100)
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


# --- light that is lost

NUM_FRAMES, BURST = 150, range(60, 65)
BLACK, BLUE = np.uint8([0, 0, 0]), np.uint8([255, 0, 0])
_noise = np.random.default_rng(8)
#: Frames -> what the camera shows instead of each: the brightness as a factor, or another picture.
LOST_LIGHT = {
    "begins dark": {i: (i + 1) / 15 for i in range(15)},
    "begins at 30 %": dict.fromkeys(range(25), 0.3),
    "three black at first": dict.fromkeys(range(3), BLACK),
    "nine black at first": dict.fromkeys(range(9), BLACK),
    "nine nearly black": {i: _noise.integers(0, 4, (HEIGHT, WIDTH, 3), np.uint8) for i in range(9)},
    "nine grey at first": dict.fromkeys(range(9), np.uint8([128, 128, 128])),
    "black for long": dict.fromkeys(range(30, 70), BLACK),
    "five black": dict.fromkeys(BURST, BLACK),
    "bursts": dict.fromkeys([*range(20, 25), *BURST], BLACK),
    "blue": dict.fromkeys(BURST, BLUE),
    "white": dict.fromkeys(BURST, np.uint8([255, 255, 255])),
    "another picture": {i: _exposed(_room(_noise), _noise) for i in BURST},
    "flash": dict.fromkeys(BURST, 4.0),
    "a tenth": dict.fromkeys(range(50, 65), 0.1),
    "a tenth for long": dict.fromkeys(range(30, 80), 0.1),
    "sinks and comes back": {i: 1 - 0.9 * np.exp(-(((i - 60) / 8) ** 2)) for i in range(40, 80)},
    "a lamp flickers": {i: 0.3 for i in range(40, 90) if i // 3 % 2},
    "dimmed for good": dict.fromkeys(range(60, 150), 0.4),
}


@functools.cache
def _flight() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """A drone that crosses a room, and its pixels."""
    rng = np.random.default_rng(9)
    room = _room(rng)
    drawn = [_with_drone(room, 15 + 0.9 * i, 60 + 35 * np.sin(i / 12)) for i in range(NUM_FRAMES)]
    return [_exposed(image, rng) for image, _ in drawn], [drone for _, drone in drawn]


def _masks(model: str, frames: list[np.ndarray]) -> list[np.ndarray | None]:
    if model == "live":
        return list(Living(SETTINGS).masks_as_they_come(frames))
    return list({"living": Living, "mog2": Mog2}[model](SETTINGS).foreground(frames[::6], frames))


@functools.cache
def _found_in_calm_light(model: str) -> np.ndarray:
    frames, drones = _flight()
    found = [_f1(mask, drone) > 0.6 for mask, drone in zip(_masks(model, frames), drones, strict=True)]
    return np.array(found)


@pytest.mark.parametrize("model", ["living", "mog2", pytest.param("live", marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", LOST_LIGHT)
def test_light_that_is_lost_leaves_no_camera_blind(case, model):
    """From a second after the last such frame on, the drone is found as in calm light.

    Found: after five black frames it was never found again. What shows nothing is no frame of the camera.
    """
    shown, (frames, drones) = LOST_LIGHT[case], _flight()
    seen = list(frames)
    for index, other in shown.items():
        is_gain = isinstance(other, float)
        lit = (
            np.clip(frames[index] * other, 0, 255).round()
            if is_gain
            else np.broadcast_to(other, frames[0].shape)
        )
        seen[index] = np.ascontiguousarray(lit, np.uint8)
    masks = _masks(model, seen)
    if case == "dimmed for good":
        if model == "mog2":
            pytest.skip("mog2 does not follow the light")
        after = min(shown)
    else:
        after = max(shown) + 25
    found = [mask is not None and _f1(mask, drone) > 0.6 for mask, drone in zip(masks, drones, strict=True)]
    assert np.sum(found[after:]) >= 0.95 * _found_in_calm_light(model)[after:].sum()
    if any(other is BLACK for other in shown.values()) and (model != "live" or min(shown)):
        assert [index for index, mask in enumerate(masks) if mask is None] == list(shown)


@pytest.mark.parametrize("strength", [20, 70, 200])
def test_the_slopes_of_a_cloud_are_no_contour_however_much_it_changes_the_image(strength):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    distance2 = (columns - 80) ** 2 + (rows - 60) ** 2
    cloud = (strength * np.exp(-distance2 / (2 * 30**2))).astype(np.uint8)
    changed = np.where(cloud > 3, np.uint8(255), np.uint8(0))
    strong = np.where(cloud > 8, np.uint8(255), np.uint8(0))
    calm = np.zeros((HEIGHT, WIDTH), bool)
    found = find_objects(changed, strong, cloud, np.zeros_like(cloud), calm, 9)
    assert not found.mask.any()


# --- the first look at a video


def test_frames_behind_those_that_are_held_stand_for_the_rest(tmp_path, monkeypatch):
    """The brightness of a frame tells its number."""
    width, height = 64, 48
    bytes_per_frame = 3 * (width // 2) * (height // 2)
    monkeypatch.setattr(first_look, "_HELD_BYTES", 20 * bytes_per_frame)
    path = tmp_path / "v.avi"
    with VideoWriter(path, 25.0, (width, height)) as writer:
        for index in range(200):
            writer.write(np.full((height, width, 3), 20 + index, np.uint8))
    video = probe(path)
    look = ForegroundSettings(working_reduction=2, num_learning_frames=10)
    learning, frames = look_first(video, read_frames(video), look)
    weights, images = zip(*learning, strict=True)
    number = [image.mean() - 20 for image in images]
    weight = np.array(weights)
    # The codec is off by a grey level. The frames 20 to 199 are four places, which are 45 frames apart.
    np.testing.assert_allclose(number, [0, 43, 88, 133, 178], atol=14)
    assert weight.sum() == pytest.approx(200)
    assert weight.max() < 80
    assert len(list(frames)) == 200
