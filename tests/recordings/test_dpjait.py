"""The dataset's folders: both halves are read, written files are read back, and what is wrong is said in one line."""

import cv2
import numpy as np
import pytest
from dpjait_folders import POSE_HEADER, REAL_HEADER, SERIALS, edit, pose_lines, write_cameras, write_video
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.geometry import make_camera, make_rig, project
from psotrack.geometry.rig_files import read_rig, write_calibration
from psotrack.recordings import read_detections
from psotrack.recordings.datasets import (
    CALIBRATION,
    ONBOARD_CALIBRATION,
    pose_file,
    read_onboard,
    read_onboard_calibration,
    read_poses,
    read_sequence,
    write_onboard_calibration,
    write_poses,
)
from psotrack.recordings.mocap import Markers, write_c3d


@pytest.fixture
def simulated(sound):
    return sound / "S99_D9"


@pytest.fixture
def real(sound):
    return sound / "R99_D9"


# --- both halves


def test_the_simulated_half(simulated, monkeypatch):
    monkeypatch.chdir(simulated)
    recording = read_sequence(".")
    assert recording.name == "S99_D9"
    assert recording.rig.names == ("cam1i", "cam2i", "cam3i")
    files = [video.path.name for video in recording.videos.values()]
    assert files == ["cam1i_s.avi", "cam2i_s.avi", "cam3i_s.avi"]
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
    assert recording.to_dict()["onboard"]["dron1"] == {
        "video": str(simulated / "dron1_cam_s.avi"),
        "frames": 5,
        "fps": 25.0,
        "image_size_wh": [64, 48],
        "focal_length_px": 60.5,
        "frames_with_pose": 4,
    }
    # Intrinsics and poses without videos are ignored.
    for path in simulated.glob("dron?_cam_s.avi"):
        path.unlink()
    assert read_onboard(simulated) == {}
    assert read_sequence(simulated).to_dict()["onboard"] is None


@pytest.mark.parametrize(
    ("names", "more"),
    [
        # Cameras are `cam1` in the calibration and `cam1i_s` in the names of files; `cam10i_s` is another camera.
        ({"cam1": "cam1i_s", "cam2": "cam2i_s", "cam10": "cam10i_s"}, "cam11i_s"),
        # `left_back_s` belongs to `left_back`, not to `left`; `left.avi` comes before `left_debug.avi`.
        ({"left": "left", "left_back": "left_back_s"}, "left_debug"),
    ],
)
def test_a_file_belongs_to_the_camera_with_the_longest_matching_name(simulated, names, more):
    write_cameras(simulated, list(names))
    for number, name in enumerate((*names.values(), more)):
        write_video(simulated / f"{name}.avi")
        (simulated / "dl_data" / f"{name}.csv").write_text(f"{number},10,20,30,40,25,40,0.66,,,,,,,\n")
    (simulated / "dl_data" / f"{more}.csv").unlink()
    recording = read_sequence(simulated)
    assert list(recording.videos) == list(names)
    for number, (name, stem) in enumerate(names.items()):
        assert recording.videos[name].path.stem == stem
        assert read_detections(recording.detections[name]).frame.tolist() == [number]


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
def test_projection_agrees_with_opencv(sound, half, metres):
    """Projection agrees with `cv2.projectPoints` and the values of the file: t is not the camera's centre."""
    rig = read_sequence(sound / half).rig
    text = (sound / half / CALIBRATION).read_text()
    values = [float(value) for value in text.splitlines()[2].split(";")[1:]]
    t, rvec, dist = np.array(values[:3]), np.array(values[3:6]), np.array(values[9:])
    f, cx, cy = values[6:9]
    K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
    points_m = np.random.default_rng(0).uniform(-2, 2, (7, 3))
    expected, _ = cv2.projectPoints(points_m / metres, rvec, t, K, dist)
    pixels, depth_m = project(rig.cameras[1], points_m)
    assert depth_m.min() > 0
    # Both compute in double precision with pixels up to a few thousand.
    np.testing.assert_allclose(pixels, expected[:, 0], rtol=0, atol=1e-8)


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


def test_videos_may_differ_in_length_and_size(simulated):
    write_video(simulated / "cam2i_s.avi", 7)
    write_video(simulated / "cam1i_s.avi", size_wh=(96, 64))
    edit(CALIBRATION, "1157.3;32;24", "1157.3;47;31")(simulated)
    recording = read_sequence(simulated)
    assert recording.num_frames == recording.truth.num_frames == 7
    assert np.flatnonzero(recording.truth.seen[:, 0]).tolist() == [1, 2, 3, 4]
    usable = recording.usable()
    assert usable.timeline().frame[4:6].tolist() == [[4, 4, 4], [-1, 5, -1]]
    assert usable.rig.cameras.image_size_wh.tolist() == [[96, 64], [64, 48], [64, 48]]


def test_poses_that_are_missing_more_than_frames_or_at_another_rate(simulated):
    (simulated / "dron1_pos_25.csv").write_text(pose_lines(3, 0.0))
    edit("dron2_pos_25.csv", "\n3;", "\n12;")(simulated)
    # The other spelling, `drone`, beside numbers that sort otherwise as text.
    (simulated / "drone10_pos_100.csv").write_text(pose_lines(20, 9.0))
    truth = read_sequence(simulated).truth
    assert truth.drones == ("dron1", "dron2", "dron10")
    assert truth.num_frames == 5
    assert np.flatnonzero(truth.seen[:, 0]).tolist() == [1, 2]
    # One missing row is interpolated.
    assert np.flatnonzero(truth.seen[:, 1]).tolist() == [1, 2, 3, 4]
    assert truth.position_m[3, 1, 0] == pytest.approx(1.3, abs=0.02)
    np.testing.assert_allclose(truth.position_m[1:, 2, 0], [9.4, 9.8, 10.2, 10.6], rtol=0, atol=1e-12)
    for path in simulated.glob("dron*_pos_*.csv"):
        path.unlink()
    assert read_sequence(simulated).truth is None


def as_spreadsheets_save_it(text):
    """With a last separator, blank lines, spaces and capitals."""
    text = text.replace("\n", ";\n") + "\n\n;;;\n"
    return text.replace(";", " ; ").replace("cam_", "CAM_")


@pytest.mark.parametrize(
    "change_text", [lambda text: "\ufeff" + text.replace("\n", "\r\n"), as_spreadsheets_save_it]
)
def test_harmless_differences_are_accepted(simulated, change_text):
    original = read_sequence(simulated)
    for name in (CALIBRATION, "dron1_pos_25.csv"):
        path = simulated / name
        path.write_bytes(change_text(path.read_text()).encode())
    changed = read_sequence(simulated)
    np.testing.assert_array_equal(changed.rig.cameras.T_cam_world, original.rig.cameras.T_cam_world)
    np.testing.assert_array_equal(changed.truth.position_m, original.truth.position_m)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("quaternion.w;quaternion.x;quaternion.y;quaternion.z", [0, 0, 0, 1]),
        ("or_q_w[-];or_q_x[-];or_q_y[-];or_q_z[-]", [0, 0, 0, 1]),
        ("q_x;q_y;q_z;q_w", [1, 0, 0, 0]),
    ],
)
def test_column_names_of_the_quaternion(tmp_path, names, expected):
    """The names of the columns decide, not their order. A first row with a pose is no placeholder."""
    text = pose_lines(3, 0.0).replace("q_w;q_x;q_y;q_z", names).replace("0;0;0;-0", "0;1;2;3")
    (tmp_path / "dron1_pos_25.csv").write_text(text)
    position_m, orientation_wxyz = read_poses(tmp_path / "dron1_pos_25.csv")
    assert position_m[0].tolist() == [1, 2, 3]
    assert orientation_wxyz[1].tolist() == expected


def write_bodies(path, **bodies):
    """A recording of bodies that fly along a diagonal, (100 or 1, markers, 3) each."""
    t = np.arange(100)[:, None, None] / 100
    labels = []
    for name, body_m in bodies.items():
        labels += [f"{name}:{name[0]}{number}" for number in range(body_m.shape[1])]
    position_m = np.concatenate([body_m + t for body_m in bodies.values()], axis=1)
    write_c3d(path, Markers(tuple(labels), position_m, 100.0))


BOX_M = np.array([[[0.2, 0, 0], [-0.1, 0, 0], [0, 0.15, 0], [0, -0.12, 0.1]]])


def test_a_person_in_the_folder_is_no_reference(run_psotrack, real, tmp_path, caplog):
    """Found: `evaluate` scored tracks against a walking person without a word."""
    rng = np.random.default_rng(0)
    t = np.arange(100)[:, None, None] / 100
    swing_m = 0.2 * np.sin(6 * t + rng.uniform(0, 6, (10, 1)))
    person_m = rng.uniform(-0.5, 0.5, (10, 3)) + swing_m
    write_bodies(real / "R99.c3d", daphnee=person_m, boite=BOX_M)
    (tmp_path / "tracks.csv").write_text("frame,drone,x_m,y_m,z_m\n0,dron1,0,0,1\n1,dron1,0,0,1\n")
    command = ("evaluate", tmp_path / "tracks.csv", real, "--quiet")
    result = run_psotrack(*command).ended(2)
    assert "expected a reference to compare with, found none" in result.err
    assert "daphnee, not rigid" in caplog.text
    assert run_psotrack(*command, "--body", "cf1=b0,b1,b2,b3").code == 0
    assert read_sequence(real, bodies={"boite": ["boite:"]}).truth.drones == ("boite",)
    # Found: with `--offset`, the reference was read twice, and said its warnings twice.
    write_bodies(real / "R99.c3d", cf1=BOX_M, cf2=BOX_M + 1.0)
    run_psotrack(*command, "--offset", 0).ended()
    assert caplog.text.count("taken for drones, because their markers are rigid") == 1


@pytest.mark.parametrize(
    ("missing", "rows", "file_name", "num_known"),
    [
        ("dron1_cam_25.csv", None, "dron1_cam.mp4", 0),
        (ONBOARD_CALIBRATION, 3, "drone1_cam.avi", 2),
        (ONBOARD_CALIBRATION, 9, "Dron_1_cam_s.AVI", 4),
    ],
)
def test_the_video_of_a_drone_alone_is_enough(simulated, missing, rows, file_name, num_known):
    """It has several names, and poses may be fewer or more than its frames."""
    (simulated / missing).unlink()
    if rows is not None:
        (simulated / "dron1_cam_25.csv").write_text(pose_lines(rows, 0.0))
    (simulated / "dron1_cam_s.avi").rename(simulated / file_name)
    onboard = read_onboard(simulated)["dron1"]
    assert onboard.video.path.name == file_name
    assert (onboard.K is None) == (missing == ONBOARD_CALIBRATION)
    assert onboard.position_m.shape == (5, 3)
    known = np.isfinite(onboard.position_m).all(axis=1)
    assert known.sum() == num_known
    assert np.isfinite(onboard.orientation_wxyz).all(axis=1).tolist() == known.tolist()
    assert list(read_sequence(simulated).videos) == ["cam1i", "cam2i", "cam3i"]


def test_a_sequence_is_read_without_broken_onboard_files(simulated, caplog):
    """Tracking needs only the wall cameras."""
    edit("dron1_cam_25.csv", "1.5", "?")(simulated)
    recording = read_sequence(simulated)
    assert not recording.onboard
    assert "dron1_cam_25.csv, line 3" in caplog.text
    assert recording.truth is not None


# --- files that are written


finite = st.floats(-50, 50)
triples = st.tuples(finite, finite, finite).map(np.array)
angle = st.floats(-4, 4)
tiny = st.floats(-1e-9, 1e-9)
#: All rotations, and rotations near half a turn, where the Rodrigues vector is nearly ambiguous.
near_half_a_turn = st.tuples(tiny.map(lambda small: np.pi + small), tiny, tiny)
rotations = (st.tuples(angle, angle, angle) | near_half_a_turn).map(Rotation.from_rotvec)
FULL_HD = (1920, 1080)
distortion = st.floats(-0.5, 0.5)


def camera_at(rotation, t_m, focal=1000.0, dist=()):
    K = np.array([[focal, 0, 960], [0, focal, 540], [0, 0, 1]])
    return make_camera(R=rotation.as_matrix(), t_m=t_m, K=K, image_size_wh=FULL_HD, dist=dist)


@given(
    poses=st.lists(st.tuples(rotations, triples), min_size=1, max_size=5),
    dist=st.just(()) | st.tuples(distortion, distortion, distortion, distortion),
    unit=st.sampled_from(["m", "mm"]),
)
def test_a_written_rig_is_read_back(tmp_path_factory, poses, dist, unit):
    path = tmp_path_factory.getbasetemp() / CALIBRATION
    cameras = {}
    for index, (rotation, t_m) in enumerate(poses):
        cameras[f"cam{index}i"] = camera_at(rotation, t_m, 1156.3 + index, dist)
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
    rig = make_rig(
        {"cam1i": camera_at(Rotation.identity(), np.array([1.0, 2.0, 3.0]), dist=(0.1, 0.0, 0.0, 0.0))}
    )
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
    angles_rad = np.loadtxt(path, delimiter=";", skiprows=2, ndmin=2)[:, 4:7]
    by_angles = Rotation.from_euler("xyz", angles_rad)
    # Near gimbal lock, Euler angles lose half of their digits: the error is up to 1e-7 rad.
    assert (by_angles * rotation[1:].inv()).magnitude().max() < 1e-6


focals, middles, sides = st.floats(1e-3, 1e5), st.floats(-1e4, 1e4), st.integers(1, 8000)
intrinsics = st.tuples(focals, focals, middles, middles, sides, sides)


@given(cameras=st.lists(intrinsics, min_size=1, max_size=4))
def test_written_intrinsics_are_read_back(tmp_path_factory, cameras):
    path = tmp_path_factory.getbasetemp() / ONBOARD_CALIBRATION
    written = {}
    for number, (fx, fy, cx, cy, width, height) in enumerate(cameras, start=1):
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        written[f"dron{number}"] = (K, (width, height))
    write_onboard_calibration(path, written)
    np.testing.assert_equal(dict(read_onboard_calibration(path)), written)
