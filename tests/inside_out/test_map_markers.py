"""`psotrack onboard map` on real files: measured corners, a video, a sequence of the dataset, and a wrong map."""

import json
import re
import shutil

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from test_inside_out_map import ROOM, on_wall, recorded_corners, with_bent_corner

from psotrack.cli.onboard.map_markers import FOUND, map_markers
from psotrack.errors import InputError, OutputError, PsotrackError, SettingsError
from psotrack.foreground.markers import marker_dictionary
from psotrack.geometry import look_at, make_camera, make_rig, project
from psotrack.geometry.rig_files import write_rig
from psotrack.inside_out import MarkerMap
from psotrack.inside_out.lens_files import scale_lens
from psotrack.recordings import VideoWriter
from psotrack.recordings.datasets import read_marker_corners, write_marker_corners
from psotrack.recordings.mocap import write_c3d

SIZE_WH = (960, 720)
LENS = make_camera(
    R=np.eye(3),
    t_m=np.zeros(3),
    K=np.array([[620.0, 0.0, 479.5], [0.0, 620.0, 359.5], [0.0, 0.0, 1.0]]),
    image_size_wh=SIZE_WH,
)
SIDE_M = 0.4
#: Two walls that meet.
CORNERS = {
    **{
        marker: on_wall((x, 3.0, z), (0, -1, 0), SIDE_M)
        for marker, x, z in ((3, -1.2, 1.2), (7, 0.0, 1.8), (8, 1.2, 1.1))
    },
    **{marker: on_wall((2.2, y, z), (-1, 0, 0), SIDE_M) for marker, y, z in ((21, 2.1, 2.0), (22, 0.9, 1.3))},
}
#: Width of a printed sheet, cells; 6 of these cells are the marker.
_CELLS = 8


def invoke(*words, expect=None):
    """Output of the command; or check the error with which it must end."""
    result = CliRunner().invoke(map_markers, [str(word) for word in words], catch_exceptions=True)
    if expect is None:
        assert result.exception is None, result.output + repr(result.exception)
        return result.output
    assert isinstance(result.exception, expect), repr(result.exception)
    return str(result.exception) if isinstance(result.exception, PsotrackError) else result.output


def draw_image(cam):
    """Sheets of paper on grey walls, drawn at twice the size, blurred in light, and compressed as in a video."""
    canvas = np.full((2 * SIZE_WH[1], 2 * SIZE_WH[0]), 0.2, np.float32)
    for marker, corners in CORNERS.items():
        sheet = np.ones((_CELLS * 40, _CELLS * 40), np.float32)
        sheet[40:-40, 40:-40] = (
            cv2.aruco.generateImageMarker(marker_dictionary("4x4_1000"), marker, 240) / 255
        )
        pixels, depth = project(cam, corners)
        if (depth < 0.3).any():
            continue
        # Edges of pixels and of the sheet: pixel centres are at whole numbers.
        at = np.array([[40, 40], [280, 40], [280, 280], [40, 280]], np.float32) - 0.5
        onto = cv2.getPerspectiveTransform(at, (2 * pixels + 0.5).astype(np.float32))
        mask = cv2.warpPerspective(np.ones_like(sheet), onto, canvas.shape[::-1])
        drawn = cv2.warpPerspective(sheet, onto, canvas.shape[::-1], flags=cv2.INTER_AREA)
        canvas = np.where(mask > 0.5, drawn, canvas)
    light = cv2.resize(cv2.GaussianBlur(canvas, (0, 0), 1.5), SIZE_WH, interpolation=cv2.INTER_AREA)
    gray = (255 * np.sqrt(np.clip(0.05 + 0.9 * light, 0, 1))).round().astype(np.uint8)
    return cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)


def make_walk(folder):
    """Write a video of the two walls, `walk.avi`, the lens, `lens.toml`, and the corners, `truth.csv`."""
    write_rig(folder / "lens.toml", make_rig({"gopro": LENS}))
    with VideoWriter(folder / "walk.avi", 25.0, SIZE_WH) as writer:
        for turn in np.linspace(0, 2 * np.pi, 24):
            centre = np.array(
                [-0.8 + 0.9 * np.cos(turn), -1.2 + 0.8 * np.sin(turn), 1.5 + 0.3 * np.sin(2 * turn)]
            )
            R, t_m = look_at(centre.tolist(), [0.7 + 0.3 * np.sin(3 * turn), 2.6, 1.5])
            writer.write(draw_image(make_camera(R=R, t_m=t_m, K=LENS.K, image_size_wh=SIZE_WH)))
    write_marker_corners(folder / "truth.csv", CORNERS)
    return folder


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """The folder that `make_walk` fills."""
    return make_walk(tmp_path_factory.mktemp("walk"))


def centres_off_m(path):
    found = read_marker_corners(path)
    return {marker: np.linalg.norm((found[marker] - CORNERS[marker]).mean(axis=0)) for marker in found}


def test_a_map_from_a_video(walk, tmp_path):
    out = tmp_path / "corners.csv"
    words = [walk / "walk.avi", "--known", 7, "--markers", walk / "truth.csv", "--camera", walk / "lens.toml"]
    printed = invoke(*words, "--out", out, "--json", tmp_path / "map.json")
    assert "5 markers from 24 frames" in printed
    off = centres_off_m(out)
    # Corners are good to 0.1 px at 620 px per metre at 1 m: 0.6 mm at 4 m, and several times that on the second wall.
    assert set(off) == set(CORNERS)
    assert max(off.values()) < 0.01
    content = json.loads((tmp_path / "map.json").read_text())
    assert content["frames"] == 24
    for marker, row in content["markers"].items():
        assert row["known"] == (marker == "7")
        # The error of the centre is below 4 of its standard deviations, in its length.
        assert off[int(marker)] <= 4 * np.linalg.norm(row["std_m"]) + 1e-9
        assert row["residual_px"] < 0.5
    assert "expected a path that does not exist yet" in invoke(*words, "--out", out, expect=OutputError)
    invoke(*words, "--out", out, "--force", "--quiet")


def test_a_marker_with_known_side_defines_the_world(walk, tmp_path):
    out = tmp_path / "corners.csv"
    invoke(
        walk / "walk.avi",
        "--known",
        7,
        "--side",
        SIDE_M,
        "--camera",
        walk / "lens.toml",
        "--out",
        out,
        "--quiet",
    )
    found = MarkerMap(read_marker_corners(out))
    row = found.ids.tolist().index(7)
    np.testing.assert_allclose(found.centres_m[row], 0.0, atol=1e-12)
    np.testing.assert_allclose(found.normals[row], [0, 0, 1], atol=1e-12)
    # Marker 8 hangs 1.2 m to the right of 7 and 0.7 m lower, on the same wall.
    np.testing.assert_allclose(found.centres_m[found.ids.tolist().index(8)], [1.2, -0.7, 0.0], atol=0.01)


def test_a_sequence_provides_video_intrinsics_and_map(walk, tmp_path):
    """The layout of the dataset: video, intrinsics and table of corners are found by their names."""
    folder = tmp_path / "S01_D2_A"
    folder.mkdir()
    shutil.copy(walk / "walk.avi", folder / "dron1_cam_s.avi")
    shutil.copy(walk / "walk.avi", folder / "cam1i_s.avi")
    shutil.copy(walk / "truth.csv", folder / "aruco_corners.csv")
    (folder / "drone_cameras_calibration.csv").write_text(
        "cam_name;focal_length_x;focal_length_y;cx;cy;width;height\ndron1;620;620;479.5;359.5;960;720\n"
    )
    (folder / "cameras_calibration.csv").write_text(
        "cam_name;cam_x[m];cam_y[m];cam_z[m];cam_or_x[rad];cam_or_y[rad];cam_or_z[rad];focal_length;cx;cy\n"
        "cam1i;0;0;5;0;0;0;600;480;360\n"
    )
    out = tmp_path / "corners.csv"
    printed = invoke(folder, "--drone", "dron1", "--known", "7", "--out", out)
    assert "5 markers" in printed
    assert max(centres_off_m(out).values()) < 0.01
    assert "nothing disagrees" in invoke(folder, "--check", folder / "aruco_corners.csv")
    message = invoke(
        folder, "--drone", "dron5", "--known", "7", "--out", tmp_path / "x.csv", expect=SettingsError
    )
    assert "expected names among dron1, found dron5" in message


def test_a_wrong_map_is_reported_and_changes_the_exit_status(walk, tmp_path):
    wrong = tmp_path / "wrong.csv"
    write_marker_corners(wrong, {**CORNERS, 22: CORNERS[22] + np.array([0.0, 0.1, 0.05])})
    words = ["--check", wrong, "--camera", walk / "lens.toml"]
    result = CliRunner().invoke(
        map_markers, [str(word) for word in (walk / "walk.avi", *words, "--json", "-")]
    )
    assert result.exit_code == FOUND
    content = json.loads(result.stdout)
    assert [(one["kind"], one["markers"]) for one in content["findings"]] == [("moved", [22])]
    assert content["markers"]["22"]["moved_m"] == pytest.approx([0.0, -0.1, -0.05], abs=0.01)
    said = CliRunner().invoke(map_markers, [str(word) for word in (walk / "walk.avi", *words, "--quiet")])
    assert "marker 22: it is 0.11 m from where the map has it" in said.output


def test_exchanged_markers_are_reported(walk, tmp_path):
    write_marker_corners(tmp_path / "wrong.csv", CORNERS | {7: CORNERS[22], 22: CORNERS[7]})
    words = ("--check", tmp_path / "wrong.csv", "--camera", walk / "lens.toml", "--json", "-")
    result = CliRunner().invoke(map_markers, [str(word) for word in (walk / "walk.avi", *words)])
    assert result.exit_code == FOUND
    findings = json.loads(result.stdout)["findings"]
    assert [(one["kind"], one["markers"]) for one in findings] == [("moved", [7]), ("moved", [22])]
    assert "where the map has marker 22" in findings[0]["message"]


def test_a_map_from_motion_capture(tmp_path):
    write_c3d(tmp_path / "room.c3d", recorded_corners(ROOM))
    out = tmp_path / "corners.csv"
    printed = invoke(tmp_path / "room.c3d", "--out", out)
    assert "16 markers, corners within 0.0 mm of squares" in printed
    for marker, corners in read_marker_corners(out).items():
        # A C3D holds float32 millimetres: 4e-4 mm at 4 m.
        np.testing.assert_allclose(corners, ROOM[marker], atol=2e-6)
    content = json.loads(invoke(tmp_path / "room.c3d", "--out", out, "--force", "--json", "-"))
    assert len(content["markers"]["3"]["residual_m"]) == 4


def test_measured_corners_that_are_no_square_are_refused(tmp_path):
    path = tmp_path / "points.csv"
    write_marker_corners(path, with_bent_corner(0.2, 0))
    message = invoke(path, "--out", tmp_path / "other.csv", expect=InputError)
    assert "line 4, marker 3: expected a flat square" in message
    assert not (tmp_path / "other.csv").exists()


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        (
            ["{walk}", "--out", "{new}", "--check", "{new}"],
            SettingsError,
            "--check MAP, found both",
        ),
        (["{walk}", "--out", "{new}"], SettingsError, "expected numbers of markers that are known"),
        (
            ["{walk}", "--out", "{new}", "--known", "7"],
            SettingsError,
            "--markers with the corners of the known",
        ),
        (
            ["{walk}", "--out", "{new}", "--known", "7,8", "--side", "0.4"],
            SettingsError,
            "found no --markers",
        ),
        (
            ["{walk}", "--out", "{new}", "--known", "9", "--markers", "{truth}"],
            InputError,
            "expected the known marker 9",
        ),
        (
            ["{walk}", "--out", "{new}", "--known", "7", "--side", "0.4"],
            SettingsError,
            "--camera FILE or --fov H,V, found nei",
        ),
        (
            ["{walk}", "--out", "{new}", "--known", "7", "--side", "-1"],
            SettingsError,
            "--side: expected a number above 0",
        ),
        (["{walk}", "--check", "{walk}"], InputError, "walk.avi: expected UTF-8 text"),
        (["{gone}", "--check", "{truth}", "--fov", "90,60"], InputError, "gone.avi: expected a video"),
        (
            ["{walk}", "--drone", "dron1", "--check", "{truth}"],
            SettingsError,
            "expected a sequence's folder as SOURCE",
        ),
        (
            ["{walk}", "--check", "{truth}", "--fov", "75.5,60.3", "--dictionary", "5x5_50"],
            InputError,
            "walk.avi: expected frames that show markers, found none",
        ),
        (
            ["{walk}", "--out", "{new}", "--known", "99", "--side", "1", "--fov", "75.5,60.3"],
            InputError,
            "walk.avi: expected the known marker 99 beside others, found only 3, 7, 8, 21, 22",
        ),
        (
            ["{walk}", "--check", "{truth}", "--fov", "75.5,60.3", "--frames", "25"],
            SettingsError,
            "--frames: expected 1 to 24, the frames of",
        ),
        (["{truth}", "--out", "{new}", "--json", "{new}"], SettingsError, "--json: expected another file"),
        (
            ["{truth}", "--out", "{new}", "--json", "{truth}"],
            OutputError,
            "truth.csv: expected a path that does not exist yet",
        ),
    ],
)
def test_unusable_choices_are_refused(walk, tmp_path, words, error, message):
    names = {"walk": "walk.avi", "truth": "truth.csv", "gone": "gone.avi"}
    paths = {key: walk / name for key, name in names.items()} | {"new": tmp_path / "new.csv"}
    assert message in invoke(*(word.format(**paths) for word in words), expect=error)
    assert not (tmp_path / "new.csv").exists()


def test_intrinsics_for_another_aspect_ratio_are_refused(walk, tmp_path):
    lens = make_camera(R=np.eye(3), t_m=np.zeros(3), K=LENS.K, image_size_wh=(1920, 1440))
    write_rig(tmp_path / "lens.toml", make_rig({"gopro": lens}))
    message = invoke(
        walk / "walk.avi",
        "--check",
        walk / "truth.csv",
        "--camera",
        tmp_path / "lens.toml",
        expect=InputError,
    )
    assert "lens.toml: expected intrinsics for 960 x 720 pixels" in message
    assert "pass --scale-camera" in message


def test_intrinsics_of_the_same_images_twice_as_large(walk, tmp_path):
    write_rig(tmp_path / "lens.toml", make_rig({"gopro": scale_lens(LENS, (2 * SIZE_WH[0], 2 * SIZE_WH[1]))}))
    words = [walk / "walk.avi", "--check", walk / "truth.csv", "--camera", tmp_path / "lens.toml"]
    assert "nothing disagrees" in invoke(*words, "--scale-camera")


def test_the_rest_of_a_video_that_ends_early_is_used_as_its_message_says(walk, tmp_path):
    whole = (walk / "walk.avi").read_bytes()
    (tmp_path / "walk.avi").write_bytes(whole[: len(whole) * 2 // 3])
    out = tmp_path / "corners.csv"
    words = [
        tmp_path / "walk.avi",
        "--known",
        7,
        "--side",
        SIDE_M,
        "--camera",
        walk / "lens.toml",
        "--out",
        out,
    ]
    message = invoke(*words, expect=InputError)
    there = int(re.search(r"--frames (\d+) uses the time before", message)[1])
    assert not out.exists()
    assert f"from {there} frames" in invoke(*words, "--frames", there)
