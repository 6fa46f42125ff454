"""Detection of markers and their corners in drawn images with known corners."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.errors import SettingsError
from psotrack.foreground.markers import MarkerDetector, marker_dictionary, refine_corners
from psotrack.foreground.markers.gamma import estimate_gamma
from psotrack.geometry import distort, make_camera, undistort

SIZE_WH = (640, 480)
#: Samples per pixel along each side of drawn images: every edge is good to 1/16 of a pixel.
FINE = 8
#: Width of the white zone around a marker, cells.
QUIET = 1.0
SQUARE = np.array([[260.0, 180.0], [360.0, 170.0], [370.0, 275.0], [255.0, 280.0]])
OBLIQUE = np.array([[100.0, 100.0], [140.0, 108.0], [139.0, 190.0], [101.0, 200.0]])


def marker_image(marker, dictionary="4x4_1000", cell_px=20):
    """Image of a marker with its white zone, and the corners of the marker's border in that image, pixels."""
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


#: Grey levels of drawn images: black and white cells of markers, and the wall.
BLACK, WHITE, WALL = 40, 200, 140


def draw(markers, *, size_wh=SIZE_WH, dictionary="4x4_1000", lens=None, exponent=2.0):
    """An image of a wall with markers at given corners, (4, 2) each, drawn by one ray for each sample."""
    drawn = np.full(size_wh[::-1], WALL, np.uint8)
    for marker, corners in markers:
        image, own = marker_image(marker, dictionary)
        towards = cv2.getPerspectiveTransform(corners.astype(np.float32), own.astype(np.float32))
        # The block of whole pixels that holds the marker and its white zone.
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
        # Positions of the samples in the marker's image.
        there = grid @ towards[:, :2].T + towards[:, 2]
        there = np.round(there[..., :2] / there[..., 2:]).astype(int)
        inside = ((there >= 0) & (there < image.shape[0])).all(axis=-1)
        fine = np.where(inside, 0.0, float(WALL))
        fine[inside] = BLACK + (WHITE - BLACK) * (image[there[inside][:, 1], there[inside][:, 0]] / 255)
        # The light of a pixel is the mean of its samples; its grey level is a root of the light.
        light = (fine**exponent).reshape(high[1] - low[1], FINE, high[0] - low[0], FINE).mean(axis=(1, 3))
        coarse = light ** (1 / exponent)
        part = drawn[low[1] : high[1], low[0] : high[0]]
        there = inside.reshape(*coarse.shape[:1], FINE, coarse.shape[1], FINE).any(axis=(1, 3))
        part[there] = np.round(coarse[there])
    return drawn


def degrade(image, *, blur_px=0.0, moved_px=0, noise=0.0, exponent=2.0, gain=1.0):
    """The image with blur, motion to the right during the exposure, other brightness, noise, and clipping.

    Blur is applied to the light, and grey levels are roots of the light.
    """
    light = image.astype(float) ** exponent
    soft = cv2.GaussianBlur(light, (0, 0), blur_px) if blur_px else light
    moved = cv2.blur(soft, (moved_px, 1)) if moved_px else soft
    noisy = gain * moved ** (1 / exponent) + np.random.default_rng(0).normal(0, noise, image.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def scene(*, exponent=2.0, **changes):
    """Three markers with sides of 96 to 140 pixels, two of them turned, and their corners."""
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
    return degrade(image, exponent=exponent, **changes), corners


def errors_px(image, corners):
    """Distance of each corner from its true position, pixels; all markers must be found."""
    found = MarkerDetector().detect(image)
    assert sorted(found.ids.tolist()) == sorted(corners)
    true = np.stack([corners[marker] for marker in found.ids.tolist()])
    return np.linalg.norm(found.corners_px - true, axis=-1)


def largest_error_px(found, corners):
    return float(np.linalg.norm(found - corners, axis=-1).max())


def white_cells(marker):
    return cv2.aruco.generateImageMarker(marker_dictionary("4x4_1000"), marker, 6)[None] > 0


def opencv_corners(image):
    """Corners by OpenCV's own refinement, by id."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    quads, ids, _ = cv2.aruco.ArucoDetector(marker_dictionary("4x4_1000"), parameters).detectMarkers(image)
    return {int(marker): quad[0] for marker, quad in zip(np.ravel(ids), quads, strict=True)}


@pytest.mark.parametrize(
    ("changes", "limits_px"),
    [
        # Limits for the square and the oblique marker. Measured 0.04 and 0.10: samples are half a pixel apart.
        ({}, (0.1, 0.2)),
        # Measured 0.02 and 0.12: blur moves no edge, but cells of the oblique marker are as narrow as the blur.
        ({"blur_px": 1.5}, (0.1, 0.25)),
        # Measured 0.03 and 0.12.
        ({"moved_px": 5}, (0.1, 0.25)),
        # Measured 0.21 and 0.31: the contrast is 160, and each edge has 16 points from a few samples each.
        ({"noise": 8.0}, (0.5, 0.5)),
    ],
    ids=["sharp", "soft", "moved", "noisy"],
)
@pytest.mark.parametrize(("corners", "which"), [(SQUARE, 0), (OBLIQUE, 1)], ids=["square", "oblique"])
def test_corners_are_found_at_their_drawn_positions(corners, which, changes, limits_px):
    found = MarkerDetector().detect(degrade(draw([(17, corners)]), **changes))
    assert found.ids.tolist() == [17]
    assert largest_error_px(found.corners_px[0], corners) < limits_px[which]


@pytest.mark.parametrize("changes", [{"blur_px": 1.5}, {"moved_px": 5}], ids=["soft", "moved"])
def test_corners_are_better_than_opencvs_in_blurred_images(changes):
    """OpenCV uses the pixels around a corner, which blur makes round. Its error was measured 40 times larger."""
    image = degrade(draw([(17, SQUARE)]), **changes)
    ours = largest_error_px(MarkerDetector().detect(image).corners_px[0], SQUARE)
    assert 3 * ours < largest_error_px(opencv_corners(image)[17], SQUARE)


@pytest.mark.parametrize("exponent", [1.0, 1.8, 2.4])
@pytest.mark.parametrize("changes", [{}, {"blur_px": 2.5}, {"moved_px": 9}], ids=["sharp", "soft", "moved"])
@pytest.mark.slow
def test_corners_are_right_for_every_gamma(changes, exponent):
    """Renderers blend grey levels, cameras blend light. A fixed gamma of 2 gives 1.5 pixels in blurred grey images."""
    # Measured 0.09 at most.
    assert errors_px(*scene(exponent=exponent, **changes)).max() < 0.15


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 2.5])
@pytest.mark.slow
def test_gamma_is_estimated_from_markers(exponent):
    image, corners = scene(exponent=exponent, blur_px=1.5)
    white = np.concatenate([white_cells(marker) for marker in corners])
    gamma = estimate_gamma(image, np.stack(list(corners.values())), np.full((3, 4), 4.0), white)
    # The estimate is linear between the two measured powers, 1 and 2.2, but the truth is curved. Measured 0.06.
    assert gamma == pytest.approx(exponent, abs=0.12)


def test_a_blur_of_most_of_a_cell_moves_no_corner():
    """The search for an edge must reach as far as the blur: four pixels would miss most of this transition."""
    # Measured 0.07.
    assert errors_px(*scene(moved_px=15)).max() < 0.15


@pytest.mark.parametrize("exponent", [1.0, 2.2])
def test_clipped_white_moves_corners_little(exponent):
    """Blurred and clipped images have wide white areas, as with a high power. Uncorrected errors are 0.3 to 1.0."""
    # Measured 0.04.
    assert errors_px(*scene(exponent=exponent, blur_px=2.0, gain=1.3)).max() < 0.1


def test_blur_before_and_after_encoding_moves_corners_little():
    """Scaling or compression blurs a video again, in grey levels. Edges with unequal blurs are then a little off."""
    image, corners = scene(moved_px=5)
    # Measured 0.24; 0.48 if the second blur were in light.
    assert np.median(errors_px(cv2.GaussianBlur(image, (0, 0), 1.5), corners)) < 0.35


def test_compression_and_noise_move_corners_little():
    image, corners = scene(moved_px=5, noise=2.0)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])
    # Measured 0.15.
    assert errors_px(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), corners).max() < 0.3


@pytest.mark.parametrize(("gain", "noise"), [(0.2, 3.0), (0.1, 1.5)])
def test_dim_light_hides_no_markers(gain, noise):
    """Without equalised brightness, black in dim images fails a threshold for bright images."""
    # Measured 0.61: the contrast is 11 and 21 times the noise.
    assert errors_px(*scene(exponent=2.2, gain=gain, noise=noise)).max() < 1.0


def test_shade_hides_no_markers():
    image, corners = scene()
    image[:225] = np.round(0.4 * image[:225])
    assert errors_px(image, corners).max() < 0.2


@pytest.mark.slow
def test_black_cells_of_a_large_marker_do_not_count_as_white():
    """Neighbouring black cells of this marker are nearly as wide as the square in which white is searched."""
    around = 0.1 + np.deg2rad(np.array([225, 315, 405, 495]))
    corners = np.array([320.3, 240.6]) + 210 * np.stack([np.cos(around), np.sin(around)], axis=-1)
    # The lower half of marker 17 is black, including its border. Measured 0.02.
    assert errors_px(draw([(17, corners)]), {17: corners}).max() < 0.1


def test_large_images_are_searched_shrunk_and_refined_in_full_size():
    image = np.full((2160, 3840), 140, np.uint8)
    shown, corners = scene()
    image[1500:1980, 3001:3641] = shown
    # Measured 0.05, as in the small image.
    assert (
        errors_px(image, {marker: at + np.array([3001, 1500]) for marker, at in corners.items()}).max() < 0.1
    )


@pytest.mark.parametrize(
    "dictionary", ["4x4_50", "5x5_100", "DICT_6X6_250", "7x7_1000", "aruco_original", "apriltag_36h11"]
)
def test_any_dictionary_of_opencv(dictionary):
    found = MarkerDetector(dictionary).detect(draw([(7, SQUARE)], dictionary=dictionary))
    assert found.ids.tolist() == [7]
    # Measured 0.04.
    assert largest_error_px(found.corners_px[0], SQUARE) < 0.1


def test_an_unknown_dictionary_is_one_line():
    with pytest.raises(SettingsError, match=r"dictionary: expected one of .*4x4_1000.*, found 9x9"):
        MarkerDetector("9x9")


@pytest.mark.parametrize("side_px", [18, 24, 40])
def test_small_markers_in_large_images_are_found(side_px):
    """In images of this width, OpenCV's defaults find no marker with sides below 14.4 pixels."""
    corners = np.array(
        [[700.0, 400.0], [700 + side_px, 401], [699 + side_px, 401 + side_px], [700, 399 + side_px]]
    )
    image = np.full((1080, 1920), 140, np.uint8)
    patch = draw([(3, corners - [600, 300])], size_wh=(240, 200))
    image[300:500, 600:840] = patch
    found = MarkerDetector().detect(image)
    assert found.ids.tolist() == [3]
    # Measured 0.13.
    assert largest_error_px(found.corners_px[0], corners) < 0.25


@pytest.mark.slow
def test_corners_are_right_in_images_of_a_lens_with_distortion():
    lens = make_camera(
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
    # Measured 0.04; parabolas through the bent edges miss the corners by 0.28, straight lines by 0.85.
    assert largest_error_px(MarkerDetector(lens=lens).detect(image).corners_px[0], corners) < 0.1
    assert 0.2 < largest_error_px(MarkerDetector().detect(image).corners_px[0], corners) < 0.4


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


def test_a_dictionary_without_any_of_the_markers_is_one_line():
    with pytest.raises(
        SettingsError, match="dictionary: expected one that has markers of the map, found 4x4_50, 0 to 49"
    ):
        MarkerDetector("4x4_50", ids=[50, 51])


def test_markers_with_one_id_are_all_found_and_left_out_where_ids_are_single():
    shifted = SQUARE + np.array([150, 0])
    found = MarkerDetector().detect(draw([(17, SQUARE), (17, shifted), (4, OBLIQUE)]))
    assert sorted(found.ids.tolist()) == [4, 17, 17]
    assert found.of_single_ids().ids.tolist() == [4]


@pytest.mark.parametrize("noise", [0.0, 40.0])
def test_an_image_without_markers_gives_an_empty_result(noise):
    found = MarkerDetector().detect(degrade(np.full((240, 320), 128, np.uint8), noise=noise))
    assert len(found) == 0
    assert found.corners_px.shape == (0, 4, 2)


def test_a_hidden_part_of_an_edge_moves_no_corner():
    image = draw([(17, SQUARE)])
    # A dark object covers a fifth of the right edge; its own edge is beside the marker's edge.
    image[225:245, 360:380] = 30
    found = refine_corners(image, SQUARE[None] + 0.5, white_cells(17))
    # Measured 0.04.
    assert largest_error_px(found.corners_px[0], SQUARE) < 0.2


def test_corners_without_edges_do_not_move():
    flat = np.full((480, 640), 128, np.uint8)
    found = refine_corners(flat, SQUARE[None], white_cells(17))
    assert np.array_equal(found.corners_px, SQUARE[None])
    # Nothing is known but the search's own accuracy, about a cell.
    assert found.std_px[0] > 5
    assert refine_corners(flat, np.zeros((0, 4, 2)), np.zeros((0, 6, 6), bool)).corners_px.shape == (0, 4, 2)


@settings(max_examples=10)
@given(
    angle=st.floats(0, 2 * np.pi),
    x=st.floats(200, 440),
    y=st.floats(190, 290),
    side=st.floats(40, 120),
    marker=st.integers(0, 999),
)
def test_any_position_and_turn(angle, x, y, side, marker):
    """Corners have the marker's own order, clockwise from its own top left corner, at every turn."""
    around = angle + np.pi / 4 * np.array([5, 7, 9, 11])
    corners = np.array([x, y]) + side / np.sqrt(2) * np.stack([np.cos(around), np.sin(around)], axis=-1)
    found = MarkerDetector().detect(draw([(marker, corners)]))
    assert found.ids.tolist() == [marker]
    # Measured 0.2 at most, for sides of 40 pixels that are nearly upright and sharp.
    assert largest_error_px(found.corners_px[0], corners) < 0.3
