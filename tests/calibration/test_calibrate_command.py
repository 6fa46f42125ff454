"""`psotrack calibrate`: boards, marks, markers on walls, a moving point, conversions; and bad input of the room."""

import json
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pandas as pd
import pytest
from board_rigs import (
    BOARD,
    HELD,
    HELD_K,
    Scene,
    draw_board,
    film_board,
    fly_point,
    gaps_of,
    random_poses,
    row_of_cameras,
    write_pairs,
)
from clock_worlds import random_motion, simulate_estimate, simulate_reference
from helpers import assert_refused, calls, make_once, posed, ring_rig, simple_lens
from marker_worlds import draw_markers, marker_at
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

import psotrack as pt
from psotrack.calibration import (
    Board,
    LensChoice,
    LensModel,
    PointViews,
    align,
    calibrate_by_point,
    calibrate_rig,
    detect_board,
    find_views,
    fit_world,
    instants_of_numbers,
    locate_camera,
    open_images,
    read_point_views,
    read_world,
)
from psotrack.calibration.rig.moving_point import adjust
from psotrack.evaluation import find_offset
from psotrack.geometry import Rig, make_rig, project
from psotrack.geometry.rig_files import read_lenses, read_rig, write_calibration, write_rig
from psotrack.recordings import Detections, VideoWriter, write_detections
from psotrack.recordings.datasets import write_marker_corners

RIG, FOUR = row_of_cameras(3), row_of_cameras(4)
CENTRES_M = np.asarray(RIG.cameras.centre_world)


@pytest.fixture
def calibrate(run_psotrack):
    """Runs `psotrack calibrate`; what it prints, or the JSON."""

    def call(*words):
        done = run_psotrack("calibrate", *words).ended()
        return json.loads(done.out) if "-" in words else " ".join(done.out.split())

    return call


@pytest.fixture
def lenses(tmp_path):
    write_rig(tmp_path / "lenses.toml", RIG)
    return tmp_path / "lenses.toml"


def write_lines(path, lines):
    path.write_text("\n".join(lines) + "\n")
    return path


# Points of known place, and markers.


def test_a_rig_from_marks(calibrate, tmp_path):
    rig = ring_rig(3, coefficients=5, image_size_wh=(1920, 1080))
    write_rig(tmp_path / "lenses.yml", rig)
    pairs = write_pairs(tmp_path / "pairs.csv", rig, wrong=("c1", 4))
    out = tmp_path / "rig.toml"
    words = ("rig", "--pairs", pairs, "--lenses", tmp_path / "lenses.yml", "--out", out)
    said = calibrate(*words, "--json", tmp_path / "report.json")
    assert "p4" in said
    assert "left out" in said
    found = read_rig(out)
    assert found.names == rig.names
    rows = json.loads((tmp_path / "report.json").read_text())["cameras"]
    for index, name in enumerate(rig.names):
        row = rows[name]
        centre_m = found.cameras.centre_world[index]
        off_m = np.abs(centre_m - rig.cameras.centre_world[index])
        assert row["points"] - row["used"] == (name == "c1")
        np.testing.assert_allclose(row["centre_m"], centre_m, atol=1e-12)
        # Five standard deviations: one in a million.
        assert (off_m < 5 * np.array(row["centre_std_m"])).all()
        assert max(row["centre_std_m"]) < 0.01
        assert 0.3 < row["rms_px"] < 1.2
    worst = rows["c1"]["worst"][0]
    assert worst == {"point": "p4", "residual_px": pytest.approx(80, abs=10), "used": False}


def test_positions_in_a_separate_file_and_a_lens_from_a_data_sheet(calibrate, tmp_path):
    pairs = [f"60881257,p{i},{x},{y}" for i, (x, y) in enumerate(PIXELS.tolist())]
    write_lines(tmp_path / "pairs.csv", ["camera,point,x_px,y_px", *pairs])
    world(tmp_path / "points.csv", {f"p{i}": place for i, place in enumerate(POINTS_M.tolist())})
    # The angles of the whole image, half a pixel beyond the first and the last pixels' centres.
    width_deg, height_deg = np.degrees(2 * np.arctan([960 / 1157, 540 / 1157]))
    lens = ("--fov", f"{width_deg},{height_deg}", "--size", "1920,1080")
    files = ("--pairs", tmp_path / "pairs.csv", "--places", tmp_path / "points.csv")
    calibrate("rig", *files, *lens, "--out", tmp_path / "a.toml", "-q")
    found = read_rig(tmp_path / "a.toml")
    np.testing.assert_allclose(found.cameras.centre_world, [CAMERA.centre_world], atol=1e-6)


def test_a_rig_from_markers_on_the_walls(calibrate, tmp_path):
    """A sequence with a camera that sees markers on two walls; and the same by a video for each camera."""
    corners = {}
    for number, (y, z) in enumerate([(-0.25, 1.65), (-1.15, 0.35), (-1.15, 1.65), (-0.35, 0.35)]):
        corners[number + 3] = marker_at((-1.5, y, z), (1, 0, 0), side_m=0.5)
    for number, (x, z) in enumerate([(-1.05, 1.65), (-0.15, 0.85), (0.75, 1.65)]):
        corners[number + 20] = marker_at((x, -1.5, z), (0, 1, 0), side_m=0.5)
    folder = tmp_path / "ROOM"
    folder.mkdir()
    with VideoWriter(folder / "cam1i_s.avi", 25.0, (1920, 1080)) as writer:
        for _ in range(3):
            writer.write(draw_markers(corners, CAMERA))
    write_calibration(folder / "cameras_calibration.csv", make_rig({"cam1i": CAMERA}))
    write_marker_corners(folder / "aruco_corners.csv", corners)
    known = ("--markers", folder / "aruco_corners.csv", "--noise", "0.3")
    lens = ("--lenses", folder / "cameras_calibration.csv", "--size", "1920,1080")
    content = calibrate("rig", folder, *known, *lens, "--out", tmp_path / "rig.toml", "--json", "-")
    row = content["cameras"]["cam1i"]
    assert row["points"] == 7 * 4
    number, _, _ = row["worst"][0]["point"].partition(".")
    assert int(number) in corners
    lens = ("--lenses", tmp_path / "rig.toml")
    calibrate("rig", folder / "cam1i_s.avi", *known, *lens, "--out", tmp_path / "again.toml")
    for name, file in (("cam1i", "rig.toml"), ("cam1i_s", "again.toml")):
        found = read_rig(tmp_path / file)
        assert found.names == (name,)
        off_m = found.cameras.centre_world[0] - CAMERA.centre_world
        # A tenth of a pixel at 5 m is 0.5 mm, but corners in compressed video have larger errors.
        assert np.linalg.norm(off_m) < 0.01


# Boards.

STATED = ("--squares", "7x5", "--square", "0.04", "--marker", "0.03", "--dictionary", "4x4_50")


def poses_by_two_cameras(count=8):
    """Poses of the board in the hand before a left camera, and before one that is 0.1 m to its right."""
    left = np.array(list(random_poses(count)))
    right = left.copy()
    right[:, 0, 3] -= 0.1
    return {"left": left, "right": right}


@pytest.mark.slow
def test_videos_of_a_board_that_begin_at_different_times(calibrate, tmp_path):
    """More than 300 frames are not all searched, which a line says; the frame of --floor always is."""
    knots = {name: poses[[0, 2, 5, 6, 8]] for name, poses in poses_by_two_cameras(9).items()}
    time, floor = np.linspace(0, 4, 340), {}
    for name, few in knots.items():
        smooth = np.tile(np.eye(4), (len(time), 1, 1))
        turns = RotationSpline(np.arange(5), Rotation.from_matrix(few[:, :3, :3]))
        smooth[:, :3, :3] = turns(time).as_matrix()
        smooth[:, :3, 3] = CubicSpline(np.arange(5), few[:, :3, 3])(time)
        film_board(tmp_path / f"{name}.avi", smooth[:315] if name == "left" else smooth[25:])
        floor[name] = smooth[45, :3, 3]
    out = tmp_path / "rig.toml"
    videos = [tmp_path / f"{name}.avi" for name in knots]
    said = calibrate("rig", *videos, *STATED, "--lens", "0", "--floor", "45", "--out", out)
    # Every second frame, and that of the floor.
    assert "left 159 of 315" in said
    assert (
        "right begins 25 frames later than left, as the board moves: its frame 0 is of the instant of" in said
    )
    np.testing.assert_allclose(read_rig(out).cameras.T_cam_world[:, :3, 3], list(floor.values()), atol=0.005)


@pytest.mark.slow
def test_a_rig_that_does_not_fit_is_not_written(run_psotrack, tmp_path):
    """Pictures that were taken now and then show no motion, and some of one camera are counted wrongly."""
    order = {"left": np.arange(14), "right": np.array([0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12, 13, 6])}
    for name, poses in poses_by_two_cameras(14).items():
        (tmp_path / name).mkdir()
        for number, T in enumerate(poses[order[name]]):
            image = draw_board(HELD, HELD_K, T, (640, 480))
            cv2.imwrite(str(tmp_path / name / f"{20 * number}.png"), image)
    words = ("calibrate", "rig", tmp_path / "left", tmp_path / "right", *STATED, "--lens", "0", "--out")
    words = (*words, tmp_path / "rig.toml")
    line = "expected a rig that fits the board's views to 0.5% of the images' width, found the board off by "
    assert_refused(lambda: run_psotrack(*words), line, "--force writes", unchanged=tmp_path)
    assert run_psotrack(*words, "--force").code == 0


@pytest.mark.slow
def test_a_rig_from_folders_of_images_of_a_board(calibrate, tmp_path, caplog):
    """Printed white on black; the function of the package gives the same."""
    paths = []
    for name, poses in poses_by_two_cameras().items():
        (tmp_path / name).mkdir()
        paths.append(str(tmp_path / name))
        for number, T in enumerate(poses):
            image = 255 - draw_board(HELD, HELD_K, T, (640, 480))
            cv2.imwrite(f"{paths[-1]}/{number}.png", image)
    out = tmp_path / "rig.toml"
    content = calibrate("rig", *paths, *STATED, "--lens", "0", "--out", out, "--json", "-")
    known = {"squares": (7, 5), "square_m": 0.04, "marker_m": 0.03, "dictionary": "4x4_50", "lens": "0"}
    found = pt.calibrate_rig(paths, **known, out=out, force=True)
    assert json.loads(json.dumps(found.to_dict())) == content
    assert "the world is camera left" in str(found)
    rig = read_rig(out)
    assert rig.names == ("left", "right")
    np.testing.assert_allclose(rig.cameras.centre_world, [[0, 0, 0], [0.1, 0, 0]], atol=0.005)
    # Of one camera only the lens is found; test_boards has the exact bounds.
    one = ("rig", paths[0], *STATED, "--names", "60881257", "--out", tmp_path / "lens.toml")
    content = calibrate(*one, "--lens", "auto", "--json", "-")["cameras"]["60881257"]
    words = "camera 60881257: lens models are compared by at least 9 views, found 8: it gets the usual"
    assert words in caplog.text
    lens = read_lenses(tmp_path / "lens.toml")
    assert lens.names == ("60881257",)
    f_x, f_y, _ = np.diag(lens.cameras.K[0])
    assert content["focal_px"] == [f_x, f_y]
    assert abs(f_x - 620) < 12


# A moving point.


def sightings(path, *ends_m, noise_px=0.3, names=RIG.names):
    """Table of the pixels of points, (frames, 3) each, in the cameras of these names."""
    rng = np.random.default_rng(0)
    lines = ["camera,frame,x_px,y_px,point"]
    for end, points_m in enumerate(ends_m):
        pixels, _ = project(RIG.cameras, points_m[:, None])
        pixels = pixels + rng.normal(0, noise_px, pixels.shape)
        for name in names:
            of_camera = pixels[:, RIG.names.index(name)]
            lines += [f"{name},{frame},{x},{y},{end}" for frame, (x, y) in enumerate(of_camera)]
    return write_lines(path, lines)


def world(path, places):
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in places.items()]
    return write_lines(path, ["point,x_m,y_m,z_m", *rows])


def test_a_moving_point_with_one_length_or_a_world_and_a_stick(calibrate, tmp_path, lenses):
    flown_m = fly_point()
    out = tmp_path / "rig.toml"
    light = sightings(tmp_path / "light.csv", flown_m)
    start = ("--points", "--lenses", lenses, "--force", "--out", out)
    said = calibrate("rig", light, *start, "--distance", f"c0,c2={gaps_of(RIG)[0, 2]}")
    assert "the world is camera c0" in said
    np.testing.assert_allclose(gaps_of(read_rig(out)), gaps_of(RIG), atol=0.03)
    # The world by the point's positions in some frames, as a drone's GPS gives.
    known = {frame: flown_m[frame] for frame in range(0, 60, 6)}
    said = calibrate("rig", light, *start, "--world", world(tmp_path / "world.csv", known))
    assert "10 points are met to" in said
    np.testing.assert_allclose(read_rig(out).cameras.centre_world, CENTRES_M, atol=0.03)
    turn = np.linspace(0, 12, 60)
    along_m = 0.25 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
    stick = sightings(tmp_path / "stick.csv", flown_m - along_m, flown_m + along_m)
    calibrate("rig", stick, *start, "--stick", "0.5")
    np.testing.assert_allclose(gaps_of(read_rig(out)), gaps_of(RIG), atol=0.03)


def test_a_moving_point_before_cameras_with_clocks_of_their_own(calibrate, tmp_path, lenses):
    """Frames of equal number are of different times: other rates, another start, a rolling shutter."""

    def at(t):
        return np.stack([0.8 * np.sin(t), 0.8 * np.cos(0.7 * t), 1.1 + 0.5 * np.sin(1.31 * t)], axis=-1)

    lines = ["version = 1"]
    clocks = [(25.0, 0.0, 0.0), (30.0, -0.4, 0.0), (50.0, 0.013, 2e-5)]
    for index, (fps, start_s, line_s) in enumerate(clocks):
        frame = np.arange(round(20 * fps))
        start_of_frame_s = start_s + frame / fps
        time_s = start_of_frame_s
        for _ in range(3):
            # The row in which the point is seen says when the row was exposed.
            pixels, _ = project(RIG.cameras[index], at(time_s))
            time_s = start_of_frame_s + line_s * pixels[:, 1]
        boxes = np.concatenate([pixels - 3.5, pixels + 4.5], axis=1)
        name = RIG.names[index]
        write_detections(tmp_path / f"{name}.csv", Detections(frame, boxes, np.ones(len(frame))))
        lines += [f"[cameras.{name}]", f'detections = "{name}.csv"', "size = [1280, 720]", f"fps = {fps}"]
        lines += [f"time_offset_s = {start_s}", f"line_time_s = {line_s}"]
    recording = write_lines(tmp_path / "recording.toml", lines)
    out = tmp_path / "rig.toml"
    apart = ("--distance", f"c0,c2={gaps_of(RIG)[0, 2]}")
    calibrate("rig", recording, "--points", "--lenses", lenses, *apart, "--out", out)
    # Half an interval of 20 ms at 1 m/s is 10 mm, and moves the cameras by more than that; boxes are whole pixels.
    np.testing.assert_allclose(gaps_of(read_rig(out)), gaps_of(RIG), atol=0.005)


@pytest.mark.slow
def test_sightings_that_hardly_determine_the_rig_are_named(calibrate, tmp_path, lenses):
    """A point far away before two cameras, 0.4 m apart, whose stated deviations contain the error."""
    far_m = fly_point() * (0.5, 1, 1) + np.array([0.0, 8.0, 0.0])
    out = tmp_path / "rig.toml"
    light = sightings(tmp_path / "light.csv", far_m, noise_px=1.0, names=("c0", "c1"))
    known = world(tmp_path / "world.csv", dict(enumerate(far_m)))
    words = ("rig", light, "--points", "--lenses", lenses, "--out", out, "--world", known)
    content = calibrate(*words, "--json", "-")
    assert any("hardly determine the places of c0 (±" in note for note in content["notes"])
    off_m = read_rig(out).cameras.centre_world - CENTRES_M[:2]
    for index, name in enumerate(("c0", "c1")):
        std_m = np.linalg.norm(content["cameras"][name]["centre_std_m"])
        assert std_m > 0.1 * gaps_of(RIG)[0, 1]
        assert np.linalg.norm(off_m[index]) < 4 * std_m


# Conversions.


def test_files_are_converted(calibrate, tmp_path):
    rig = ring_rig(3, coefficients=4)
    K = rig.cameras.K.copy()
    K[:, 1, 1] = K[:, 0, 0]
    rig = Rig(rig.names, replace(rig.cameras, K=K))
    a, b, c, d = tmp_path / "a.toml", tmp_path / "b.yml", tmp_path / "c.csv", tmp_path / "d.toml"
    write_rig(a, rig)
    assert "c2" in calibrate("convert", a, b)
    calibrate("convert", b, c, "-q")
    content = calibrate("convert", c, d, "--size", "320,240", "--json", "-")
    assert content["rig"] == str(d)
    # Two files have Rodrigues vectors, whose conversion rounds.
    np.testing.assert_allclose(read_rig(d).cameras.T_cam_world, rig.cameras.T_cam_world, atol=1e-14)
    out = tmp_path / "out.toml"
    calibrate("convert", a, out, "--units", "mm", "-q")
    in_mm = read_rig(out).cameras.centre_world
    np.testing.assert_allclose(in_mm, 1e-3 * rig.cameras.centre_world, atol=1e-15)
    calibrate("convert", a, out, "--lenses", "--undistorted", "-q", "--force")
    assert read_lenses(out).cameras.dist.size == 0
    calibrate("convert", a, out, "--to", "anipose", "-q", "--force")
    assert "[metadata]" in out.read_text()


# What is refused.


def runs(words):
    """A command on the files of `files`."""
    return lambda folder, run: partial(run, words)


def calibrates(options):
    return runs(f"calibrate rig --out {{new}} {options}")


def reads(text, read):
    """A file of this text is read."""

    def prepare(folder, run):
        path = folder / "points.csv"
        path.write_text(text)
        return partial(read, path)

    return prepare


def pairs(before, after):
    """Marks are read after a change of their table."""

    def prepare(folder, run):
        path = write_pairs(folder / "pairs.csv", RIG)
        path.write_text(path.read_text().replace(before, after, 1))
        return lambda: run("calibrate rig --pairs {tmp}/pairs.csv --lenses {lenses} --out {new}")

    return prepare


def flat_views(folder, run):
    """A board that is turned and moved in the plane of the image alone is filmed."""
    poses = np.tile(np.eye(4), (10, 1, 1))
    degrees = 3 * np.arange(10)[:, None]
    poses[:, :3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    poses[:, :3, 3] = (0, 0, 0.45) - poses[:, :3, :3] @ [0.14, 0.1, 0]
    poses[:, 0, 3] += 0.005 * np.arange(10)
    cameras = open_images([film_board(folder / "board.avi", poses)])
    found = find_views(HELD, cameras, instants_of_numbers(cameras))
    return partial(calibrate_rig, found.board, found.views, LensChoice(LensModel(4)))


def board_views(change):
    """Views of a board, some corners of which are taken away."""
    views = Scene(RIG).views(np.random.default_rng(8))
    pixels = views.corners_px.copy()
    change(pixels)
    return calls(calibrate_rig, BOARD, replace(views, corners_px=pixels))


def apart(pixels):
    pixels[2, ::2] = np.nan
    pixels[:2, 1::2] = np.nan


def offsets(path, *, max_offset_s=1.0, offset_s=0.2, backwards=False, **others):
    """The clock of a reference with this path is sought by noisy tracks."""
    estimate = simulate_estimate(path, offset_s=offset_s, noise_m=0.02, **others)
    time_s, position_m = simulate_reference(path)
    if backwards:
        time_s = time_s[::-1]
    return calls(find_offset, estimate, time_s, position_m, max_offset_s=max_offset_s)


# Points before a camera.
RNG = np.random.default_rng(9)
LENS = simple_lens(1157.0, (1920, 1080))
CAMERA = posed(LENS, (4.0, 3.0, 2.0), (0.0, 0.0, 1.0))
POINTS_M = RNG.uniform((-1, -1, 0), (1, 1, 2), (12, 3))
PIXELS, _ = project(CAMERA, POINTS_M)
#: Points on a line.
LINE_M = POINTS_M[0] + np.arange(5)[:, None] * np.array([0.2, 0.1, 0.05])
LINE_PX, _ = project(CAMERA, LINE_M)
#: A sheet of 20 cm at a distance of 8 m, tilted a little, looks the same if it is tilted to the other side.
SHEET_M = np.array([(x, y, 0) for x in (-0.1, 0.0, 0.1) for y in (-0.1, 0.1)])
SHEET_CAMERA = posed(LENS, (0.9, 0.0, 8.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))
SHEET_PX = project(SHEET_CAMERA, SHEET_M)[0] + np.random.default_rng(0).normal(0, 0.5, (6, 2))
located = partial(calls, locate_camera, name="camera c7")


def point_views(pixels):
    count = np.arange(len(pixels))
    return PointViews(FOUR.names, np.zeros_like(count), count, pixels)


FLOWN_PX, _ = project(FOUR.cameras, fly_point()[:, None])
#: Two cameras see one half of the points, and the two others the rest.
HALVES_PX = FLOWN_PX.copy()
HALVES_PX[:30, :2] = np.nan
HALVES_PX[30:, 2:] = np.nan
LINE = np.arange(4.0)[:, None] * [1.0, 2.0, 0.5]
END_TWICE = "camera,frame,point,x_px,y_px\nc0,0,tip,1,1\nc0,0,tip,1,1\n"
SUN = "point,x_m,y_m,z_m\nc0,0,0,0\nc1,1,0,0\nsun,1,1,1\n"
GREY = [np.full((240, 320), 128, np.uint8)] * 3

#: Name of the case -> how the bad input is made, and words of the line.
BAD = {
    # Marks, and points of known place.
    "point twice": (pairs("c1,p3,", "c1,p2,"), "line 19, column point", "once per camera, found p2 again"),
    "unknown point": (pairs("c1,p3,", "c1,p99,"), "line 19, column point: expected x_m, y_m, z_m in one of"),
    "no lens of it": (pairs("c1,p3,", "c9,p3,"), "lenses.toml: expected the lens of c9, found only c0, c1"),
    "three points": (located(POINTS_M[:3], PIXELS[:3], CAMERA), "camera c7", "known position, found 3"),
    "a line": (located(LINE_M, LINE_PX, CAMERA), "camera c7", "not all on one line"),
    "mirrored": (located(POINTS_M * [1, -1, 1], PIXELS, CAMERA), "camera c7", "check for mirrored axes"),
    "mixed up": (located(POINTS_M, PIXELS[RNG.permutation(12)], CAMERA), "camera c7", "mixed up"),
    "small plane": (located(SHEET_M, SHEET_PX, SHEET_CAMERA), "camera c7", "two poses"),
    # Boards and their views.
    "no board": (calls(detect_board, 0.04, GREY), "or a chessboard, found neither in 3 images"),
    "dictionary": (calls(Board((7, 5), 0.04, 0.03, "9x9").opencv), "dictionary", "4x4_50", "found 9x9"),
    # The fit ended at a focal length of 320 000 px, with which the boards seem tilted, and that lens was accepted.
    "flat, far": (flat_views, "views that determine the focal length"),
    "few views": (
        board_views(lambda pixels: pixels[1, 4:].fill(np.nan)),
        "camera c1: expected at least 5 views of 6 corners",
    ),
    "apart": (board_views(apart), "no instant at which one of c0, c1 and one of c2 see the board together"),
    "no images": (calls(open_images, ["top*.png"]), "images of this pattern, found none"),
    # A moving point, and the world.
    "few instants": (
        calls(calibrate_by_point, FOUR, point_views(FLOWN_PX[:8])),
        "points: expected at least 12 instants",
    ),
    "two halves": (calls(adjust, FOUR, point_views(HALVES_PX)), "cameras: expected points that connect all"),
    "end twice": (reads(END_TWICE, read_point_views), "each point once per camera and frame, found 0 of c0"),
    "two of three": (
        reads(SUN, lambda path: fit_world(FOUR, read_world(path), with_scale=False)),
        "found 2 of 3",
    ),
    "a line given": (calls(align, np.eye(4, 3), LINE, with_scale=True), "not on one line, found 4 on a line"),
    # Clocks.
    "hardly moves": (offsets(random_motion(0, 0.01)), "the offset to a frame, 0.04 s, found a"),
    "out of range": (offsets(random_motion(0), max_offset_s=0.3, offset_s=0.9), "end of the range, +0.3 s"),
    "no common time": (offsets(random_motion(0), start_s=60.0), "of both at offsets within 1 s, found none"),
    "back in time": (offsets(random_motion(0), backwards=True), "reference at two increasing times"),
    # The commands.
    "two ways": (calibrates("--pairs a --markers b"), "found --pairs and --markers"),
    "no way": (calibrates("a b"), "expected one of --square, --squares, --points, --pairs, --markers"),
    "lens of a board": (calibrates("a.mp4 --square 0.04 --fov 60,40"), "--fov: expected points or markers"),
    "no lens": (calibrates("--pairs {pairs}"), "--lenses: expected a calibration with the lens of"),
    "no size": (calibrates("--pairs {pairs} --fov 60,40"), "--size: expected width and height"),
    "no scale": (calibrates("{light} --points --lenses {lenses}"), "and --world FILE, found none"),
    "two scales": (calibrates("{light} --points --lenses {lenses} --distance c0,c2=1 --stick 1"), "found 2"),
    "one end": (calibrates("{light} --points --lenses {lenses} --stick 1"), "two ends of a stick"),
    "far floor": (calibrates("{board} --squares 7x5 --square 0.04 --marker 0.03 --floor 99"), "one is 13"),
    "fx, fy": (runs("calibrate convert {lenses} {tmp}/a.csv"), "expected one focal length, found fx"),
}


def make_files(folder):
    write_rig(folder / "lenses.toml", RIG)
    write_pairs(folder / "pairs.csv", RIG)
    film_board(folder / "board.avi")
    rows = [{"camera": name, "frame": k, "x_px": 1, "y_px": 1} for name in RIG.names for k in range(20)]
    pd.DataFrame(rows).to_csv(folder / "light.csv", index=False)


@pytest.mark.parametrize(("prepare", "words"), [(one, words) for one, *words in BAD.values()], ids=BAD)
def test_bad_input_is_refused_in_one_line(prepare, words, tmp_path_factory, run_psotrack, tmp_path):
    files = make_once(tmp_path_factory, "calibration_files", make_files)
    paths = {path.stem: path for path in files.iterdir()}
    paths["tmp"] = tmp_path
    paths["new"] = tmp_path / "new.toml"

    def run(line):
        return run_psotrack(*(word.format(**paths) for word in line.split()))

    assert_refused(prepare(tmp_path, run), *words, unchanged=tmp_path)
