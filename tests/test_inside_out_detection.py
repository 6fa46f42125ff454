"""Markers in images: which they are, and where their corners are, against images that are drawn to be known."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.detection import marker_dictionary
from psotrack.errors import SettingsError
from psotrack.geometry import camera, distort, undistort
from psotrack.inside_out.detection import MarkerDetector, refined_corners
from psotrack.inside_out.detection.blending import blending_exponent

SIZE_WH = (640, 480)
#: Samples per pixel, along each side, of what is drawn: an edge is then right to 1/16 of a pixel everywhere.
FINE = 8
#: Cells of white around a marker.
QUIET = 1.0
SQUARE = np.array([[260.0, 180.0], [360.0, 170.0], [370.0, 275.0], [255.0, 280.0]])
OBLIQUE = np.array([[100.0, 100.0], [140.0, 108.0], [139.0, 190.0], [101.0, 200.0]])


def pattern(marker, dictionary="4x4_1000", cell_px=20):
    """A marker with its quiet zone, in its own pixels, and its corners there: the edges of its border."""
    model = marker_dictionary(dictionary)
    cells = model.markerSize + 2
    quiet_px = round(QUIET * cell_px)
    image = cv2.copyMakeBorder(
        cv2.aruco.generateImageMarker(model, marker, cells * cell_px),
        *[quiet_px] * 4,
        cv2.BORDER_CONSTANT,
        value=255,
    )
    low, high = quiet_px - 0.5, quiet_px + cells * cell_px - 0.5
    return image, np.array([[low, low], [high, low], [high, high], [low, high]])


def draw(
    markers,
    *,
    size_wh=SIZE_WH,
    dictionary="4x4_1000",
    lens=None,
    exponent=2.0,
    black=40,
    white=200,
    wall=140,
):
    """An image of a wall with markers whose corners are given, (4, 2) each, by casting rays through fine pixels."""
    drawn = np.full(size_wh[::-1], wall, np.uint8)
    for marker, corners in markers:
        image, own = pattern(marker, dictionary)
        towards = cv2.getPerspectiveTransform(corners.astype(np.float32), own.astype(np.float32))
        # Whole pixels that hold the marker and the white around it.
        margin = np.ptp(corners, axis=0).max() / 4
        low = np.clip(np.floor(corners.min(axis=0) - margin), 0, size_wh).astype(int)
        high = np.clip(np.ceil(corners.max(axis=0) + margin), 0, size_wh).astype(int)
        axes = [
            np.arange(FINE * start, FINE * end) / FINE + 0.5 / FINE - 0.5
            for start, end in zip(low, high, strict=True)
        ]
        grid = np.stack(np.meshgrid(*axes), axis=-1)
        if lens is not None:
            grid = undistort(lens, grid) @ lens.K[:2, :2].T + lens.K[:2, 2]
        # Where a fine pixel is in the marker's own image.
        there = grid @ towards[:, :2].T + towards[:, 2]
        there = np.round(there[..., :2] / there[..., 2:]).astype(int)
        inside = ((there >= 0) & (there < image.shape[0])).all(axis=-1)
        fine = np.where(inside, 0.0, float(wall))
        fine[inside] = black + (white - black) * (image[there[inside][:, 1], there[inside][:, 0]] / 255)
        # A pixel is the mean of its light, and its level a root of that.
        light = (fine**exponent).reshape(high[1] - low[1], FINE, high[0] - low[0], FINE).mean(axis=(1, 3))
        coarse = light ** (1 / exponent)
        part = drawn[low[1] : high[1], low[0] : high[0]]
        there = inside.reshape(*coarse.shape[:1], FINE, coarse.shape[1], FINE).any(axis=(1, 3))
        part[there] = np.round(coarse[there])
    return drawn


def degraded(image, *, blur_px=0.0, moved_px=0, noise=0.0, exponent=2.0, gain=1.0):
    """The image through a soft lens, moved to the right while the shutter was open, brighter, and with noise.

    All of it in light, of which grey levels are a root; and clipped.
    """
    light = image.astype(float) ** exponent
    soft = cv2.GaussianBlur(light, (0, 0), blur_px) if blur_px else light
    moved = cv2.blur(soft, (moved_px, 1)) if moved_px else soft
    noisy = gain * moved ** (1 / exponent) + np.random.default_rng(0).normal(0, noise, image.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def scene(*, exponent=2.0, **changes):
    """Three markers of 96 to 140 pixels, two of them turned, and where they are."""
    around = np.deg2rad(np.array([225, 315, 405, 495]))
    corners = {
        marker: np.array(middle)
        + side / np.sqrt(2) * np.stack([np.cos(around + turn), np.sin(around + turn)], -1)
        for marker, middle, side, turn in (
            (17, (150.3, 130.6), 140.0, 0.06),
            (402, (450.7, 130.2), 110.0, 0.5),
            (731, (330.4, 350.1), 96.0, -0.3),
        )
    }
    image = draw(list(corners.items()), exponent=exponent)
    return degraded(image, exponent=exponent, **changes), corners


def errors_px(image, corners):
    """How far each corner is off, of markers that must all be there."""
    seen = MarkerDetector().detect(image)
    assert sorted(seen.ids.tolist()) == sorted(corners)
    true = np.stack([corners[marker] for marker in seen.ids.tolist()])
    return np.linalg.norm(seen.corners_px - true, axis=-1)


def error_px(found, corners):
    return float(np.linalg.norm(found - corners, axis=-1).max())


def white_cells(marker):
    return cv2.aruco.generateImageMarker(marker_dictionary("4x4_1000"), marker, 6)[None] > 0


def opencv_corners(image):
    """OpenCV's own corners with its refinement, by id."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    quads, ids, _ = cv2.aruco.ArucoDetector(marker_dictionary("4x4_1000"), parameters).detectMarkers(image)
    return {int(marker): quad[0] for marker, quad in zip(np.ravel(ids), quads, strict=True)}


@pytest.mark.parametrize(
    ("changes", "limits_px"),
    [
        # Pairs of limits, for the square and the oblique one. Measured 0.04 and 0.10: samples are half a pixel apart.
        ({}, (0.1, 0.2)),
        # Measured 0.02 and 0.12: a blur moves no edge, but cells of the oblique one are as narrow as it is wide.
        ({"blur_px": 1.5}, (0.1, 0.25)),
        # Measured 0.03 and 0.12.
        ({"moved_px": 5}, (0.1, 0.25)),
        # Measured 0.21 and 0.31: with contrast 160, 16 points on an edge, each from a few samples.
        ({"noise": 8.0}, (0.5, 0.5)),
    ],
    ids=["sharp", "soft", "moved", "noisy"],
)
@pytest.mark.parametrize(("corners", "which"), [(SQUARE, 0), (OBLIQUE, 1)], ids=["square", "oblique"])
def test_a_marker_is_where_it_was_drawn(corners, which, changes, limits_px):
    seen = MarkerDetector().detect(degraded(draw([(17, corners)]), **changes))
    assert seen.ids.tolist() == [17]
    assert error_px(seen.corners_px[0], corners) < limits_px[which]


@pytest.mark.parametrize("changes", [{"blur_px": 1.5}, {"moved_px": 5}], ids=["soft", "moved"])
def test_corners_are_better_than_those_of_opencv_where_images_are_blurred(changes):
    """OpenCV looks at the corners themselves, which blurs round off: measured 40 times as far off."""
    image = degraded(draw([(17, SQUARE)]), **changes)
    ours = error_px(MarkerDetector().detect(image).corners_px[0], SQUARE)
    assert 3 * ours < error_px(opencv_corners(image)[17], SQUARE)


@pytest.mark.parametrize("exponent", [1.0, 1.8, 2.4])
@pytest.mark.parametrize("changes", [{}, {"blur_px": 2.5}, {"moved_px": 9}], ids=["sharp", "soft", "moved"])
def test_corners_are_right_in_whatever_power_of_grey_an_image_blends(changes, exponent):
    """Renderers blend grey levels, cameras light. Taken for squares, grey ones that are blurred are 1.5 pixels off."""
    # Measured 0.09 at most.
    assert errors_px(*scene(exponent=exponent, **changes)).max() < 0.15


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 2.5])
def test_markers_tell_in_which_power_an_image_blends(exponent):
    image, corners = scene(exponent=exponent, blur_px=1.5)
    white = np.concatenate([white_cells(marker) for marker in corners])
    told = blending_exponent(image, np.stack(list(corners.values())), np.full((3, 4), 4.0), white, None)
    # Between the two that are measured, 1 and 2.2, a line is a curve: measured 0.06.
    assert told == pytest.approx(exponent, abs=0.12)


def test_a_blur_of_most_of_a_cell_moves_no_corner():
    """Edges are looked for as far as they are blurred: in four pixels, most of this rise is missed."""
    # Measured 0.07.
    assert errors_px(*scene(moved_px=15)).max() < 0.15


@pytest.mark.parametrize("exponent", [1.0, 2.2])
def test_white_that_is_clipped_moves_corners_little(exponent):
    """What was blurred and then clipped has wide white, as what blends in a high power: else off by 0.3 to 1.0."""
    # Measured 0.04.
    assert errors_px(*scene(exponent=exponent, blur_px=2.0, gain=1.3)).max() < 0.1


def test_what_is_blurred_again_once_it_is_encoded_blends_in_between():
    """As by scaling or compressing a video. Edges that are blurred otherwise than others are then off a little."""
    image, corners = scene(moved_px=5)
    # Measured 0.24; in light 0.48.
    assert np.median(errors_px(cv2.GaussianBlur(image, (0, 0), 1.5), corners)) < 0.35


def test_compression_and_noise_move_corners_little():
    image, corners = scene(moved_px=5, noise=2.0)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])
    # Measured 0.15.
    assert errors_px(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), corners).max() < 0.3


@pytest.mark.parametrize(("gain", "noise"), [(0.2, 3.0), (0.1, 1.5)])
def test_dim_light_hides_no_markers(gain, noise):
    """In levels of their own, black is not dark enough for a threshold that is made for bright images."""
    # Measured 0.61: contrast is 11 and 21 times the noise.
    assert errors_px(*scene(exponent=2.2, gain=gain, noise=noise)).max() < 1.0


def test_shade_hides_no_markers():
    image, corners = scene()
    image[:225] = np.round(0.4 * image[:225])
    assert errors_px(image, corners).max() < 0.2


def test_a_large_marker_has_no_white_of_its_own():
    """Black cells side by side are as wide as what white is looked for in, in images that are lit alike."""
    around = 0.1 + np.deg2rad(np.array([225, 315, 405, 495]))
    corners = np.array([320.3, 240.6]) + 210 * np.stack([np.cos(around), np.sin(around)], axis=-1)
    # The lower half of 17 is black, with its border. Measured 0.02.
    assert errors_px(draw([(17, corners)]), {17: corners}).max() < 0.1


def test_large_images_are_searched_smaller_and_looked_at_as_they_are():
    image = np.full((2160, 3840), 140, np.uint8)
    shown, corners = scene()
    image[1500:1980, 3001:3641] = shown
    # Measured as in the small image: 0.05.
    assert (
        errors_px(image, {marker: at + np.array([3001, 1500]) for marker, at in corners.items()}).max() < 0.1
    )


@pytest.mark.parametrize(
    "dictionary", ["4x4_50", "5x5_100", "DICT_6X6_250", "7x7_1000", "aruco_original", "apriltag_36h11"]
)
def test_any_dictionary_of_opencv(dictionary):
    seen = MarkerDetector(dictionary).detect(draw([(7, SQUARE)], dictionary=dictionary))
    assert seen.ids.tolist() == [7]
    # Measured 0.04.
    assert error_px(seen.corners_px[0], SQUARE) < 0.1


def test_an_unknown_dictionary_is_one_line():
    with pytest.raises(SettingsError, match=r"dictionary: expected one of .*4x4_1000.*, found 9x9"):
        MarkerDetector("9x9")


@pytest.mark.parametrize("side_px", [18, 24, 40])
def test_small_markers_in_large_images_are_found(side_px):
    """OpenCV's defaults find none below 14.4 pixels in images of this width."""
    corners = np.array(
        [[700.0, 400.0], [700 + side_px, 401], [699 + side_px, 401 + side_px], [700, 399 + side_px]]
    )
    image = np.full((1080, 1920), 140, np.uint8)
    patch = draw([(3, corners - [600, 300])], size_wh=(240, 200))
    image[300:500, 600:840] = patch
    seen = MarkerDetector().detect(image)
    assert seen.ids.tolist() == [3]
    # Measured 0.13.
    assert error_px(seen.corners_px[0], corners) < 0.25


def test_a_lens_bends_edges_and_corners_stay_where_they_are():
    lens = camera(
        R=np.eye(3),
        t_m=np.zeros(3),
        K=np.array([[400.0, 0, 319.5], [0, 400.0, 239.5], [0, 0, 1]]),
        image_size_wh=SIZE_WH,
        dist=(-0.2, 0.05, 0.001, -0.001),
    )
    straight = np.array([[40.0, 30.0], [170.0, 25.0], [165.0, 155.0], [45.0, 160.0]])
    rays = (straight - lens.K[:2, 2]) / 400
    corners = np.stack(distort(lens, *rays.T), axis=-1) * 400 + lens.K[:2, 2]
    image = draw([(5, straight)], lens=lens)
    # Measured 0.04; lines that are taken to be straight miss the corners by 0.85.
    assert error_px(MarkerDetector(lens=lens).detect(image).corners_px[0], corners) < 0.1
    assert error_px(MarkerDetector().detect(image).corners_px[0], corners) > 0.4


def test_only_the_markers_that_are_sought_are_found():
    image = draw([(17, SQUARE), (400, OBLIQUE)])
    whole = MarkerDetector().detect(image)
    assert sorted(whole.ids.tolist()) == [17, 400]
    for sought in (17, 400):
        # Those that the dictionary does not have are no markers.
        seen = MarkerDetector(ids=[5000, sought, 3]).detect(image)
        assert seen.ids.tolist() == [sought]
        # What they tell of how the image blends, 0.01 pixels of it, is then told by one of them.
        np.testing.assert_allclose(seen.corners_px, whole.select(whole.ids == sought).corners_px, atol=0.03)


def test_a_dictionary_without_any_of_the_markers_is_one_line():
    with pytest.raises(
        SettingsError, match="dictionary: expected one that has markers of the map, found 4x4_50, 0 to 49"
    ):
        MarkerDetector("4x4_50", ids=[50, 51])


def test_of_two_with_one_id_neither_counts():
    shifted = SQUARE + np.array([150, 0])
    seen = MarkerDetector().detect(draw([(17, SQUARE), (17, shifted), (4, OBLIQUE)]))
    assert seen.ids.tolist() == [4]


@pytest.mark.parametrize("noise", [0.0, 40.0])
def test_no_markers_are_an_ordinary_case(noise):
    seen = MarkerDetector().detect(degraded(np.full((240, 320), 128, np.uint8), noise=noise))
    assert len(seen) == 0
    assert seen.corners_px.shape == (0, 4, 2)


def test_what_hides_a_part_of_an_edge_moves_no_corner():
    image = draw([(17, SQUARE)])
    # A dark thing over a fifth of the right edge, with an edge of its own beside it.
    image[225:245, 360:380] = 30
    found = refined_corners(image, SQUARE[None] + 0.5, white_cells(17))
    # Measured 0.04.
    assert error_px(found[0], SQUARE) < 0.2


def test_without_edges_corners_stay():
    flat = np.full((480, 640), 128, np.uint8)
    assert np.array_equal(refined_corners(flat, SQUARE[None], white_cells(17)), SQUARE[None])
    assert refined_corners(flat, np.zeros((0, 4, 2)), np.zeros((0, 6, 6), bool)).shape == (0, 4, 2)


@settings(max_examples=10)
@given(
    angle=st.floats(0, 2 * np.pi),
    x=st.floats(200, 440),
    y=st.floats(190, 290),
    side=st.floats(40, 120),
    marker=st.integers(0, 999),
)
def test_any_place_and_turn(angle, x, y, side, marker):
    """Corners come in the marker's own order, clockwise from its own top left, however it is turned."""
    around = angle + np.pi / 4 * np.array([5, 7, 9, 11])
    corners = np.array([x, y]) + side / np.sqrt(2) * np.stack([np.cos(around), np.sin(around)], axis=-1)
    seen = MarkerDetector().detect(draw([(marker, corners)]))
    assert seen.ids.tolist() == [marker]
    # Measured 0.2 at most, where sides of 40 pixels are nearly upright and sharp.
    assert error_px(seen.corners_px[0], corners) < 0.3
