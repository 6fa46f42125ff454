"""The reader of the dataset: hand-made folders of both halves are read, and damaged in many ways."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from psotrack.cli import cli
from psotrack.errors import InputError, SettingsError
from psotrack.geometry import project
from psotrack.recordings import VideoWriter, read_detections
from psotrack.recordings.datasets import read_sequence
from psotrack.recordings.mocap import Markers, write_c3d

WIDTH, HEIGHT, FPS = 64, 48, 25.0
SIMULATED_HEADER = (
    "cam_name;cam_x[m];cam_y[m];cam_z[m];cam_or_x[rad];cam_or_y[rad];cam_or_z[rad];focal_length;cx;cy"
)
REAL_HEADER = SIMULATED_HEADER.replace("[m]", "[mm]") + ";coeff_1;coeff_2;coeff_3;coeff_4"
POSE_HEADER = "id;pos_x[m];pos_y[m];pos_z[m];rot_x[rad];rot_y[rad];rot_z[rad];q_w;q_x;q_y;q_z"
SERIALS = ("55260362", "56339527", "60881257", "61920488")


@pytest.fixture(scope="session")
def make_video(tmp_path_factory):
    """Return a function that writes a small black video once and returns its path."""
    folder = tmp_path_factory.mktemp("videos")

    def make(num_frames: int, size_wh: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
        path = folder / f"{num_frames}_{size_wh[0]}.avi"
        if not path.exists():
            with VideoWriter(path, FPS, size_wh) as writer:
                for _ in range(num_frames):
                    writer.write(np.zeros((size_wh[1], size_wh[0], 3), np.uint8))
        return path

    return make


def pose_lines(num_rows: int, x0: float) -> str:
    rows = ["0;0;0;-0;0;0;0;1;0;0;0"]
    rows += [f"{i};{x0 + 0.1 * i};2;1.5;0;0;0;0;0;0;1" for i in range(1, num_rows)]
    return "\n".join([POSE_HEADER, *rows]) + "\n"


@pytest.fixture
def simulated_folder(tmp_path, make_video):
    """A simulated sequence of three cameras, two drones and five frames; its folder name states nine drones."""
    folder = tmp_path / "Simulated_Data" / "S99_D9"
    folder.mkdir(parents=True)
    cameras = [f"cam{i}i;{i};0.5;8;1.9;{i / 10};0;{1156.3 + i};32;24" for i in (1, 2, 3)]
    (folder / "cameras_calibration.csv").write_text("\n".join([SIMULATED_HEADER, *cameras]) + "\n")
    for i in (1, 2, 3):
        shutil.copy(make_video(5), folder / f"cam{i}i_s.avi")
    (folder / "dron1_pos_25.csv").write_text(pose_lines(5, 0.0))
    (folder / "dron2_pos_25.csv").write_text(pose_lines(5, 1.0))
    return folder


@pytest.fixture
def real_folder(tmp_path, make_video):
    """A real sequence of four cameras named by serial number, two drones at 100 Hz, and five frames."""
    folder = tmp_path / "Real_Data" / "R99_D2"
    folder.mkdir(parents=True)
    cameras = [f"{name};-100;250.5;6000;1.9;0.1;0;1158.7;32;24;-0.1;0.02;0.001;-0.002" for name in SERIALS]
    (folder / "cameras_calibration.csv").write_text("\n".join([REAL_HEADER, *cameras]) + "\n")
    for name in SERIALS:
        shutil.copy(make_video(5), folder / f"{name}.avi")
    t = np.arange(20)[:, None, None]
    position_m = np.tile([1.0, 2.0, 1.5], (20, 6, 1)) + 0.01 * t + 0.1 * np.arange(6)[None, :, None]
    labels = tuple(f"Dron{drone}:Dron{drone}{i}" for drone in (4, 7) for i in (1, 2, 3))
    write_c3d(folder / "R99.c3d", Markers(labels, position_m, 100.0))
    return folder


def replace_in_file(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_the_simulated_half(simulated_folder):
    recording = read_sequence(simulated_folder)
    assert recording.name == "S99_D9"
    assert recording.rig.names == ("cam1i", "cam2i", "cam3i")
    assert [recording.videos[name].path.name for name in recording.rig.names] == [
        "cam1i_s.avi",
        "cam2i_s.avi",
        "cam3i_s.avi",
    ]
    assert (recording.fps, recording.num_frames) == (25.0, 5)
    cameras = recording.rig.cameras
    assert cameras.image_size_wh.tolist() == [[64, 48]] * 3
    assert cameras.K[:, 0, 0].tolist() == [1157.3, 1158.3, 1159.3]  # each camera has its own focal length
    assert cameras.dist.shape == (3, 0)
    truth = recording.truth
    assert truth.drones == ("dron1", "dron2")  # the files count, not the name of the folder
    assert np.isnan(truth.position_m[0]).all()  # the placeholder
    assert np.isnan(truth.orientation_wxyz[0]).all()
    np.testing.assert_allclose(truth.position_m[1:, 1, 0], [1.1, 1.2, 1.3, 1.4], rtol=0, atol=1e-12)
    assert truth.orientation_wxyz[4, 0].tolist() == [0, 0, 0, 1]
    assert truth.time_s.tolist() == [0, 0.04, 0.08, 0.12, 0.16]
    assert not recording.detections
    assert recording.usable().num_frames == 5


@pytest.fixture
def published_folder(simulated_folder, make_video):
    """The simulated half as published: ten cameras, named `cam1` in the calibration and `cam1i_s` in file names."""
    names = [f"cam{i}" for i in range(1, 11)]
    cameras = [f"{name};{i};0.5;8;1.9;0;0;{1156.3 + i};32;24" for i, name in enumerate(names, start=1)]
    (simulated_folder / "cameras_calibration.csv").write_text("\n".join([SIMULATED_HEADER, *cameras]) + "\n")
    (simulated_folder / "dl_data").mkdir()
    for i, name in enumerate(names, start=1):
        shutil.copy(make_video(5), simulated_folder / f"{name}i_s.avi")
        (simulated_folder / "dl_data" / f"{name}i_s.csv").write_text(f"{i},10,20,30,40,25,40,0.66,,,,,,,\n")
    return simulated_folder


def test_the_simulated_half_as_published(published_folder):
    """The file `cam1i_s` belongs to the camera `cam1` of the calibration; the file `cam10i_s` does not."""
    recording = read_sequence(published_folder)
    names = tuple(f"cam{i}" for i in range(1, 11))
    assert recording.rig.names == names
    assert {name: video.path.name for name, video in recording.videos.items()} == {
        name: f"{name}i_s.avi" for name in names
    }
    for i, name in enumerate(names, start=1):
        assert read_detections(recording.detections[name]).frame.tolist() == [i]


@pytest.mark.parametrize("typed", ["cam1", "cam1i", "cam1i_s", "CAM1"])
@pytest.mark.parametrize("half", ["simulated_folder", "published_folder"])
def test_a_camera_is_selected_by_any_of_its_names(half, typed, request):
    recording = read_sequence(request.getfixturevalue(half))
    kept = recording.usable([typed, "cam3"])
    assert kept.rig.names == (recording.rig.names[0], recording.rig.names[2])
    assert list(kept.videos) == list(kept.rig.names)
    assert kept.rig.cameras.K[:, 0, 0].tolist() == [1157.3, 1159.3]


@pytest.mark.parametrize(
    ("typed", "found"),
    [
        (["cam"], "found cam"),
        (["cam11"], "found cam11"),
        (["cam1", "cam1i_s"], "each once, found cam1, cam1i_s"),
    ],
)
def test_unknown_and_repeated_camera_names(published_folder, typed, found):
    with pytest.raises(SettingsError, match=f"cameras: expected some of cam1, cam2, .*{found}"):
        read_sequence(published_folder).usable(typed)


def test_a_file_belongs_to_the_camera_with_the_longest_matching_name(simulated_folder, make_video):
    """`left_back_s` belongs to `left_back`, not to `left`; `left.avi` comes before `left_debug.avi`."""
    names = ("left", "left_back")
    cameras = [f"{name};1;0.5;8;1.9;0;0;1156.3;32;24" for name in names]
    (simulated_folder / "cameras_calibration.csv").write_text("\n".join([SIMULATED_HEADER, *cameras]) + "\n")
    for name in ("left_back_s", "left", "left_debug"):
        shutil.copy(make_video(5), simulated_folder / f"{name}.avi")
    videos = read_sequence(simulated_folder).videos
    assert {name: video.path.name for name, video in videos.items()} == {
        "left": "left.avi",
        "left_back": "left_back_s.avi",
    }


def test_the_real_half(real_folder):
    recording = read_sequence(real_folder)
    assert recording.rig.names == SERIALS
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


@pytest.mark.parametrize("half", ["simulated_folder", "real_folder"])
def test_projection_agrees_with_opencv(half, request):
    """Projection agrees with `cv2.projectPoints` and the values of the file: t is not the camera's centre."""
    folder = request.getfixturevalue(half)
    rig = read_sequence(folder).rig
    line = (folder / "cameras_calibration.csv").read_text().splitlines()[2].split(";")
    t, rvec = np.array(line[1:4], float), np.array(line[4:7], float)
    f, cx, cy = (float(value) for value in line[7:10])
    points_m = np.random.default_rng(0).uniform(-2, 2, (7, 3))
    in_file_units = points_m * (1000 if half == "real_folder" else 1)
    K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
    expected, _ = cv2.projectPoints(in_file_units, rvec, t, K, np.array(line[10:], float))
    pixels, depth_m = project(rig.cameras[1], points_m)
    assert depth_m.min() > 0
    # Both compute in double precision with pixels up to a few thousand.
    np.testing.assert_allclose(pixels, expected[:, 0], rtol=0, atol=1e-8)


def test_forms_of_the_path_of_a_sequence(simulated_folder, monkeypatch):
    monkeypatch.chdir(simulated_folder.parent)
    for typed in ("S99_D9", "S99_D9/", "./S99_D9//", simulated_folder):
        assert read_sequence(typed).name == "S99_D9"
    monkeypatch.chdir(simulated_folder)
    assert read_sequence(".").name == "S99_D9"


def test_cameras_may_be_without_video(simulated_folder, caplog):
    (simulated_folder / "cam2i_s.avi").unlink()
    with caplog.at_level("INFO"):
        recording = read_sequence(simulated_folder)
    assert list(recording.videos) == ["cam1i", "cam3i"]
    assert recording.rig.cameras.image_size_wh.tolist() == [[64, 48]] * 3
    assert "camera cam2i has no video: assuming 64 x 48 pixels like most cameras" in caplog.text
    assert recording.usable().rig.names == ("cam1i", "cam3i")
    assert "camera cam2i is left out: it has no video" in caplog.text
    assert recording.usable(["cam3i", "cam1i"]).num_frames == 5


def test_videos_may_differ_in_length(simulated_folder, make_video):
    shutil.copy(make_video(7), simulated_folder / "cam2i_s.avi")
    recording = read_sequence(simulated_folder)
    assert recording.num_frames == recording.truth.num_frames == 7
    assert recording.truth.seen[:, 0].tolist() == [False, True, True, True, True, False, False]
    assert recording.usable().timeline().frame[4:6].tolist() == [[4, 4, 4], [-1, 5, -1]]


def test_a_video_of_another_size(simulated_folder, make_video):
    shutil.copy(make_video(5, (96, 64)), simulated_folder / "cam1i_s.avi")
    with pytest.raises(
        InputError, match=r"cam1i_s\.avi: .* principal point \(32, 24\), found 96 x 64 pixels"
    ):
        read_sequence(simulated_folder)
    replace_in_file(simulated_folder / "cameras_calibration.csv", "1157.3;32;24", "1157.3;47;31")
    recording = read_sequence(simulated_folder).usable()
    assert recording.rig.cameras.image_size_wh.tolist() == [[96, 64], [64, 48], [64, 48]]


def test_poses_after_the_end_of_the_videos_are_dropped(simulated_folder):
    (simulated_folder / "dron1_pos_25.csv").write_text(pose_lines(9, 0.0))
    assert read_sequence(simulated_folder).truth.num_frames == 5


def test_missing_poses_are_nan(simulated_folder):
    (simulated_folder / "dron1_pos_25.csv").write_text(pose_lines(3, 0.0))
    replace_in_file(simulated_folder / "dron2_pos_25.csv", "\n3;", "\n12;")
    truth = read_sequence(simulated_folder).truth
    assert truth.seen[:, 0].tolist() == [False, True, True, False, False]
    # One missing row is interpolated.
    assert truth.seen[:, 1].tolist() == [False, True, True, True, True]
    assert truth.position_m[3, 1, 0] == pytest.approx(1.3, abs=0.02)


def test_ten_drones_are_in_the_order_of_their_numbers(simulated_folder):
    for number in range(3, 11):
        (simulated_folder / f"drone{number}_pos_25.csv").write_text(
            pose_lines(5, number)
        )  # the other spelling, `drone`
    truth = read_sequence(simulated_folder).truth
    assert truth.drones == tuple(f"dron{number}" for number in range(1, 11))
    assert truth.position_m[1, 9, 0] == pytest.approx(10.1)


def test_no_reference(simulated_folder):
    for path in simulated_folder.glob("dron*.csv"):
        path.unlink()
    assert read_sequence(simulated_folder).truth is None


def test_detections_are_assigned_to_cameras(simulated_folder):
    (simulated_folder / "dl_data").mkdir()
    (simulated_folder / "dl_data" / "cam2i_s.csv").write_text("1,10,20,4,6,12,23,0.5\n")
    detections = read_sequence(simulated_folder).detections
    assert list(detections) == ["cam2i"]
    assert read_detections(detections["cam2i"]).xyxy.tolist() == [[10, 20, 14, 26]]


def test_other_videos_are_ignored(simulated_folder, make_video, caplog):
    shutil.copy(make_video(7), simulated_folder / "dron1_fpv.mp4")
    with caplog.at_level("INFO"):
        assert read_sequence(simulated_folder).truth.num_frames == 5
    assert "dron1_fpv.mp4: not used" in caplog.text


def test_serial_numbers_with_a_prefix(real_folder):
    (real_folder / f"{SERIALS[0]}.avi").rename(real_folder / f"cam_{SERIALS[0]}.avi")
    assert list(read_sequence(real_folder).videos) == list(SERIALS)


def assert_reading_fails(folder, message):
    with pytest.raises(InputError, match=message):
        read_sequence(folder)


def test_no_such_folder(tmp_path):
    assert_reading_fails(tmp_path / "nix", r"nix/cameras_calibration\.csv: expected .*, found no such file")


def test_no_videos_at_all(simulated_folder):
    for path in simulated_folder.glob("*.avi"):
        path.unlink()
    assert_reading_fails(
        simulated_folder, r"S99_D9: expected videos named like the cameras, cam1i\.avi \.\.\., found no \.avi"
    )


def test_two_videos_of_one_camera(simulated_folder, make_video):
    shutil.copy(make_video(5), simulated_folder / "cam1i.avi")
    assert_reading_fails(
        simulated_folder, r"cam1i_s\.avi: expected one such file per camera, found cam1i\.avi as well"
    )


def test_a_broken_video(simulated_folder):
    (simulated_folder / "cam1i_s.avi").write_bytes(b"")
    assert_reading_fails(simulated_folder, r"cam1i_s\.avi: expected a video, found an empty file")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (";", ",", ", line 1: expected columns separated by ';', found 'cam_name,cam_x"),
        ("focal_length", "focus", r": expected a column focal_length, found only cam_name, cam_x\[m\]"),
        (
            "cam_x[m]",
            "cam_x[ft]",
            r": expected a column cam_x\[m\] or cam_x\[cm\] or cam_x\[mm\], found cam_x\[ft\]",
        ),
        ("cam_x[m]", "cam_x", r": expected a column cam_x\[m\] or cam_x\[cm\] or cam_x\[mm\], found cam_x"),
        ("cam_y[m]", "cam_x[m]", ", line 1: expected each column once, found cam_x again"),
        (";cy", ";coeff_1", ": expected a column coeff_2"),
        ("cam2i;2;0.5", "cam2i;2;x", r", line 3, column cam_y\[m\]: expected a number, found 'x'"),
        ("cam2i;2;0.5", "cam2i;2;nan", r", line 3, column cam_y\[m\]: expected a finite number, found 'nan'"),
        ("cam2i;2;0.5", "cam2i;2;0,5", ", line 3.*found '0,5'; write decimals with a point"),
        ("cam2i;2;0.5", "cam2i;2;", r", line 3, column cam_y\[m\]: expected a value, found nothing"),
        ("cam2i;2;0.5", "cam2i;0.5", ", line 3: expected 10 values as in the header, found 9"),
        ("cam2i;2", "cam1i_s;2", ", line 3, column cam_name: expected each camera once, found cam1i_s again"),
        ("1158.3", "0", ", line 3, column focal_length: expected a focal length above 0 pixels, found 0"),
        ("1158.3", "-1158.3", ", line 3, column focal_length: expected a focal length above 0"),
    ],
)
def test_an_unreadable_calibration(simulated_folder, old, new, message):
    path = simulated_folder / "cameras_calibration.csv"
    text = path.read_text()
    path.write_text(text.replace(old, new) if len(old) == 1 else text.replace(old, new, 1))
    assert_reading_fails(simulated_folder, rf"cameras_calibration\.csv{message}")


@pytest.mark.parametrize(("text", "found"), [("", "an empty file"), (f"{SIMULATED_HEADER}\n", "none")])
def test_an_empty_calibration(simulated_folder, text, found):
    (simulated_folder / "cameras_calibration.csv").write_text(text)
    assert_reading_fails(simulated_folder, f"cameras_calibration.csv.*expected .*, found {found}")


def test_too_many_coefficients(real_folder):
    replace_in_file(real_folder / "cameras_calibration.csv", "coeff_4", "coeff_4;coeff_5")
    text = (real_folder / "cameras_calibration.csv").read_text()
    (real_folder / "cameras_calibration.csv").write_text(text.replace("-0.002", "-0.002;0"))
    assert_reading_fails(real_folder, "expected 4 distortion coefficients, found 5")


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
def test_harmless_differences_are_accepted(simulated_folder, change_text):
    original = read_sequence(simulated_folder)
    for name in ("cameras_calibration.csv", "dron1_pos_25.csv"):
        path = simulated_folder / name
        path.write_bytes(change_text(path.read_text()).encode())
    changed = read_sequence(simulated_folder)
    assert changed.rig.names == original.rig.names
    np.testing.assert_array_equal(changed.rig.cameras.T_cam_world, original.rig.cameras.T_cam_world)
    np.testing.assert_array_equal(changed.truth.position_m, original.truth.position_m)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("\n2;0.2", "\n2;nan", r"line 4, column pos_x\[m\]: expected a finite number, found 'nan'"),
        ("\n2;0.2", "\n2;inf", r"line 4, column pos_x\[m\]: expected a finite number, found 'inf'"),
        ("\n2;0.2", "\n2;", r"line 4, column pos_x\[m\]: expected a value, found nothing"),
        ("\n2;0.2", "\n1;0.2", "line 4, column id: expected each frame once, found 1 again, after line 3"),
        ("\n2;0.2", "\n2.5;0.2", "line 4, column id: expected a whole number, 0 or more, found '2.5'"),
        ("\n2;0.2;2;1.5", "\n2;0.2;2", "line 4: expected 11 values as in the header, found 10"),
        ("0;0;0;1\n2", "0;0;0;7\n2", "line 3, column q_w: expected a quaternion of length 1, found length 7"),
        ("pos_x", "x", r"csv: expected a column pos_x, found only id, x\[m\]"),
    ],
)
def test_a_broken_reference(simulated_folder, old, new, message):
    replace_in_file(simulated_folder / "dron1_pos_25.csv", old, new)
    assert_reading_fails(simulated_folder, f"dron1_pos_25.*{message}")


def test_a_reference_at_another_rate(simulated_folder):
    (simulated_folder / "dron2_pos_25.csv").write_text(pose_lines(20, 1.0))
    (simulated_folder / "dron2_pos_25.csv").rename(simulated_folder / "dron2_pos_100.csv")
    truth = read_sequence(simulated_folder).truth
    np.testing.assert_allclose(truth.position_m[1:, 1, 0], [1.4, 1.8, 2.2, 2.6], rtol=0, atol=1e-12)


def test_two_files_of_one_drone(simulated_folder):
    shutil.copy(simulated_folder / "dron1_pos_25.csv", simulated_folder / "drone1_pos_25.csv")
    assert_reading_fails(
        simulated_folder,
        r"drone1_pos_25\.csv: expected one file per drone, found dron1 in .*dron1_pos_25\.csv as well",
    )


def test_two_recordings(real_folder):
    shutil.copy(real_folder / "R99.c3d", real_folder / "R98.c3d")
    assert_reading_fails(
        real_folder, r"R99\.c3d: expected one file per drone, found dron4 in .*R98\.c3d as well"
    )


def test_a_reference_that_is_not_c3d(real_folder):
    (real_folder / "R99.c3d").write_text("hello " * 400)
    assert_reading_fails(real_folder, r"R99\.c3d: expected a C3D file, found no valid c3d file")


def write_person(path: Path) -> None:
    """A person and a rigid box, as in a C3D of a gait laboratory."""
    rng = np.random.default_rng(0)
    t = np.arange(100)[:, None, None] / 100
    person_m = rng.uniform(-0.5, 0.5, (10, 3)) + 0.2 * np.sin(6 * t + rng.uniform(0, 6, (10, 1))) + t
    box_m = np.array([[0.2, 0, 0], [-0.1, 0, 0], [0, 0.15, 0], [0, -0.12, 0.1]]) + t
    labels = (*(f"Daphnee:M{i}" for i in range(10)), *(f"boite:b{i}" for i in range(4)))
    write_c3d(path, Markers(labels, np.concatenate([person_m, box_m], axis=1), 100.0))


def test_a_person_in_the_folder_is_no_reference(real_folder, tmp_path, caplog):
    """Found: `evaluate` scored tracks against a walking person without a word."""
    write_person(real_folder / "R99.c3d")
    (tmp_path / "tracks.csv").write_text("frame,drone,x_m,y_m,z_m\n0,dron1,0,0,1\n1,dron1,0,0,1\n")
    result = CliRunner().invoke(cli, ["evaluate", str(tmp_path / "tracks.csv"), str(real_folder)])
    assert isinstance(result.exception, InputError)
    assert "expected a reference to compare with, found none" in str(result.exception)
    assert "boite, rigid (boite:b0, " in caplog.text
    assert "daphnee, not rigid" in caplog.text
    arguments = ["evaluate", str(tmp_path / "tracks.csv"), str(real_folder), "--body", "cf1=b0,b1,b2,b3"]
    result = CliRunner().invoke(cli, [*arguments, "--json", "-"])
    assert result.exit_code == 0, result.output
    assert read_sequence(real_folder, bodies={"boite": ["boite:"]}).truth.drones == ("boite",)


def test_bodies_need_a_c3d(real_folder):
    (real_folder / "R99.c3d").unlink()
    with pytest.raises(
        InputError, match=r"bodies cf1: expected one C3D file that holds their markers, found none"
    ):
        read_sequence(real_folder, bodies={"cf1": ["a"]})


@pytest.mark.parametrize(
    ("names", "recognised"),
    [
        ("q_w;q_x;q_y;q_z", True),
        ("qw;qx;qy;qz", True),
        ("quat_w;quat_x;quat_y;quat_z", True),
        ("quaternion.w;quaternion.x;quaternion.y;quaternion.z", True),
        ("or_q_w[-];or_q_x[-];or_q_y[-];or_q_z[-]", True),
        ("Q_W;Q_X;Q_Y;Q_Z", True),
        ("q1;q2;q3;q4", False),
        ("a;b;c;d", False),
    ],
)
def test_column_names_of_the_quaternion(simulated_folder, names, recognised):
    for path in simulated_folder.glob("dron*.csv"):
        replace_in_file(path, "q_w;q_x;q_y;q_z", names)
    orientation_wxyz = read_sequence(simulated_folder).truth.orientation_wxyz
    if recognised:
        assert orientation_wxyz[1, 0].tolist() == [0, 0, 0, 1]
    else:
        assert orientation_wxyz is None


def test_quaternion_with_the_scalar_last(simulated_folder):
    """The names of the columns decide, not their order."""
    for path in simulated_folder.glob("dron*.csv"):
        replace_in_file(path, "q_w;q_x;q_y;q_z", "q_x;q_y;q_z;q_w")
    assert read_sequence(simulated_folder).truth.orientation_wxyz[1, 0].tolist() == [1, 0, 0, 0]
