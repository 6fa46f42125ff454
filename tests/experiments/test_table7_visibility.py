"""Visible markers, compared with markers placed by hand and with OpenCV's projection."""

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import LENSES
from scipy.spatial.transform import Rotation

from psotrack.geometry import make_camera
from psotrack.inside_out import MarkerMap

sys.path.append(str(Path(__file__).parents[2] / "experiments" / "table7"))
from _visibility import visible_markers

#: A camera at the origin (x to the right, y down, z ahead); a metre at 1 m is 100 px in an image of 201 x 101.
LENS = make_camera(
    R=np.eye(3),
    t_m=np.zeros(3),
    K=np.array([[100.0, 0, 100], [0, 100, 50], [0, 0, 1]]),
    image_size_wh=(201, 101),
)
ORIGIN, AHEAD = np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]])


def square_m(middle, side_m=0.2, turn_deg=0.0):
    """A marker that faces the camera, turned about the vertical axis through its middle."""
    corners = side_m / 2 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    return Rotation.from_euler("y", turn_deg, degrees=True).apply(corners) + middle


def visible(*markers, position_m=ORIGIN, wxyz=AHEAD, **options):
    marker_map = MarkerMap({10 * number: corners for number, corners in enumerate(markers)})
    return visible_markers(marker_map, LENS, position_m, wxyz, **options)


@pytest.mark.parametrize(
    ("corners", "expected"),
    [
        (square_m([0, 0, 1]), True),
        (square_m([0, 0, -1], turn_deg=180), False),  # Behind the camera, though it faces the camera.
        (square_m([0, 0, 1], turn_deg=180), False),  # Seen from the back.
        (square_m([0, 0, 1], turn_deg=-45), True),
        (square_m([1.2, 0, 1]), False),  # To the right of the image.
        # The right edge is at 100 + 100 (0.904 + 0.1) = 200.4 px; the image ends at 200.5 px.
        (square_m([0.904, 0, 1]), True),
        (square_m([0.906, 0, 1]), False),
        (square_m([0, -0.404, 1]), True),  # The upper edge is at -0.4 px.
        (square_m([0, -0.406, 1]), False),
        (square_m([0, 0, 1.65]), True),  # 20 / 1.65 = 12.1 px.
        (square_m([0, 0, 1.7]), False),  # 11.8 px.
        (square_m([0, 0, 1], turn_deg=70), False),  # 7 px wide, and 20 px high.
    ],
)
def test_markers_placed_by_hand(corners, expected):
    assert visible(corners).tolist() == [[expected]]


def test_the_smallest_side_can_be_chosen():
    assert visible(square_m([0, 0, 1.7]), min_side_px=11.0).tolist() == [[True]]


def test_visibility_does_not_depend_on_the_worlds_axes():
    """The world is turned, markers and camera together; in the second frame there is no pose."""
    markers = [square_m([0, 0, 1]), square_m([0.906, 0, 1]), square_m([-0.3, 0.1, 1.2])]
    turn, shift_m = Rotation.from_rotvec([0.3, -2.0, 1.1]), np.array([4.0, -7.0, 2.0])
    moved = [turn.apply(corners) + shift_m for corners in markers]
    found = visible(
        *moved,
        position_m=np.array([shift_m, shift_m, [np.nan] * 3]),
        wxyz=np.array([turn.as_quat(scalar_first=True), [np.nan] * 4, [1.0, 0, 0, 0]]),
    )
    assert found.tolist() == [[True, False, True], [False] * 3, [False] * 3]
    assert not visible(*moved, position_m=np.full((2, 3), np.nan), wxyz=np.full((2, 4), np.nan)).any()


def test_a_lens_with_distortion():
    """Markers at all distances from the axis are visible where OpenCV projects all corners into the image."""
    lens = replace(LENS, dist=np.array(LENSES[4]))
    middles = [[x, y, 1.0] for x in np.linspace(-1.2, 1.2, 25) for y in (-0.3, 0.0, 0.42)]
    marker_map = MarkerMap({number: square_m(middle) for number, middle in enumerate(middles)})
    found = visible_markers(marker_map, lens, ORIGIN, AHEAD)[0]
    pixels = cv2.projectPoints(
        marker_map.all_corners_m.reshape(-1, 3), np.zeros(3), np.zeros(3), lens.K, lens.dist
    )[0]
    pixels = pixels.reshape(-1, 4, 2)
    inside = ((pixels >= -0.5) & (pixels <= [200.5, 100.5])).all(axis=(1, 2))
    np.testing.assert_array_equal(found, inside)
    assert 0 < inside.sum() < len(inside)
