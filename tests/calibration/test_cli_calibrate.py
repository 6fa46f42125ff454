"""`psotrack calibrate`: points marked by hand, markers in videos, boards, conversions, and wrong input."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from helpers import ring_rig
from scipy.spatial.transform import Rotation

from psotrack.calibration import Board
from psotrack.cli.calibrate import calibrate
from psotrack.errors import PsotrackError
from psotrack.geometry import Rig, look_at, make_camera, make_rig, project
from psotrack.geometry.rig_files import read_lenses, read_rig, write_calibration, write_rig
from psotrack.recordings import VideoWriter
from psotrack.recordings.datasets import write_marker_corners

WORLD = np.random.default_rng(0).uniform((-1.5, -1.5, 0.2), (1.5, 1.5, 2.4), (14, 3))


def run(*arguments):
    wide = CliRunner(env={"COLUMNS": "200"})
    result = wide.invoke(calibrate, [str(one) for one in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result


def refused(*arguments):
    """Message of the error that the command raises; `main` prints the message as one line."""
    with pytest.raises(PsotrackError) as error:
        run(*arguments)
    message = str(error.value)
    assert "\n" not in message
    return message


def write_lines(path, *lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def pairs_of(path, rig, *, noise_px=0.5, wrong=None):
    """Write marks of all points in all cameras; only the rows of the first camera have positions."""
    rng = np.random.default_rng(1)
    lines = ["camera,point,x_px,y_px,x_m,y_m,z_m"]
    for index, name in enumerate(rig.names):
        pixels = project(rig.cameras[index], WORLD)[0] + rng.normal(0, noise_px, (len(WORLD), 2))
        for number, (x, y) in enumerate(pixels):
            x += 80 if (name, number) == wrong else 0
            place = ",".join(map(repr, WORLD[number].tolist())) if index == 0 else ",,"
            lines.append(f"{name},p{number},{x},{y},{place}")
    return write_lines(path, *lines)


def centres(rig):
    return rig.cameras.centre_world


def test_a_rig_from_marks(tmp_path):
    rig = ring_rig(3, coefficients=5, image_size_wh=(1920, 1080))
    write_rig(tmp_path / "lenses.yml", rig)
    pairs = pairs_of(tmp_path / "pairs.csv", rig, wrong=("c1", 4))
    out, report = tmp_path / "rig.toml", tmp_path / "report.json"
    shown = run(
        "rig",
        "--pairs",
        pairs,
        "--lenses",
        tmp_path / "lenses.yml",
        "--out",
        out,
        "--json",
        report,
    ).stdout
    assert "p4" in shown
    assert "left out" in shown
    found = read_rig(out)
    assert found.names == rig.names
    rows = json.loads(report.read_text())["cameras"]
    for index, name in enumerate(rig.names):
        row = rows[name]
        assert row["points"] - row["used"] == (name == "c1")
        np.testing.assert_allclose(row["centre_m"], centres(found)[index], atol=1e-12)
        # Five standard deviations: one in a million.
        assert (np.abs(centres(found)[index] - centres(rig)[index]) < 5 * np.array(row["centre_std_m"])).all()
        assert max(row["centre_std_m"]) < 0.01
        assert 0.3 < row["rms_px"] < 1.2
    assert rows["c1"]["worst"][0] == {
        "point": "p4",
        "residual_px": pytest.approx(80, abs=10),
        "used": False,
    }
    assert "--force" in refused("rig", "--pairs", pairs, "--lenses", out, "--out", out)


def test_positions_in_a_separate_file_and_a_lens_from_a_data_sheet(tmp_path):
    K = np.array([[800.0, 0, 639.5], [0, 800.0, 359.5], [0, 0, 1]])
    R, t_m = look_at((4.0, 0.5, 2.0), (0.0, 0.0, 1.2))
    rig = make_rig({"60881257": make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1280, 720))})
    pixels = project(rig.cameras[0], WORLD)[0]
    pairs = write_lines(
        tmp_path / "pairs.csv",
        "camera,point,x_px,y_px",
        *(f"60881257,p{i},{x},{y}" for i, (x, y) in enumerate(pixels.tolist())),
    )
    points = write_lines(
        tmp_path / "points.csv",
        "point,x_m,y_m,z_m",
        *(f"p{i},{x},{y},{z}" for i, (x, y, z) in enumerate(WORLD.tolist())),
    )
    view_deg = [2 * np.rad2deg(np.arctan(side / 2 / 800)) for side in (1280, 720)]
    lens = ("--fov", f"{view_deg[0]},{view_deg[1]}", "--size", "1280,720")
    run("rig", "--pairs", pairs, "--places", points, *lens, "--out", tmp_path / "a.toml", "-q")
    np.testing.assert_allclose(centres(read_rig(tmp_path / "a.toml")), centres(rig), atol=1e-6)
    message = refused("rig", "--pairs", pairs, *lens, "--out", tmp_path / "c.yml")
    assert (
        "line 2, column point: expected x_m, y_m, z_m in one of its rows, or in a file of places" in message
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("c1,p3,", "c1,p2,"), "line 19, column point: expected each point once per camera, found p2 again"),
        (("c1,p3,", "c1,p99,"), "line 19, column point: expected x_m, y_m, z_m in one of its rows"),
        (("x_px", "u"), "pairs.csv: expected a column x_px"),
        (("c0,p0,", "c0,,"), "line 2, column point: expected a value, found nothing"),
        (("c0,p0,", "c0,p0,x"), "line 2, column x_px: expected a number"),
        (("c0,p0,", "c0,p0,1,2,3,"), "line 2: expected 7 values as in the header, found 10"),
        (("c1,p3,", "c9,p3,"), "rig.toml: expected the lens of c9, found only c0, c1"),
    ],
)
def test_broken_marks_are_refused(tmp_path, change, message):
    rig = ring_rig(2, image_size_wh=(1920, 1080))
    write_rig(tmp_path / "rig.toml", rig)
    pairs = pairs_of(tmp_path / "pairs.csv", rig)
    pairs.write_text(pairs.read_text().replace(*change, 1))
    options = ("--lenses", tmp_path / "rig.toml", "--out", tmp_path / "out.toml")
    assert message in refused("rig", "--pairs", pairs, *options)
    assert not (tmp_path / "out.toml").exists()


def test_a_point_with_two_positions_is_refused(tmp_path):
    pairs = write_lines(
        tmp_path / "pairs.csv", "camera,point,x_px,y_px,x_m,y_m,z_m", "c0,p,1,2,0,0,1", "c1,p,3,4,0,0,2"
    )
    lens = ("--fov", "60,40", "--size", "640,480", "--out", tmp_path / "out.toml")
    assert "line 3, column point: expected p at [0.0, 0.0, 1.0], as before" in refused(
        "rig", "--pairs", pairs, *lens
    )
    pairs = write_lines(tmp_path / "pairs.csv", "camera,point,x_px,y_px,x_m,y_m,z_m", "c0,p,1,2,0,0,1")
    assert "camera c0: expected at least 4 points of known position, found 1" in refused(
        "rig", "--pairs", pairs, *lens
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--pairs", "a", "--markers", "b"), "found --pairs and --markers"),
        (("--pairs", "a.csv"), "a.csv: expected a file to read"),
        (("a.mp4", "--markers", "nowhere"), "nowhere: expected a file to read"),
        (("a.mp4", "--square", "0.04", "--fov", "60,40"), "--fov: expected points or markers, not a board"),
    ],
)
def test_wrong_combinations_of_options_are_refused(tmp_path, arguments, message):
    assert message in refused("rig", *arguments, "--out", tmp_path / "out.toml")


def test_wrong_combinations_of_lens_options_are_refused(tmp_path):
    pairs = pairs_of(tmp_path / "pairs.csv", ring_rig(1))
    start = ("rig", "--pairs", pairs, "--out", tmp_path / "out.toml")
    assert "--lenses: expected a calibration with the lens of each camera, or --fov H,V" in refused(*start)
    assert "found both" in refused(*start, "--fov", "60,40", "--lenses", "rig.toml")
    assert "--size: expected width and height" in refused(*start, "--fov", "60,40")


def marker_room(folder):
    """Write a sequence with a camera that sees markers on two walls, drawn by homographies; returns the rig."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    K = np.array([[1150.0, 0, 639.5], [0, 1150.0, 359.5], [0, 0, 1]])
    R, t_m = look_at((4.0, -2.5, 2.2), (-0.6, 0.8, 1.2))
    one = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1280, 720))
    corners = {}
    for number, (y, z) in enumerate([(0.0, 1.9), (0.9, 0.6), (0.9, 1.9), (0.1, 0.6)]):
        square = np.array([(0, 0), (0.5, 0), (0.5, -0.5), (0, -0.5)]) + np.array((y, z))
        corners[number + 3] = np.column_stack([np.full(4, -1.5), square])
    for number, (x, z) in enumerate([(-1.3, 1.9), (-0.4, 1.1), (0.5, 1.9)]):
        square = np.array([(0, 0), (0.5, 0), (0.5, -0.5), (0, -0.5)]) + np.array((x, z))
        corners[number + 20] = np.column_stack([square[:, 0], np.full(4, 1.5), square[:, 1]])
    large = np.full((4 * 720, 4 * 1280), 225, np.uint8)
    for marker, places in corners.items():
        side = 600
        sheet = cv2.copyMakeBorder(
            cv2.aruco.generateImageMarker(dictionary, marker, side),
            100,
            100,
            100,
            100,
            cv2.BORDER_CONSTANT,
            value=255,
        )
        drawn = np.array([(0, 0), (side, 0), (side, side), (0, side)], np.float32) + 99.5
        # In an image that is four times as large, pixel p is at 4 p + 1.5.
        pixels = (4 * project(one, places)[0] + 1.5).astype(np.float32)
        H = cv2.getPerspectiveTransform(drawn, pixels)
        inside = cv2.warpPerspective(np.full_like(sheet, 255), H, large.shape[::-1])
        warped = cv2.warpPerspective(sheet, H, large.shape[::-1], flags=cv2.INTER_AREA)
        large = np.where(inside > 0, warped, large)
    image = cv2.cvtColor(cv2.resize(large, (1280, 720), interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR)
    with VideoWriter(folder / "cam1i_s.avi", 25.0, (1280, 720)) as writer:
        for _ in range(3):
            writer.write(image)
    rig = make_rig({"cam1i": one})
    write_calibration(folder / "cameras_calibration.csv", rig)
    write_marker_corners(folder / "aruco_corners.csv", corners)
    return rig


def test_a_rig_from_markers_on_the_walls(tmp_path):
    folder = tmp_path / "ROOM"
    folder.mkdir()
    rig = marker_room(folder)
    known = ("--markers", folder / "aruco_corners.csv", "--noise", "0.3")
    lens = ("--lenses", folder / "cameras_calibration.csv", "--size", "1280,720")
    output = run("rig", folder, *known, *lens, "--out", tmp_path / "rig.toml", "--json", "-").stdout
    row = json.loads(output)["cameras"]["cam1i"]
    assert row["points"] == 7 * 4
    assert row["worst"][0]["point"].partition(".")[0] in {"3", "4", "5", "6", "20", "21", "22"}
    # A tenth of a pixel at 5 m is 0.5 mm, but corners in compressed video have larger errors. Measured 3 mm.
    assert np.linalg.norm(centres(read_rig(tmp_path / "rig.toml")) - centres(rig)) < 0.01
    # The same by a video for each camera instead of a sequence.
    lens = ("--lenses", tmp_path / "rig.toml")
    run("rig", folder / "cam1i_s.avi", *known, *lens, "--out", tmp_path / "again.toml")
    again = read_rig(tmp_path / "again.toml")
    assert again.names == ("cam1i_s",)
    assert np.linalg.norm(centres(again) - centres(rig)) < 0.01


def film_board(path):
    """A video of a ChArUco board of 7 x 5 squares of 4 cm, by a camera of 620 pixels focal length."""
    board, per_m = Board((7, 5), 0.04, 0.03), 3000.0
    K = np.array([[620.0, 0, 322.0], [0, 620.0, 236.0], [0, 0, 1]])
    sheet = board.opencv().generateImage((int(0.28 * per_m), int(0.2 * per_m)))
    rng = np.random.default_rng(0)
    with VideoWriter(path, 25.0, (640, 480)) as writer:
        for _ in range(14):
            R = Rotation.from_euler("xyz", rng.uniform(-35, 35, 3), degrees=True).as_matrix()
            shift = (rng.uniform(-0.08, 0.08), rng.uniform(-0.06, 0.06), rng.uniform(0.32, 0.5))
            # Pixel u of the sheet is at (u + 0.5) / per_m on the board. The board's middle is at `shift`.
            to_board = np.array(
                [[1 / per_m, 0, 0.5 / per_m - 0.14], [0, 1 / per_m, 0.5 / per_m - 0.1], [0, 0, 1]]
            )
            H = K @ np.column_stack([R[:, 0], R[:, 1], shift]) @ to_board
            image = cv2.warpPerspective(sheet, H, (640, 480), flags=cv2.INTER_AREA, borderValue=200)
            writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))


@pytest.mark.slow
def test_the_lens_of_one_camera_from_a_board(tmp_path):
    film_board(tmp_path / "board.avi")
    size = ("--squares", "7x5", "--square", "0.04", "--marker", "0.03", "--lens", "4")
    out = tmp_path / "lens.toml"
    words = ("rig", tmp_path / "board.avi", *size, "--names", "60881257", "--out", out)
    content = json.loads(run(*words, "--json", "-").stdout)["cameras"]["60881257"]
    lens = read_lenses(out)
    assert lens.names == ("60881257",)
    assert content["focal_px"] == np.diag(lens.cameras.K[0])[:2].tolist()
    # The images are warped without smoothing; test_calibration_intrinsics has the exact bounds.
    assert abs(lens.cameras.K[0, 0, 0] - 620) < 12
    wrong = ("--squares", "8x6", "--square", "0.04", "--marker", "0.03", "--dictionary", "6x6_50")
    message = refused("rig", tmp_path / "board.avi", *wrong, "--out", tmp_path / "x.yml")
    assert "found a ChArUco board of 7 x 5 squares of 40 mm with markers of " in message
    assert "pass --squares 7x5 --dictionary 4x4_50" in message


def square_pixels(rig):
    K = rig.cameras.K.copy()
    K[:, 1, 1] = K[:, 0, 0]
    return Rig(rig.names, replace(rig.cameras, K=K))


def test_files_are_converted(tmp_path):
    rig = square_pixels(ring_rig(3, coefficients=4))
    write_rig(tmp_path / "a.toml", rig)
    shown = run("convert", tmp_path / "a.toml", tmp_path / "b.yml").stdout
    assert "c2" in shown
    run("convert", tmp_path / "b.yml", tmp_path / "c.csv", "-q")
    output = json.loads(
        run("convert", tmp_path / "c.csv", tmp_path / "d.toml", "--size", "320,240", "--json", "-").stdout
    )
    assert output["rig"] == str(tmp_path / "d.toml")
    # Two files have Rodrigues vectors, whose conversion rounds.
    np.testing.assert_allclose(
        read_rig(tmp_path / "d.toml").cameras.T_cam_world, rig.cameras.T_cam_world, atol=1e-14
    )
    run("convert", tmp_path / "a.toml", tmp_path / "mm.toml", "--units", "mm", "-q")
    np.testing.assert_allclose(centres(read_rig(tmp_path / "mm.toml")), 1e-3 * centres(rig), atol=1e-15)
    assert "--force" in refused("convert", tmp_path / "a.toml", tmp_path / "b.yml")
    run("convert", tmp_path / "a.toml", tmp_path / "lens.toml", "--lenses", "--undistorted", "-q")
    assert read_lenses(tmp_path / "lens.toml").cameras.dist.size == 0
    run("convert", tmp_path / "a.toml", tmp_path / "other.toml", "--to", "anipose", "-q")
    assert "[metadata]" in (tmp_path / "other.toml").read_text()
    assert "--units: expected one of m, cm, mm, found inch" in refused(
        "convert", tmp_path / "a.toml", tmp_path / "x.toml", "--units", "inch"
    )
    write_rig(tmp_path / "wide.toml", ring_rig(2, coefficients=8))
    message = refused("convert", tmp_path / "wide.toml", tmp_path / "wide.csv")
    assert "camera c0: expected one focal length, found fx" in message
    assert "write a rig.toml" in message
    result = CliRunner().invoke(calibrate, ["convert", "c.csv", "x.toml", "--size", "320"])
    assert result.exit_code == 2
    assert "expected two whole numbers above 0" in result.output
