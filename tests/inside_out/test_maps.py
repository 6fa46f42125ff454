"""Maps of markers: tables, squares fitted to measured corners, maps from videos and from centres, faults of maps."""

import json
import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from helpers import make_once
from hypothesis import given, settings
from hypothesis import strategies as st
from marker_worlds import (
    DRAWN_LENS,
    PASSING_CAMERA,
    SQUARE,
    any_room,
    column_names,
    fly_past,
    found_markers,
    four_walls,
    long_table,
    make_drawn_flight,
    marker_at,
    posed,
    seen_markers,
    simple_lens,
    wall_markers,
    wide_table,
    write_onboard_sequence,
)
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.geometry import make_rig
from psotrack.geometry.rig_files import write_rig
from psotrack.inside_out import (
    LocaliseSettings,
    MarkerCentres,
    MarkerMap,
    PoseSettings,
    build_map,
    check_map,
    corners_in_own_frame,
    fit_squares,
    read_marker_map,
    read_measured_corners,
)
from psotrack.inside_out.lens_files import scale_lens
from psotrack.inside_out.localising import localise_frames
from psotrack.inside_out.mapping import complete_map
from psotrack.inside_out.mapping.sightings import collect_sightings, outward
from psotrack.inside_out.marker_map import fit_square
from psotrack.recordings.datasets import read_marker_corners, write_marker_corners
from psotrack.recordings.mocap import Markers, write_c3d

SIDE_M = 0.4
ROOM = four_walls()
LENSES = simple_lens(560.0, (1280, 960)), simple_lens(520.0, (1280, 960), (-0.08, 0.015, 0.001, -0.0005))


def walk(source, num_views, noise_px=0.0, seed=0, corners_m=ROOM):
    """Frames of a camera that is carried through a room and turns around more than once, with the visible markers."""
    rng, frames = np.random.default_rng(seed), []
    for view in range(num_views):
        turn = 2.3 * np.pi * view / num_views + source
        away = np.array([-1.8 * np.cos(turn), -1.2 * np.sin(turn), 1.5])
        centre_m = away + 0.4 * np.array([np.cos(5 * turn), np.sin(4 * turn), np.sin(3 * turn)])
        ahead = np.array([np.cos(turn), np.sin(turn), 0.15 * np.sin(3 * turn)])
        camera = posed(LENSES[source], centre_m, centre_m + ahead)
        frames.append((source, view / 5, seen_markers(corners_m, camera, rng, noise_px)))
    return frames


def sightings(num_views=28, videos=1, **options):
    frames = [frame for source in range(videos) for frame in walk(source, num_views, **options)]
    return collect_sightings(frames, LENSES[:videos])


def errors_m(built, truth=ROOM):
    """Distances of corners from their true positions, metres: (markers, 4)."""
    true_m = np.array([truth[marker] for marker in built.ids.tolist()])
    return np.linalg.norm(built.marker_map.all_corners_m - true_m, axis=-1)


# Tables

NAMES = ("tl", "tr", "br", "bl")


OURS = wide_table(ROOM)
LAYOUTS = {
    "ours": OURS,
    "millimetres": wide_table(ROOM, column_names("{axis}{corner}[mm]"), scale=1e3),
    "centimetres": wide_table(ROOM, column_names("{axis}{corner} (cm)"), scale=1e2),
    "commas": wide_table(ROOM, column_names("{axis}_{corner}"), separator=","),
    "tabs": wide_table(ROOM, column_names("corner{corner}_{axis}_mm"), scale=1e3, separator="\t"),
    "from 0": wide_table(ROOM, column_names("p{corner}.{axis} [m]", "0123")),
    "corner names": wide_table(
        ROOM, ["Marker ID", *column_names("{corner}_{axis}", NAMES)[1:]], separator=","
    ),
    "numbers alone": wide_table(ROOM, None, separator=","),
    "long": long_table(ROOM, ["id", "corner", "x_m", "y_m", "z_m"]),
    "long from 0": long_table(
        ROOM, ["marker", "corner_id", *(f"{a} [mm]" for a in "XYZ")], "0123", scale=1e3, separator=";"
    ),
    "long with names": long_table(
        ROOM, ["aruco_id", "corner", *"xyz"], ["Top-left", "TR", "bottom right", "bl"]
    ),
    "long numbers": long_table(ROOM, None, separator=";"),
    "a spreadsheet's": "\ufeff" + OURS.replace("\n", ";\r\n"),
    "words in ids": OURS.replace("\n", "\nMarker_")[: -len("Marker_")],
    "other columns": OURS.replace("\n", ";0.3\n").replace("z4[m];0.3", "z4[m];size"),
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


def test_a_table_may_state_a_standard_deviation_of_each_marker(tmp_path):
    path, std_m = tmp_path / "corners.csv", {marker: 0.001 * marker for marker in ROOM}
    write_marker_corners(path, ROOM, std_m)
    assert path.read_text().splitlines()[0].endswith(";std_m")
    found = read_marker_map(path)
    assert found.std_m == pytest.approx(std_m)
    assert found.std_of([7, 99, 3]).tolist() == pytest.approx([0.007, 0.0, 0.003])
    write_marker_corners(path, ROOM)
    assert read_marker_map(path).std_of([7, 3]).tolist() == [0, 0]
    path.write_text(path.read_text().replace("\n", ";2\n").replace("z4[m];2", "z4[m];std[mm]"))
    assert read_marker_map(path).std_m[7] == pytest.approx(0.002)


def test_a_map_has_sides_centres_and_normals():
    found = MarkerMap(ROOM)
    np.testing.assert_array_equal(found.ids, np.arange(1, 17))
    np.testing.assert_allclose(found.sides_m, SIDE_M, rtol=1e-12)
    np.testing.assert_allclose(found.normals[4], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(found.centres_m[0], [-2.1, 3, 1.2], atol=1e-12)
    np.testing.assert_array_equal(found.corners_of([7, 3])[1], ROOM[3])
    assert 7 in found
    assert 17 not in found


def test_maps_of_real_rooms_are_accepted(tmp_path):
    """Corners with errors of 2 mm each; a box with markers on its outside; and markers that are turned any way."""
    rng, path = np.random.default_rng(0), tmp_path / "corners.csv"
    small = {
        marker: MarkerMap(ROOM).centres_m[marker - 1] + 0.5 * (corners - corners.mean(axis=0))
        for marker, corners in ROOM.items()
    }
    measured = {marker: corners + 0.002 * rng.standard_normal((4, 3)) for marker, corners in small.items()}
    fronts = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
    box = {index: marker_at(0.3 * front, front, side_m=SIDE_M) for index, front in enumerate(fronts)}
    for corners_m in (measured, box, any_room()):
        write_marker_corners(path, corners_m)
        assert len(read_marker_map(path)) == len(corners_m)


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
    for step in 1e-3 * rng.standard_normal((200, 7)):
        assert cost(step[:3], step[3:6], 1 + step[6]) > best


def recorded_corners(labels="Marker{}:{}", noise_m=0.0):
    """The corners of the room, beside a drone and a point without a name, in 30 frames."""
    names = [labels.format(marker, corner) for marker in ROOM for corner in range(1, 5)]
    noise = noise_m * np.random.default_rng(2).standard_normal((30, len(names), 3))
    position_m = np.concatenate(list(ROOM.values())) + noise
    beside = np.pad(position_m, ((0, 0), (0, 2), (0, 0)), constant_values=1.0)
    return Markers((*names, "Dron1:Dron12", "*113"), beside, 100.0)


@pytest.mark.parametrize("labels", ["Marker{}:{}", "M{}_{}", "{}.{}", "aruco {}-{}"])
def test_corners_of_a_c3d(tmp_path, labels):
    markers = recorded_corners(labels, noise_m=0.0005)
    markers.position_m[:11, 3] = np.nan
    # For a few frames, the label is on another point.
    markers.position_m[5:12, 8] += 0.5
    write_c3d(tmp_path / "room.c3d", markers)
    found = fit_squares(read_measured_corners(tmp_path / "room.c3d"))
    for marker, corners in ROOM.items():
        # Medians of 20 to 30 frames are good to 0.0005 m x 1.25 / sqrt(20) = 0.14 mm; limit five times that.
        np.testing.assert_allclose(found.marker_map.corners_m[marker], corners, atol=7e-4)
        assert found.residual_m[marker].max() < 1e-3


# Maps from videos


@pytest.mark.parametrize("videos", [1, 2])
def test_exact_images_give_the_exact_map(videos):
    """Two videos have different lenses, one with distortion, and show markers of different sides."""
    several, truth = videos == 2, dict(ROOM)
    if several:
        for marker, corners in ROOM.items():
            middle = corners.mean(axis=0)
            truth[marker] = middle + (0.5 + 0.05 * marker) * (corners - middle)
    seen = sightings(videos=videos, corners_m=truth)
    built = build_map(seen, {7: truth[7]}, estimate_sides=several)
    assert set(built.ids) == set(ROOM)
    assert built.unplaced == ()
    assert errors_m(built, truth).max() < 1e-6
    assert built.outliers.sum() == 0


def test_known_markers_stay_and_one_that_no_frame_connects_is_not_placed():
    alone = 0, 99.0, found_markers([40], [[[10.0, 10], [50, 10], [50, 50], [10, 50]]])
    seen = collect_sightings([*walk(0, 20, noise_px=0.3), alone], LENSES[:1])
    built = build_map(seen, {7: ROOM[7], 12: ROOM[12]})
    for marker in (7, 12):
        np.testing.assert_allclose(built.marker_map.corners_m[marker], ROOM[marker], atol=1e-12)
        assert not built.covariance[built.ids.tolist().index(marker)].any()
    assert built.known.sum() == 2
    assert (built.std_m[~built.known] > 0).all()
    assert built.unplaced == (40,)
    assert 40 not in built.marker_map


def test_a_single_known_side_makes_the_axes_of_the_marker_those_of_the_world():
    """The map moves with the known marker, and is as large: the same images give the same map in another world."""
    seen = sightings(noise_px=0.2)
    known = fit_square(ROOM[7]).T_world_marker
    axes, centre = known[:3, :3], known[:3, 3]
    given_world = build_map(seen, {7: ROOM[7]}).marker_map.all_corners_m
    own = build_map(seen, {7: corners_in_own_frame(2 * SIDE_M)}).marker_map
    moved = own.all_corners_m / 2 @ axes.T + centre
    # Both searches end when the relative decrease of the cost is less than 1e-9.
    np.testing.assert_allclose(moved, given_world, atol=1e-5)
    np.testing.assert_allclose(own.sides_m, 2 * SIDE_M, rtol=1e-12)


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
    right = sightings(noise_px=0.2)
    rng = np.random.default_rng(3)
    wrong = rng.random(len(right.view)) < 0.04
    marker = np.where(wrong, rng.integers(1, 17, len(wrong)), right.marker)
    # Ids that occur twice in a view are left out when sightings are collected.
    frames = []
    for view in range(right.num_views):
        rows = right.view == view
        frames.append((0, float(right.time_s[view]), found_markers(marker[rows], right.corners_px[rows])))
    built = build_map(collect_sightings(frames, LENSES[:1]), {7: ROOM[7]})
    clean = build_map(right, {7: ROOM[7]})
    assert set(built.ids) == set(ROOM)
    assert 0 < built.outliers.sum() <= wrong.sum() + 2
    # The map is as good as without wrong ids, except for the missing sightings.
    assert errors_m(built).max() < 1.5 * errors_m(clean).max()


def with_insets(seen, seed):
    """Corners of a camera that encodes light by another power than assumed: all sides are found too far inside."""
    rng = np.random.default_rng(seed)
    inset_px = 0.05 * rng.normal() + 0.02 * rng.normal(size=max(ROOM) + 1)
    return replace(seen, corners_px=seen.corners_px - inset_px[seen.marker, None, None] * outward(seen))


@pytest.mark.parametrize(("inset", "noise_px", "least"), [(False, 0.3, 1.2), (True, 0.1, 1.8)])
def test_the_covariance_agrees_with_the_errors(inset, noise_px, least):
    """Found: an average three quarters as large, because the covariance had whole insets.

    The adjustment finds a part of an inset. Measured today with insets: 2.1 for 4 rooms.
    """
    normalised, corners_inside = [], []
    for seed in range(4):
        seen = sightings(noise_px=noise_px, num_views=50, seed=seed)
        built = build_map(with_insets(seen, seed) if inset else seen, {7: ROOM[7]})
        truth_m = np.array([ROOM[marker].mean(axis=0) for marker in built.ids.tolist()])
        off = (built.marker_map.centres_m - truth_m)[~built.known]
        covariance = built.covariance[~built.known, :3, :3]
        normalised.append((off * np.linalg.solve(covariance, off[..., None])[..., 0]).sum(axis=1))
        std_m = built.marker_map.std_of(built.ids.tolist())
        assert std_m[built.known] == 0
        within = errors_m(built)[~built.known] / std_m[~built.known, None] < np.sqrt(chi2.ppf(0.9, 3))
        corners_inside.append(within.mean())
    # The expectation is 3; less, because the covariance allows for errors common to all frames, which these corners do
    # not have, and insets that differ among markers also count as errors that last. The 15 markers of a room share
    # errors, so 4 rooms have about 20 degrees of freedom: 3 +- 0.9.
    assert least < np.mean(normalised) < 4.0
    assert np.mean(np.concatenate(normalised) < chi2.ppf(0.9, 3)) > 0.85
    # The one standard deviation of a marker's corners, which the table has.
    assert np.mean(corners_inside) > 0.85


# Maps from centres

ANY_ROOM = any_room()


@pytest.mark.parametrize(("side_m", "error_m"), [(None, 0.005), (0.3, 0.0)])
def test_a_map_from_centres(side_m, error_m):
    """Corners are found from the video; the covariances count the errors of the centres."""
    rng = np.random.default_rng(0)
    frames, centres_m = fly_past(20)
    found = [markers for _, _, markers in frames]
    off = {name: error_m * rng.standard_normal(3) for name in ANY_ROOM}
    given = MarkerCentres({name: corners.mean(axis=0) + off[name] for name, corners in ANY_ROOM.items()})
    completed = complete_map(found, given, PASSING_CAMERA, side_m=side_m)
    for name, corners in completed.corners_m.items():
        # A marker that is hardly seen from the side may be turned by 3 degrees: 12 mm at its corners.
        assert np.linalg.norm(corners - off[name] - ANY_ROOM[name], axis=1).max() < 0.03, name
    settings = LocaliseSettings(pose=PoseSettings(map_error_m=error_m))
    known = [(k, t, one.select(np.isin(one.ids, completed.ids))) for k, t, one in frames]
    path = localise_frames(known, completed, PASSING_CAMERA, settings).path
    apart_m = path.position_m - centres_m
    assert np.linalg.norm(apart_m, axis=1).max() < (0.05 if error_m else 0.03)
    inverse = np.linalg.inv(path.covariance[:, :3, :3])
    # The normalised squared error averages 3; errors of the map are the same in all frames.
    assert np.einsum("fi,fij,fj->f", apart_m, inverse, apart_m).mean() < 9


def test_wrong_centres_are_left_out():
    given = {name: corners.mean(axis=0) for name, corners in ANY_ROOM.items()}
    given |= {2: given[3], 3: given[2], 12: given[12] + 0.5}
    completed = complete_map(
        [markers for _, _, markers in fly_past(20)[0]], MarkerCentres(given), PASSING_CAMERA
    )
    assert not {2, 3, 12} & set(completed.corners_m)
    for name, corners in completed.corners_m.items():
        assert np.linalg.norm(corners - ANY_ROOM[name], axis=1).max() < 0.03, name


# Wrong maps


@pytest.fixture(scope="module")
def noisy_sightings():
    return sightings(noise_px=0.3)


def test_correct_maps_have_no_findings(noisy_sightings):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        measured = {marker: corners + 0.001 * rng.standard_normal((4, 3)) for marker, corners in ROOM.items()}
        checkup = check_map(noisy_sightings, MarkerMap(measured))
        assert checkup.findings == ()
        assert all(count > 5 for count in checkup.sightings.values())


TURN = Rotation.from_rotvec([0.0, 0.0, 12.0], degrees=True).as_matrix()
MIDDLE = ROOM[9].mean(axis=0)
CLOCKWISE = r"degrees, .*; count its corners clockwise"
#: Name of the fault -> corners of a wrong map, kind of the finding, words about marker 9.
FAULTS = {
    "moved": (
        {9: ROOM[9] + [0.04, 0, -0.03]},
        "moved",
        r"it is (5\d|4\d) mm from where the map has it, at \(-2.1",
    ),
    "far away": ({9: ROOM[9] + [1.0, 0.0, 0.5]}, "moved", r"marker 9: it is 1.12 m from where"),
    "turned": ({9: MIDDLE + (ROOM[9] - MIDDLE) @ TURN.T}, "turned", r"it is turned by 1[123]\.\d degrees"),
    "exchanged": ({9: ROOM[14], 14: ROOM[9]}, "moved", "where the map has marker 14.*; correct its id"),
    "counted from another": (
        {9: np.roll(ROOM[9], 1, axis=0)},
        "turned",
        rf"turned by (89|90)\.\d {CLOCKWISE}",
    ),
    "backwards": ({9: ROOM[9][[0, 3, 2, 1]]}, "turned", rf"turned by 1(79|80)\.\d {CLOCKWISE}"),
    "too large": ({9: MIDDLE + 1.2 * (ROOM[9] - MIDDLE)}, "side", "it is (399|400|401) mm wide, not 480 mm"),
}


@pytest.mark.parametrize(("wrong", "kind", "message"), FAULTS.values(), ids=FAULTS)
def test_a_wrong_marker_is_named(noisy_sightings, wrong, kind, message):
    checkup = check_map(noisy_sightings, MarkerMap({**ROOM, **wrong}))
    assert [(one.kind, one.markers) for one in checkup.findings] == [(kind, (one,)) for one in sorted(wrong)]
    assert str(checkup.findings[0]).startswith("marker 9: ")
    assert re.search(message, str(checkup.findings[0]))


@given(
    pairs=st.lists(st.sampled_from(list(combinations(ROOM, 2))), min_size=1, max_size=3, unique=True),
    rolls=st.tuples(st.integers(0, 3), st.integers(0, 3)),
    left_out=st.sets(st.sampled_from(list(ROOM)), max_size=4),
)
@settings(max_examples=5)
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
    assert {marker for finding in checkup.findings for marker in finding.markers} == wrong


def test_a_map_of_another_room_is_one_finding(noisy_sightings):
    shuffled = np.random.default_rng(4).permutation(list(ROOM)).tolist()
    checkup = check_map(noisy_sightings, MarkerMap({i: ROOM[j] for i, j in zip(ROOM, shuffled, strict=True)}))
    assert [one.kind for one in checkup.findings] == ["map"]


# The command


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return make_once(tmp_path_factory, "drawn_flight", make_drawn_flight)


@pytest.fixture
def run_map(run_psotrack):
    """Runs `onboard map`, which must end with an exit code; what it prints."""

    def call(*words, code=0):
        done = run_psotrack("onboard", "map", *words)
        assert done.code == code, done.err
        return done.out

    return call


def centres_off_m(path):
    found = read_marker_corners(path)
    return {
        marker: np.linalg.norm((found[marker] - corners).mean(axis=0))
        for marker, corners in wall_markers().items()
        if marker in found
    }


def test_a_map_from_a_video(run_map, drawn, tmp_path):
    out, report = tmp_path / "corners.csv", tmp_path / "map.json"
    words = (drawn / "flight.avi", "--camera", drawn / "lens.toml", "--out", out)
    said = run_map(*words, "--known", 17, "--markers", drawn / "corners.csv", "--json", report)
    assert "markers from 13 frames" in said
    off_m = centres_off_m(out)
    assert len(off_m) >= 11
    # Corners are good to 0.1 px at 457 px per metre at 1 m: 1 mm at 4 m, and several times that on the second wall.
    assert max(off_m.values()) < 0.02
    content = json.loads(report.read_text())
    assert content["frames"] == 13
    for marker, row in content["markers"].items():
        assert row["known"] == (marker == "17")
        assert row["residual_px"] < 0.5
        if int(marker) in off_m:
            # The error of the centre is below 4 of its standard deviations, in its length.
            assert off_m[int(marker)] <= 4 * np.linalg.norm(row["std_m"]) + 1e-9
    # A marker with a known side defines the world; 20 hangs 1.3 m to the right of 17, on the same wall.
    run_map(*words, "--known", 17, "--side", 0.3, "--force", "--quiet")
    found = MarkerMap(read_marker_corners(out))
    row = found.ids.tolist().index(17)
    np.testing.assert_allclose(found.centres_m[row], 0.0, atol=1e-12)
    np.testing.assert_allclose(found.normals[row], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(found.centres_m[found.ids.tolist().index(20)], [1.3, 0, 0], atol=0.02)


def test_a_sequence_provides_videos_intrinsics_and_map(run_map, drawn, tmp_path):
    """The layout of the dataset: video, intrinsics and table of corners are found by their names."""
    folder = write_onboard_sequence(drawn, tmp_path / "S01_D2_A")
    out = tmp_path / "corners.csv"
    run_map(folder, "--drone", "dron1", "--known", "17", "--out", out)
    assert max(centres_off_m(out).values()) < 0.02
    assert "nothing disagrees" in run_map(folder, "--check", folder / "aruco_corners.csv", "--frames", 6)


def test_a_wrong_map_is_reported_and_changes_the_exit_status(run_map, drawn, tmp_path):
    corners_m, report = wall_markers(), tmp_path / "map.json"
    wrong = corners_m | {20: corners_m[20] + [0.1, 0.0, 0.05], 8: corners_m[29], 29: corners_m[8]}
    write_marker_corners(tmp_path / "wrong.csv", wrong)
    write_rig(tmp_path / "large.toml", make_rig({"front": scale_lens(DRAWN_LENS, (1280, 960))}))
    words = (drawn / "flight.avi", "--camera", tmp_path / "large.toml", "--scale-camera", "--json", report)
    said = run_map(*words, "--check", tmp_path / "wrong.csv", "--quiet", code=1)
    assert "marker 20: it is 0.11 m from where the map has it" in said
    content = json.loads(report.read_text())
    assert [(one["kind"], one["markers"]) for one in content["findings"]] == [
        ("moved", [i]) for i in (8, 20, 29)
    ]
    assert content["markers"]["20"]["moved_m"] == pytest.approx([-0.1, 0, -0.05], abs=0.015)
    assert "where the map has marker 29" in content["findings"][0]["message"]


def test_a_map_from_motion_capture(run_map, tmp_path):
    write_c3d(tmp_path / "room.c3d", recorded_corners())
    out, report = tmp_path / "corners.csv", tmp_path / "map.json"
    said = run_map(tmp_path / "room.c3d", "--out", out, "--json", report)
    assert "16 markers, corners within 0.0 mm of squares" in said
    for marker, corners in read_marker_corners(out).items():
        # A C3D holds float32 millimetres: 4e-4 mm at 4 m.
        np.testing.assert_allclose(corners, ROOM[marker], atol=2e-6)
    assert len(json.loads(report.read_text())["markers"]["3"]["residual_m"]) == 4
