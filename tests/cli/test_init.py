"""`psotrack init`: files of a folder are matched to cameras by their names, and nothing is guessed."""

import io
import itertools
import json
import shlex
import string
import sys
import unicodedata

import cv2
import msgspec
import numpy as np
import pytest
from helpers import assert_refused, content_of
from hypothesis import given
from hypothesis import strategies as st

from psotrack.geometry import camera_key, cameras_of, chosen_camera
from psotrack.geometry.rig_files import read_rig
from psotrack.recordings import (
    CameraTable,
    RecordingFile,
    VideoWriter,
    WorldTable,
    read_recording_file,
    write_recording_file,
)
from psotrack.recordings.datasets import open_recording
from psotrack.recordings.mocap import Markers, write_c3d

CAMERA = """size = [64, 48]
K = [[60, 0, 32], [0, 60, 24], [0, 0, 1]]
rvec = [1.5, 0, 0]
tvec = [0, 0, 5]
"""
BOXES = "2,0,0,9,9,4,5,0.5\n"


@pytest.fixture
def folder(tmp_path):
    """Return a function that makes a folder with files of these names and a `rig.toml` of these cameras."""

    def make(*files, cameras=()):
        path = tmp_path / "flight"
        path.mkdir()
        rig = "version = 1\n" + "\n".join(f"[cameras.{json.dumps(name)}]\n{CAMERA}" for name in cameras)
        for name in ("rig.toml", *files) if cameras else files:
            file = path / name
            file.parent.mkdir(exist_ok=True)
            if file.suffix == ".png":
                cv2.imwrite(str(file), np.zeros((48, 64), np.uint8))
            elif file.suffix in (".csv", ".toml"):
                file.write_text(BOXES if file.suffix == ".csv" else rig)
            else:
                with VideoWriter(tmp_path / "small.avi", 25.0, (64, 48)) as writer:
                    for index in range(4):
                        writer.write(np.full((48, 64, 3), 40 * index, np.uint8))
                (tmp_path / "small.avi").rename(file)
        return path

    return make


@pytest.fixture
def init(run_psotrack):
    """Runs `init`, which must succeed: what it prints."""
    return lambda *words: run_psotrack("init", *words).ended().out


@pytest.fixture
def refuses(run_psotrack):
    """Runs `init`, which must refuse in one line with some words."""

    def refuses(folder, *words, options=()):
        assert_refused(lambda: run_psotrack("init", folder, *options), *words, unchanged=folder)

    return refuses


@pytest.mark.parametrize(
    ("cameras", "videos"),
    [
        (("cam1", "cam10", "cam2"), ("cam1i_s.avi", "cam10i_s.avi", "cam2i_s.avi")),
        (("60881257", "55260362"), ("cam_60881257.avi", "cam_55260362.avi")),
        (("cam_60881257", "cam_55260362"), ("60881257.avi", "55260362.avi")),
        (("GoPro 3", "GoPro 12"), ("gopro3_clip.AVI", "GOPRO-12.avi")),
        (("left", "right"), ("2026-05-01_LEFT.avi", "2026-05-01_right_2.avi")),
        (("0", "1"), ("cam_0.avi", "cam_1.avi")),
        (("cam01", "cam02"), ("cam1.avi", "cam_2_take7.avi")),
        (("front left", "front"), ("front_left.avi", "front.avi")),
        (("top", "side"), ("top/minimal_top.avi", "side/clip.avi")),
        (("cam1", "cam2"), ("cam[1]/clip.avi", "cam(2).avi")),
    ],
)
def test_files_are_matched_to_cameras(init, folder, cameras, videos):
    path = folder(*videos, cameras=cameras)
    shown = init(path)
    recording = open_recording(path).usable()
    found = [path / name for name in videos]
    assert [recording.videos[name].path for name in cameras] == found
    assert recording.rig.names == cameras
    for name in (*cameras, *(each.name for each in found), "64 x 48", "25"):
        assert name in shown


def test_everything_in_a_folder_is_found(init, folder):
    images = [f"Right/{index}.png" for index in range(12)]
    path = folder(
        "left.avi", "notes/extra.avi", "left_ignore.png", *images, cameras=("left", "right", "top", "unused")
    )
    (path / "dl_data").mkdir()
    texts = {
        # Cameras that see nothing at first.
        "dl_data/left.csv": f"0\n1\n{BOXES}",
        "dl_data/top.csv": "0,,\n1,,,,,,,\n2,0,0,9,9,4,5,0.5,,,\n",
        "left_times.csv": "frame,time_s\n0,0\n1,0.1\n2,0.15\n3,0.2\n",
        "drone.tum": "".join(f"{t} 0 0 1 0 0 0 1\n" for t in (0, 0.1, 0.2)),
        "aruco_corners.csv": "id;x1\n",
        "notes.txt": "windy",
        # The output of `track`, which must not become the reference of its own evaluation.
        "tracks.csv": "frame,time_s,drone,x_m,y_m,z_m,status\n0,0,0,1,1,1,tracked\n",
        ".hidden.mp4": "",
    }
    for name, text in texts.items():
        (path / name).write_text(text)
    shown = init(path, "--fps", 30)
    content = read_recording_file(path / "recording.toml")
    assert content == RecordingFile(
        version=1,
        calibration="rig.toml",
        cameras={
            "left": CameraTable(
                video="left.avi",
                ignore="left_ignore.png",
                detections="dl_data/left.csv",
                timestamps="left_times.csv",
            ),
            "right": CameraTable(video="Right", fps=30.0),
            "top": CameraTable(detections="dl_data/top.csv", size=(64, 48), fps=30.0),
        },
        reference=content.reference,
        markers=content.markers,
    )
    assert content.reference.files == ("drone.tum",)
    assert content.markers.corners == "aruco_corners.csv"
    assert "cameras without any file, left out: unused" in shown
    assert "files that are not used: extra.avi, notes.txt, tracks.csv" in shown
    recording = open_recording(path)
    assert recording.videos["right"].num_frames == 12
    assert recording.usable(videos=False).rig.names == ("left", "right", "top")


def test_a_calibration_and_a_file_elsewhere(init, folder, tmp_path):
    path = folder("cam1.avi", cameras=("cam1",))
    elsewhere = tmp_path / "rigs" / "today.toml"
    elsewhere.parent.mkdir()
    (path / "rig.toml").rename(elsewhere)
    out = tmp_path / "lists" / "flight.toml"
    init(path, "--calibration", elsewhere, "--out", out)
    assert read_recording_file(out).calibration == "../rigs/today.toml"
    assert open_recording(out).usable().videos["cam1"].num_frames == 4


ANIPOSE = """[cam_0]
name = "left"
size = [64, 48]
matrix = [[60.0, 0.0, 32.0], [0.0, 60.0, 24.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0, 0.0]
rotation = [1.5, 0.0, 0.0]
translation = [0.0, 0.0, 5000.0]
"""


def test_a_calibration_that_leaves_its_unit_open(init, refuses, folder):
    path = folder("left.avi")
    (path / "calibration.toml").write_text(ANIPOSE)
    refuses(path, "the file leaves it open; state m or cm or mm: --units of")
    init(path, "--units", "mm")
    assert 'calibration_unit = "mm"' in (path / "recording.toml").read_text()
    np.testing.assert_allclose(open_recording(path).rig.cameras.T_cam_world[0, :3, 3], [0, 0, 5], atol=1e-12)


def test_videos_that_are_smaller_than_calibrated(init, refuses, folder, run_psotrack, caplog):
    """Of the same shape, the lens is rescaled about the image's corner, half a pixel outside the first pixel."""
    path = folder("left.avi", cameras=("left",))
    K = {"32": "63.5", "60": "120", "24": "47.5"}
    large = (path / "rig.toml").read_text().replace("[64, 48]", "[128, 96]")
    for small, twice in K.items():
        large = large.replace(f"{small},", f"{twice},").replace(f"{small}]", f"{twice}]")
    (path / "rig.toml").write_text(large)
    shown = init(path)
    words = "rescaled from 128 x 96 to 64 x 48 pixels, the size of the images, for camera left; this is right where"
    assert words in caplog.text
    assert "64 x 48" in shown
    half = [[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]
    np.testing.assert_allclose(open_recording(path).usable().rig.cameras.K, [half])
    done = run_psotrack("calibrate", "convert", path / "rig.toml", path / "small.toml", "--size", "64,48")
    assert "rescaled from 128 x 96 to 64 x 48 pixels: both must show the same field of view" in done.out
    np.testing.assert_allclose(read_rig(path / "small.toml").cameras.K, [half])
    wrong = ("calibrate", "convert", path / "rig.toml", path / "no.toml", "--size", "64,40")
    words = "--size: expected a size of the shape of 128 x 96 pixels, as rig.toml"
    assert_refused(lambda: run_psotrack(*wrong), words, unchanged=path)
    (path / "rig.toml").write_text(large.replace("[128, 96]", "[128, 80]"))
    refuses(
        path, "left.avi: expected 128 x 80 pixels as calibrated, found 64 x 48 pixels", options=("--force",)
    )


def test_a_file_edited_by_hand_is_kept_beside_the_new_one(init, folder):
    path = folder("left.avi", cameras=["left"])
    written, older = path / "recording.toml", path / "recording.toml.bak"
    init(path)
    fresh = written.read_text()
    init(path, "--force")
    assert not older.exists()
    edited = fresh + "[world]\nbounds_m = [[-4, -3, 0], [4, 3, 3]]  # the hall\n"
    written.write_text(edited)
    assert f"{older}: the file as it was" in init(path, "--force")
    assert (written.read_text(), older.read_text()) == (fresh, edited)
    # A second call has nothing to keep, and leaves what was kept before.
    assert "as it was" not in init(path, "--force")
    assert older.read_text() == edited


def test_without_a_calibration_cameras_have_no_place(init, folder):
    path = folder("left.avi", "GX010124.avi")
    shown = init(path, "--match", "right=GX010124.avi", "--json", path / "report.json")
    recording = open_recording(path)
    assert (recording.placed, tuple(recording.by_name)) == ((), ("right", "left"))
    assert "psotrack calibrate rig" in shown
    report = json.loads((path / "report.json").read_text())
    assert report["cameras"]["left"]["placed"] is False
    assert report["cameras"]["left"]["image_size_wh"] == [64, 48]


def test_matches_by_hand(init, refuses, folder):
    path = folder(
        "GX010123.avi", "GX 24.avi", "cam2.avi", "take_cam1_cam2.avi", cameras=("cam1", "cam2", "cam3")
    )
    # All files that are unclear are named together.
    refuses(
        path,
        "GX 24.avi: expected the video of a camera of rig.toml, cam1, cam2, cam3, found none",
        "--leave-out 'GX 24.avi'; the same for GX010123.avi, take_cam1_cam2.avi",
    )
    left_out = ("--leave-out", "GX 24.avi", "--leave-out", "take_cam1_cam2.avi")
    init(path, "--match", "Cam 1=GX010123.avi", *left_out, "--match", "cam3=rtsp://x/1")
    videos = {name: each.video for name, each in read_recording_file(path / "recording.toml").cameras.items()}
    assert videos == {"cam1": "GX010123.avi", "cam2": "cam2.avi", "cam3": "rtsp://x/1"}


# --- questions


class Answers(io.StringIO):
    """What somebody types at a terminal; the end is Ctrl-C."""

    def isatty(self):
        return True

    def readline(self, size=-1):
        line = super().readline()
        if not line:
            raise KeyboardInterrupt
        return line


@pytest.fixture
def ask(run_psotrack, monkeypatch):
    """Return a function that runs a command at a terminal, and answers its questions."""

    def run(command, folder, *answers):
        monkeypatch.setattr(sys, "stdin", Answers("".join(f"{answer}\n" for answer in answers)))
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
        return run_psotrack(command, folder)

    return run


UNCLEAR = ("GX01.avi", "GX02.avi", "test.avi", "boxes/first.csv")


def test_all_files_are_asked_for_together(ask, folder):
    path = folder(*UNCLEAR, cameras=("left", "right"))
    done = ask("init", path, "right", "nobody", "1", "-", "2").ended()
    assert "Whose are these 4 files?" in done.out
    assert "1  left\n  2  right" in done.out
    assert "expected a camera of rig.toml, or -, found nobody" in done.out
    assert read_recording_file(path / "recording.toml").cameras == {
        "left": CameraTable(video="GX02.avi"),
        "right": CameraTable(video="GX01.avi", detections="boxes/first.csv"),
    }


@pytest.mark.parametrize("command", ["init", "run"])
def test_an_empty_answer_and_ctrl_c_leave_everything_as_it_was(ask, folder, command):
    path = folder(*UNCLEAR, cameras=("left", "right"))
    before = content_of(path)
    done = ask(command, path, "1", "")
    assert (done.code, "the same for GX02.avi, test.avi" in done.err) == (2, True)
    with pytest.raises(KeyboardInterrupt):
        ask(command, path, "1")
    assert content_of(path) == before


# --- what is not clear

#: Files and options, cameras of rig.toml -> words of the line.
BAD = {
    ("cam1.avi cam10.avi", "cam1 cam2"): (
        "cam10.avi: expected the video of a camera of rig.toml, cam1, cam2",
        "--match CAMERA=cam10.avi, or leave it out with --leave-out cam10.avi",
    ),
    ("cam1_a.avi cam1_b.avi", "cam1"): (
        "cam1_b.avi: expected one video of camera cam1, found cam1_a.avi as well; say",
    ),
    ("videos/left.avi videos/right.avi", "left"): (
        "for the videos in videos: psotrack init",
        "flight/videos --calibration",
    ),
    ("left/a.avi left/b.avi right/a.avi", "left right"): (
        "left/a.avi: expected one video of camera left, found a.avi, b.avi in left; say whose it is",
    ),
    ("", "cam1"): ("expected files named like the cameras of rig.toml, cam1, found none",),
    ("", ""): ("expected videos, folders of images, or detections, found none",),
    ("cam1.avi calibration.toml", "cam1"): (
        "expected one rig file, found calibration.toml, rig.toml; name the one",
    ),
    ("cam1.csv", "cam1"): ("frames per second of camera cam1, which has no video, found none; pass --fps",),
    ("cam1.csv --fps 9", ""): ("images of camera cam1, which has no video, found none; pass --size",),
    ("cam1.avi --units mm", ""): ("--units: expected a rig file, in the folder or by --calibration",),
    ("cam1.avi --body cf1", "cam1"): ("--body: expected a C3D file",),
    ("cam1.avi --match cam1", "cam1"): ("'--match': expected CAMERA=FILE, found 'cam1'",),
    ("cam1.avi --match cam9=cam1.avi", "cam1"): (
        "--match: expected a camera of",
        "rig.toml: cam1, found cam9",
    ),
    ("cam1.avi --match cam1=no.avi", "cam1"): ("--match: expected a file in", "flight, found no.avi"),
    ("cam1.avi --match cam1=rig.toml", "cam1"): ("--match: expected a video, ", " found rig.toml"),
    ("cam1.avi b.avi --match cam1=cam1.avi --match cam1=b.avi", "cam1"): (
        "--match: expected one video of camera cam1, found two",
    ),
    ("cam1.avi --leave-out no.avi", "cam1"): ("--leave-out: expected a file in", "flight, found no.avi"),
    ("cam1.avi --out a.txt", "cam1"): ("--out: expected a file that ends in .toml",),
}


@pytest.mark.parametrize(("written", "cameras"), BAD)
def test_what_is_not_clear_is_refused(refuses, folder, written, cameras):
    files = [*itertools.takewhile(lambda word: not word.startswith("--"), shlex.split(written))]
    options = shlex.split(written)[len(files) :]
    refuses(folder(*files, cameras=cameras.split()), *BAD[written, cameras], options=options)


# --- names


Words = st.text(string.ascii_letters, min_size=1, max_size=6)
Numbers = st.integers(1, 99_999)
Separators = st.sampled_from(["", " ", "_", "-", ".", "__"])


@given(word=Words, numbers=st.lists(Numbers, min_size=2, max_size=8, unique=True), more=Separators)
def test_numbers_are_compared_as_a_whole(word, numbers, more):
    cameras = [f"{word}{number}" for number in numbers]
    for camera, number in zip(cameras, numbers, strict=True):
        name = f"{word}{more}{number}"
        assert cameras_of(name, cameras) == [camera]
        assert cameras_of(name, [other for other in cameras if other != camera]) == []
        assert chosen_camera(name, cameras) == camera
        assert camera_key(name) == camera_key(camera)


def test_accents_may_be_stored_apart():
    assert cameras_of(unicodedata.normalize("NFD", "größe_1"), ["Größe", "links"]) == ["Größe"]


def test_a_part_of_a_name_chooses_a_camera_only_where_it_is_one():
    assert chosen_camera("cam1", ["cam1i", "cam10i", "cam2i"]) == "cam1i"
    assert chosen_camera("1", ["cam1", "cam10", "cam2"]) == "cam1"
    assert chosen_camera("left", ["left_a", "left_b"]) is None
    assert chosen_camera("", ["cam1"]) is None


def test_the_markers_of_drones_are_written(init, refuses, folder):
    path, time_s = folder("a.avi", cameras=("a",)), np.arange(50)[:, None, None] / 100
    cross_m = np.array([[0.2, 0, 0], [-0.1, 0, 0], [0, 0.15, 0], [0, -0.12, 0.1]])
    labels = tuple(f"{body}:{i}" for body in ("cf1", "cf2") for i in range(4))
    markers = Markers(labels, np.hstack([cross_m + time_s, cross_m - time_s]), 100.0)
    write_c3d(path / "flight.c3d", markers)
    refuses(path, "expected NAME=LABEL", options=("--body", "=x"))
    refuses(path, "expected labels of cf1:0, ", options=("--body", "cf1=cf9:"))
    init(path, "--body", "cf2", "--body", "one=cf1:0,cf1:1,cf1:2")
    assert open_recording(path).truth.drones == ("cf2", "one")
    written = read_recording_file(path / "recording.toml").reference
    assert written.bodies == {"cf2": ("cf2:",), "one": ("cf1:0", "cf1:1", "cf1:2")}


# --- the file

Names = st.text(st.characters(categories=("L", "N"), include_characters=" _-."), min_size=1).filter(
    camera_key
)
Lengths = st.floats(-1e6, 1e6)
Tables = st.builds(
    CameraTable,
    video=st.text(st.characters(exclude_categories=("C",)), min_size=1),
    size=st.none() | st.tuples(st.integers(1, 10**6), st.integers(1, 10**6)),
    fps=st.none() | st.floats(1e-3, 2e4),
    time_offset_s=st.none() | Lengths,
    line_time_s=Lengths,
    distortion=st.none() | st.lists(Lengths, max_size=14).map(tuple),
)


@given(name=Names, table=Tables, bounds_m=st.none() | st.just(((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))))
def test_what_is_written_is_read(name, table, bounds_m, tmp_path_factory):
    content = RecordingFile(version=1, cameras={name: table}, world=WorldTable(bounds_m=bounds_m))
    path = tmp_path_factory.getbasetemp() / "any.toml"
    write_recording_file(path, content)
    assert msgspec.to_builtins(read_recording_file(path)) == msgspec.to_builtins(content)
