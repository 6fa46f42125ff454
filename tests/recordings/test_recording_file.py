"""`recording.toml`: every key is read, and every fault of the file is one line that names file, table and key."""

import tomllib

import cv2
import numpy as np
import pytest
from dpjait_folders import write_tum, write_video
from helpers import assert_refused

from psotrack.geometry import project
from psotrack.geometry.rig_files import read_rig, write_calibration, write_rig
from psotrack.recordings import Detections, read_frames, write_detections
from psotrack.recordings.datasets import find_marker_corners, open_recording, write_poses
from psotrack.trajectories import Trajectories, write_trajectories

K = "[[1160.2, 0.5, 31.0], [0, 1160.9, 25.2], [0, 0, 1]]"
RVEC, TVEC = (1.2, -0.4, 0.3), (0.1, 0.2, 5.0)
PLACE = f"K = {K}\nrvec = {list(RVEC)}\ntvec = {list(TVEC)}\n"


@pytest.fixture
def folder(sound):
    """A folder with videos, for a test's own `recording.toml`."""
    return sound / "any"


def write(folder, *tables, top=""):
    path = folder / "recording.toml"
    path.write_text("\n".join([f"version = 1\n{top}\n", *tables]), encoding="utf-8")
    return path


def camera(name, *lines):
    return "\n".join([f"[cameras.{name}]", *lines, ""])


def write_boxes(path, frames):
    """One box in each of some frames."""
    count = len(frames)
    write_detections(path, Detections(np.array(frames), np.tile([1.0, 2, 3, 4], (count, 1)), np.ones(count)))


LEFT = camera("left", 'video = "left.avi"', PLACE)
RIGHT = camera("right", 'video = "right.avi"', PLACE)
WIDE = camera("wide", 'video = "wide.avi"', PLACE)


def test_the_keys_of_a_camera(folder):
    cv2.imwrite(str(folder / "ignore.png"), np.zeros((48, 64), np.uint8))
    write_boxes(folder / "left.csv", [3])
    (folder / "corners.csv").write_text("")
    path = write(
        folder,
        camera(
            "left",
            'video = "left.avi"',
            'ignore = "ignore.png"',
            'detections = "left.csv"',
            "size = [64, 48]",
            "fps = 24.5",
            "time_offset_s = 0.5",
            "line_time_s = 1e-5",
            PLACE,
            "distortion = [-0.28, 0.09, 0, 0, 0.01]",
        ),
        RIGHT,
        "[world]\nbounds_m = [[-4, -3, 0], [4, 3, 2.5]]\n",
        '[markers]\ncorners = "corners.csv"\n',
    )
    recording = open_recording(path)
    assert recording.name == "any"
    assert recording.rig.names == tuple(recording.videos) == ("left", "right")
    left, right = recording.cameras
    assert (left.ignore, right.ignore) == (folder / "ignore.png", None)
    assert recording.detections == {"left": folder / "left.csv"}
    assert left.video.fps == left.times.fps == 24.5
    assert left.times.time_s[[0, 5]].tolist() == [0.5, 0.5 + 5 / 24.5]
    assert right.times.time_s[[0, 5]].tolist() == [0.0, 0.2]
    assert (left.line_time_s, right.line_time_s) == (1e-5, 0.0)
    assert recording.bounds_m == (-4, 4, -3, 3, 0, 2.5)
    assert recording.marker_corners == find_marker_corners(path) == folder / "corners.csv"
    # OpenCV's projection has no skew.
    point = np.array([[0.1, 0.2, 0.3]])
    plain_K = np.array(tomllib.loads(f"K = {K}")["K"]) * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]
    dist = np.array([-0.28, 0.09, 0, 0, 0.01])
    expected, _ = cv2.projectPoints(point, np.array(RVEC), np.array(TVEC), plain_K, dist)
    expected[0, 0, 0] += 0.5 * (expected[0, 0, 1] - 25.2) / 1160.9
    np.testing.assert_allclose(
        project(recording.rig.cameras[0], point[0])[0], expected[0, 0], rtol=0, atol=1e-9
    )


def test_a_folder_a_file_and_a_folder_of_the_dataset_are_recordings(folder):
    path = write(folder, LEFT, RIGHT)
    assert open_recording(folder).rig.names == open_recording(str(path)).rig.names == ("left", "right")
    other = path.rename(folder / "morning.toml")
    assert open_recording(other).name == "morning"
    rig = open_recording(other).rig
    rig.cameras.K[:, 1, 1], rig.cameras.K[:, 0, 1] = 1160.2, 0.0
    write_calibration(folder / "cameras_calibration.csv", rig)
    assert open_recording(folder).name == "any"
    np.testing.assert_array_equal(open_recording(folder).rig.cameras.K, rig.cameras.K)


def test_the_first_instants_are_as_many_as_asked_for_at_any_rate(folder):
    late = camera("wide", 'video = "wide.avi"', "time_offset_s = 0.1", PLACE)
    # Frame 2 of the slow camera is near instant 5, too.
    first = open_recording(write(folder, LEFT, late)).usable(num_frames=5)
    assert first.num_frames == 5
    assert first.at_rate(25.0).num_frames == 2


def write_times(folder, times):
    (folder / "times.csv").write_text("frame,time_s\n" + "".join(f"{i},{t}\n" for i, t in enumerate(times)))


TIMED = camera("left", 'video = "left.avi"', 'timestamps = "times.csv"', PLACE)


@pytest.mark.parametrize("num_times", [4, 10, 15])
def test_video_and_times_of_a_program_that_was_stopped(folder, num_times, caplog):
    """One of them is longer: both are used as far as there are both; the last frame may be incomplete."""
    write_video(folder / "left.avi", 10)
    # A killed program would not have written the index and the counts.
    data = bytearray((folder / "left.avi").read_bytes())
    del data[data.rindex(b"idx1") :]
    for chunk, place in ((b"avih", 24), (b"strh", 40), (b"RIFF", 4), (b"movi", -4)):
        start = data.index(chunk) + place
        data[start : start + 4] = bytes(4)
    (folder / "left.avi").write_bytes(data)
    # Not quite regular.
    times = [index / 25 + 0.001 * (index % 2) for index in range(num_times)]
    write_times(folder, times)
    recording = open_recording(write(folder, TIMED, RIGHT))
    used = min(num_times, 9)
    assert recording.videos["left"].num_frames == used
    assert recording.by_name["left"].times.time_s.tolist() == times[:used]
    assert f"the video was not finished; its first {used} frames are used" in caplog.text
    assert len(list(read_frames(recording.videos["left"]))) == used


# --- calibration


def with_rig(folder, rig_file, *names, more=""):
    """Recording of cameras whose place a rig file has."""
    cameras = [camera(name, f'video = "{name.lower()}.avi"') for name in names]
    return open_recording(write(folder, *cameras, top=f'calibration = "{rig_file}"\n{more}'))


@pytest.mark.parametrize("name", ["rig.toml", "rig.yml"])
def test_a_rig_file_and_own_keys_that_override_it(folder, name):
    given = open_recording(write(folder, LEFT, RIGHT)).rig
    write_rig(folder / name, given)
    own = camera("right", 'video = "right.avi"', "tvec = [1, 2, 3]")
    path = write(folder, camera("LEFT", 'video = "left.avi"'), own, top=f'calibration = "{name}"')
    rig = open_recording(path).rig
    assert rig.names == ("LEFT", "right")
    np.testing.assert_array_equal(rig.cameras.K, given.cameras.K)
    np.testing.assert_array_equal(rig.cameras.T_cam_world[:, :3, 3], [TVEC, [1, 2, 3]])
    np.testing.assert_allclose(rig.cameras.T_cam_world[1, :3, :3], given.cameras.T_cam_world[1, :3, :3])


def test_files_that_state_no_sizes_get_those_of_the_videos(folder):
    """The layout of the dataset, and coefficients of DLT whose rows count upwards from the end of the image."""
    sizes_wh = {"left": (64, 48), "wide": (96, 48)}
    given = open_recording(write(folder, LEFT, WIDE)).rig
    columns = []
    for T, K, size_wh in zip(
        given.cameras.T_cam_world, given.cameras.K, given.cameras.image_size_wh, strict=True
    ):
        P = np.array([[1, 0, 0], [0, -1, size_wh[1]], [0, 0, 1]]) @ K @ T[:3]
        columns.append((P / P[2, 3]).ravel()[:11])
    rows = [",".join(given.names), *(",".join(map(repr, row)) for row in np.array(columns).T.tolist())]
    (folder / "calibration.csv").write_text("\n".join(rows))
    rig = with_rig(folder, "calibration.csv", *sizes_wh, more='calibration_unit = "m"').rig
    np.testing.assert_allclose(rig.cameras.K, given.cameras.K, rtol=0, atol=1e-7)
    np.testing.assert_allclose(rig.cameras.T_cam_world, given.cameras.T_cam_world, rtol=0, atol=1e-9)

    given.cameras.K[:, 1, 1], given.cameras.K[:, 0, 1] = 1160.2, 0.0
    write_calibration(folder / "cameras.csv", given)
    rig = with_rig(folder, "cameras.csv", *sizes_wh).rig
    np.testing.assert_array_equal(rig.cameras.K, read_rig(folder / "cameras.csv", sizes_wh).cameras.K)
    assert rig.cameras.image_size_wh.tolist() == [[64, 48], [96, 48]]


def test_cameras_without_place_are_left_out(folder, caplog):
    recording = open_recording(write(folder, LEFT, camera("right", 'video = "right.avi"')))
    assert (recording.rig.names, tuple(recording.by_name)) == (("left",), ("left", "right"))
    assert tuple(recording.videos) == ("left", "right")
    assert recording.usable().rig.names == ("left",)
    assert "camera right is left out: it has no place in the world" in caplog.text
    recording = open_recording(write(folder, camera("left", 'video = "left.avi"', f"K = {K}")))
    assert (len(recording.rig), recording.num_frames, recording.fps) == (0, 6, 25.0)


# --- reference


def path_m(time_s):
    return np.stack([np.sin(time_s), np.cos(time_s), 1 + time_s], axis=-1)


def write_reference(file):
    time_s = np.arange(0, 2, 0.01)
    if file.suffix == ".tum":
        write_tum(file, time_s, path_m(time_s))
    else:
        tracks = Trajectories(np.arange(len(time_s)), time_s, ("drone",), path_m(time_s)[:, None])
        write_trajectories(file, tracks, force=True)


def truth_of(folder, file, *lines):
    table = "\n".join(["[reference]", f'files = ["{file}"]', *lines])
    recording = open_recording(write(folder, LEFT, RIGHT, table))
    assert recording.truth.num_frames == recording.num_frames == 6
    return recording.truth


@pytest.mark.parametrize("later_s", [0.0, 0.017])
@pytest.mark.parametrize("file", ["drone.tum", "tracks.csv"])
def test_the_reference_is_sampled_at_the_instants(folder, file, later_s):
    write_reference(folder / file)
    truth = truth_of(folder, file, f"time_offset_s = {-later_s}")
    assert truth.drones == ("drone",)
    expected_m = path_m(np.arange(6) / 25 + later_s)
    np.testing.assert_allclose(truth.position_m[:, 0], expected_m, rtol=0, atol=1e-7)


@pytest.mark.parametrize(("file", "rate_hz"), [("dron1_pos_100.csv", 100), ("dron1.csv", 25)])
def test_pose_files_have_the_rate_of_their_name_or_of_the_recording(folder, file, rate_hz):
    write_poses(folder / file, path_m(np.arange(30) / rate_hz), np.tile([1.0, 0, 0, 0], (30, 1)))
    truth = truth_of(folder, file)
    assert truth.drones == ("dron1",)
    # Row 0 of a pose file is a placeholder.
    np.testing.assert_allclose(truth.position_m[1:, 0], path_m(np.arange(1, 6) / 25), rtol=0, atol=1e-6)
    assert truth.orientation_wxyz[1:, 0].tolist() == [[1, 0, 0, 0]] * 5


# --- warnings


def test_what_does_not_meet_in_time_is_a_warning(folder, caplog):
    write_reference(folder / "drone.tum")
    assert not truth_of(folder, "drone.tum", "time_offset_s = 100.0").seen.any()
    assert "it lasts from 100.000 to 101.990 s on the recording's clock" in caplog.text
    open_recording(write(folder, camera("left", 'video = "left.avi"', "time_offset_s = 9.0", PLACE), RIGHT))
    assert "cameras.left: no other camera films while it does, from 9.000 to 9.200 s" in caplog.text


WITH_BOXES = camera("left", 'video = "left.avi"', 'detections = "left.csv"', PLACE)


@pytest.mark.parametrize(("first", "used"), [(0, 6), (2, 4), (5, 1)])
def test_detections_beyond_the_end_of_the_video_are_a_warning(folder, caplog, first, used):
    write_boxes(folder / "left.csv", range(first, first + 6))
    recording = open_recording(write(folder, WITH_BOXES, RIGHT))
    recording.check_detections(recording.detections)
    words = (
        f"left.csv: {6 - used} of 6 detections are not used, because camera left (left.avi) ends with frame 5"
    )
    assert (words in caplog.text) == (used < 6)


def test_detections_that_all_lie_beyond_the_end_of_the_video(run_psotrack, folder):
    write_boxes(folder / "left.csv", [6])
    path = write(folder, WITH_BOXES, RIGHT)
    words = (
        "left.csv: expected detections in the frames 0 to 5 of camera left (left.avi), found none before frame 6; ",
        "are they detections in another video?",
    )
    assert_refused(lambda: run_psotrack("init", "--show", path), *words, unchanged=folder)
    assert_refused(lambda: run_psotrack("doctor", path), *words, unchanged=folder)


# --- streams


@pytest.mark.parametrize(
    ("video", "stream"),
    [
        ('"rtsp://left/1"', "rtsp://left/1"),
        ("0", "device 0"),
        ('"/dev/v4l/by-id/left"', "device /dev/v4l/by-id/left"),
        # Addresses without the name of a host.
        ('"udp://@:1234"', "udp://@:1234"),
        ('"gstreamer://videotestsrc ! appsink"', "gstreamer://videotestsrc ! appsink"),
    ],
)
def test_streams_wait_for_live_tracking(folder, video, stream):
    recording = open_recording(write(folder, camera("left", f"video = {video}"), RIGHT))
    assert [each.stream for each in recording.cameras] == [stream, None]
    assert recording.usable(["right"]).rig.names == ("right",)
