"""Foreground of drawn scenes with known shapes, and comparisons with NumPy and SciPy."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from psotrack.errors import SettingsError
from psotrack.foreground.silhouettes import ForegroundSettings, Mog2, coverage, learning_step
from psotrack.foreground.silhouettes.foreground import remove_speckle

HEIGHT, WIDTH = 120, 160
RADIUS_PX = 9.0


def _make_background(rng: np.random.Generator) -> np.ndarray:
    """Make the image of an empty room: a smooth texture without edges."""
    coarse = rng.integers(90, 190, (HEIGHT // 20, WIDTH // 20, 3)).astype(np.float32)
    return cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def _draw_frame(
    background: np.ndarray,
    rng: np.random.Generator,
    *centres_xy: tuple[float, float],
    radius_px: float = RADIUS_PX,
) -> np.ndarray:
    """Draw dark discs with antialiased edges on the background, and add noise of 2 grey levels."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    image = background.copy()
    for centre_x, centre_y in centres_xy:
        inside = np.clip(radius_px - np.hypot(x - centre_x, y - centre_y) + 0.5, 0, 1)[..., None]
        image = image * (1 - inside) + 25.0 * inside
    return np.clip(image + rng.normal(0, 2, image.shape), 0, 255).round().astype(np.uint8)


def _centroid_px(cells: np.ndarray, cell_px: int) -> np.ndarray:
    """Return the centroid (x, y) of a coverage image.

    The unit is pixels of the full image; the centre of the first pixel is (0, 0).
    """
    weights = cells.astype(np.float64)
    y, x = np.indices(cells.shape) * cell_px + (cell_px - 1) / 2
    return np.array([(x * weights).sum(), (y * weights).sum()]) / weights.sum()


@pytest.mark.parametrize(("working_reduction", "reduction"), [(1, 1), (1, 4), (2, 4), (4, 4), (3, 6)])
def test_a_disc_is_found_at_its_true_centre(working_reduction: int, reduction: int) -> None:
    rng = np.random.default_rng(5)
    background = _make_background(rng)
    fg_settings = ForegroundSettings(working_reduction=working_reduction, reduction=reduction)
    centres = rng.uniform([30, 30], [WIDTH - 30, HEIGHT - 30], (60, 2))
    frames = [_draw_frame(background, rng, (x, y)) for x, y in centres]
    found = [
        _centroid_px(coverage(mask, reduction // working_reduction), reduction)
        for mask in Mog2(fg_settings).foreground(frames, frames)
    ]
    error_px = np.array(found) - centres
    # Rounding at the edge scatters a centroid by 0.05 to 0.25 px; the mean of 60 centroids would show a shift.
    assert np.abs(error_px.mean(axis=0)).max() < 0.1
    assert error_px.std(axis=0).max() < 0.5


def test_silhouette_has_the_area_of_the_shape() -> None:
    rng = np.random.default_rng(6)
    background = _make_background(rng)
    frames = [_draw_frame(background, rng, (30.0 + 5 * i, 60.0)) for i in range(20)]
    (mask,) = Mog2(ForegroundSettings(working_reduction=1)).foreground(frames, frames[7:8])
    # Pixels on the edge that differ from the background count as foreground: up to half a pixel on all sides.
    assert np.pi * RADIUS_PX**2 <= np.count_nonzero(mask) <= np.pi * (RADIUS_PX + 1) ** 2


@pytest.mark.parametrize("hovering_frames", [range(0, 18), range(22, 40)])
def test_a_hovering_drone_is_foreground_and_leaves_no_ghost(hovering_frames: range) -> None:
    rng = np.random.default_rng(7)
    background = _make_background(rng)
    centres = [(40.0, 60.0) if i in hovering_frames else (60.0 + 2 * i, 40.0) for i in range(40)]
    frames = [_draw_frame(background, rng, centre) for centre in centres]
    fg_settings = ForegroundSettings(working_reduction=1)
    for centre, mask in zip(centres, Mog2(fg_settings).foreground(frames, frames), strict=True):
        area_px = np.pi * RADIUS_PX**2
        assert np.abs(_centroid_px(mask, 1) - centre).max() < 0.5
        assert 0.9 * area_px < np.count_nonzero(mask) < 1.4 * area_px


@given(seed=st.integers(0, 99), num_frames=st.integers(1, 12), var_threshold=st.sampled_from([8.0, 16.0]))
@settings(max_examples=20, deadline=None)
def test_foreground_is_that_of_opencv_which_learned_the_mean(
    seed: int, num_frames: int, var_threshold: float
) -> None:
    frames = np.random.default_rng(seed).integers(90, 130, (num_frames, 24, 32, 3), dtype=np.uint8)
    model = cv2.createBackgroundSubtractorMOG2(varThreshold=var_threshold)
    model.setBackgroundRatio(0.5)
    for number, frame in enumerate(frames, 1):
        model.apply(frame, learningRate=1 / number)
    shown = np.clip(frames[0].astype(int) + 25, 0, 255).astype(np.uint8)
    # OpenCV's shadows are foreground.
    expected = [255 * (model.apply(frame, learningRate=0) > 0) for frame in (shown, frames[-1])]
    fg_settings = ForegroundSettings(working_reduction=1, min_blob_px=0, var_threshold=var_threshold)
    np.testing.assert_array_equal(list(Mog2(fg_settings).foreground(frames, [shown, frames[-1]])), expected)


def test_the_background_is_constant_at_learning_rate_zero() -> None:
    rng = np.random.default_rng(9)
    background = _make_background(rng)
    frames = [_draw_frame(background, rng, (20.0 + 3 * i, 60.0)) for i in range(40)]
    first, *_, last = Mog2(ForegroundSettings()).foreground(frames, 60 * frames[3:4])
    np.testing.assert_array_equal(first, last)
    *_, absorbed = Mog2(ForegroundSettings(learning_rate=0.05)).foreground(frames, 60 * frames[3:4])
    assert first.any()
    assert not absorbed.any()


@pytest.mark.parametrize(("shadows", "level"), [("keep", 255), ("drop", 0), ("weight", 64)])
def test_shadow_label_is_kept_dropped_or_weighted(shadows: str, level: int) -> None:
    rng = np.random.default_rng(10)
    background = _make_background(rng)
    empty = [_draw_frame(background, rng) for _ in range(20)]
    shaded = background.copy()
    shaded[40:80, 60:100] *= 0.65  # the same hue, darker: MOG2's definition of a shadow
    frame = _draw_frame(shaded, rng, (30.0, 30.0))
    fg_settings = ForegroundSettings(working_reduction=1, shadows=shadows, shadow_weight=0.25)
    (mask,) = Mog2(fg_settings).foreground(empty, [frame])
    # Noise may move the colour of single pixels outside the range that MOG2 accepts as shadow.
    assert np.mean(mask[45:75, 65:95] == level) > 0.95
    assert mask[30, 30] == 255
    assert mask[100, 130] == 0


@given(
    pixels=st.lists(st.integers(0, 20 * 30 - 1), max_size=150),
    min_blob_px=st.integers(0, 12),
)
@settings(max_examples=60, deadline=None)
def test_remove_speckle_removes_only_small_blobs(pixels: list[int], min_blob_px: int) -> None:
    """The oracle labels blobs by SciPy and removes each small blob."""
    mask = np.zeros((20, 30), np.uint8)
    mask.flat[pixels] = np.arange(len(pixels)) % 2 * 155 + 100
    labels, count = ndimage.label(mask, np.ones((3, 3)))
    expected = mask.copy()
    for label in range(1, count + 1):
        if np.count_nonzero(labels == label) < min_blob_px:
            expected[labels == label] = 0
    np.testing.assert_array_equal(remove_speckle(mask, min_blob_px), expected)


def test_min_blob_px_counts_pixels_of_the_full_image() -> None:
    rng = np.random.default_rng(11)
    background = _make_background(rng)
    empty = [_draw_frame(background, rng) for _ in range(20)]
    frame = _draw_frame(background, rng, (40.0, 40.0), radius_px=3.0)  # about 28 px, 7 at half the size
    for working_reduction in (1, 2):
        for min_blob_px, seen in ((12, True), (100, False)):
            fg_settings = ForegroundSettings(working_reduction=working_reduction, min_blob_px=min_blob_px)
            (mask,) = Mog2(fg_settings).foreground(empty, [frame])
            assert mask.any() == seen


@given(
    height=st.integers(1, 23), width=st.integers(1, 23), reduction=st.integers(1, 6), seed=st.integers(0, 99)
)
@settings(max_examples=100, deadline=None)
def test_coverage_is_the_mean_of_its_pixels(height: int, width: int, reduction: int, seed: int) -> None:
    """The oracle is the mean of a NumPy slice, with background beyond the image border."""
    mask = np.random.default_rng(seed).choice(np.array([0, 127, 255], np.uint8), (height, width))
    cells = coverage(mask, reduction)
    assert cells.shape == (-(-height // reduction), -(-width // reduction))
    for i, j in np.ndindex(*cells.shape):
        inside = mask[reduction * i : reduction * (i + 1), reduction * j : reduction * (j + 1)]
        # Coverage is rounded to a whole number, and a half may go up or down; 1e-4 covers float32's rounding.
        assert abs(float(cells[i, j]) - inside.sum(dtype=int) / reduction**2) <= 0.5 + 1e-4


@pytest.mark.parametrize("shape", [(119, 159), (1, 1), (5, 3)])
def test_any_image_size_works_at_half_scale(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(12)
    empty = rng.integers(100, 110, (9, *shape, 3), dtype=np.uint8)
    dark = np.full((*shape, 3), 10, np.uint8)
    (mask,) = Mog2(ForegroundSettings(min_blob_px=0)).foreground(empty, [dark])
    np.testing.assert_array_equal(mask, np.full((-(-shape[0] // 2), -(-shape[1] // 2)), 255))


@given(num_frames=st.integers(1, 5000), num_learning_frames=st.integers(1, 300))
def test_learning_frames_spread_over_the_video(num_frames: int, num_learning_frames: int) -> None:
    step = learning_step(num_frames, ForegroundSettings(num_learning_frames=num_learning_frames))
    used = range(0, num_frames, step)
    assert 1 <= len(used) <= num_learning_frames
    # Rounding the step up drops less than half of the frames.
    assert len(used) >= min(num_frames, num_learning_frames) / 2


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"working_reduction": 0}, "working_reduction: expected a whole number of at least 1, found 0"),
        ({"working_reduction": 1.5}, "working_reduction: expected a whole number, found 1.5"),
        ({"num_learning_frames": 0}, "num_learning_frames: expected a whole number of at least 1, found 0"),
        ({"min_blob_px": -1}, "min_blob_px: expected a whole number of at least 0, found -1"),
        ({"learning_rate": -0.1}, "learning_rate: expected a number of at least 0, found -0.1"),
        ({"learning_rate": float("nan")}, "learning_rate: expected a number of at least 0, found NaN"),
        ({"shadow_weight": 1.5}, "shadow_weight: expected a number of at most 1, found 1.5"),
        ({"var_threshold": 0.0}, "var_threshold: expected a number above 0, found 0"),
        ({"var_threshold": float("inf")}, "var_threshold: expected a number above 0, found inf"),
        ({"shadows": "maybe"}, "shadows: expected one of keep, drop, weight, found maybe"),
    ],
)
def test_invalid_settings_are_refused(setting: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError) as error_info:
        ForegroundSettings(**setting)
    assert str(error_info.value) == message
