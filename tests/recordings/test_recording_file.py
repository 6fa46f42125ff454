"""`recording.toml`: every key is read, and every fault of the file is one line that names file, table and key."""

import re
import shutil
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from psotrack.cli import cli
from psotrack.errors import InputError
from psotrack.geometry import project
from psotrack.geometry.rig_files import read_rig, write_calibration, write_rig
from psotrack.recordings import (
    Detections,
    VideoWriter,
    read_frames,
    write_detections,
)
from psotrack.recordings.datasets import find_marker_corners, open_recording
from psotrack.recordings.datasets._poses import write_poses
from psotrack.trajectories import Trajectories, write_trajectories
from psotrack.trajectories.tum import write_tum

K = "[[1160.2, 0.5, 31.0], [0, 1160.9, 25.2], [0, 0, 1]]"
PLACE = f"K = {K}\nrvec = [1.2, -0.4, 0.3]\ntvec = [0.1, 0.2, 5.0]\n"


@pytest.fixture(scope="session")
def videos(tmp_path_factory):
    """Three small videos: left and right of 6 frames at 25 Hz, wide of 11 frames at 50 Hz and another size."""
    folder = tmp_path_factory.mktemp("small")
    for name, count, fps, size_wh in (
        ("left", 6, 25.0, (64, 48)),
        ("right", 6, 25.0, (64, 48)),
        ("wide", 11, 50.0, (96, 48)),
    ):
        with VideoWriter(folder / f"{name}.avi", fps, size_wh) as writer:
            for index in range(count):
                writer.write(np.full((size_wh[1], size_wh[0], 3), 20 * index, np.uint8))
    return folder


@pytest.fixture
def folder(videos, tmp_path):
    """A folder with the videos, for a test's own `recording.toml`."""
    return shutil.copytree(videos, tmp_path / "flight")


def write(folder, *tables, top=""):
    path = folder / "recording.toml"
    path.write_text("\n".join([f"version = 1\n{top}\n", *tables]), encoding="utf-8")
    return path


def camera(name, *lines):
    return "\n".join([f"[cameras.{name}]", *lines, ""])


LEFT = camera("left", 'video = "left.avi"', PLACE)
RIGHT = camera("right", 'video = "right.avi"', PLACE)


def assert_fails(path, *words):
    """The recording cannot be opened, and the message has one line with these words in it."""
    with pytest.raises(InputError) as error:
        open_recording(path)
    message = str(error.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_the_keys_of_a_camera(folder):
    cv2.imwrite(str(folder / "ignore.png"), np.zeros((48, 64), np.uint8))
    (folder / "left.csv").write_text("3,0,0,10,10,5,5,0.9\n")
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
    (folder / "corners.csv").write_text("")
    recording = open_recording(path)
    assert recording.name == "flight"
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
    left = recording.rig.cameras[0]
    rotation, _ = cv2.Rodrigues(np.array([1.2, -0.4, 0.3]))
    np.testing.assert_allclose(left.T_cam_world[:3, :3], rotation, rtol=0, atol=1e-12)
    assert left.T_cam_world[:3, 3].tolist() == [0.1, 0.2, 5.0]
    # OpenCV's projection has no skew.
    point = np.array([[0.1, 0.2, 0.3]])
    plain_K = np.array(tomllib.loads(f"K = {K}")["K"]) * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]
    dist = np.array([-0.28, 0.09, 0, 0, 0.01])
    expected, _ = cv2.projectPoints(
        point, np.array([1.2, -0.4, 0.3]), np.array([0.1, 0.2, 5.0]), plain_K, dist
    )
    expected[0, 0, 0] += 0.5 * (expected[0, 0, 1] - 25.2) / 1160.9
    np.testing.assert_allclose(project(left, point[0])[0], expected[0, 0], rtol=0, atol=1e-9)


def test_a_folder_a_file_and_a_folder_of_the_dataset_are_recordings(folder):
    path = write(folder, LEFT, RIGHT)
    assert open_recording(folder).rig.names == open_recording(str(path)).rig.names == ("left", "right")
    other = path.rename(folder / "morning.toml")
    assert open_recording(other).name == "morning"
    rig = open_recording(other).rig
    rig.cameras.K[:, 1, 1], rig.cameras.K[:, 0, 1] = 1160.2, 0.0
    write_calibration(folder / "cameras_calibration.csv", rig)
    assert open_recording(folder).name == "flight"
    np.testing.assert_array_equal(open_recording(folder).rig.cameras.K, rig.cameras.K)


def test_sizes_rates_starts_and_lengths_may_differ(folder):
    recording = open_recording(
        write(folder, LEFT, camera("wide", 'video = "wide.avi"', "time_offset_s = 0.1", PLACE))
    ).usable()
    assert recording.rig.cameras.image_size_wh.tolist() == [[64, 48], [96, 48]]
    assert (recording.fps, recording.num_frames) == (50.0, 16)
    assert recording.timeline().frame[[0, 4, 6, 10, 15]].tolist() == [
        [0, -1],
        [2, -1],
        [3, 1],
        [5, 5],
        [-1, 10],
    ]


def test_the_first_instants_are_as_many_as_asked_for_at_any_rate(folder):
    path = write(folder, LEFT, camera("wide", 'video = "wide.avi"', "time_offset_s = 0.1", PLACE))
    # Frame 2 of the slow camera is near instant 5, too.
    first = open_recording(path).usable(num_frames=5)
    assert first.num_frames == 5
    assert first.at_rate(25.0).num_frames == 2


def test_images_are_frames_in_natural_order(folder):
    (folder / "shots").mkdir()
    for index in range(12):
        cv2.imwrite(str(folder / "shots" / f"shot{index}.png"), np.full((48, 64), 20 * index, np.uint8))
    path = write(folder, camera("left", 'images = "shots/*.png"', "fps = 30", PLACE), RIGHT)
    recording = open_recording(path)
    video = recording.videos["left"]
    assert (video.num_frames, video.fps, video.image_size_wh) == (12, 30.0, (64, 48))
    assert [int(frame[0, 0, 0]) for frame in read_frames(video)] == [20 * index for index in range(12)]
    assert [int(frame[0, 0, 0]) for frame in read_frames(video, 5)] == [0, 100, 200]
    cv2.imwrite(str(folder / "shots" / "shot7.png"), np.zeros((40, 64), np.uint8))
    with pytest.raises(
        InputError, match=r"shot7\.png: expected 64 x 48 pixels as in shot0\.png, found 64 x 40"
    ):
        list(read_frames(video))
    (folder / "shots" / "shot3.png").write_text("not an image")
    with pytest.raises(InputError, match=r"shot3\.png: expected an image, found a file that is no PNG"):
        list(read_frames(video))


def test_detections_alone(folder):
    write_detections(
        folder / "left.csv", Detections(np.array([2, 7]), np.array([[1.0, 2, 3, 4]] * 2), np.ones(2))
    )
    path = write(
        folder,
        camera("left", 'detections = "left.csv"', "size = [3840, 2160]", "fps = 50", PLACE),
        camera("right", "size = [640, 480]", "fps = 50", PLACE),
    )
    recording = open_recording(path)
    assert not recording.videos
    assert recording.usable(videos=False).rig.names == ("left", "right")
    assert (recording.num_frames, recording.fps) == (8, 50.0)
    assert recording.rig.cameras.image_size_wh.tolist() == [[3840, 2160], [640, 480]]
    longer = folder / "right.csv"
    write_detections(longer, Detections(np.array([19]), np.array([[1.0, 2, 3, 4]]), np.ones(1)))
    assert recording.with_detections({"right": longer}).usable(videos=False).num_frames == 20
    with pytest.raises(InputError, match="expected a video for each of the cameras left, right, found none"):
        recording.usable()


def test_timestamps(folder):
    times = [0.0, 0.04, 0.09, 0.12, 0.16, 0.21]
    (folder / "times.csv").write_text("frame,time_s\n" + "".join(f"{i},{t}\n" for i, t in enumerate(times)))
    path = write(folder, camera("left", 'video = "left.avi"', 'timestamps = "times.csv"', PLACE), RIGHT)
    assert open_recording(path).by_name["left"].times.time_s.tolist() == times


def unfinished(path: Path, num_frames: int) -> None:
    """Write a video, and take from it what a killed program would not have written: the index and the counts."""
    size_wh = (64, 48)
    with VideoWriter(path, 25.0, size_wh) as writer:
        for index in range(num_frames):
            writer.write(np.full((size_wh[1], size_wh[0], 3), index, np.uint8))
    data = bytearray(path.read_bytes())
    del data[data.rindex(b"idx1") :]
    for chunk, place in ((b"avih", 24), (b"strh", 40), (b"RIFF", 4), (b"movi", -4)):
        start = data.index(chunk) + place
        data[start : start + 4] = bytes(4)
    path.write_bytes(data)


@pytest.mark.parametrize("num_times", [4, 10, 15])
def test_video_and_times_of_a_program_that_was_stopped(folder, num_times, caplog):
    """One of them is longer: both are used as far as there are both; the last frame may be incomplete."""
    unfinished(folder / "left.avi", 10)
    rows = "".join(f"{index},{index / 25}\n" for index in range(num_times))
    (folder / "times.csv").write_text(f"frame,time_s\n{rows}")
    path = write(folder, camera("left", 'video = "left.avi"', 'timestamps = "times.csv"', PLACE), RIGHT)
    recording = open_recording(path)
    used = min(num_times, 9)
    assert recording.videos["left"].num_frames == recording.by_name["left"].times.num_frames == used
    assert f"the video was not finished; its first {used} frames are used" in caplog.text
    assert len(list(read_frames(recording.videos["left"]))) == used


class TestCalibration:
    def test_a_rig_file_and_own_keys_that_override_it(self, folder):
        given = open_recording(write(folder, LEFT, RIGHT)).rig
        for name in ("rig.toml", "rig.yml"):
            write_rig(folder / name, given)
            own = camera("right", 'video = "right.avi"', "tvec = [1, 2, 3]")
            path = write(folder, camera("LEFT", 'video = "left.avi"'), own, top=f'calibration = "{name}"')
            rig = open_recording(path).rig
            assert rig.names == ("LEFT", "right")
            np.testing.assert_array_equal(rig.cameras.K, given.cameras.K)
            np.testing.assert_array_equal(rig.cameras[0].T_cam_world[:3, 3], [0.1, 0.2, 5.0])
            np.testing.assert_array_equal(rig.cameras[1].T_cam_world[:3, 3], [1, 2, 3])
            np.testing.assert_allclose(
                rig.cameras.T_cam_world[1, :3, :3], given.cameras.T_cam_world[1, :3, :3]
            )

    def test_the_layout_of_the_dataset_states_no_sizes(self, folder):
        given = open_recording(write(folder, LEFT, camera("wide", 'video = "wide.avi"', PLACE))).rig
        given.cameras.K[:, 1, 1], given.cameras.K[:, 0, 1] = 1160.2, 0.0
        write_calibration(folder / "cameras.csv", given)
        cameras = [camera(name, f'video = "{name}.avi"') for name in ("left", "wide")]
        rig = open_recording(write(folder, *cameras, top='calibration = "cameras.csv"')).rig
        sizes = {"left": (64, 48), "wide": (96, 48)}
        np.testing.assert_array_equal(rig.cameras.K, read_rig(folder / "cameras.csv", sizes).cameras.K)
        assert rig.cameras.image_size_wh.tolist() == [[64, 48], [96, 48]]

    def test_coefficients_whose_rows_count_upwards_get_the_height_of_each_video(self, folder):
        """A file of DLT states no sizes: the row of a pixel follows from the height of the camera's own images."""
        given = open_recording(write(folder, LEFT, camera("wide", 'video = "wide.avi"', PLACE))).rig
        columns = []
        for T, K, size_wh in zip(
            given.cameras.T_cam_world, given.cameras.K, given.cameras.image_size_wh, strict=True
        ):
            P = np.array([[1, 0, 0], [0, -1, size_wh[1]], [0, 0, 1]]) @ K @ T[:3]
            columns.append((P / P[2, 3]).ravel()[:11])
        rows = [",".join(given.names), *(",".join(map(repr, row)) for row in np.array(columns).T.tolist())]
        (folder / "calibration.csv").write_text("\n".join(rows))
        cameras = [camera(name, f'video = "{name}.avi"') for name in given.names]
        top = 'calibration = "calibration.csv"\ncalibration_unit = "m"'
        rig = open_recording(write(folder, *cameras, top=top)).rig
        np.testing.assert_allclose(rig.cameras.K, given.cameras.K, rtol=0, atol=1e-7)
        np.testing.assert_allclose(rig.cameras.T_cam_world, given.cameras.T_cam_world, rtol=0, atol=1e-9)

    def test_another_size_than_calibrated(self, folder):
        given = open_recording(write(folder, LEFT)).rig
        given.cameras.image_size_wh[:] = (128, 96)
        write_rig(folder / "rig.toml", given)
        path = write(folder, camera("left", 'video = "left.avi"'), top='calibration = "rig.toml"')
        with pytest.raises(
            InputError, match=r"expected 128 x 96 pixels as calibrated, found 64 x 48 .* by 1/2"
        ):
            open_recording(path).usable()

    def test_cameras_without_place_are_left_out(self, folder, caplog):
        path = write(folder, LEFT, camera("right", 'video = "right.avi"'))
        recording = open_recording(path)
        assert (recording.rig.names, tuple(recording.by_name)) == (("left",), ("left", "right"))
        assert tuple(recording.videos) == ("left", "right")
        assert recording.usable().rig.names == ("left",)
        assert "camera right is left out: it has no place in the world" in caplog.text

    def test_no_camera_has_a_place(self, folder):
        path = write(folder, camera("left", 'video = "left.avi"', f"K = {K}"))
        recording = open_recording(path)
        assert (len(recording.rig), recording.num_frames, recording.fps) == (0, 6, 25.0)
        with pytest.raises(
            InputError, match=r"lens and place are known, found none for left; .* calibrate rig"
        ):
            recording.usable()


class TestReference:
    time_s = np.arange(0, 2, 0.01)

    def path_m(self, time_s):
        return np.stack([np.sin(time_s), np.cos(time_s), 1 + time_s], axis=-1)

    def reference(self, name):
        position_m = self.path_m(self.time_s)[:, None]
        return Trajectories(np.arange(len(self.time_s)), self.time_s, (name,), position_m)

    def truth(self, folder, file, *lines):
        table = "\n".join(["[reference]", f'files = ["{file}"]', *lines])
        recording = open_recording(write(folder, LEFT, RIGHT, table))
        assert recording.truth.num_frames == recording.num_frames == 6
        return recording.truth

    @pytest.mark.parametrize("later_s", [0.0, 0.017])
    @pytest.mark.parametrize("file", ["drone.tum", "tracks.csv"])
    def test_the_reference_is_sampled_at_the_instants(self, folder, file, later_s):
        if file == "drone.tum":
            write_tum(folder, self.reference("drone"))
        else:
            write_trajectories(folder / file, self.reference("drone"))
        truth = self.truth(folder, file, f"time_offset_s = {-later_s}")
        assert truth.drones == ("drone",)
        np.testing.assert_allclose(
            truth.position_m[:, 0], self.path_m(np.arange(6) / 25 + later_s), rtol=0, atol=1e-7
        )

    @pytest.mark.parametrize(("file", "rate_hz"), [("dron1_pos_100.csv", 100), ("dron1.csv", 25)])
    def test_pose_files_have_the_rate_of_their_name_or_of_the_recording(self, folder, file, rate_hz):
        time_s = np.arange(30) / rate_hz
        orientation_wxyz = np.tile([1.0, 0, 0, 0], (30, 1))
        write_poses(folder / file, self.path_m(time_s), orientation_wxyz)
        truth = self.truth(folder, file)
        assert truth.drones == ("dron1",)
        # Row 0 of a pose file is a placeholder.
        np.testing.assert_allclose(
            truth.position_m[1:, 0], self.path_m(np.arange(1, 6) / 25), rtol=0, atol=1e-6
        )
        assert truth.orientation_wxyz[1:, 0].tolist() == [[1, 0, 0, 0]] * 5

    def test_two_files_of_one_drone(self, folder):
        write_tum(folder, self.reference("drone"))
        write_trajectories(folder / "tracks.csv", self.reference("drone"))
        table = '[reference]\nfiles = ["drone.tum", "tracks.csv"]\n'
        assert_fails(write(folder, LEFT, table), "tracks.csv", "one file per drone", "drone.tum")

    def test_a_reference_at_another_time_is_a_warning(self, folder, caplog):
        write_tum(folder, self.reference("drone"))
        assert not self.truth(folder, "drone.tum", "time_offset_s = 100.0").seen.any()
        assert "it lasts from 100.000 to 101.990 s on the recording's clock" in caplog.text


class TestFaults:
    @pytest.mark.parametrize(
        ("lines", "words"),
        [
            ("fsp = 25", ("cameras.left.fsp", "did you mean fps?")),
            ("fps = -25", ("cameras.left.fps", "a number above 0", "found -25")),
            ("fps = 0", ("cameras.left.fps", "a number above 0")),
            ("fps = nan", ("cameras.left.fps", "a finite number")),
            ("fps = 1e9", ("cameras.left.fps", "0.001 to 20000 frames per second", "found 1e+09")),
            ("fps = 1e-9", ("cameras.left.fps", "0.001 to 20000 frames per second", "found 1e-09")),
            ("size = [64]", ("cameras.left.size", "a list of length 2")),
            ("size = [64, 0]", ("cameras.left.size[1]", "at least 1")),
            ("size = [128, 96]", ("cameras.left.size", "64 x 48 pixels as in the video", "128 x 96")),
            ('images = "left/*.png"', ("cameras.left", "video or images", "both")),
            ('timestamps = "t.csv"\nfps = 25', ("cameras.left", "timestamps or fps", "both")),
            ('timestamps = "t.csv"\ntime_offset_s = 1.0', ("timestamps or time_offset_s", "both")),
            ('timestamps = "nothing.csv"', ("cameras.left.timestamps", "a file that exists", "nothing.csv")),
            ('ignore = "nothing.png"', ("cameras.left.ignore", "a file that exists")),
            ('detections = "nothing.csv"', ("cameras.left.detections", "a file that exists")),
            ('model = "fish"', ("cameras.left.model", "one of fisheye, opencv", "did you mean fisheye?")),
            ("distortion = [0.1, 0.2, 0.3]", ("cameras.left.distortion", "coefficients", "found 3")),
            ("rvec = [0, 0, 0]", ("cameras.left.K", "3 x 3 numbers")),
            ("K = [[1, 0, 0], [0, 1]]", ("cameras.left.K", "a list of length 3")),
            ("K = [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]", ("cameras.left.K", "fx and fy above 0")),
        ],
    )
    def test_a_wrong_key_of_a_camera(self, folder, lines, words):
        (folder / "t.csv").write_text("frame,time_s\n0,0\n")
        place = (
            ""
            if "rvec" in lines
            else PLACE.replace(f"K = {K}\n", "" if lines.startswith("K") else f"K = {K}\n")
        )
        path = write(folder, camera("left", 'video = "left.avi"', lines, place))
        assert_fails(path, "recording.toml", *words)

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("version = 2\n" + LEFT, ("version", "1", "2")),
            (LEFT, ("version", "none")),
            ("version = 1\n", ("cameras", "[cameras.NAME]", "none")),
            ("version = 1\ncameras = 3\n", ("cameras", "[cameras.NAME]")),
            ("version = 1\nfps = 25\n" + LEFT, ("fps", "below [cameras.NAME]")),
            ("version = 1\ncalibraton = 'a'\n" + LEFT, ("calibraton", "did you mean calibration?")),
            ('version = 1\ncalibration = "no.toml"\n' + LEFT, ("calibration", "a file that exists", "no.toml")),
            ("version = 1\n" + LEFT + LEFT, ("valid TOML",)),
            ("version = 1\n" + LEFT + LEFT.replace("left]", "Left]"), ("cameras.Left", "each camera once", "left")),
            ("version = 1\n" + LEFT + LEFT.replace("left]", '"a/b"]'), ("cameras", "names of files", "a/b")),
            ("version = 1\n" + LEFT + "[world]\nbounds_m = [[0, 0, 0], [1, 0, 1]]", ("world.bounds_m", "lowest")),
            ("version = 1\n" + LEFT + "[reference]\nfile = 'a.tum'", ("reference.file", "did you mean files?")),
            ("version = 1\n" + LEFT + "[reference]\nfiles = ['a.tum']", ("reference.files", "a file that exists")),
            ("version = 1\n" + LEFT + "[markers]\n", ("markers.corners", "a value", "none")),
            ("version = 1\n[cameras.left]\nsize = [64, 48]\n", ("cameras.left.fps", "no video")),
            ("version = 1\n[cameras.left]\nfps = 25\n" + PLACE, ("cameras.left.size", "no video")),
            ("version = 1\n[cameras.left]\nimages = 'x/*.png'\n", ("cameras.left.fps", "timestamps")),
            ("version = 1\n[cameras.left]\nimages = 'x/*.png'\nfps = 5", ("cameras.left.images", "x/*.png")),
            ("version = 1\n[cameras.left]\nvideo = 'left.zip'\n", ("cameras.left.video", "unpack it first")),
            ("version = 1\n[cameras.left]\nvideo = 'no.avi'\n", ("cameras.left.video", "a file that exists")),
            ("version = 1\n[cameras.left]\nvideo = ''\n", ("cameras.left.video",)),
        ],
    )  # fmt: skip
    def test_a_wrong_file(self, folder, text, words):
        (folder / "left.zip").write_bytes(b"PK")
        path = folder / "recording.toml"
        path.write_text(text)
        assert_fails(path, "recording.toml", *words)

    @pytest.mark.parametrize(
        ("rows", "words"),
        [
            (
                "0,0\n1,0.04\n2,0.03\n3,0.12\n4,0.16\n5,0.2\n",
                ("times that increase", "found 0.03 s for frame 2 after 0.04 s"),
            ),
            ("0,0\n1,0.04\n", ("times of the 6 frames of the video", "found 2")),
            ("0,0\n2,0.08\n", ("line 3, column frame", "frame 1: every frame once", "found 2")),
            ("0,0\n1,zero\n", ("line 3, column time_s", "a number")),
            (
                "".join(f"{frame},{40 * frame}\n" for frame in range(6)),
                (
                    "times in seconds, of about 25 frames per second as in left.avi",
                    "0.025",
                    "divide the times by 1000",
                ),
            ),
            (
                "".join(f"{frame},{4e7 * frame}\n" for frame in range(6)),
                ("2.5e-08", "are the times in seconds?"),
            ),
        ],
    )
    def test_wrong_timestamps(self, folder, rows, words):
        (folder / "times.csv").write_text("frame,time_s\n" + rows)
        path = write(folder, camera("left", 'video = "left.avi"', 'timestamps = "times.csv"', PLACE))
        assert_fails(path, "times.csv", *words)

    def test_times_since_1970_are_refused_before_memory_is_used_up(self, folder):
        since = "time_offset_s = 1700000000.{}"
        path = write(
            folder,
            camera("left", 'video = "left.avi"', since.format(25), PLACE),
            camera("right", 'video = "right.avi"', since.format(5), PLACE),
        )
        with pytest.raises(InputError) as error:
            open_recording(path).timeline()
        assert re.search(
            r"frame times: expected at most 10000000 instants from time 0 on, found 4.3e\+10: 25 Hz until "
            r"1700000000\.70 s, when camera right ends; .* subtract 1700000000.25 s, the time of the first frame of "
            r"camera left",
            str(error.value),
        )
        with pytest.raises(InputError, match=r"1e\+09 Hz until 0.20 s, .*; check the rates and times"):
            open_recording(write(folder, LEFT, RIGHT)).timeline(1e9)

    @pytest.mark.parametrize(("first", "used"), [(0, 6), (2, 4), (5, 1)])
    def test_detections_beyond_the_end_of_the_video_are_a_warning(self, folder, caplog, first, used):
        boxes = Detections(np.arange(first, first + 6), np.tile([1.0, 2, 3, 4], (6, 1)), np.ones(6))
        write_detections(folder / "left.csv", boxes)
        path = write(folder, LEFT.replace("\nK =", '\ndetections = "left.csv"\nK ='), RIGHT)
        recording = open_recording(path)
        recording.check_detections(recording.detections)
        words = f"left.csv: {6 - used} of 6 detections are not used, because camera left (left.avi) ends with frame 5"
        assert (words in caplog.text) == (used < 6)

    def test_detections_that_all_lie_beyond_the_end_of_the_video(self, folder):
        write_detections(
            folder / "left.csv", Detections(np.array([6]), np.array([[1.0, 2, 3, 4]]), np.ones(1))
        )
        path = write(folder, LEFT.replace("\nK =", '\ndetections = "left.csv"\nK ='), RIGHT)
        for command in (["init", "--show"], ["doctor"]):
            done = CliRunner().invoke(cli, [*command, str(path)])
            assert isinstance(done.exception, InputError)
            assert re.search(
                r"left.csv: expected detections in the frames 0 to 5 of camera left \(left.avi\), "
                r"found none before frame 6; are they detections in another video\?$",
                str(done.exception),
            )

    def test_a_video_of_two_cameras(self, folder):
        path = write(folder, LEFT, RIGHT.replace("right.avi", "./left.avi"))
        assert_fails(path, "cameras.right", "a video of its own", "that of left, left.avi")

    def test_rows_that_take_longer_than_a_frame(self, folder):
        path = write(folder, camera("left", 'video = "left.avi"', "line_time_s = 0.001", PLACE))
        assert_fails(
            path, "cameras.left.line_time_s", "at most 0.00083 s, a frame's time for 48 rows", "0.001"
        )

    def test_a_camera_that_films_alone_is_a_warning(self, folder, caplog):
        open_recording(
            write(folder, camera("left", 'video = "left.avi"', "time_offset_s = 9.0", PLACE), RIGHT)
        )
        assert "cameras.left: no other camera films while it does, from 9.000 to 9.200 s" in caplog.text

    def test_an_ignored_part_of_another_size(self, folder):
        cv2.imwrite(str(folder / "ignore.png"), np.zeros((10, 10), np.uint8))
        path = write(folder, camera("left", 'video = "left.avi"', 'ignore = "ignore.png"', PLACE))
        assert_fails(path, "ignore.png", "64 x 48 pixels as camera left", "10 x 10")

    def test_streams_wait_for_live_tracking(self, folder):
        path = write(folder, camera("left", 'video = "rtsp://left/1"', PLACE, "size = [64, 48]"), RIGHT)
        recording = open_recording(path)
        assert [each.stream for each in recording.cameras] == ["rtsp://left/1", None]
        with pytest.raises(
            InputError, match="camera left: expected a video file, found the stream rtsp://left/1"
        ):
            recording.usable()
        assert recording.usable(["right"]).rig.names == ("right",)
        path = write(folder, camera("left", "video = 0"), RIGHT)
        assert open_recording(path).cameras[0].stream == "device 0"
        path = write(folder, camera("left", 'video = "/dev/v4l/by-id/left"'), RIGHT)
        assert open_recording(path).cameras[0].stream == "device /dev/v4l/by-id/left"

    @pytest.mark.parametrize(
        ("video", "words"),
        [
            (
                '"rtps://left/1"',
                "a file, the number of a device, or an address that begins with rtsp://, rtsps://",
            ),
            ('"rtsp://"', "expected an address with a host, and a port below 65536 if any, found rtsp://"),
            ('"rtsp:///stream"', "expected an address with a host"),
            ('"http://left:99999/"', "expected an address with a host, and a port below 65536"),
            ('"http://left:eight/"', "expected an address with a host, and a port below 65536"),
            ('"gstreamer://"', "expected an address with a host"),
            ("-1", "expected the number of a device, from 0, found -1"),
        ],
    )
    def test_addresses_that_are_none(self, folder, video, words):
        assert_fails(
            write(folder, camera("left", f"video = {video}", PLACE), RIGHT), "cameras.left.video", words
        )

    @pytest.mark.parametrize(
        "video", ["udp://@:1234", "udp://239.0.0.1:1234", "gstreamer://videotestsrc ! appsink"]
    )
    def test_addresses_without_the_name_of_a_host(self, folder, video):
        path = write(folder, camera("left", f'video = "{video}"', PLACE, "size = [64, 48]"), RIGHT)
        assert open_recording(path).cameras[0].stream == video

    def test_what_is_no_recording(self, folder, tmp_path):
        (tmp_path / "S01.zip").write_bytes(b"PK")
        assert_fails(tmp_path / "S01.zip", "S01.zip", "found an archive; unpack it first")
        assert_fails(tmp_path / "nowhere", "nowhere", "found nothing")
        assert_fails(folder / "left.avi", "left.avi", "found another file")
        assert_fails(folder, "neither recording.toml nor cameras_calibration.csv", "psotrack init")
        write(folder, LEFT)
        assert_fails(tmp_path, f"did you mean {folder}?")
