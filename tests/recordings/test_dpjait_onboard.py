"""Videos, poses and intrinsics of on-board cameras: round trips, and damaged files."""

import logging

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import look_at, make_camera, make_rig
from psotrack.geometry.rig_files import write_calibration
from psotrack.recordings import VideoWriter, inventory_table
from psotrack.recordings.datasets import (
    CALIBRATION,
    ONBOARD_CALIBRATION,
    onboard_pose_file,
    pose_file,
    read_onboard,
    read_onboard_calibration,
    read_sequence,
    write_onboard_calibration,
    write_poses,
)

WIDTH, HEIGHT, FRAMES = 64, 48, 5
K = np.array([[30.5, 0.0, 31.5], [0.0, 30.25, 23.5], [0.0, 0.0, 1.0]])
ORIENTATION_WXYZ = Rotation.from_rotvec(np.linspace(0.1, 0.9, FRAMES)[:, None] * [0.3, 0.2, 1.0]).as_quat(
    scalar_first=True
)
POSITION_M = np.stack([np.linspace(0, 1, FRAMES), np.full(FRAMES, -2.0), np.full(FRAMES, 1.5)], axis=-1)


def write_video(path, size_wh=(WIDTH, HEIGHT), num_frames=FRAMES):
    with VideoWriter(path, 25.0, size_wh) as writer:
        for _ in range(num_frames):
            writer.write(np.zeros((size_wh[1], size_wh[0], 3), np.uint8))


@pytest.fixture
def folder(tmp_path):
    """A sequence of two wall cameras and two drones, each with an on-board camera."""
    R, t_m = look_at((4.0, 3.0, 2.5), (0.0, 0.0, 1.0))
    camera = make_camera(R=R, t_m=t_m, K=np.diag([80.0, 80.0, 1.0]), image_size_wh=(WIDTH, HEIGHT))
    write_calibration(tmp_path / CALIBRATION, make_rig({"cam1i": camera, "cam2i": camera}))
    for name in ("cam1i_s.avi", "cam2i_s.avi", "dron1_cam_s.avi", "dron2_cam_s.avi"):
        write_video(tmp_path / name)
    for number in (1, 2):
        shifted_m = np.add(POSITION_M, [0.0, number, 0.0])
        write_poses(tmp_path / pose_file(number), shifted_m, ORIENTATION_WXYZ)
        write_poses(
            tmp_path / onboard_pose_file(number), np.add(shifted_m, [0.1, 0.0, 0.0]), ORIENTATION_WXYZ
        )
    intrinsics = {"dron1": (K, (WIDTH, HEIGHT)), "dron2": (K + np.diag([1.0, 1.0, 0.0]), (WIDTH, HEIGHT))}
    write_onboard_calibration(tmp_path / ONBOARD_CALIBRATION, intrinsics)
    return tmp_path


def replace_in_file(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_written_onboard_files_are_read_back(folder):
    found = read_onboard(folder)
    assert list(found) == ["dron1", "dron2"]
    first, second = found.values()
    assert (first.video.path.name, first.video.num_frames) == ("dron1_cam_s.avi", FRAMES)
    np.testing.assert_array_equal(first.K, K)
    np.testing.assert_array_equal(second.K - first.K, np.diag([1.0, 1.0, 0.0]))
    assert np.isnan(first.position_m[0]).all(), "the first row is a placeholder"
    assert np.isnan(first.orientation_wxyz[0]).all()
    np.testing.assert_array_equal(first.position_m[1:], np.add(POSITION_M, [0.1, 1.0, 0.0])[1:])
    # The reader normalises quaternions.
    np.testing.assert_allclose(second.orientation_wxyz[1:], ORIENTATION_WXYZ[1:], atol=1e-15)


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


def test_a_recording_has_onboard_cameras_beside_its_fixed_cameras(folder):
    recording = read_sequence(folder)
    assert list(recording.videos) == ["cam1i", "cam2i"]
    assert recording.truth.drones == ("dron1", "dron2")
    # The reference holds the poses of the drones, not of the on-board cameras 0.1 m in front.
    of_drone_m = np.add(POSITION_M, [0.0, 1.0, 0.0])[1:]
    np.testing.assert_allclose(recording.truth.position_m[1:, 0], of_drone_m, rtol=0, atol=1e-12)
    assert list(recording.onboard) == ["dron1", "dron2"]
    assert recording.usable(num_frames=3).onboard == recording.onboard


def test_a_sequence_without_onboard_videos(folder):
    for path in folder.glob("*cam_*"):
        path.unlink()
    # Intrinsics without videos are ignored.
    assert read_onboard(folder) == {}
    recording = read_sequence(folder)
    assert not recording.onboard
    assert recording.to_dict()["onboard"] is None


@pytest.mark.parametrize("missing", ["dron1_cam_25.csv", ONBOARD_CALIBRATION])
def test_a_video_alone_is_enough(folder, missing):
    (folder / missing).unlink()
    onboard = read_onboard(folder)["dron1"]
    assert (onboard.K is None) == (missing == ONBOARD_CALIBRATION)
    assert np.isnan(onboard.orientation_wxyz).all() == (missing == "dron1_cam_25.csv")
    assert onboard.position_m.shape == (FRAMES, 3)


@pytest.mark.parametrize(("rows", "num_known"), [(3, 2), (9, 4)])
def test_poses_may_be_fewer_or_more_than_frames(folder, rows, num_known):
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (rows, 1))
    write_poses(folder / onboard_pose_file(1), np.ones((rows, 3)), turns)
    onboard = read_onboard(folder)["dron1"]
    assert onboard.position_m.shape == (FRAMES, 3)
    assert np.isfinite(onboard.position_m).all(axis=1).sum() == num_known


@pytest.mark.parametrize("file_name", ["drone1_cam.avi", "Dron_1_cam_s.AVI", "dron1_cam.mp4"])
def test_other_spellings_of_the_file_name_are_accepted(folder, file_name):
    (folder / "dron1_cam_s.avi").rename(folder / file_name)
    assert read_onboard(folder)["dron1"].video.path.name == file_name
    assert list(read_sequence(folder).videos) == ["cam1i", "cam2i"]


# --- inconsistent files


def test_two_videos_of_one_drone(folder):
    write_video(folder / "drone1_cam.avi")
    with pytest.raises(
        InputError, match=r"drone1_cam\.avi: expected one file per drone, found dron1_cam_s\.avi"
    ):
        read_onboard(folder)


def test_a_video_of_another_size_than_its_intrinsics(folder):
    write_video(folder / "dron2_cam_s.avi", (32, 32))
    with pytest.raises(InputError, match=r"dron2_cam_s\.avi: expected 64 x 48 pixels .*, found 32 x 32"):
        read_onboard(folder)


def test_poses_at_another_rate(folder):
    (folder / "dron2_cam_25.csv").rename(folder / "dron2_cam_30.csv")
    with pytest.raises(InputError, match=r"dron2_cam_30\.csv: expected poses at the 25 Hz .*, found 30 Hz"):
        read_onboard(folder)


def test_a_pose_that_is_not_a_number(folder):
    replace_in_file(folder / "dron1_cam_25.csv", "1.5", "one and a half")
    with pytest.raises(InputError, match=r"dron1_cam_25\.csv, line 3, column pos_z\[m\]: expected a number"):
        read_onboard(folder)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("dron2", "dron1", r"line 3, column cam_name: expected each camera once, found dron1 again"),
        (
            "30.5",
            "-30.5",
            r"line 2, column focal_length_x: expected a number of pixels above 0, found -30\.5",
        ),
        ("30.25", "0", r"line 2, column focal_length_y: expected a number of pixels above 0"),
        (";48", ";0", r"line 2, column height: expected a number of pixels above 0"),
        (";64", ";64.5", r"line 2, column width: expected a whole number"),
        ("cx", "c_x", r"expected a column cx, found only"),
    ],
)
def test_broken_intrinsics(folder, old, new, message):
    replace_in_file(folder / ONBOARD_CALIBRATION, old, new)
    with pytest.raises(InputError, match=rf"drone_cameras_calibration\.csv.*{message}"):
        read_onboard(folder)


def test_a_sequence_is_read_without_broken_onboard_files(folder, caplog):
    """Tracking needs only the wall cameras."""
    replace_in_file(folder / "dron1_cam_25.csv", "1.5", "?")
    with caplog.at_level(logging.WARNING):
        recording = read_sequence(folder)
    assert not recording.onboard
    assert "dron1_cam_25.csv, line 3" in caplog.text
    assert recording.truth is not None


@pytest.mark.parametrize("intrinsics", [{}, {"dron1": (K + np.eye(3, k=1), (WIDTH, HEIGHT))}])
def test_intrinsics_that_the_table_cannot_hold(tmp_path, intrinsics):
    with pytest.raises(SettingsError, match="without skew"):
        write_onboard_calibration(tmp_path / "x.csv", intrinsics)


# --- the inventory


def test_the_inventory_has_a_row_per_onboard_camera(folder):
    content = read_sequence(folder).to_dict()
    assert content["onboard"]["dron2"] == {
        "video": str(folder / "dron2_cam_s.avi"),
        "frames": FRAMES,
        "fps": 25.0,
        "image_size_wh": [WIDTH, HEIGHT],
        "focal_length_px": 31.5,
        "frames_with_pose": FRAMES - 1,
    }
    console = Console(width=120)
    with console.capture() as capture:
        console.print(inventory_table(content))
    row = next(line for line in capture.get().splitlines() if "on dron2" in line)
    assert row.split() == ["on", "dron2", "dron2_cam_s.avi", "5", "25", "64", "x", "48", "31.5", "4", "poses"]
