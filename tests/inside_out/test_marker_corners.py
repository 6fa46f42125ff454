"""Detection of markers and their corners in drawn images with known corners."""

from functools import cache, partial

import cv2
import numpy as np
import pytest
from helpers import simple_lens
from hypothesis import given, settings
from hypothesis import strategies as st
from marker_pictures import draw

from psotrack.foreground.markers import MarkerDetector, marker_dictionary, refine_corners
from psotrack.geometry import distort

SQUARE = np.array([[260.0, 180.0], [360.0, 170.0], [370.0, 275.0], [255.0, 280.0]])
OBLIQUE = np.array([[100.0, 100.0], [140.0, 108.0], [139.0, 190.0], [101.0, 200.0]])


def degrade(image, *, blur_px=0.0, moved_px=0, noise=0.0, exponent=2.0, gain=1.0):
    """The image with blur, motion to the right during the exposure, other brightness, noise, and clipping.

    Blur is applied to the light, and grey levels are roots of the light.
    """
    light = image.astype(float) ** exponent
    if blur_px:
        light = cv2.GaussianBlur(light, (0, 0), blur_px)
    if moved_px:
        light = cv2.blur(light, (moved_px, 1))
    noisy = gain * light ** (1 / exponent) + np.random.default_rng(0).normal(0, noise, image.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def turned_square(middle, side, turn):
    """Corners of a square, clockwise from the top left one, turned in the image."""
    around = turn + np.pi / 4 * np.array([5, 7, 9, 11])
    return np.array(middle) + side / np.sqrt(2) * np.stack([np.cos(around), np.sin(around)], axis=-1)


#: Three markers with sides of 96 to 140 pixels, two of them turned.
SCENE = {
    17: turned_square((150.3, 130.6), 140.0, 0.06),
    402: turned_square((450.7, 130.2), 110.0, 0.5),
    731: turned_square((330.4, 350.1), 96.0, -0.3),
}
draw_scene = cache(partial(draw, tuple(SCENE.items())))


def scene(exponent=2.0, **changes):
    """Picture of the three markers, and their corners."""
    return degrade(draw_scene(exponent=exponent), exponent=exponent, **changes), SCENE


def errors_px(image, corners, **options):
    """Distance of each corner from its true position, pixels; all markers must be found."""
    found = MarkerDetector(**options).detect(image)
    assert sorted(found.ids.tolist()) == sorted(corners)
    true = np.stack([corners[marker] for marker in found.ids.tolist()])
    return np.linalg.norm(found.corners_px - true, axis=-1)


@pytest.mark.parametrize("exponent", [1.0, 2.4])
@pytest.mark.parametrize(
    "changes",
    [
        # Measured 0.09 at most; a fixed gamma of 2 gives 1.5 pixels in blurred grey images.
        {"blur_px": 2.5},
        # The search for an edge must reach as far as the blur: four pixels would miss most of this transition.
        {"moved_px": 15},
        # Blurred and clipped images have wide white areas, as with a high power. Uncorrected errors are 0.3 to 1.0.
        {"blur_px": 2.0, "gain": 1.2},
    ],
    ids=["soft", "moved", "clipped"],
)
def test_corners_are_right_for_every_gamma(changes, exponent):
    """Renderers blend grey levels, cameras blend light."""
    image, corners = scene(exponent=exponent, **changes)
    assert errors_px(image, corners).max() < (0.12 if "gain" in changes else 0.15)


def test_a_second_blur_and_compression_move_corners_little():
    """Scaling or compression blurs a video again, in grey levels. Edges with unequal blurs are then a little off."""
    image, corners = scene(moved_px=5)
    soft = cv2.GaussianBlur(image, (0, 0), 1.5)
    # Measured 0.24; 0.48 if the second blur were in light.
    assert np.median(errors_px(soft, corners)) < 0.35
    image, corners = scene(moved_px=5, noise=2.0)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])
    compressed = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    # Measured 0.15.
    assert errors_px(compressed, corners).max() < 0.3


def test_dim_light_and_shade_hide_no_markers():
    """Without equalised brightness, black in dim images fails a threshold for bright images."""
    for gain, noise in ((0.2, 3.0), (0.1, 1.5)):
        image, corners = scene(exponent=2.2, gain=gain, noise=noise)
        # Measured 0.61: the contrast is 11 and 21 times the noise.
        assert errors_px(image, corners).max() < 1.0
    image, corners = scene()
    image[:225] = np.round(0.4 * image[:225])
    assert errors_px(image, corners).max() < 0.2


def test_black_cells_of_a_large_marker_do_not_count_as_white():
    """Neighbouring black cells of this marker are nearly as wide as the square in which white is searched."""
    corners = turned_square((320.3, 240.6), 297.0, 0.1)
    image = draw([(17, corners)], fine=4)
    # The lower half of marker 17 is black, including its border. Measured 0.02.
    assert errors_px(image, {17: corners}).max() < 0.1


def test_large_images_are_searched_shrunk_and_refined_in_full_size():
    image = np.full((2160, 3840), 140, np.uint8)
    shown, corners = scene()
    image[1500:1980, 3001:3641] = shown
    there = {marker: at + np.array([3001, 1500]) for marker, at in corners.items()}
    # Measured 0.05, as in the small image.
    assert errors_px(image, there).max() < 0.1


@pytest.mark.parametrize(
    "dictionary", ["4x4_50", "5x5_100", "DICT_6X6_250", "7x7_1000", "aruco_original", "apriltag_36h11"]
)
def test_any_dictionary_of_opencv(dictionary):
    image = draw([(7, SQUARE)], dictionary=dictionary)
    # Measured 0.04.
    assert errors_px(image, {7: SQUARE}, dictionary=dictionary).max() < 0.1


def test_small_markers_in_large_images_are_found():
    """In images of this width, OpenCV's defaults find no marker with sides below 14.4 pixels."""
    corners = np.array([[100.0, 100], [118, 101], [117, 119], [100, 117]])
    image = np.full((1080, 1920), 140, np.uint8)
    image[300:500, 600:840] = draw([(3, corners)], size_wh=(240, 200))
    # Measured 0.13.
    assert errors_px(image, {3: corners + np.array([600, 300])}).max() < 0.25


def test_corners_are_right_in_images_of_a_lens_with_distortion():
    lens = simple_lens(400.0, (640, 480), (-0.2, 0.05, 0.001, -0.001))
    middle_px = lens.K[:2, 2]
    straight = np.array([[40.0, 30.0], [170.0, 25.0], [165.0, 155.0], [45.0, 160.0]])
    rays = (straight - middle_px) / 400
    corners = np.stack(distort(lens, *rays.T), axis=-1) * 400 + middle_px
    image = draw([(5, straight)], lens=lens, fine=4)
    # Measured 0.04; parabolas through the bent edges miss the corners by 0.28, straight lines by 0.85.
    assert errors_px(image, {5: corners}, lens=lens).max() < 0.1
    assert 0.2 < errors_px(image, {5: corners}).max() < 0.4


def test_only_the_wanted_markers_are_found():
    image = draw([(17, SQUARE), (400, OBLIQUE)])
    whole = MarkerDetector().detect(image)
    assert sorted(whole.ids.tolist()) == [17, 400]
    for wanted in (17, 400):
        # Ids that the dictionary does not have are ignored.
        found = MarkerDetector(ids=[5000, wanted, 3]).detect(image)
        assert found.ids.tolist() == [wanted]
        # The gamma is estimated from one marker instead of two, which moves corners by 0.01 pixels.
        np.testing.assert_allclose(found.corners_px, whole.select(whole.ids == wanted).corners_px, atol=0.03)


def test_markers_with_one_id_are_all_found_and_left_out_where_ids_are_single():
    shifted = SQUARE + np.array([150, 0])
    found = MarkerDetector().detect(draw([(17, SQUARE), (17, shifted), (4, OBLIQUE)]))
    assert sorted(found.ids.tolist()) == [4, 17, 17]
    assert found.of_single_ids().ids.tolist() == [4]


def test_hidden_parts_of_edges_move_no_corner():
    image = draw([(17, SQUARE)])
    # A dark object covers a fifth of the right edge; its own edge is beside the marker's edge.
    image[225:245, 360:380] = 30
    white = cv2.aruco.generateImageMarker(marker_dictionary("4x4_1000"), 17, 6) > 0
    found = refine_corners(image, SQUARE[None] + 0.5, white[None])
    # Measured 0.04.
    assert np.linalg.norm(found.corners_px[0] - SQUARE, axis=-1).max() < 0.2


@settings(max_examples=10)
@given(
    turn=st.floats(0, 2 * np.pi),
    middle=st.tuples(st.floats(200, 440), st.floats(190, 290)),
    side=st.floats(40, 120),
    marker=st.integers(0, 999),
)
def test_any_position_and_turn(turn, middle, side, marker):
    """Corners have the marker's own order, clockwise from its own top left corner, at every turn."""
    corners = turned_square(middle, side, turn)
    image = draw([(marker, corners)])
    # Measured 0.2 at most, for sides of 40 pixels that are nearly upright and sharp.
    assert errors_px(image, {marker: corners}).max() < 0.3
