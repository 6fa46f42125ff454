"""`psotrack calibrate rig` without a board, as a user types it: a moving point, a stick, points, markers, worlds."""

import json

import numpy as np
import pytest
from board_rigs import row_of_cameras
from click.testing import CliRunner

from psotrack.cli.calibrate import calibrate
from psotrack.errors import PsotrackError
from psotrack.geometry import project
from psotrack.geometry.rig_files import read_rig, write_rig
from psotrack.recordings import Detections, write_detections

RIG = row_of_cameras(3)
CENTRES = np.asarray(RIG.cameras.centre_world)


@pytest.fixture
def lenses(tmp_path):
    write_rig(tmp_path / "lenses.toml", RIG)
    return tmp_path / "lenses.toml"


def run(*arguments):
    result = CliRunner(env={"COLUMNS": "200"}).invoke(
        calibrate, ["rig", *map(str, arguments)], catch_exceptions=False
    )
    assert result.exit_code == 0, result.output
    return result.stdout


def refused(*arguments):
    """Message of the error; `main` prints the message as one line and exits with code 2."""
    with pytest.raises(PsotrackError) as error:
        run(*arguments)
    message = str(error.value)
    assert "\n" not in message
    return message


def write_lines(path, lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def flight(instants=60):
    """Positions of a point that flies through the room."""
    t = np.linspace(0, 30, instants)
    return np.stack([0.8 * np.sin(t), 0.8 * np.cos(0.7 * t), 1.1 + 0.5 * np.sin(0.31 * t)], axis=-1)


def sightings(path, ends_m, noise_px=0.3, names=RIG.names):
    """Table of the pixels of points, (ends, frames, 3); `point` only for two ends."""
    rng = np.random.default_rng(0)
    lines = ["camera,frame,x_px,y_px" + (",point" if len(ends_m) > 1 else "")]
    for end, points_m in enumerate(ends_m):
        pixels = project(RIG.cameras, points_m[:, None])[0] + rng.normal(0, noise_px, (len(points_m), 3, 2))
        lines += [
            f"{name},{frame},{x},{y}" + (f",{end}" if len(ends_m) > 1 else "")
            for frame, of_frame in enumerate(pixels)
            for name, (x, y) in zip(RIG.names, of_frame, strict=True)
            if name in names
        ]
    return write_lines(path, lines)


def gaps(rig):
    centres = np.asarray(rig.cameras.centre_world)
    return np.linalg.norm(centres[:, None] - centres, axis=-1)


def world(path, places):
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in places.items()]
    return write_lines(path, ["point,x_m,y_m,z_m", *rows])


@pytest.mark.slow
def test_a_moving_point_and_one_length(tmp_path, lenses):
    light = sightings(tmp_path / "light.csv", flight()[None])
    start = (light, "--points", "--lenses", lenses)
    apart = np.linalg.norm(CENTRES[0] - CENTRES[2])
    shown = run(*start, "--distance", f"c0,c2={apart}", "--out", tmp_path / "rig.toml")
    assert "the world is camera c0" in shown
    np.testing.assert_allclose(gaps(read_rig(tmp_path / "rig.toml")), gaps(RIG), atol=0.03)
    # The world by the point's positions in some frames, as a drone's GPS gives.
    known = {frame: flight()[frame] for frame in range(0, 60, 6)}
    shown = run(*start, "--world", world(tmp_path / "world.csv", known), "--out", tmp_path / "in_world.toml")
    assert "10 points are met to" in shown
    np.testing.assert_allclose(read_rig(tmp_path / "in_world.toml").cameras.centre_world, CENTRES, atol=0.03)
    out = ("--out", tmp_path / "other.toml")
    assert (
        "expected one of --distance NAME,NAME=METRES, --stick METRES and --world FILE, found none"
        in refused(*start, *out)
    )
    assert "found 2" in refused(*start, "--distance", "c0,c2=1", "--stick", "1", *out)
    assert "distance: expected two of c0, c1, c2, found c0,top" in refused(
        *start, "--distance", "c0,top=1", *out
    )
    assert "expected the two ends of a stick, told apart by a column named point" in refused(
        *start, "--stick", "0.5", *out
    )


@pytest.mark.slow
def test_a_moving_point_before_cameras_with_clocks_of_their_own(tmp_path, lenses):
    """Frames of equal number are of different times: other rates, another start, a rolling shutter."""
    lines = ["version = 1"]
    for index, (fps, start_s, line_s) in enumerate(
        [(25.0, 0.0, 0.0), (30.0, -0.4, 0.0), (50.0, 0.013, 2e-5)]
    ):
        time_s = start_s + np.arange(round(20 * fps)) / fps
        for _ in range(3):
            # The row in which the point is seen says when the row was exposed.
            pixels = project(RIG.cameras[index], smooth(time_s))[0]
            time_s = start_s + np.arange(len(time_s)) / fps + line_s * pixels[:, 1]
        boxes = np.concatenate([pixels - 4, pixels + 4], axis=1) + 0.5
        seen = Detections(np.arange(len(boxes)), boxes, np.ones(len(boxes)))
        write_detections(tmp_path / f"{RIG.names[index]}.csv", seen)
        lines += [
            f"[cameras.{RIG.names[index]}]",
            f'detections = "{RIG.names[index]}.csv"',
            "size = [1280, 720]",
            f"fps = {fps}\ntime_offset_s = {start_s}\nline_time_s = {line_s}",
        ]
    recording = write_lines(tmp_path / "recording.toml", lines)
    apart = np.linalg.norm(CENTRES[0] - CENTRES[2])
    given = ("--points", "--lenses", lenses, "--distance", f"c0,c2={apart}", "--out", tmp_path / "rig.toml")
    run(recording, *given)
    # Half an interval of 20 ms at 1 m/s is 10 mm, and moves the cameras by more than that; boxes are whole pixels.
    np.testing.assert_allclose(gaps(read_rig(tmp_path / "rig.toml")), gaps(RIG), atol=0.005)


def smooth(time_s):
    """Positions of a point that flies through the room at about 1 m/s."""
    return np.stack(
        [0.8 * np.sin(time_s), 0.8 * np.cos(0.7 * time_s), 1.1 + 0.5 * np.sin(1.31 * time_s)], axis=-1
    )


@pytest.mark.slow
def test_sightings_that_hardly_determine_the_rig_are_named(tmp_path, lenses):
    """A point far away before two cameras, 0.4 m apart, whose stated deviations contain the error."""
    far = flight() * (0.5, 1, 1) + (0, 8, 0)
    light = sightings(tmp_path / "light.csv", far[None], noise_px=1.0, names=("c0", "c1"))
    apart = np.linalg.norm(CENTRES[0] - CENTRES[1])
    out = tmp_path / "rig.toml"
    known = world(tmp_path / "world.csv", {frame: far[frame] for frame in range(60)})
    words = (light, "--points", "--lenses", lenses, "--out", out)
    content = json.loads(run(*words, "--world", known, "--json", "-"))
    assert any("hardly determine the places of c0 (±" in note for note in content["notes"])
    for index, name in enumerate(("c0", "c1")):
        std_m = np.linalg.norm(content["cameras"][name]["centre_std_m"])
        off_m = np.linalg.norm(read_rig(out).cameras.centre_world[index] - CENTRES[index])
        assert 0.1 * apart < std_m
        assert off_m < 4 * std_m


@pytest.mark.slow
def test_a_stick_of_two_lights(tmp_path, lenses):
    turn = np.linspace(0, 12, 60)
    along = 0.25 * np.stack([np.cos(turn), np.sin(turn), np.zeros(60)], axis=-1)
    stick = sightings(tmp_path / "stick.csv", np.stack([flight() - along, flight() + along]))
    run(stick, "--points", "--lenses", lenses, "--stick", "0.5", "--out", tmp_path / "rig.toml")
    np.testing.assert_allclose(gaps(read_rig(tmp_path / "rig.toml")), gaps(RIG), atol=0.03)


def test_points_of_known_place(tmp_path, lenses):
    points_m = flight(14)
    pixels = project(RIG.cameras, points_m[:, None])[0] + np.random.default_rng(1).normal(0, 0.3, (14, 3, 2))
    pairs = write_lines(
        tmp_path / "pairs.csv",
        ["camera,point,x_px,y_px,x_m,y_m,z_m"]
        + [
            f"{name},p{k},{pixels[k, c, 0]},{pixels[k, c, 1]},{x},{y},{z}"
            for c, name in enumerate(RIG.names)
            for k, (x, y, z) in enumerate(points_m)
        ],
    )
    out = tmp_path / "rig.toml"
    content = json.loads(run("--pairs", pairs, "--lenses", lenses, "--out", out, "--json", "-"))
    assert content["cameras"]["c1"]["used"] == 14
    np.testing.assert_allclose(read_rig(out).cameras.centre_world, CENTRES, atol=0.02)
    other = ("--out", tmp_path / "other.toml")
    no_lens = refused("--pairs", pairs, *other)
    assert "--lenses: expected a calibration with the lens of each camera, or --fov H,V" in no_lens
    assert "--pairs: expected no video" in refused("a.mp4", "--pairs", pairs, "--lenses", lenses, *other)
    assert "--world: expected none" in refused("--pairs", pairs, "--world", pairs, "--lenses", lenses, *other)
    write_rig(tmp_path / "two.toml", RIG.select(["c0", "c1"]))
    assert "expected the lens of c2, found only c0, c1" in refused(
        "--pairs", pairs, "--lenses", tmp_path / "two.toml", *other
    )
