"""Maps of markers: tables, squares fitted to measured corners, maps from videos, and faults of maps."""

import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.errors import InputError, SettingsError
from psotrack.foreground.markers import DetectedMarkers
from psotrack.geometry import look_at, make_camera, project
from psotrack.inside_out import (
    MarkerMap,
    build_map,
    check_map,
    corners_in_own_frame,
    fit_squares,
    read_marker_map,
    read_measured_corners,
)
from psotrack.inside_out.mapping.sightings import collect_sightings, outward
from psotrack.inside_out.marker_map import SQUARE, fit_square
from psotrack.recordings.datasets import read_marker_corners, write_marker_corners
from psotrack.recordings.mocap import Markers, write_c3d

SIDE_M = 0.4


def on_wall(centre_m, inward, side_m=SIDE_M):
    """Corners (4, 3) of an upright marker on a wall, metres."""
    front = np.array(inward, float)
    up = np.array([0.0, 0.0, 1.0])
    return np.array(centre_m, float) + side_m * SQUARE @ np.stack([np.cross(up, front), up, front])


def room():
    """Four markers on each wall of a room of 8 x 6 m, at changing heights; ids from 1."""
    walls = [((0, 3), (0, -1, 0)), ((4, 0), (-1, 0, 0)), ((0, -3), (0, 1, 0)), ((-4, 0), (1, 0, 0))]
    corners, marker = {}, 1
    for (x, y), inward in walls:
        for index, along in enumerate((-2.1, -0.7, 0.8, 2.2)):
            centre = (x + along * abs(inward[1]), y + along * abs(inward[0]), 1.2 + 0.5 * (index % 3))
            corners[marker] = on_wall(centre, inward)
            marker += 1
    return corners


ROOM = room()
LENSES = (
    make_camera(
        R=np.eye(3),
        t_m=np.zeros(3),
        K=np.array([[560.0, 0.0, 640.0], [0.0, 563.0, 478.0], [0.0, 0.0, 1.0]]),
        image_size_wh=(1280, 960),
    ),
    make_camera(
        R=np.eye(3),
        t_m=np.zeros(3),
        K=np.array([[520.0, 0.0, 650.0], [0.0, 520.0, 470.0], [0.0, 0.0, 1.0]]),
        dist=(-0.08, 0.015, 0.001, -0.0005),
        image_size_wh=(1280, 960),
    ),
)


def found_markers(ids, corners_px):
    """Detected markers, (markers, 4, 2), pixels."""
    return DetectedMarkers(
        np.array(ids, int), np.array(corners_px).reshape(-1, 4, 2), np.full(len(ids), np.nan)
    )


def simulate_frames(corners_m, lens, source, num_views, *, noise_px=0.0, seed=0):
    """Frames of a camera that is carried through a room and turns around more than once, with the visible markers."""
    rng = np.random.default_rng(seed)
    frames = []
    for view in range(num_views):
        turn = 2.3 * np.pi * view / num_views + source
        away = np.array([-1.8 * np.cos(turn), -1.2 * np.sin(turn), 1.5])
        centre = away + 0.4 * np.array([np.cos(5 * turn), np.sin(4 * turn), np.sin(3 * turn)])
        ahead = np.array([np.cos(turn), np.sin(turn), 0.15 * np.sin(3 * turn)])
        R, t_m = look_at(centre.tolist(), (centre + ahead).tolist())
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, t_m
        ids, quads = [], []
        for marker, corners in corners_m.items():
            pixels, depth = project(replace(lens, T_cam_world=T), corners)
            normal = np.cross(corners[3] - corners[1], corners[2] - corners[0])
            faces = normal @ (centre - corners.mean(axis=0)) > 0
            inside = ((pixels > 0) & (pixels < lens.image_size_wh - 1)).all()
            # The polynomial of the distortion folds back far outside the image.
            if (
                faces
                and inside
                and (depth > 0.3).all()
                and (np.abs((corners @ R.T + t_m)[:, :2]) < 1.2 * depth[:, None]).all()
            ):
                ids.append(marker)
                quads.append(pixels + noise_px * rng.standard_normal((4, 2)))
        frames.append((source, view / 5, found_markers(ids, quads)))
    return frames


def sightings(corners_m=ROOM, num_views=28, videos=1, **options):
    frames = [
        frame
        for source in range(videos)
        for frame in simulate_frames(corners_m, LENSES[source], source, num_views, **options)
    ]
    return collect_sightings(frames, LENSES[:videos])


def errors_m(built, truth=ROOM):
    """Distances of corners from their true positions, metres: (markers, 4)."""
    ids = built.ids.tolist()
    return np.linalg.norm(
        built.marker_map.all_corners_m - np.array([truth[marker] for marker in ids]), axis=-1
    )


# Tables

NAMES = ("tl", "tr", "br", "bl")


def wide_table(header, *, scale=1.0, separator=";"):
    lines = [separator.join(header)] if header else []
    for marker, corners in ROOM.items():
        lines.append(
            separator.join([str(marker), *(repr(float(scale * value)) for value in corners.ravel())])
        )
    return "\n".join(lines) + "\n"


def column_names(pattern, corners="1234"):
    return ["id", *(pattern.format(axis=axis, corner=corner) for corner in corners for axis in "xyz")]


def long_table(header, corner_names, *, scale=1.0, separator=","):
    lines = [separator.join(header)] if header else []
    for marker, corners in ROOM.items():
        for name, corner in zip(corner_names, corners, strict=True):
            lines.append(
                separator.join([str(marker), name, *(repr(float(scale * value)) for value in corner)])
            )
    return "\n".join(lines) + "\n"


LAYOUTS = {
    "ours": wide_table(column_names("{axis}{corner}[m]")),
    "millimetres": wide_table(column_names("{axis}{corner}[mm]"), scale=1e3),
    "centimetres": wide_table(column_names("{axis}{corner} (cm)"), scale=1e2),
    "commas": wide_table(column_names("{axis}_{corner}"), separator=","),
    "tabs": wide_table(column_names("corner{corner}_{axis}_mm"), scale=1e3, separator="\t"),
    "from 0": wide_table(column_names("p{corner}.{axis} [m]", "0123")),
    "corner names": wide_table(["Marker ID", *column_names("{corner}_{axis}", NAMES)[1:]], separator=","),
    "numbers alone": wide_table(None, separator=","),
    "long": long_table(["id", "corner", "x_m", "y_m", "z_m"], "1234"),
    "long from 0": long_table(
        ["marker", "corner_id", "X [mm]", "Y [mm]", "Z [mm]"], "0123", scale=1e3, separator=";"
    ),
    "long with names": long_table(
        ["aruco_id", "corner", "x", "y", "z"], ["Top-left", "TR", "bottom right", "bl"]
    ),
    "long numbers": long_table(None, "1234", separator=";"),
    "a spreadsheet's": "\ufeff" + wide_table(column_names("{axis}{corner}[m]")).replace("\n", ";\r\n"),
    "words in ids": wide_table(column_names("{axis}{corner}[m]")).replace("\n", "\nMarker_")[
        : -len("Marker_")
    ],
}


@pytest.mark.parametrize("text", LAYOUTS.values(), ids=LAYOUTS)
def test_layouts_of_tables(tmp_path, text):
    path = tmp_path / "corners.csv"
    path.write_bytes(text.encode())
    found = read_marker_map(path)
    assert set(found.corners_m) == set(ROOM)
    for marker, corners in ROOM.items():
        # Millimetres are divided by 1000, with rounding in the last digits.
        np.testing.assert_allclose(found.corners_m[marker], corners, atol=1e-12)
        np.testing.assert_array_equal(read_marker_corners(path)[marker], found.corners_m[marker])


def test_other_columns_are_ignored(tmp_path):
    path = tmp_path / "corners.csv"
    lines = wide_table(column_names("{axis}{corner}[m]")).splitlines()
    path.write_text("\n".join([f"{lines[0]};wall;size", *(f"{line};north;0.3" for line in lines[1:])]))
    assert len(read_marker_map(path)) == len(ROOM)


def test_a_table_may_state_a_standard_deviation_of_each_marker(tmp_path):
    path, std_m = tmp_path / "corners.csv", {marker: 0.001 * marker for marker in ROOM}
    write_marker_corners(path, ROOM, std_m)
    assert path.read_text().splitlines()[0].endswith(";std_m")
    found = read_marker_map(path)
    assert found.std_m == pytest.approx(std_m)
    assert found.std_of([7, 99, 3]).tolist() == pytest.approx([0.007, 0.0, 0.003])
    write_marker_corners(path, ROOM)
    assert read_marker_map(path).std_of([7, 3]).tolist() == [0, 0]
    path.write_text(
        path.read_text().replace("z4[m]", "z4[m];std_m").replace("\n", ";2\n").replace("std_m;2", "std[mm]")
    )
    assert read_marker_map(path).std_m[7] == pytest.approx(0.002)
    path.write_text(path.read_text().replace(";2\n", ";-2\n"))
    with pytest.raises(
        InputError, match=r"line 2, column std\[mm\]: expected a standard deviation of 0 or more"
    ):
        read_marker_map(path)


def test_a_map_has_sides_centres_and_normals():
    found = MarkerMap(ROOM)
    np.testing.assert_array_equal(found.ids, np.arange(1, 17))
    np.testing.assert_allclose(found.sides_m, SIDE_M, rtol=1e-12)
    np.testing.assert_allclose(found.normals[4], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(found.centres_m[0], [-2.1, 3, 1.2], atol=1e-12)
    np.testing.assert_array_equal(found.corners_of([7, 3])[1], ROOM[3])
    assert 7 in found
    assert 17 not in found
    with pytest.raises(InputError, match=r"marker 5: expected finite corners"):
        MarkerMap({5: np.full((4, 3), np.nan)})
    with pytest.raises(InputError, match="at least one marker"):
        MarkerMap({})


def with_corners(marker, corners):
    return {**ROOM, marker: corners}


def with_bent_corner(distance_m, axis):
    corners = ROOM[3].copy()
    corners[2, axis] += distance_m
    return with_corners(3, corners)


#: Line 4 of the standard layout belongs to marker 3.
BAD_PLACES = {
    "not planar": (
        with_bent_corner(0.05, 1),
        r"line 4, marker 3: expected a flat square.* found corners 25 mm off the nearest square; .* side is 40\d mm",
    ),
    "not square": (
        with_bent_corner(0.06, 0),
        r"line 4, marker 3: expected a flat square.* found corners 4\d mm off",
    ),
    "crossed": (
        with_corners(3, ROOM[3][[0, 1, 3, 2]]),
        r"line 4, marker 3: expected .* corners one after the other .* found corners",
    ),
    "in one place": (
        with_corners(3, ROOM[2] + 0.01),
        r"line 4, marker 3: .* found both markers at the place of marker 2",
    ),
    "one in millimetres": (
        with_corners(3, 1e3 * ROOM[3]),
        r"line 4, marker 3: expected a marker with a side of .* found 400 m; is it in millimetres\? .* x1\[mm\]",
    ),
    "mirrored": (
        {marker: corners * [1.0, -1.0, 1.0] for marker, corners in ROOM.items()},
        r"corners.csv: .* 16 of 16 markers face out of the room, and none into it; .* an axis is mirrored",
    ),
    "all in millimetres": (
        {marker: 1e3 * corners for marker, corners in ROOM.items()},
        r"line 2, marker 1: .* found 400 m; is it in millimetres",
    ),
}


@pytest.mark.parametrize(("corners", "message"), BAD_PLACES.values(), ids=BAD_PLACES)
def test_impossible_markers_are_refused(tmp_path, corners, message):
    path = tmp_path / "corners.csv"
    write_marker_corners(path, corners)
    with pytest.raises(InputError, match=message):
        read_marker_map(path)


STANDARD, LONG = LAYOUTS["ours"], LAYOUTS["long"]
THIRD = STANDARD.splitlines()[3]
BAD_TEXTS = {
    "an empty cell": (
        STANDARD.replace(THIRD, ";".join("" if i == 5 else cell for i, cell in enumerate(THIRD.split(";")))),
        r"line 4, column y2\[m\]: expected a value, found nothing",
    ),
    "an empty cell at the end": (
        STANDARD.replace(THIRD, THIRD.rpartition(";")[0] + ";"),
        r"line 4, column z4\[m\]: expected a value, found nothing",
    ),
    "three corners": (
        STANDARD.replace(THIRD, ";".join(THIRD.split(";")[:10])),
        r"line 4: expected 13 values, found 10; a marker has four corners",
    ),
    "three corners in a header": (
        "\n".join(";".join(line.split(";")[:10]) for line in STANDARD.splitlines()),
        r"corners.csv: expected a column x4, found only",
    ),
    "three corners below each other": (
        LONG.replace(LONG.splitlines()[11] + "\n", ""),
        r"line 10 to 12, marker 3: expected 4 corners, found none of number 3; add it, or leave the marker out",
    ),
    "a marker twice": (
        STANDARD.replace("\n4;", "\n3;"),
        r"line 5, column id: expected each marker once, found 3 again",
    ),
    "a corner twice": (
        LONG.replace("\n3,2,", "\n3,1,"),
        r"line 11, column corner: .* found corner 1 of marker 3 again",
    ),
    "corners from 0 to 4": (
        LONG.replace("\n3,1,", "\n3,0,"),
        r"line 5, column corner: expected a corner, 0 to 3, or tl, .* found '4'",
    ),
    "no number": (
        STANDARD.replace("\n3;", "\nthree;"),
        r"line 4, column id: expected a marker's number, found 'three'",
    ),
    "decimal commas": (
        STANDARD.replace("3.0;", "3,0;"),
        r"column y1\[m\]: expected a number.*; write decimals with a point",
    ),
    "another unit": (STANDARD.replace("x1[m]", "x1[in]"), r"expected a column x1\[m\].* found x1\[in\]"),
    "a column twice": (
        STANDARD.replace("y2[m]", "x_2[m]"),
        r"line 1: expected each column once, found x2\[m\] and x_2\[m\]",
    ),
    "no rows": (STANDARD.splitlines()[0], "expected rows below the header, found none"),
    "nothing": ("\n", "expected a table of marker corners, found an empty file"),
    "other numbers": ("1;2;3;4\n5;6;7;8\n", "line 1: expected a header, or numbers in rows of 13"),
}


@pytest.mark.parametrize(("text", "message"), BAD_TEXTS.values(), ids=BAD_TEXTS)
def test_malformed_tables_are_refused(tmp_path, text, message):
    path = tmp_path / "corners.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_marker_map(path)


def test_a_measured_map_is_accepted(tmp_path):
    """Corners with errors of 2 mm each, as from motion capture, of markers of 0.2 m."""
    rng = np.random.default_rng(0)
    path = tmp_path / "corners.csv"
    corners = {
        marker: on_wall(corners.mean(axis=0), MarkerMap(ROOM).normals[marker - 1], 0.2)
        + 0.002 * rng.standard_normal((4, 3))
        for marker, corners in ROOM.items()
    }
    write_marker_corners(path, corners)
    assert len(read_marker_map(path)) == len(ROOM)


def test_markers_on_the_outside_of_a_box_face_outwards(tmp_path):
    box = {
        index: on_wall(0.3 * np.array(front, float), front)
        for index, front in enumerate([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
    }
    write_marker_corners(tmp_path / "box.csv", box)
    assert len(read_marker_map(tmp_path / "box.csv")) == 4


# Measured corners


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-9, 9)] * 3), st.floats(0.05, 1.0))
def test_the_square_fitted_to_a_square_is_the_same_square(turn, centre, side_m):
    axes = Rotation.from_rotvec(turn).as_matrix()
    found = fit_square(np.array(centre) + side_m * SQUARE @ axes.T)
    # Double precision, for numbers up to 10.
    np.testing.assert_allclose(found.T_world_marker[:3, :3], axes, atol=1e-11 / side_m)
    np.testing.assert_allclose(found.T_world_marker[:3, 3], centre, atol=1e-11)
    assert found.side_m == pytest.approx(side_m, rel=1e-9)


def test_the_fitted_square_is_nearer_than_other_squares():
    rng = np.random.default_rng(1)
    points = ROOM[5] + 0.005 * rng.standard_normal((4, 3))
    square = fit_square(points)
    axes, centre, side = square.T_world_marker[:3, :3], square.T_world_marker[:3, 3], square.side_m

    def cost(turn, shift, factor):
        turned = axes @ Rotation.from_rotvec(turn).as_matrix()
        return np.sum((centre + shift + side * factor * SQUARE @ turned.T - points) ** 2)

    best = cost(np.zeros(3), np.zeros(3), 1.0)
    for _ in range(200):
        step = 1e-3 * rng.standard_normal(7)
        assert cost(step[:3], step[3:6], 1 + step[6]) > best


def recorded_corners(corners_m, labels="Marker{}:{}", frames=30, noise_m=0.0):
    rng = np.random.default_rng(2)
    names = [labels.format(marker, corner) for marker in corners_m for corner in range(1, 5)]
    position = np.concatenate(list(corners_m.values())) + noise_m * rng.standard_normal(
        (frames, len(names), 3)
    )
    return Markers(
        (*names, "Dron1:Dron12", "*113"),
        np.pad(position, ((0, 0), (0, 2), (0, 0)), constant_values=1.0),
        100.0,
    )


@pytest.mark.parametrize("labels", ["Marker{}:{}", "M{}_{}", "{}.{}", "aruco {}-{}"])
def test_corners_of_a_c3d(tmp_path, labels):
    path = tmp_path / "room.c3d"
    markers = recorded_corners(ROOM, labels, noise_m=0.0005)
    markers.position_m[:11, 3] = np.nan
    # For a few frames, the label is on another point.
    markers.position_m[5:12, 8] += 0.5
    write_c3d(path, markers)
    found = fit_squares(read_measured_corners(path))
    for marker, corners in ROOM.items():
        # Medians of 20 to 30 frames are good to 0.0005 m x 1.25 / sqrt(20) = 0.14 mm; limit five times that.
        np.testing.assert_allclose(found.marker_map.corners_m[marker], corners, atol=7e-4)
        assert found.residual_m[marker].max() < 1e-3


def test_c3d_without_a_corner(tmp_path):
    markers = recorded_corners(ROOM)
    markers.position_m[:, 9] = np.nan
    write_c3d(tmp_path / "room.c3d", markers)
    with pytest.raises(
        InputError, match=r"room.c3d, marker 3: expected 4 corners, found that number 2 is never seen"
    ):
        read_measured_corners(tmp_path / "room.c3d")
    write_c3d(tmp_path / "drones.c3d", Markers(("Dron1:Dron11",), np.ones((5, 1, 3)), 100.0))
    with pytest.raises(InputError, match=r"labels such as Marker7:1.* found Dron1:Dron11"):
        read_measured_corners(tmp_path / "drones.c3d")


def test_measured_corners_without_a_square_are_refused(tmp_path):
    write_marker_corners(tmp_path / "points.csv", with_bent_corner(0.15, 0))
    with pytest.raises(InputError, match=r"line 4, marker 3: expected a flat square"):
        fit_squares(read_measured_corners(tmp_path / "points.csv"))


# Maps from videos


@pytest.mark.parametrize("videos", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_exact_images_give_the_exact_map(videos):
    """Two videos have different lenses; one lens has distortion."""
    built = build_map(sightings(videos=videos), {7: ROOM[7]})
    assert set(built.ids) == set(ROOM)
    assert built.unplaced == ()
    assert errors_m(built).max() < 1e-6
    assert built.outliers.sum() == 0


def test_the_known_marker_stays_and_has_no_uncertainty():
    built = build_map(sightings(noise_px=0.3), {7: ROOM[7], 12: ROOM[12]})
    for marker in (7, 12):
        np.testing.assert_allclose(built.marker_map.corners_m[marker], ROOM[marker], atol=1e-12)
        assert not built.covariance[built.ids.tolist().index(marker)].any()
    assert built.known.sum() == 2
    assert (built.std_m[~built.known] > 0).all()


def test_a_single_known_side_makes_the_axes_of_the_marker_those_of_the_world():
    """The map moves with the known marker: the same images give the same map in another world."""
    given_world = build_map(sightings(noise_px=0.2), {7: ROOM[7]})
    own_world = build_map(sightings(noise_px=0.2), {7: corners_in_own_frame(SIDE_M)})
    known = fit_square(ROOM[7]).T_world_marker
    axes, centre = known[:3, :3], known[:3, 3]
    moved = own_world.marker_map.all_corners_m @ axes.T + centre
    # Both searches end when the relative decrease of the cost is less than 1e-9.
    np.testing.assert_allclose(moved, given_world.marker_map.all_corners_m, atol=1e-5)


@pytest.mark.slow
def test_a_larger_marker_makes_a_larger_room():
    built = build_map(sightings(), {7: corners_in_own_frame(2 * SIDE_M)})
    np.testing.assert_allclose(built.marker_map.sides_m, 2 * SIDE_M, rtol=1e-12)
    distance = np.linalg.norm(built.marker_map.centres_m[0] - built.marker_map.centres_m[8])
    # The tolerance is the accuracy of the map.
    assert distance == pytest.approx(
        2 * np.linalg.norm(ROOM[1].mean(axis=0) - ROOM[9].mean(axis=0)), abs=1e-5
    )


@pytest.mark.slow
def test_different_sides_are_estimated():
    normals = MarkerMap(ROOM).normals
    sizes = {marker: 0.2 + 0.02 * marker for marker in ROOM}
    truth = {
        marker: on_wall(ROOM[marker].mean(axis=0), normals[marker - 1], sizes[marker]) for marker in ROOM
    }
    built = build_map(sightings(truth), {7: truth[7]}, estimate_sides=True)
    assert errors_m(built, truth).max() < 1e-6


def test_an_inset_of_corners_is_estimated():
    """The detector finds corners too far inside. Without an inset, squares that seem too small enlarge the room."""
    exact = sightings(videos=2)
    inset_px = np.array([0.3, 0.15])[exact.lens[exact.view]][:, None, None]
    found = replace(exact, corners_px=exact.corners_px - inset_px * outward(exact))
    built = build_map(found, {7: ROOM[7]})
    # Most of the inset is found, because the prior expects a smaller inset. The covariance contains the rest.
    assert (np.abs(built.inset_px - [0.2, 0.1]) < 0.05).all()
    off_m = np.linalg.norm(built.marker_map.centres_m - MarkerMap(ROOM).centres_m, axis=1)[~built.known]
    assert (off_m < 3 * np.linalg.norm(built.std_m[~built.known], axis=1)).all()


def test_sightings_with_wrong_ids_are_left_out():
    right = sightings(noise_px=0.2, num_views=40)
    rng = np.random.default_rng(3)
    wrong = rng.random(len(right.view)) < 0.04
    marker = np.where(wrong, rng.integers(1, 17, len(wrong)), right.marker)
    # Ids that occur twice in a view are left out when sightings are collected.
    frames = [
        (
            0,
            float(right.time_s[view]),
            found_markers(marker[right.view == view], right.corners_px[right.view == view]),
        )
        for view in range(right.num_views)
    ]
    built = build_map(collect_sightings(frames, LENSES[:1]), {7: ROOM[7]})
    clean = build_map(right, {7: ROOM[7]})
    assert set(built.ids) == set(ROOM)
    assert 0 < built.outliers.sum() <= wrong.sum() + 2
    # The map is as good as without wrong ids, except for the missing sightings.
    assert errors_m(built).max() < 1.5 * errors_m(clean).max()


def test_markers_without_a_connection_are_not_placed():
    unconnected = 0, 99.0, found_markers([40], [[[10.0, 10], [50, 10], [50, 50], [10, 50]]])
    found = collect_sightings([*simulate_frames(ROOM, LENSES[0], 0, 20), unconnected], LENSES[:1])
    built = build_map(found, {7: ROOM[7]})
    assert built.unplaced == (40,)
    assert 40 not in built.marker_map


def test_unusable_known_markers():
    with pytest.raises(InputError, match=r"expected the known marker 77 beside others, found only 1, 2, 3"):
        build_map(sightings(), {77: ROOM[7]})
    alone = sightings({7: ROOM[7]})
    with pytest.raises(InputError, match="found others beside it in no frame; name another one by --known"):
        build_map(alone, {7: ROOM[7]})
    with pytest.raises(SettingsError, match="side_m: expected a number above 0"):
        corners_in_own_frame(0.0)
    with pytest.raises(InputError, match="expected frames that show markers, found none in any frame"):
        collect_sightings([(0, 0.0, found_markers([], []))], LENSES[:1])


@pytest.mark.slow
@pytest.mark.parametrize("noise_px", [0.1, 0.3])
def test_the_stated_standard_deviation_agrees_with_the_errors_of_corners(noise_px):
    """The truth lies within the 90 % sphere about a corner at least as often; insets make it wider than white noise."""
    inside = []
    for seed in range(6):
        built = build_map(
            with_insets(sightings(noise_px=noise_px, num_views=30, seed=seed), seed), {7: ROOM[7]}
        )
        std_m = built.marker_map.std_of(built.ids.tolist())
        assert std_m[built.known] == 0
        inside += (errors_m(built) / np.maximum(std_m, 1e-9)[:, None] < np.sqrt(chi2.ppf(0.9, 3)))[
            ~built.known
        ].tolist()
    assert np.mean(inside) > 0.85


@pytest.mark.slow
def test_the_covariance_agrees_with_the_errors():
    """Noise is independent in every frame: normalised squared errors of the centres average 3 over repeated draws."""
    normalised = []
    for seed in range(12):
        built = build_map(sightings(noise_px=0.3, num_views=50, seed=seed), {7: ROOM[7]})
        off = built.marker_map.centres_m - np.array(
            [ROOM[marker].mean(axis=0) for marker in built.ids.tolist()]
        )
        for error, covariance in zip(off[~built.known], built.covariance[~built.known, :3, :3], strict=True):
            normalised.append(error @ np.linalg.solve(covariance, error))
    # The mean is less than 3, because the covariance allows for errors common to all frames, which these corners do not
    # have. The 15 markers of a room share errors, so 12 rooms have about 60 degrees of freedom: 3 +- 0.5.
    assert 1.2 < np.mean(normalised) < 4.0


def with_insets(seen, seed):
    """Corners of a camera that encodes light by another power than assumed: all sides are found too far inside."""
    rng = np.random.default_rng(seed)
    inset_px = 0.05 * rng.normal() + 0.02 * rng.normal(size=max(ROOM) + 1)
    return replace(seen, corners_px=seen.corners_px - inset_px[seen.marker, None, None] * outward(seen))


@pytest.mark.slow
def test_the_covariance_agrees_with_the_errors_of_a_camera_of_another_power():
    """Found: an average of 1.6, because the covariance had whole insets, and the adjustment finds a part of them."""
    normalised = []
    for seed in range(12):
        seen = with_insets(sightings(noise_px=0.1, num_views=50, seed=seed), seed)
        built = build_map(seen, {7: ROOM[7]})
        truth_m = np.array([ROOM[marker].mean(axis=0) for marker in built.ids.tolist()])
        off = (built.marker_map.centres_m - truth_m)[~built.known]
        covariance = built.covariance[~built.known, :3, :3]
        normalised.append((off * np.linalg.solve(covariance, off[..., None])[..., 0]).sum(axis=1))
    # Measured 2.1, less than 3: insets that differ among markers also count as errors that last. The markers of a room
    # share one inset, so 12 rooms have few degrees of freedom.
    assert 1.8 < np.mean(normalised) < 4.0
    assert np.mean(np.concatenate(normalised) < chi2.ppf(0.9, 3)) > 0.85


# Wrong maps


def test_correct_maps_have_no_findings():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        measured = {marker: corners + 0.001 * rng.standard_normal((4, 3)) for marker, corners in ROOM.items()}
        checkup = check_map(sightings(noise_px=0.3, seed=seed), MarkerMap(measured))
        assert checkup.findings == ()
        assert all(count > 5 for count in checkup.sightings.values())


TURN = Rotation.from_rotvec(np.deg2rad(12) * np.array([0.0, 0.0, 1.0])).as_matrix()
MIDDLE = ROOM[9].mean(axis=0)
FAULTS = {
    "moved": (
        {9: ROOM[9] + np.array([0.04, 0.0, -0.03])},
        "moved",
        {9},
        r"marker 9: it is 5\d mm from where the map has it, at \(-2.10., -3.0.., 1.2..\) m|4\d mm",
    ),
    "far away": (
        {9: ROOM[9] + np.array([1.0, 0.0, 0.5])},
        "moved",
        {9},
        r"marker 9: it is 1.12 m from where",
    ),
    "turned": (
        {9: MIDDLE + (ROOM[9] - MIDDLE) @ TURN.T},
        "turned",
        {9},
        r"marker 9: it is turned by 1[123]\.\d degrees",
    ),
    "exchanged": (
        {9: ROOM[14], 14: ROOM[9]},
        "moved",
        {9, 14},
        "marker 9: it is .* m from where the map has it, .*, where the map has marker 14.*; correct its id",
    ),
    "corners from another": (
        {9: np.roll(ROOM[9], 1, axis=0)},
        "turned",
        {9},
        r"marker 9: it is turned by (89|90)\.\d degrees, .*; count its corners clockwise",
    ),
    "corners from the opposite": (
        {9: np.roll(ROOM[9], 2, axis=0)},
        "turned",
        {9},
        r"turned by 1(79|80)\.\d degrees, .*; count its corners clockwise",
    ),
    "corners backwards": (
        {9: ROOM[9][[0, 3, 2, 1]]},
        "turned",
        {9},
        r"turned by 1(79|80)\.\d degrees, .*; count its corners clockwise",
    ),
    "too large": (
        {9: MIDDLE + 1.2 * (ROOM[9] - MIDDLE)},
        "side",
        {9},
        "marker 9: it is (399|400|401) mm wide, not 480 mm",
    ),
}


@pytest.mark.parametrize(("wrong", "kind", "markers", "message"), FAULTS.values(), ids=FAULTS)
def test_a_wrong_marker_is_named(wrong, kind, markers, message):
    checkup = check_map(sightings(noise_px=0.3), MarkerMap({**ROOM, **wrong}))
    assert [(one.kind, one.markers) for one in checkup.findings] == [
        (kind, (one,)) for one in sorted(markers)
    ]
    assert re.search(message, str(checkup.findings[0]))


def test_several_wrong_markers_are_all_named():
    wrong = {2: ROOM[2] + 0.1, 6: np.roll(ROOM[6], -1, axis=0), 11: ROOM[15], 15: ROOM[11]}
    checkup = check_map(sightings(noise_px=0.3), MarkerMap({**ROOM, **wrong}))
    assert {(one.kind, one.markers) for one in checkup.findings} == {
        ("moved", (2,)),
        ("turned", (6,)),
        ("moved", (11,)),
        ("moved", (15,)),
    }


@pytest.fixture(scope="module")
def noisy_sightings():
    return sightings(noise_px=0.3)


@pytest.mark.slow
@given(
    pairs=st.lists(st.sampled_from(list(combinations(ROOM, 2))), min_size=1, max_size=3, unique=True),
    rolls=st.tuples(st.integers(0, 3), st.integers(0, 3)),
    left_out=st.sets(st.sampled_from(list(ROOM)), max_size=4),
)
@settings(max_examples=6)
def test_exchanged_markers_are_findings(noisy_sightings, pairs, rolls, left_out):
    """Also with their corners counted from others, with pairs that share a marker, and in a part of the map."""
    given_m = dict(ROOM)
    for one, other in pairs:
        given_m[one], given_m[other] = (
            np.roll(given_m[marker], roll, axis=0) for marker, roll in zip((other, one), rolls, strict=True)
        )
    kept = {marker: corners for marker, corners in given_m.items() if marker not in left_out}
    checkup = check_map(noisy_sightings, MarkerMap(kept))
    wrong = {marker for marker, corners in kept.items() if not np.array_equal(corners, ROOM[marker])}
    named = {marker for finding in checkup.findings for marker in finding.markers}
    assert named == wrong


def test_a_map_of_another_room_is_one_finding():
    rng = np.random.default_rng(4)
    shuffled = dict(zip(ROOM, [ROOM[marker] for marker in rng.permutation(list(ROOM)).tolist()], strict=True))
    checkup = check_map(sightings(noise_px=0.3), MarkerMap(shuffled))
    assert [one.kind for one in checkup.findings] == ["map"]
    with pytest.raises(InputError, match="expected frames that show two markers of the map, found none"):
        check_map(sightings(), MarkerMap({99: ROOM[1]}))
