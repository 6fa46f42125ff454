"""`psotrack calibrate`: boards, marked points, markers on walls, a moving point, a stick, worlds, and conversions."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from board_rigs import (
    HELD,
    HELD_K,
    WORLD_M,
    draw_board,
    film_board,
    fly_point,
    gaps_of,
    random_poses,
    row_of_cameras,
    write_pairs,
)
from helpers import ring_rig
from marker_worlds import draw_markers, marker_at

import psotrack as pt
from psotrack.geometry import Rig, look_at, make_camera, make_rig, project
from psotrack.geometry.rig_files import read_lenses, read_rig, write_calibration, write_rig
from psotrack.recordings import Detections, VideoWriter, write_detections
from psotrack.recordings.datasets import write_marker_corners

RIG = row_of_cameras(3)
CENTRES_M = np.asarray(RIG.cameras.centre_world)


@pytest.fixture
def calibrate(run_psotrack):
    """Runs `psotrack calibrate`; what it prints, or the JSON."""

    def call(*words):
        done = run_psotrack("calibrate", *words)
        assert done.code == 0, done.err
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
    pairs, out = write_pairs(tmp_path / "pairs.csv", rig, wrong=("c1", 4)), tmp_path / "rig.toml"
    words = ("rig", "--pairs", pairs, "--lenses", tmp_path / "lenses.yml", "--out", out)
    said = calibrate(*words, "--json", tmp_path / "report.json")
    assert "p4" in said
    assert "left out" in said
    found, rows = read_rig(out), json.loads((tmp_path / "report.json").read_text())["cameras"]
    assert found.names == rig.names
    for index, name in enumerate(rig.names):
        row, centre_m = rows[name], found.cameras.centre_world[index]
        assert row["points"] - row["used"] == (name == "c1")
        np.testing.assert_allclose(row["centre_m"], centre_m, atol=1e-12)
        # Five standard deviations: one in a million.
        assert (np.abs(centre_m - rig.cameras.centre_world[index]) < 5 * np.array(row["centre_std_m"])).all()
        assert max(row["centre_std_m"]) < 0.01
        assert 0.3 < row["rms_px"] < 1.2
    worst = rows["c1"]["worst"][0]
    assert worst == {"point": "p4", "residual_px": pytest.approx(80, abs=10), "used": False}


def test_positions_in_a_separate_file_and_a_lens_from_a_data_sheet(calibrate, tmp_path):
    K = np.array([[800.0, 0, 639.5], [0, 800.0, 359.5], [0, 0, 1]])
    R, t_m = look_at((4.0, 0.5, 2.0), (0.0, 0.0, 1.2))
    rig = make_rig({"60881257": make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1280, 720))})
    pixels = project(rig.cameras[0], WORLD_M)[0].tolist()
    pairs = [f"60881257,p{i},{x},{y}" for i, (x, y) in enumerate(pixels)]
    write_lines(tmp_path / "pairs.csv", ["camera,point,x_px,y_px", *pairs])
    places = [f"p{i},{x},{y},{z}" for i, (x, y, z) in enumerate(WORLD_M.tolist())]
    write_lines(tmp_path / "points.csv", ["point,x_m,y_m,z_m", *places])
    view_deg = [2 * np.rad2deg(np.arctan(side / 2 / 800)) for side in (1280, 720)]
    lens = ("--fov", f"{view_deg[0]},{view_deg[1]}", "--size", "1280,720")
    files = ("--pairs", tmp_path / "pairs.csv", "--places", tmp_path / "points.csv")
    calibrate("rig", *files, *lens, "--out", tmp_path / "a.toml", "-q")
    centre_m = read_rig(tmp_path / "a.toml").cameras.centre_world
    np.testing.assert_allclose(centre_m, rig.cameras.centre_world, atol=1e-6)


def test_a_rig_from_markers_on_the_walls(calibrate, tmp_path):
    """A sequence with a camera that sees markers on two walls; and the same by a video for each camera."""
    K = np.array([[1150.0, 0, 639.5], [0, 1150.0, 359.5], [0, 0, 1]])
    R, t_m = look_at((4.0, -2.5, 2.2), (-0.6, 0.8, 1.2))
    rig = make_rig({"cam1i": make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1280, 720))})
    corners = {}
    for number, (y, z) in enumerate([(0.25, 1.65), (1.15, 0.35), (1.15, 1.65), (0.35, 0.35)]):
        corners[number + 3] = marker_at((-1.5, y, z), (1, 0, 0), side_m=0.5)
    for number, (x, z) in enumerate([(-1.05, 1.65), (-0.15, 0.85), (0.75, 1.65)]):
        corners[number + 20] = marker_at((x, 1.5, z), (0, -1, 0), side_m=0.5)
    folder = tmp_path / "ROOM"
    folder.mkdir()
    with VideoWriter(folder / "cam1i_s.avi", 25.0, (1280, 720)) as writer:
        for _ in range(3):
            writer.write(draw_markers(corners, rig.cameras[0]))
    write_calibration(folder / "cameras_calibration.csv", rig)
    write_marker_corners(folder / "aruco_corners.csv", corners)
    known = ("--markers", folder / "aruco_corners.csv", "--noise", "0.3")
    lens = ("--lenses", folder / "cameras_calibration.csv", "--size", "1280,720")
    row = calibrate("rig", folder, *known, *lens, "--out", tmp_path / "rig.toml", "--json", "-")
    row = row["cameras"]["cam1i"]
    assert row["points"] == 7 * 4
    assert int(row["worst"][0]["point"].partition(".")[0]) in corners
    lens = ("--lenses", tmp_path / "rig.toml")
    calibrate("rig", folder / "cam1i_s.avi", *known, *lens, "--out", tmp_path / "again.toml")
    for name, file in (("cam1i", "rig.toml"), ("cam1i_s", "again.toml")):
        found = read_rig(tmp_path / file)
        assert found.names == (name,)
        # A tenth of a pixel at 5 m is 0.5 mm, but corners in compressed video have larger errors.
        assert np.linalg.norm(found.cameras.centre_world - rig.cameras.centre_world) < 0.01


# Boards.

STATED = ("--squares", "7x5", "--square", "0.04", "--marker", "0.03", "--dictionary", "4x4_50")


def poses_by_two_cameras(count=8):
    """Pairs of poses of the board in the hand, before a left camera and one that is 0.1 m to its right."""
    for T in random_poses(count):
        right = T.copy()
        right[0, 3] -= 0.1
        yield T, right


@pytest.mark.slow
def test_any_frame_of_a_long_video_may_be_the_floor(calibrate, tmp_path):
    """More than 300 frames are not all searched, which a line says; the frame of --floor always is."""
    pairs, out = list(poses_by_two_cameras(18)), tmp_path / "rig.toml"
    videos = [film_board(tmp_path / f"{i}.avi", (pair[i] for pair in pairs), 17) for i in range(2)]
    said = calibrate("rig", *videos, *STATED, "--lens", "0", "--floor", "45", "--out", out)
    # Every second frame, and that of the floor.
    assert "0 154 of 306, 1 154 of 306" in said
    np.testing.assert_allclose(read_rig(out).cameras.T_cam_world[0, :3, 3], pairs[2][0][:3, 3], atol=0.01)


@pytest.mark.slow
def test_a_rig_from_folders_of_images_of_a_board(calibrate, tmp_path, caplog):
    """Printed white on black; the function of the package gives the same."""
    names = ("left", "right")
    for number, pair in enumerate(poses_by_two_cameras()):
        for name, T in zip(names, pair, strict=True):
            (tmp_path / name).mkdir(exist_ok=True)
            image = 255 - draw_board(HELD, HELD_K, T, (640, 480))
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), image)
    paths, out = [str(tmp_path / name) for name in names], tmp_path / "rig.toml"
    content = calibrate("rig", *paths, *STATED, "--lens", "0", "--out", out, "--json", "-")
    assert content["print"] == []
    known = {"squares": (7, 5), "square_m": 0.04, "marker_m": 0.03, "dictionary": "4x4_50", "lens": "0"}
    found = pt.calibrate_rig(paths, **known, out=out, force=True)
    assert json.loads(json.dumps(found.to_dict())) == content
    assert "the world is camera left" in str(found)
    rig = read_rig(out)
    assert rig.names == names
    np.testing.assert_allclose(rig.cameras.centre_world, [[0, 0, 0], [0.1, 0, 0]], atol=0.005)
    # Of one camera only the lens is found; test_boards has the exact bounds.
    one = ("rig", paths[0], *STATED, "--names", "60881257", "--out", tmp_path / "lens.toml")
    content = calibrate(*one, "--lens", "auto", "--json", "-")["cameras"]["60881257"]
    words = "camera 60881257: lens models are compared by at least 9 views, found 8: it gets the usual"
    assert words in caplog.text
    lens = read_lenses(tmp_path / "lens.toml")
    assert lens.names == ("60881257",)
    assert content["focal_px"] == np.diag(lens.cameras.K[0])[:2].tolist()
    assert abs(lens.cameras.K[0, 0, 0] - 620) < 12


# A moving point.


def sightings(path, ends_m, noise_px=0.3, names=RIG.names):
    """Table of the pixels of points, (ends, frames, 3); `point` only for two ends."""
    rng, several = np.random.default_rng(0), len(ends_m) > 1
    lines = ["camera,frame,x_px,y_px" + several * ",point"]
    for end, points_m in enumerate(ends_m):
        pixels = project(RIG.cameras, points_m[:, None])[0] + rng.normal(0, noise_px, (len(points_m), 3, 2))
        for frame, of_frame in enumerate(pixels):
            for name, (x, y) in zip(RIG.names, of_frame, strict=True):
                if name in names:
                    lines.append(f"{name},{frame},{x},{y}" + several * f",{end}")
    return write_lines(path, lines)


def world(path, places):
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in places.items()]
    return write_lines(path, ["point,x_m,y_m,z_m", *rows])


def test_a_moving_point_with_one_length_or_a_world_and_a_stick(calibrate, tmp_path, lenses):
    flown_m, out = fly_point(), tmp_path / "rig.toml"
    light = sightings(tmp_path / "light.csv", flown_m[None])
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
    along_m = 0.25 * np.stack([np.cos(turn), np.sin(turn), np.zeros(60)], axis=-1)
    stick = sightings(tmp_path / "stick.csv", np.stack([flown_m - along_m, flown_m + along_m]))
    calibrate("rig", stick, *start, "--stick", "0.5")
    np.testing.assert_allclose(gaps_of(read_rig(out)), gaps_of(RIG), atol=0.03)


def test_a_moving_point_before_cameras_with_clocks_of_their_own(calibrate, tmp_path, lenses):
    """Frames of equal number are of different times: other rates, another start, a rolling shutter."""

    def at(t):
        return np.stack([0.8 * np.sin(t), 0.8 * np.cos(0.7 * t), 1.1 + 0.5 * np.sin(1.31 * t)], axis=-1)

    lines, clocks = ["version = 1"], [(25.0, 0.0, 0.0), (30.0, -0.4, 0.0), (50.0, 0.013, 2e-5)]
    for index, (fps, start_s, line_s) in enumerate(clocks):
        name, time_s = RIG.names[index], start_s + np.arange(round(20 * fps)) / fps
        for _ in range(3):
            # The row in which the point is seen says when the row was exposed.
            pixels = project(RIG.cameras[index], at(time_s))[0]
            time_s = start_s + np.arange(len(time_s)) / fps + line_s * pixels[:, 1]
        boxes = np.concatenate([pixels - 4, pixels + 4], axis=1) + 0.5
        write_detections(
            tmp_path / f"{name}.csv", Detections(np.arange(len(boxes)), boxes, np.ones(len(boxes)))
        )
        lines += [f"[cameras.{name}]", f'detections = "{name}.csv"', "size = [1280, 720]", f"fps = {fps}"]
        lines += [f"time_offset_s = {start_s}", f"line_time_s = {line_s}"]
    recording = write_lines(tmp_path / "recording.toml", lines)
    apart = ("--distance", f"c0,c2={gaps_of(RIG)[0, 2]}")
    calibrate("rig", recording, "--points", "--lenses", lenses, *apart, "--out", tmp_path / "rig.toml")
    # Half an interval of 20 ms at 1 m/s is 10 mm, and moves the cameras by more than that; boxes are whole pixels.
    np.testing.assert_allclose(gaps_of(read_rig(tmp_path / "rig.toml")), gaps_of(RIG), atol=0.005)


def test_sightings_that_hardly_determine_the_rig_are_named(calibrate, tmp_path, lenses):
    """A point far away before two cameras, 0.4 m apart, whose stated deviations contain the error."""
    far_m, out = fly_point() * (0.5, 1, 1) + (0, 8, 0), tmp_path / "rig.toml"
    light = sightings(tmp_path / "light.csv", far_m[None], noise_px=1.0, names=("c0", "c1"))
    known = world(tmp_path / "world.csv", dict(enumerate(far_m)))
    words = ("rig", light, "--points", "--lenses", lenses, "--out", out, "--world", known)
    content = calibrate(*words, "--json", "-")
    assert any("hardly determine the places of c0 (±" in note for note in content["notes"])
    for index, name in enumerate(("c0", "c1")):
        std_m = np.linalg.norm(content["cameras"][name]["centre_std_m"])
        assert std_m > 0.1 * gaps_of(RIG)[0, 1]
        assert np.linalg.norm(read_rig(out).cameras.centre_world[index] - CENTRES_M[index]) < 4 * std_m


# Conversions.


def test_files_are_converted(calibrate, tmp_path):
    rig = ring_rig(3, coefficients=4)
    K = rig.cameras.K.copy()
    K[:, 1, 1] = K[:, 0, 0]
    rig = Rig(rig.names, replace(rig.cameras, K=K))
    files = {name: tmp_path / name for name in ("a.toml", "b.yml", "c.csv", "d.toml", "mm.toml", "lens.toml")}
    a, b, c, d, mm, lens = files.values()
    write_rig(a, rig)
    assert "c2" in calibrate("convert", a, b)
    calibrate("convert", b, c, "-q")
    assert calibrate("convert", c, d, "--size", "320,240", "--json", "-")["rig"] == str(d)
    # Two files have Rodrigues vectors, whose conversion rounds.
    np.testing.assert_allclose(read_rig(d).cameras.T_cam_world, rig.cameras.T_cam_world, atol=1e-14)
    calibrate("convert", a, mm, "--units", "mm", "-q")
    in_mm = read_rig(mm).cameras.centre_world
    np.testing.assert_allclose(in_mm, 1e-3 * rig.cameras.centre_world, atol=1e-15)
    calibrate("convert", a, lens, "--lenses", "--undistorted", "-q")
    assert read_lenses(lens).cameras.dist.size == 0
    calibrate("convert", a, tmp_path / "other.toml", "--to", "anipose", "-q")
    assert "[metadata]" in (tmp_path / "other.toml").read_text()
