"""Markers in photographs and videos: what is found in comparison with OpenCV, corners, their accuracy, the command."""

import csv
import functools
import json

import cv2
import numpy as np
import pytest
from helpers import assert_refused
from hypothesis import given, settings
from hypothesis import strategies as st
from marker_pictures import Sheet, picture, rows_of_sheets
from real_data import published

from psotrack.foreground.markers import MarkerDetector, marker_dictionary
from psotrack.recordings import VideoWriter, probe, read_frames, read_grey

COLUMNS = ["id", "x0_px", "y0_px", "x1_px", "y1_px", "x2_px", "y2_px", "x3_px", "y3_px", "std_px"]


def opencv_markers(gray, dictionary, refinement):
    """Ids and corners by OpenCV's detector with its defaults."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    detector = cv2.aruco.ArucoDetector(marker_dictionary(dictionary), parameters)
    quads, ids, _ = detector.detectMarkers(gray)
    if ids is None:
        return []
    corners_px = [quad[0] for quad in quads]
    return list(zip(ids.ravel().tolist(), corners_px, strict=True))


def is_among(found, marker, quad):
    """Whether a marker was found at this place."""
    diagonal_px = np.linalg.norm(quad[0] - quad[2])
    off_px = np.linalg.norm(found.corners_px.mean(axis=1) - quad.mean(axis=0), axis=-1)
    is_it = (found.ids == marker) & (off_px < 0.2 * diagonal_px)
    return is_it.any()


def overlooked(gray, dictionary, found, smallest_cell_px=0.0):
    """Markers of OpenCV's, with cells of this size or larger, that are not among the found ones."""
    missing = []
    cells = marker_dictionary(dictionary).markerSize + 2
    for refinement in (cv2.aruco.CORNER_REFINE_NONE, cv2.aruco.CORNER_REFINE_SUBPIX):
        for marker, quad in opencv_markers(gray, dictionary, refinement):
            shortest_px = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=-1).min()
            if shortest_px >= smallest_cell_px * cells and not is_among(found, marker, quad):
                missing.append(marker)
    return missing


def wrong_ones(found, sheets):
    """Ids of found markers that are not at the places of the sheets."""
    wrong = []
    for marker, quad in zip(found.ids.tolist(), found.corners_px, strict=True):
        there = [sheet for sheet in sheets if sheet.marker == marker]
        off_px = [np.linalg.norm(sheet.corners_px - quad, axis=-1).max() for sheet in there]
        if not any(off < 0.2 * sheet.side_px + 2 for sheet, off in zip(there, off_px, strict=True)):
            wrong.append(marker)
    return wrong


def errors_and_std(gray, sheets):
    """Errors of the corners of found sheets, (sheets, 4, 2), and their standard deviations, pixels."""
    found = MarkerDetector("4x4_50").detect(gray)
    true_px = {sheet.marker: sheet.corners_px for sheet in sheets}
    errors_px = [
        quad - true_px[marker] for marker, quad in zip(found.ids.tolist(), found.corners_px, strict=True)
    ]
    return np.array(errors_px), found.std_px


@settings(max_examples=10)
@given(
    seed=st.integers(0, 10**6),
    dictionary=st.sampled_from(["4x4_50", "5x5_100", "6x6_250", "apriltag_36h11"]),
    inverted=st.booleans(),
    shaded=st.booleans(),
    blur_px=st.sampled_from([0.4, 0.9, 1.6]),
    noise=st.sampled_from([0.0, 3.0, 9.0]),
)
def test_what_opencv_finds_is_found_and_nothing_wrong(seed, dictionary, **shown):
    size_wh = (400, 300)
    sheets = rows_of_sheets(np.random.default_rng(seed), 12, size_wh, (14, 44))
    gray = picture(sheets, size_wh, dictionary, seed=seed, **shown)
    for thorough in (False, True):
        found = MarkerDetector(dictionary, thorough=thorough).detect(gray)
        assert overlooked(gray, dictionary, found) == []
        assert wrong_ones(found, sheets) == []


@pytest.mark.parametrize("inverted", [False, True])
def test_markers_of_15_pixels_and_more_are_found(inverted):
    """OpenCV finds no marker with sides below 0.75 % of the longer side, which are 9.6 pixels here, and no inverted."""
    size_wh = (1280, 720)
    sheets = rows_of_sheets(np.random.default_rng(3), 50, size_wh, (15, 40), tilt=0.3)
    gray = picture(sheets, size_wh, inverted=inverted, blur_px=0.6)
    found = MarkerDetector("4x4_50", thorough=True).detect(gray)
    assert wrong_ones(found, sheets) == []
    # Measured 50 and 50.
    assert len(found) >= len(sheets) - 1


def test_a_photograph_of_24_megapixels():
    """A marker that fills most of the picture, blurred over tens of pixels, beside some of 15 to 60 pixels."""
    scale = 12
    coarse = Sheet(7, (325.0, 500 / 3), 2500 / scale, turn=0.15, tilt=0.2)
    small = picture([coarse], (500, 333), noise=0.0)
    gray = cv2.resize(small, (6000, 4000), interpolation=cv2.INTER_CUBIC)
    others = rows_of_sheets(np.random.default_rng(1), 9, (640, 480), (15, 60), tilt=0.3)
    others = [sheet for sheet in others if sheet.marker != 7]
    gray[100:580, 100:740] = picture(others, (640, 480))
    found = MarkerDetector("4x4_50", thorough=True).detect(gray)
    assert overlooked(gray, "4x4_50", found) == []
    assert set(found.ids.tolist()) == {7, *(sheet.marker for sheet in others)}
    large = found.corners_px[found.ids.tolist().index(7)]
    true = (coarse.corners_px + 0.5) * [6000 / 500, 4000 / 333] - 0.5
    # Found: a blurred edge between two samples counted as sharp, and the corner was off by 12 pixels.
    off_px = np.linalg.norm(large - true, axis=-1)
    assert off_px.max() < 0.3 * scale


@pytest.mark.parametrize(
    ("changes", "sheets", "limit_px"),
    [
        # Limits of the root mean square error along an axis; measured 0.03, 0.08, 0.12.
        ({}, {}, 0.06),
        ({"noise": 8.0}, {}, 0.16),
        # Straight lines through these edges miss the corners by 0.6 and more.
        ({}, {"bow": 0.08, "tilt": 0.8}, 0.35),
    ],
    ids=["sharp", "noisy", "bent"],
)
def test_standard_deviations_of_corners_are_honest(changes, sheets, limit_px):
    """The squared errors in units of their variances have a mean near 1; far below it, the deviations say too much."""
    size_wh = (900, 700)
    mean_squares, std_px = [], []
    for seed in range(2):
        shown = rows_of_sheets(np.random.default_rng(seed), 12, size_wh, (40, 95), **sheets)
        gray = picture(shown, size_wh, seed=seed, **changes)
        errors_px, own_std_px = errors_and_std(gray, shown)
        mean_squares.extend((errors_px**2).mean(axis=(1, 2)))
        std_px.extend(own_std_px)
    mean_squares = np.array(mean_squares)
    squares = mean_squares / np.square(std_px)
    assert len(squares) >= 18
    assert np.sqrt(mean_squares.mean()) < limit_px
    assert 0.05 < squares.mean() < 2.0
    # Three standard deviations in the mean over a marker's corners.
    assert np.mean(squares < 9) > 0.95


def test_blur_by_motion_moves_no_corner_far():
    """Found: edges into which blur had mixed other cells counted as bent, which moved corners by up to 2.9 pixels."""
    off_px = []
    for seed in range(2):
        shown = rows_of_sheets(np.random.default_rng(11020 + seed), 24, (800, 600), (28, 50), tilt=0.6)
        sharp = picture(shown, (800, 600), noise=0.0, seed=seed)
        light = cv2.blur((sharp / 255) ** 2.2, (7, 1))
        noise = np.random.default_rng(seed).normal(0, 2, light.shape)
        levels = np.round(255 * light ** (1 / 2.2) + noise)
        gray = np.clip(levels, 0, 255).astype(np.uint8)
        errors_px, _ = errors_and_std(gray, shown)
        off_px.extend(np.linalg.norm(errors_px, axis=-1))
    # Measured 1.2 in the worst of 36 markers.
    assert len(off_px) >= 34
    assert np.max(off_px) < 1.5


def assert_none_of(dictionaries, gray):
    for dictionary in dictionaries:
        found = MarkerDetector(dictionary, thorough=True).detect(gray)
        assert len(found) == 0, dictionary


def test_noise_and_markers_of_another_dictionary_are_no_markers():
    for seed in range(3):
        assert_none_of(["4x4_1000", "aruco_original"], picture([], (640, 480), noise=6.0, seed=seed))
    sheets = rows_of_sheets(np.random.default_rng(5), 12, (900, 700), (40, 95))
    gray = picture(sheets, (900, 700), "6x6_250")
    assert_none_of(["4x4_50", "5x5_100", "apriltag_36h11"], gray)


def test_the_middle_of_a_marker_of_more_cells_is_no_marker():
    """The middles of 6 x 6 cells on marker 3 of 8 x 8 cells look like a marker of 4x4_50, seen straight from ahead."""
    sheets = []
    for number, name in enumerate([0, 1, 2, 3, 5, 6, 15, 17, 19, 33]):
        row, column = divmod(number, 5)
        sheets.append(Sheet(name, (70.0 + 110 * column, 70.0 + 110 * row), 74.0))
    gray = picture(sheets, (600, 300), "6x6_250", blur_px=0.5, seed=2)
    assert_none_of(["4x4_50", "4x4_1000", "aruco_original"], gray)


def test_half_a_marker_is_no_marker():
    """What the four borders of an image leave of a marker. Found: the right half of 52 was read as 660."""
    half = picture([Sheet(52, (0.5, 80.0), 80.0)], (200, 160), "4x4_1000")
    for turns in range(4):
        gray = np.rot90(half, turns)
        assert_none_of(["4x4_1000"], np.ascontiguousarray(gray))
        assert_none_of(["4x4_1000"], np.ascontiguousarray(gray[:, ::-1]))


# --- the command


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def detect(run_psotrack):
    return functools.partial(run_psotrack, "onboard", "detect")


def test_the_table_of_photographs(detect, tmp_path):
    """In grey and in colour, of a sensor of 12 bits, and in the negative."""
    sheets = [
        Sheet(7, (150.2, 120.4), 90.0, 0.3),
        Sheet(21, (330.1, 200.7), 70.0, 1.2, 0.5),
        Sheet(7, (120.3, 270.2), 60.0, 0.8),
    ]
    gray = picture(sheets)
    images = {
        "grey.png": gray,
        "colour.jpg": cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR),
        "deep.png": gray.astype(np.uint16) * 16,
        "inverted.png": 255 - gray,
    }
    folder, out = tmp_path / "photographs", tmp_path / "markers.csv"
    folder.mkdir()
    for name, image in images.items():
        cv2.imwrite(str(folder / name), image)
    # Only the parts that an image needs decide: a text of three bytes without its checksum, after the header.
    whole = (folder / "grey.png").read_bytes()
    damaged_text = (3).to_bytes(4) + b"tEXta\0b" + bytes(4)
    (folder / "grey.png").write_bytes(whole[:33] + damaged_text + whole[33:])
    said = detect(folder, "--dictionary", "4x4_50", "--out", out, "--json", tmp_path / "markers.json")
    assert f"{out}: 12 markers in 4 of 4 images" in said.out
    rows = table(out)
    assert list(rows[0]) == ["image", *COLUMNS]
    for name in images:
        ids = [row["id"] for row in rows if row["image"] == name]
        assert sorted(ids) == ["21", "7", "7"]
    for row in rows:
        corners = np.array([float(row[name]) for name in COLUMNS[1:-1]]).reshape(4, 2)
        off_px = [np.linalg.norm(sheet.corners_px - corners, axis=-1).max() for sheet in sheets]
        # Measured 0.42 in the negative, whose blurred edges have the levels of no camera, and 0.1 in the others.
        limit_px = 0.6 if row["image"] == "inverted.png" else 0.2
        assert min(off_px) < limit_px
        assert 0.01 < float(row["std_px"]) < 0.5
    content = json.loads((tmp_path / "markers.json").read_text())
    assert (content["images"], content["markers"], content["by_id"]) == (4, 12, {"7": 8, "21": 4})
    # Single images, and images of one name.
    detect(folder / "grey.png", folder / "deep.png", "--out", out, "--force")
    assert {row["image"] for row in table(out)} == {"grey.png", "deep.png"}
    again = tmp_path / "grey.png"
    again.write_bytes((folder / "grey.png").read_bytes())
    detect(folder / "grey.png", again, "--out", out, "--force")
    assert {row["image"] for row in table(out)} == {str(folder / "grey.png"), str(again)}


def test_the_table_of_a_video(detect, tmp_path):
    sheet = Sheet(7, (150.0, 120.0), 90.0, 0.3)
    video, out = tmp_path / "video.avi", tmp_path / "markers.csv"
    with VideoWriter(video, 25.0, (480, 360)) as writer:
        for sheets in ([sheet], [sheet], [], [sheet]):
            gray = picture(sheets)
            writer.write(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR))
    assert "3 markers in 3 of 4 frames" in detect(video, "--out", out).out
    rows = table(out)
    assert list(rows[0]) == ["frame", *COLUMNS]
    assert [row["frame"] for row in rows] == ["0", "1", "3"]
    for row in rows:
        assert row["id"] == "7"
        assert abs(float(row["x0_px"]) - sheet.corners_px[0, 0]) < 0.5
    detect(video, "--out", out, "--frames", "2", "--force")
    assert [row["frame"] for row in table(out)] == ["0", "1"]


#: Name of the case -> words of the command, and words of the line.
BAD = {
    "empty folder": (["empty"], "empty: expected images, which end in .png"),
    "dictionary": (["image.png", "--dictionary", "9x9"], "dictionary: expected one of 4x4_100"),
    "image and video": (["image.png", "video.avi"], "found another file; a video needs a call of its own"),
    "frames of an image": (["image.png", "--frames", "3"], "--frames: expected a video, found images"),
    "no video": (["video.avi"], "video.avi: expected a video"),
    # Found: OpenCV's warning, or libpng's, came before the line.
    "damaged": (["damaged.png"], "damaged.png: expected an image, found a PNG that is cut short or damaged"),
}


@pytest.mark.parametrize("case", BAD)
def test_unusable_input_is_one_line(case, detect, tmp_path, monkeypatch):
    command, words = BAD[case]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "video.avi").write_text("no video")
    cv2.imwrite(str(tmp_path / "image.png"), picture([]))
    whole = (tmp_path / "image.png").read_bytes()
    (tmp_path / "damaged.png").write_bytes(whole[:5000] + bytes(40) + whole[5040:])
    assert_refused(functools.partial(detect, *command, "--out", "new.csv"), words, unchanged=tmp_path)


# --- photographs of other people


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "pattern", "dictionary"),
    [
        ("UbiquityRobotics/fiducials", "**/*.jpg", "5x5_1000"),
        ("duckietown/lib-dt-apriltags", "**/*.png", "apriltag_36h11"),
        ("AprilRobotics/apriltag", "**/*.jpg", "apriltag_36h11"),
        ("abakisita/camera_calibration", "**/*.jpg", "6x6_250"),
        ("Ashrafhij/TelloAI-V.0.1", "part_A/image*.jpg", "4x4_50"),
    ],
)
def test_what_opencv_finds_in_photographs_is_found(name, pattern, dictionary):
    paths = sorted(published(name).glob(pattern))
    assert paths
    for path in paths:
        gray = read_grey(path)
        for thorough in (False, True):
            found = MarkerDetector(dictionary, thorough=thorough).detect(gray)
            # Of cells of a pixel, the samples of OpenCV's defaults are right by chance, as others are.
            assert overlooked(gray, dictionary, found, smallest_cell_px=1.5) == [], path.name


@pytest.mark.real
@pytest.mark.slow
def test_inverted_boards_in_videos():
    """In the negative, OpenCV finds the markers of these boards, of 15 to 60 pixels."""
    folder = published("mprib/caliscope") / "tests/sessions/charuco_calibration"
    detector = MarkerDetector("4x4_50", thorough=True)
    for path in sorted(folder.glob("**/*.mp4")):
        for number, frame in enumerate(read_frames(probe(path))):
            if number in (0, 32, 64):
                gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
                found = detector.detect(gray)
                for marker, quad in opencv_markers(255 - gray, "4x4_50", cv2.aruco.CORNER_REFINE_NONE):
                    assert is_among(found, marker, quad), (path.name, number)


@pytest.mark.real
@pytest.mark.slow
def test_no_marker_is_found_in_photographs_of_unknown_markers():
    folder = published("QAlexBall/opencv_contrib") / "modules/aruco/tutorials"
    for path in sorted(folder.glob("**/*original.png")):
        gray = read_grey(path)
        assert_none_of(["4x4_50", "5x5_1000", "6x6_250", "7x7_1000", "apriltag_36h11"], gray)
