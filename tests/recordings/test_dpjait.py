"""The dataset's folders: both halves are read, written files are read back, and what is wrong is said in one line."""

import csv
import shutil

import cv2
import numpy as np
import pytest
from dpjait_folders import (
    POSE_HEADER,
    REAL_HEADER,
    SERIALS,
    SIMULATED_HEADER,
    make_real,
    make_simulated,
    pose_lines,
    write_cameras,
    write_video,
)
from helpers import assert_refused, make_once
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from scipy.spatial.transform import Rotation

from psotrack.geometry import make_camera, make_rig, project
from psotrack.geometry.rig_files import read_rig, write_calibration
from psotrack.recordings import inventory_table, read_detections
from psotrack.recordings.datasets import (
    CALIBRATION,
    MARKER_CORNERS,
    ONBOARD_CALIBRATION,
    pose_file,
    read_marker_corners,
    read_onboard,
    read_onboard_calibration,
    read_poses,
    read_sequence,
    write_marker_corners,
    write_onboard_calibration,
    write_poses,
)
from psotrack.recordings.mocap import Markers, write_c3d


@pytest.fixture(scope="session")
def halves(tmp_path_factory):
    """Folder with a sequence of each half; the names of the folders state other numbers of drones."""

    def make(folder):
        make_simulated(folder / "S99_D9")
        make_real(folder / "R99_D9")

    return make_once(tmp_path_factory, "dpjait", make)


@pytest.fixture
def simulated(halves, tmp_path):
    """A copy of the simulated sequence, which a test may change."""
    return shutil.copytree(halves / "S99_D9", tmp_path / "S99_D9")


@pytest.fixture
def real(halves, tmp_path):
    """A copy of the real sequence, which a test may change."""
    return shutil.copytree(halves / "R99_D9", tmp_path / "R99_D9")


def edit(file, old, new, count=1):
    """Function that replaces a text in a file of a folder."""

    def change(folder):
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new, count))

    return change


def write(file, text):
    """Function that writes a file of a folder."""
    return lambda folder: (folder / file).write_text(text)


# --- both halves


def test_the_simulated_half(simulated):
    recording = read_sequence(simulated)
    assert recording.name == "S99_D9"
    assert recording.rig.names == ("cam1i", "cam2i", "cam3i")
    assert {name: video.path.name for name, video in recording.videos.items()} == {
        name: f"{name}_s.avi" for name in recording.rig.names
    }
    assert (recording.fps, recording.num_frames) == (25.0, 5)
    cameras = recording.rig.cameras
    assert cameras.image_size_wh.tolist() == [[64, 48]] * 3
    # Each camera has its own focal length.
    assert cameras.K[:, 0, 0].tolist() == [1157.3, 1158.3, 1159.3]
    assert cameras.dist.shape == (3, 0)
    truth = recording.truth
    # The files count, not the name of the folder; the first row is a placeholder.
    assert truth.drones == ("dron1", "dron2")
    assert np.isnan(truth.position_m[0]).all()
    assert np.isnan(truth.orientation_wxyz[0]).all()
    np.testing.assert_allclose(truth.position_m[1:, 1, 0], [1.1, 1.2, 1.3, 1.4], rtol=0, atol=1e-12)
    assert truth.orientation_wxyz[4, 0].tolist() == [0, 0, 0, 1]
    assert truth.time_s.tolist() == [0, 0.04, 0.08, 0.12, 0.16]
    assert list(recording.detections) == ["cam2i"]
    assert read_detections(recording.detections["cam2i"]).xyxy.tolist() == [[10, 20, 14, 26]]
    assert recording.usable().num_frames == 5


def test_the_cameras_on_drones(simulated):
    recording = read_sequence(simulated)
    first, second = recording.onboard.values()
    assert list(recording.onboard) == ["dron1", "dron2"]
    assert recording.usable(num_frames=3).onboard == recording.onboard
    assert (first.video.path.name, first.video.num_frames) == ("dron1_cam_s.avi", 5)
    assert first.K.tolist() == [[60.5, 0, 31.5], [0, 60.25, 23.5], [0, 0, 1]]
    assert second.K[:2, :2].tolist() == [[61, 0], [0, 61]]
    assert np.isnan(first.position_m[0]).all(), "the first row is a placeholder"
    np.testing.assert_allclose(second.position_m[1:, 0], [1.2, 1.3, 1.4, 1.5], rtol=0, atol=1e-12)
    assert second.orientation_wxyz[4].tolist() == [0, 0, 0, 1]
    content = recording.to_dict()
    assert content["onboard"]["dron1"] == {
        "video": str(simulated / "dron1_cam_s.avi"),
        "frames": 5,
        "fps": 25.0,
        "image_size_wh": [64, 48],
        "focal_length_px": 60.5,
        "frames_with_pose": 4,
    }
    console = Console(width=120)
    with console.capture() as capture:
        console.print(inventory_table(content))
    row = next(line for line in capture.get().splitlines() if "on dron1" in line)
    assert row.split() == ["on", "dron1", "dron1_cam_s.avi", "5", "25", "64", "x", "48", "60.5", "4", "poses"]
    # Intrinsics and poses without videos are ignored.
    for path in simulated.glob("dron?_cam_s.avi"):
        path.unlink()
    assert read_onboard(simulated) == {}
    assert read_sequence(simulated).to_dict()["onboard"] is None


def test_the_simulated_half_as_published(simulated):
    """Cameras are `cam1` in the calibration and `cam1i_s` in the names of files; `cam10i_s` is another camera."""
    names = [f"cam{i}" for i in range(1, 11)]
    write_cameras(simulated, names)
    for i, name in enumerate(names, start=1):
        write_video(simulated / f"{name}i_s.avi")
        (simulated / "dl_data" / f"{name}i_s.csv").write_text(f"{i},10,20,30,40,25,40,0.66,,,,,,,\n")
    recording = read_sequence(simulated)
    assert recording.rig.names == tuple(names)
    assert {name: video.path.name for name, video in recording.videos.items()} == {
        name: f"{name}i_s.avi" for name in names
    }
    for i, name in enumerate(names, start=1):
        assert read_detections(recording.detections[name]).frame.tolist() == [i]
    # A camera is selected by any of its names.
    for typed in ("cam1", "cam1i", "cam1i_s", "CAM1"):
        kept = recording.usable([typed, "cam3"])
        assert kept.rig.names == tuple(kept.videos) == ("cam1", "cam3")
        assert kept.rig.cameras.K[:, 0, 0].tolist() == [1157.3, 1159.3]
    for typed, found in (
        (["cam"], "found cam"),
        (["cam11"], "found cam11"),
        (["cam1", "cam1i_s"], "each once, found cam1, cam1i_s"),
    ):
        words = ("cameras: expected some of cam1, cam2, ", found)
        assert_refused(lambda typed=typed: recording.usable(typed), *words, unchanged=simulated)


def test_a_file_belongs_to_the_camera_with_the_longest_matching_name(simulated):
    """`left_back_s` belongs to `left_back`, not to `left`; `left.avi` comes before `left_debug.avi`."""
    write_cameras(simulated, ["left", "left_back"])
    for name in ("left_back_s", "left", "left_debug"):
        write_video(simulated / f"{name}.avi")
    videos = read_sequence(simulated).videos
    assert {name: video.path.name for name, video in videos.items()} == {
        "left": "left.avi",
        "left_back": "left_back_s.avi",
    }


def test_the_real_half(real):
    (real / f"{SERIALS[0]}.avi").rename(real / f"cam_{SERIALS[0]}.avi")
    recording = read_sequence(real)
    assert recording.rig.names == tuple(recording.videos) == SERIALS
    cameras = recording.rig.cameras
    np.testing.assert_allclose(cameras.T_cam_world[0, :3, 3], [-0.1, 0.2505, 6.0], rtol=0, atol=1e-12)
    assert cameras.dist[2].tolist() == [-0.1, 0.02, 0.001, -0.002]
    truth = recording.truth
    assert truth.drones == ("dron4", "dron7")
    # Frame 3 of the video is frame 12 of the mocap recording; the second of three markers is the centroid. The file
    # stores float32 millimetres.
    np.testing.assert_allclose(truth.position_m[3, 0], np.array([1.0, 2.0, 1.5]) + 0.12 + 0.1, atol=3e-7)
    assert truth.orientation_wxyz is None
    assert truth.seen.all()


@pytest.mark.parametrize(("half", "metres"), [("S99_D9", 1), ("R99_D9", 1e-3)])
def test_projection_agrees_with_opencv(halves, half, metres):
    """Projection agrees with `cv2.projectPoints` and the values of the file: t is not the camera's centre."""
    rig = read_sequence(halves / half).rig
    line = (halves / half / CALIBRATION).read_text().splitlines()[2].split(";")
    t, rvec = np.array(line[1:4], float), np.array(line[4:7], float)
    f, cx, cy = (float(value) for value in line[7:10])
    points_m = np.random.default_rng(0).uniform(-2, 2, (7, 3))
    K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points_m / metres, rvec, t, K, np.array(line[10:], float))
    pixels, depth_m = project(rig.cameras[1], points_m)
    assert depth_m.min() > 0
    # Both compute in double precision with pixels up to a few thousand.
    np.testing.assert_allclose(pixels, expected[:, 0], rtol=0, atol=1e-8)


def test_forms_of_the_path_of_a_sequence(halves, monkeypatch):
    monkeypatch.chdir(halves)
    for typed in ("S99_D9", "S99_D9/", "./S99_D9//"):
        assert read_sequence(typed).name == "S99_D9"
    monkeypatch.chdir(halves / "S99_D9")
    assert read_sequence(".").name == "S99_D9"


# --- folders that differ


def test_cameras_without_video_and_videos_without_camera(simulated, caplog):
    caplog.set_level("INFO")
    (simulated / "cam2i_s.avi").unlink()
    write_video(simulated / "dron1_fpv.avi", 7)
    recording = read_sequence(simulated)
    assert list(recording.videos) == ["cam1i", "cam3i"]
    assert recording.truth.num_frames == 5
    assert recording.rig.cameras.image_size_wh.tolist() == [[64, 48]] * 3
    assert "camera cam2i has no video: assuming 64 x 48 pixels like most cameras" in caplog.text
    assert "dron1_fpv.avi: not used" in caplog.text
    assert recording.usable().rig.names == ("cam1i", "cam3i")
    assert "camera cam2i is left out: it has no video" in caplog.text
    assert recording.usable(["cam3i", "cam1i"]).num_frames == 5


def test_videos_may_differ_in_length(simulated):
    write_video(simulated / "cam2i_s.avi", 7)
    recording = read_sequence(simulated)
    assert recording.num_frames == recording.truth.num_frames == 7
    assert recording.truth.seen[:, 0].tolist() == [False, True, True, True, True, False, False]
    assert recording.usable().timeline().frame[4:6].tolist() == [[4, 4, 4], [-1, 5, -1]]


def test_a_video_of_another_size(simulated):
    write_video(simulated / "cam1i_s.avi", size_wh=(96, 64))
    words = ("cam1i_s.avi: expected images", "principal point (32, 24), found 96 x 64 pixels")
    assert_refused(lambda: read_sequence(simulated), *words, unchanged=simulated)
    edit(CALIBRATION, "1157.3;32;24", "1157.3;47;31")(simulated)
    recording = read_sequence(simulated).usable()
    assert recording.rig.cameras.image_size_wh.tolist() == [[96, 64], [64, 48], [64, 48]]


def test_poses_that_are_missing_more_than_frames_or_at_another_rate(simulated):
    (simulated / "dron1_pos_25.csv").write_text(pose_lines(3, 0.0))
    edit("dron2_pos_25.csv", "\n3;", "\n12;")(simulated)
    # The other spelling, `drone`, beside numbers that sort otherwise as text.
    (simulated / "drone10_pos_100.csv").write_text(pose_lines(20, 9.0))
    truth = read_sequence(simulated).truth
    assert truth.drones == ("dron1", "dron2", "dron10")
    assert truth.num_frames == 5
    assert truth.seen[:, 0].tolist() == [False, True, True, False, False]
    # One missing row is interpolated.
    assert truth.seen[:, 1].tolist() == [False, True, True, True, True]
    assert truth.position_m[3, 1, 0] == pytest.approx(1.3, abs=0.02)
    np.testing.assert_allclose(truth.position_m[1:, 2, 0], [9.4, 9.8, 10.2, 10.6], rtol=0, atol=1e-12)
    for path in simulated.glob("dron*_pos_*.csv"):
        path.unlink()
    assert read_sequence(simulated).truth is None


@pytest.mark.parametrize(
    "change_text",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", ";\n"),
        lambda text: text + "\n\n;;;\n",
        lambda text: text.replace(";", " ; "),
        lambda text: text.replace("cam_", "CAM_"),
    ],
    ids=["byte order mark", "Windows", "last separator", "blank lines", "spaces", "upper case"],
)
def test_harmless_differences_are_accepted(simulated, change_text):
    original = read_sequence(simulated)
    for name in (CALIBRATION, "dron1_pos_25.csv"):
        path = simulated / name
        path.write_bytes(change_text(path.read_text()).encode())
    changed = read_sequence(simulated)
    assert changed.rig.names == original.rig.names
    np.testing.assert_array_equal(changed.rig.cameras.T_cam_world, original.rig.cameras.T_cam_world)
    np.testing.assert_array_equal(changed.truth.position_m, original.truth.position_m)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("qw;qx;qy;qz", [0, 0, 0, 1]),
        ("quat_w;quat_x;quat_y;quat_z", [0, 0, 0, 1]),
        ("quaternion.w;quaternion.x;quaternion.y;quaternion.z", [0, 0, 0, 1]),
        ("or_q_w[-];or_q_x[-];or_q_y[-];or_q_z[-]", [0, 0, 0, 1]),
        ("Q_W;Q_X;Q_Y;Q_Z", [0, 0, 0, 1]),
        ("q_x;q_y;q_z;q_w", [1, 0, 0, 0]),
        ("q1;q2;q3;q4", None),
    ],
)
def test_column_names_of_the_quaternion(tmp_path, names, expected):
    """The names of the columns decide, not their order."""
    (tmp_path / "dron1_pos_25.csv").write_text(pose_lines(3, 0.0).replace("q_w;q_x;q_y;q_z", names))
    _, orientation_wxyz = read_poses(tmp_path / "dron1_pos_25.csv")
    assert (None if orientation_wxyz is None else orientation_wxyz[1].tolist()) == expected


def write_bodies(path, **bodies):
    """A recording of bodies that fly along a diagonal, (frames, markers, 3) or (markers, 3) each."""
    t = np.arange(100)[:, None, None] / 100
    position_m = [np.broadcast_to(body_m, (100, *np.shape(body_m)[-2:])) + t for body_m in bodies.values()]
    labels = [f"{name}:{name[0]}{i}" for name, body_m in bodies.items() for i in range(np.shape(body_m)[-2])]
    write_c3d(path, Markers(tuple(labels), np.concatenate(position_m, axis=1), 100.0))


BOX_M = np.array([[0.2, 0, 0], [-0.1, 0, 0], [0, 0.15, 0], [0, -0.12, 0.1]])


def test_a_person_in_the_folder_is_no_reference(run_psotrack, real, tmp_path, caplog):
    """Found: `evaluate` scored tracks against a walking person without a word."""
    rng = np.random.default_rng(0)
    t = np.arange(100)[:, None, None] / 100
    person_m = rng.uniform(-0.5, 0.5, (10, 3)) + 0.2 * np.sin(6 * t + rng.uniform(0, 6, (10, 1)))
    write_bodies(real / "R99.c3d", daphnee=person_m, boite=BOX_M)
    (tmp_path / "tracks.csv").write_text("frame,drone,x_m,y_m,z_m\n0,dron1,0,0,1\n1,dron1,0,0,1\n")
    command = ("evaluate", tmp_path / "tracks.csv", real, "--quiet")
    result = run_psotrack(*command)
    assert result.code == 2
    assert "expected a reference to compare with, found none" in result.err
    assert "boite, rigid (boite:b0, " in caplog.text
    assert "daphnee, not rigid" in caplog.text
    assert run_psotrack(*command, "--body", "cf1=b0,b1,b2,b3").code == 0
    assert read_sequence(real, bodies={"boite": ["boite:"]}).truth.drones == ("boite",)
    # Found: with `--offset`, the reference was read twice, and said its warnings twice.
    write_bodies(real / "R99.c3d", cf1=BOX_M, cf2=BOX_M + 1.0)
    result = run_psotrack(*command, "--offset", 0)
    assert result.code == 0, result.err
    assert caplog.text.count("taken for drones, because their markers are rigid") == 1


@pytest.mark.parametrize("missing", ["dron1_cam_25.csv", ONBOARD_CALIBRATION])
def test_the_video_of_a_drone_alone_is_enough(simulated, missing):
    (simulated / missing).unlink()
    onboard = read_onboard(simulated)["dron1"]
    assert (onboard.K is None) == (missing == ONBOARD_CALIBRATION)
    assert np.isnan(onboard.orientation_wxyz).all() == (missing == "dron1_cam_25.csv")
    assert onboard.position_m.shape == (5, 3)


@pytest.mark.parametrize(("rows", "num_known"), [(3, 2), (9, 4)])
def test_onboard_poses_may_be_fewer_or_more_than_frames(simulated, rows, num_known):
    (simulated / "dron1_cam_25.csv").write_text(pose_lines(rows, 0.0))
    onboard = read_onboard(simulated)["dron1"]
    assert onboard.position_m.shape == (5, 3)
    assert np.isfinite(onboard.position_m).all(axis=1).sum() == num_known


@pytest.mark.parametrize("file_name", ["drone1_cam.avi", "Dron_1_cam_s.AVI", "dron1_cam.mp4"])
def test_other_names_of_the_video_of_a_drone(simulated, file_name):
    (simulated / "dron1_cam_s.avi").rename(simulated / file_name)
    assert read_onboard(simulated)["dron1"].video.path.name == file_name
    assert list(read_sequence(simulated).videos) == ["cam1i", "cam2i", "cam3i"]


def test_a_sequence_is_read_without_broken_onboard_files(simulated, caplog):
    """Tracking needs only the wall cameras."""
    edit("dron1_cam_25.csv", "1.5", "?")(simulated)
    recording = read_sequence(simulated)
    assert not recording.onboard
    assert "dron1_cam_25.csv, line 3" in caplog.text
    assert recording.truth is not None


# --- what is refused


def _remove(pattern):
    def change(folder):
        for path in folder.glob(pattern):
            path.unlink()

    return change


def _copy(source, target):
    return lambda folder: shutil.copy(folder / source, folder / target)


def _cameras(old, new, count=1):
    return edit(CALIBRATION, old, new, count)


def _poses(old, new):
    return edit("dron1_pos_25.csv", old, new)


#: Name of the case -> what happens to the simulated folder, words of the line; the first ones say where.
BAD = {
    "no such folder": (shutil.rmtree, f"S99_D9/{CALIBRATION}: expected", "found no such file"),
    "no videos": (_remove("*.avi"), "S99_D9: expected videos named like the cameras, cam1i.avi ..., found no .avi"),
    "two videos": (_copy("cam1i_s.avi", "cam1i.avi"),
                   "cam1i_s.avi: expected one such file per camera, found cam1i.avi as well"),
    "a broken video": (write("cam1i_s.avi", ""), "cam1i_s.avi: expected a video, found an empty file"),
    "detections that are no folder": (lambda folder: _no_folder(folder),
                                      "dl_data: expected a folder of detections, or none, found a file"),
    "an empty calibration": (write(CALIBRATION, ""), f"{CALIBRATION}, line 1: expected columns", "found an empty file"),
    "no cameras": (write(CALIBRATION, f"{SIMULATED_HEADER}\n"), CALIBRATION, "found none"),
    "commas": (_cameras(";", ",", -1), ", line 1: expected columns separated by ';', found 'cam_name,cam_x"),
    "no focal length": (_cameras("focal_length", "focus"), ": expected a column focal_length, found only cam_name, "),
    "feet": (_cameras("cam_x[m]", "cam_x[ft]"),
             ": expected a column cam_x[m] or cam_x[cm] or cam_x[mm], found cam_x[ft]"),
    "no unit": (_cameras("cam_x[m]", "cam_x"), "expected a column cam_x[m] or cam_x[cm] or cam_x[mm], found cam_x"),
    "a column twice": (_cameras("cam_y[m]", "cam_x[m]"), ", line 1: expected each column once, found cam_x again"),
    "a coefficient alone": (_cameras(";cy", ";coeff_1"), ": expected a column coeff_2"),
    "five coefficients": (lambda folder: _five_coefficients(folder), "4 distortion coefficients, found 5"),
    "no number": (_cameras("cam2i;2;0.5", "cam2i;2;x"), ", line 3, column cam_y[m]: expected a number, found 'x'"),
    "NaN": (_cameras("cam2i;2;0.5", "cam2i;2;nan"), "line 3, column cam_y[m]: expected a finite number, found 'nan'"),
    "a comma": (_cameras("cam2i;2;0.5", "cam2i;2;0,5"), ", line 3", "found '0,5'; write decimals with a point"),
    "no value": (_cameras("cam2i;2;0.5", "cam2i;2;"), "line 3, column cam_y[m]: expected a value, found nothing"),
    "few values": (_cameras("cam2i;2;0.5", "cam2i;0.5"), ", line 3: expected 10 values as in the header, found 9"),
    "a camera twice": (_cameras("cam2i;2", "cam1i_s;2"),
                       ", line 3, column cam_name: expected each camera once, found cam1i_s again"),
    "focal length 0": (_cameras("1158.3", "0"), "line 3, column focal_length: expected a focal length above 0 pixels"),
    "focal length below 0": (_cameras("1158.3", "-1158.3"), "column focal_length: expected a focal length above 0"),
    "a frame twice": (_poses("\n2;0.2", "\n1;0.2"),
                      "line 4, column id: expected each frame once, found 1 again, after line 3"),
    "half a frame": (_poses("\n2;0.2", "\n2.5;0.2"),
                     "line 4, column id: expected a whole number, 0 or more, found '2.5'"),
    "a long quaternion": (_poses("0;0;0;1\n2", "0;0;0;7\n2"),
                          "line 3, column q_w: expected a quaternion of length 1, found length 7"),
    "no column of x": (_poses("pos_x", "x"), "csv: expected a column pos_x, found only id, x[m]"),
    "a drone twice": (_copy("dron1_pos_25.csv", "drone1_pos_25.csv"),
                      "drone1_pos_25.csv: expected one file per drone, found dron1 in ", "dron1_pos_25.csv as well"),
}  # fmt: skip


def _no_folder(folder):
    shutil.rmtree(folder / "dl_data")
    (folder / "dl_data").touch()


def _five_coefficients(folder):
    """Five coefficients in the calibration of the first camera, where the layout has four."""
    header, row, *_ = (folder / CALIBRATION).read_text().splitlines()
    coefficients = ";".join(f"coeff_{number}" for number in range(1, 6))
    (folder / CALIBRATION).write_text(f"{header};{coefficients}\n{row};0.1;0;0;0;0\n")


@pytest.mark.parametrize(("change", "words"), [(each[0], each[1:]) for each in BAD.values()], ids=BAD)
def test_a_wrong_sequence_is_refused(simulated, tmp_path, change, words):
    change(simulated)
    assert_refused(lambda: read_sequence(simulated), *words, unchanged=tmp_path)


BAD_REAL = {
    "two recordings": (_copy("R99.c3d", "R98.c3d"), None, "R99.c3d: expected one file per drone, found dron4 in "),
    "no C3D": (write("R99.c3d", "hello " * 400), None, "R99.c3d: expected a C3D file, found no valid c3d file"),
    "bodies of none": (_remove("*.c3d"), {"cf1": ["a"]},
                       "bodies cf1: expected one C3D file that holds their markers, found none"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "bodies", "words"), BAD_REAL.values(), ids=BAD_REAL)
def test_wrong_motion_capture_is_refused(real, change, bodies, words):
    change(real)
    assert_refused(lambda: read_sequence(real, bodies=bodies), words, unchanged=real)


def _intrinsics(old, new):
    return edit(ONBOARD_CALIBRATION, old, new)


BAD_ONBOARD = {
    "two videos": (_copy("dron1_cam_s.avi", "drone1_cam.avi"),
                   "drone1_cam.avi: expected one file per drone, found dron1_cam_s.avi"),
    "another size": (lambda folder: write_video(folder / "dron2_cam_s.avi", size_wh=(32, 32)),
                     "dron2_cam_s.avi: expected 64 x 48 pixels as dron2 has in", "found 32 x 32"),
    "another rate": (lambda folder: (folder / "dron2_cam_25.csv").rename(folder / "dron2_cam_30.csv"),
                     "dron2_cam_30.csv: expected poses at the 25 Hz of the video, found 30 Hz"),
    "a drone twice": (_intrinsics("dron2", "dron1"),
                      "line 3, column cam_name: expected each camera once, found dron1 again"),
    "below 0": (_intrinsics("60.5", "-60.5"),
                "line 2, column focal_length_x: expected a number of pixels above 0, found -60.5"),
    "no height": (_intrinsics(";48", ";0"), "line 2, column height: expected a number of pixels above 0"),
    "half a pixel": (_intrinsics(";64", ";64.5"), "line 2, column width: expected a whole number"),
    "no cx": (_intrinsics("cx", "c_x"), f"{ONBOARD_CALIBRATION}: expected a column cx, found only"),
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "words"), [(each[0], each[1:]) for each in BAD_ONBOARD.values()], ids=BAD_ONBOARD
)
def test_wrong_files_of_cameras_on_drones_are_refused(simulated, change, words):
    change(simulated)
    assert_refused(lambda: read_onboard(simulated), *words, unchanged=simulated)


# --- files that are written


finite = st.floats(-50, 50)
triples = st.tuples(finite, finite, finite)
#: All rotations, and rotations near half a turn, where the Rodrigues vector is nearly ambiguous.
rotations = st.one_of(
    st.tuples(*[st.floats(-4, 4)] * 3).map(Rotation.from_rotvec),
    st.tuples(*[st.floats(-1e-9, 1e-9)] * 3).map(
        lambda small: Rotation.from_rotvec(np.array([np.pi, 0, 0]) + small)
    ),
)
FULL_HD = (1920, 1080)
PLAIN_K = np.array([[1000, 0, 960], [0, 1000, 540], [0, 0, 1.0]])


def camera_at(rotation, t_m, K=PLAIN_K, dist=(), fisheye=False):
    R, t_m = rotation.as_matrix(), np.array(t_m)
    return make_camera(R=R, t_m=t_m, K=K, image_size_wh=FULL_HD, dist=dist, fisheye=fisheye)


@given(
    poses=st.lists(st.tuples(rotations, triples), min_size=1, max_size=5),
    dist=st.one_of(st.just(()), st.tuples(*[st.floats(-0.5, 0.5)] * 4)),
    unit=st.sampled_from(["m", "mm"]),
)
def test_a_written_rig_is_read_back(tmp_path_factory, poses, dist, unit):
    path = tmp_path_factory.getbasetemp() / CALIBRATION
    cameras = {
        f"cam{i}i": camera_at(
            *pose, np.array([[1156.3 + i, 0, 960.25], [0, 1156.3 + i, 540 + i], [0, 0, 1]]), dist
        )
        for i, pose in enumerate(poses)
    }
    rig = make_rig(cameras)
    write_calibration(path, rig, unit)
    again = read_rig(path, FULL_HD)
    assert again.names == rig.names
    # Rotations are converted to vectors and back, lengths to millimetres and back, which rounds doubles up to 50.
    np.testing.assert_allclose(again.cameras.T_cam_world, rig.cameras.T_cam_world, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(again.cameras.K, rig.cameras.K)
    coefficients = again.cameras.dist.shape[-1]
    assert coefficients == (4 if any(dist) else 0)
    np.testing.assert_array_equal(again.cameras.dist, rig.cameras.dist[:, :coefficients])


def test_written_files_look_like_the_published_ones(tmp_path):
    rig = make_rig({"cam1i": camera_at(Rotation.identity(), (1.0, 2.0, 3.0), dist=(0.1, 0.0, 0.0, 0.0))})
    write_calibration(tmp_path / CALIBRATION, rig, "mm")
    assert (tmp_path / CALIBRATION).read_text().splitlines() == [
        REAL_HEADER,
        "cam1i;1000.0;2000.0;3000.0;0.0;0.0;0.0;1000.0;960.0;540.0;0.1;0.0;0.0;0.0",
    ]
    write_poses(tmp_path / pose_file(1), np.ones((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    assert (tmp_path / "dron1_pos_25.csv").read_text().splitlines() == [
        POSE_HEADER,
        "0;0.0;0.0;-0.0;0.0;0.0;0.0;1.0;0.0;0.0;0.0",
        "1;1.0;1.0;1.0;0.0;0.0;0.0;1.0;0.0;0.0;0.0",
    ]


def test_what_the_layout_cannot_hold_is_refused(tmp_path):
    """The message names the camera, not the first one but the one that the file cannot hold."""
    path, upright = tmp_path / CALIBRATION, (Rotation.identity(), np.zeros(3))
    # A fifth coefficient of zero can be left out.
    sound = camera_at(*upright, dist=(0.1, 0.0, 0.0, 0.0, 0.0))
    write_calibration(path, make_rig({"a": sound}))
    cameras = {
        "distortion by k1, k2, p1, p2 alone, found 5 coefficients": {"dist": (0.1, 0.0, 0.0, 0.0, 0.01)},
        "one focal length, found fx 1000 and fy 1001": {"K": PLAIN_K + np.diag([0, 1.0, 0])},
        "no skew, found 2.5": {"K": PLAIN_K + np.eye(3, k=1) * [0, 2.5, 0]},
        "OpenCV's pinhole model, found a fisheye": {"fisheye": True},
    }
    for words, fields in cameras.items():
        rig = make_rig(
            {"a": sound, "GoPro 3": camera_at(*upright, **fields), "z": camera_at(*upright, **fields)}
        )
        line = f"camera GoPro 3: expected {words}; "
        assert_refused(lambda rig=rig: write_calibration(path, rig), line, "rig.toml", unchanged=tmp_path)
    turns, position_m = np.tile([1.0, 0, 0, 0], (3, 1)), np.ones((3, 3))
    position_m[2, 1] = np.nan
    words = "poses: expected finite numbers, found NaN or infinity at frame 2"
    assert_refused(lambda: write_poses(tmp_path / "a", position_m, turns), words, unchanged=tmp_path)
    words = "expected equal numbers of positions and orientations"
    assert_refused(lambda: write_poses(tmp_path / "a", turns[:0, :3], turns[:0]), words, unchanged=tmp_path)
    for intrinsics in ({}, {"dron1": (PLAIN_K + np.eye(3, k=1), FULL_HD)}):
        assert_refused(
            lambda intrinsics=intrinsics: write_onboard_calibration(tmp_path / "a", intrinsics),
            "expected at least one camera, all without skew",
            unchanged=tmp_path,
        )


@given(poses=st.lists(st.tuples(triples, rotations), min_size=2, max_size=9))
def test_written_poses_are_read_back(tmp_path_factory, poses):
    path = tmp_path_factory.getbasetemp() / pose_file(1)
    position_m = np.array([position for position, _ in poses])
    rotation = Rotation.concatenate([rotation for _, rotation in poses])
    write_poses(path, position_m, rotation.as_quat(scalar_first=True))
    position_again_m, orientation_again_wxyz = read_poses(path)
    assert np.isnan(position_again_m[0]).all()
    assert np.isnan(orientation_again_wxyz[0]).all()
    np.testing.assert_array_equal(position_again_m[1:], position_m[1:])
    again = Rotation.from_quat(orientation_again_wxyz[1:], scalar_first=True)
    # The reader normalises the quaternion, which rounds it.
    assert (again * rotation[1:].inv()).magnitude().max() < 1e-12
    # The Euler angles in the file are the same rotation: R = Rz Ry Rx.
    with path.open() as file:
        rows = list(csv.DictReader(file, delimiter=";"))[1:]
    angles_rad = np.array([[float(row[f"rot_{axis}[rad]"]) for axis in "xyz"] for row in rows])
    Rx, Ry, Rz = (Rotation.from_rotvec(np.eye(3)[axis] * angles_rad[:, axis : axis + 1]) for axis in range(3))
    # Near gimbal lock, Euler angles lose half of their digits: the error is up to 1e-7 rad.
    assert ((Rz * Ry * Rx) * rotation[1:].inv()).magnitude().max() < 1e-6


def test_a_first_row_with_a_pose_is_a_pose(tmp_path):
    path = tmp_path / "dron1_pos_25.csv"
    path.write_text("id;pos_x[m];pos_y[m];pos_z[m]\n0;1;2;3\n1;1;2;3\n")
    position_m, orientation_wxyz = read_poses(path)
    assert position_m.tolist() == [[1, 2, 3]] * 2
    assert orientation_wxyz is None


@given(
    cameras=st.lists(
        st.tuples(*[st.floats(1e-3, 1e5)] * 2, *[st.floats(-1e4, 1e4)] * 2, *[st.integers(1, 8000)] * 2),
        min_size=1,
        max_size=4,
    )
)
def test_written_intrinsics_are_read_back(tmp_path_factory, cameras):
    path = tmp_path_factory.getbasetemp() / ONBOARD_CALIBRATION
    intrinsics = {
        f"dron{number}": (np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), (width, height))
        for number, (fx, fy, cx, cy, width, height) in enumerate(cameras, start=1)
    }
    write_onboard_calibration(path, intrinsics)
    again = read_onboard_calibration(path)
    assert list(again) == list(intrinsics)
    for name, (expected, size_wh) in intrinsics.items():
        np.testing.assert_array_equal(again[name][0], expected)
        assert again[name][1] == size_wh


@given(
    corners=st.dictionaries(
        st.integers(0, 999), st.lists(triples, min_size=4, max_size=4).map(np.array), min_size=1, max_size=5
    )
)
def test_written_marker_corners_are_read_back(tmp_path_factory, corners):
    path = tmp_path_factory.getbasetemp() / MARKER_CORNERS
    write_marker_corners(path, corners)
    again = read_marker_corners(path)
    assert set(again) == set(corners)
    for marker, corners_m in corners.items():
        np.testing.assert_array_equal(again[marker], corners_m)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("7;", "5;", "line 3, column id: expected each marker once, found 5 again"),
        ("z4[m]", "z5[m]", "expected a column z4"),
    ],
)
def test_wrong_marker_corners_are_refused(tmp_path, old, new, words):
    path = tmp_path / MARKER_CORNERS
    write_marker_corners(path, {5: np.zeros((4, 3)), 7: np.full((4, 3), 0.5)})
    edit(MARKER_CORNERS, old, new)(tmp_path)
    assert_refused(lambda: read_marker_corners(path), words, unchanged=tmp_path)
