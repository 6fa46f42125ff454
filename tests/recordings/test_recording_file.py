"""`recording.toml`, of which every key is read, and what the room refuses.

One line says what was expected, what was found and where, and no file appears or changes. Motion capture has tables of
its own. Damaged files are a matter of the fuzzer; the words of numbers, tables and TOML that all rooms share are tested
in `tests/support` and `tests/geometry`.
"""

import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from archives_made import OLD
from dpjait_folders import PLAIN_K, UPRIGHT, edit, full_hd_recording, write_tum, write_video
from helpers import assert_refused, cameras_of, ring_rig
from worlds import make_tracks

from psotrack.geometry import make_camera, make_rig, project
from psotrack.geometry.rig_files import write_calibration, write_rig
from psotrack.recordings import (
    Detections,
    FrameTimes,
    Recording,
    VideoWriter,
    make_timeline,
    open_video,
    probe,
    read_detections,
    read_frames,
    read_near,
    write_detections,
)
from psotrack.recordings.datasets import (
    CALIBRATION,
    MARKER_CORNERS,
    ONBOARD_CALIBRATION,
    find_marker_corners,
    open_recording,
    read_marker_corners,
    read_onboard,
    read_sequence,
    write_marker_corners,
    write_onboard_calibration,
    write_poses,
)
from psotrack.recordings.exchange import Footage, export_tracks, read_tracks
from psotrack.trajectories import Trajectories, write_trajectories

K = "[[1160.2, 0.5, 31.0], [0, 1160.9, 25.2], [0, 0, 1]]"
RVEC, TVEC = (1.2, -0.4, 0.3), (0.1, 0.2, 5.0)
PLACE = f"K = {K}\nrvec = {list(RVEC)}\ntvec = {list(TVEC)}\n"


@pytest.fixture
def folder(sound):
    """A folder with videos, for a test's own `recording.toml`."""
    return sound / "any"


def write_recording(folder, *tables, top=""):
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


def test_the_keys_of_a_camera(folder):
    cv2.imwrite(str(folder / "ignore.png"), np.zeros((48, 64), np.uint8))
    write_boxes(folder / "left.csv", [3])
    (folder / "corners.csv").write_text("")
    path = write_recording(
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
    path = write_recording(folder, LEFT, RIGHT)
    assert open_recording(folder).rig.names == open_recording(str(path)).rig.names == ("left", "right")
    other = path.rename(folder / "morning.toml")
    assert open_recording(other).name == "morning"
    rig = open_recording(other).rig
    rig.cameras.K[:, 1, 1], rig.cameras.K[:, 0, 1] = 1160.2, 0.0
    write_calibration(folder / "cameras_calibration.csv", rig)
    assert open_recording(folder).name == "any"
    np.testing.assert_array_equal(open_recording(folder).rig.cameras.K, rig.cameras.K)


TIMED = camera("left", 'video = "left.avi"', 'timestamps = "times.csv"', PLACE)


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory):
    """What a killed process leaves: a copy of the file of a writer that still writes; frames get brighter."""
    folder = tmp_path_factory.mktemp("killed")
    writer = cv2.VideoWriter(str(folder / "open.avi"), cv2.VideoWriter.fourcc(*"XVID"), 25, (640, 480))
    rng = np.random.default_rng(0)
    for level in range(60):
        writer.write(rng.integers(0, 2 * level + 2, (480, 640, 3), dtype=np.uint8))
    shutil.copy(folder / "open.avi", folder / "left.avi")
    writer.release()
    return folder / "left.avi"


@pytest.mark.parametrize("num_times", [30, 100])
def test_video_and_times_of_a_program_that_was_killed(folder, unfinished, num_times, caplog):
    """Both are used as far as there are both, but for the last frame, which may be incomplete."""
    shutil.copy(unfinished, folder)
    # Not quite regular.
    times = [index / 25 + 0.001 * (index % 2) for index in range(num_times)]
    rows = "".join(f"{i},{t}\n" for i, t in enumerate(times))
    (folder / "times.csv").write_text(f"frame,time_s\n{rows}")
    left = open_recording(write_recording(folder, TIMED, RIGHT)).by_name["left"]
    whole = probe(folder / "left.avi")
    # FFmpeg holds back the last 32 KiB, a few frames of this noise.
    assert 40 < whole.num_frames < 60
    assert not whole.is_finished
    # It has no index, so no frame is reached by seeking.
    assert list(read_near(whole, [20, 40])) == []
    used = min(num_times, whole.num_frames)
    assert left.times.time_s.tolist() == times[:used]
    assert f"the video was not finished; its first {used} frames are used" in caplog.text
    means = [frame.mean() for frame in read_frames(left.video)]
    # The codec changes the mean of a frame by less than 4 of 255 (measured).
    assert means == pytest.approx(np.arange(used) + 0.5, abs=4)


# --- calibration


@pytest.mark.parametrize("name", ["rig.toml", "rig.yml"])
def test_a_rig_file_and_own_keys_that_override_it(folder, name):
    given = open_recording(write_recording(folder, LEFT, RIGHT)).rig
    write_rig(folder / name, given)
    own = camera("right", 'video = "right.avi"', "tvec = [1, 2, 3]")
    path = write_recording(folder, camera("LEFT", 'video = "left.avi"'), own, top=f'calibration = "{name}"')
    rig = open_recording(path).rig
    assert rig.names == ("LEFT", "right")
    np.testing.assert_array_equal(rig.cameras.K, given.cameras.K)
    np.testing.assert_array_equal(rig.cameras.T_cam_world[:, :3, 3], [TVEC, [1, 2, 3]])
    turns = rig.cameras.T_cam_world[:, :3, :3]
    np.testing.assert_allclose(turns, given.cameras.T_cam_world[:, :3, :3])


def test_a_camera_without_a_name_in_the_rig_file_is_named(folder, caplog):
    write_rig(folder / "rig.toml", ring_rig(2, image_size_wh=(64, 48)))
    videos = (camera("c0", 'video = "left.avi"'), camera("K2", 'video = "right.avi"'))
    assert open_recording(write_recording(folder, *videos, top='calibration = "rig.toml"')).rig.names == (
        "c0",
    )
    assert "no place of camera K2 in rig.toml, whose c1 is of no camera of the recording; " in caplog.text


def test_cameras_without_place_are_left_out(folder, caplog):
    recording = open_recording(write_recording(folder, LEFT, camera("right", 'video = "right.avi"')))
    assert recording.rig.names == ("left",)
    assert tuple(recording.by_name) == tuple(recording.videos) == ("left", "right")
    assert recording.usable().rig.names == ("left",)
    assert "camera right is left out: it has no place in the world" in caplog.text
    recording = open_recording(write_recording(folder, camera("left", 'video = "left.avi"', f"K = {K}")))
    assert len(recording.rig) == 0
    assert recording.num_frames == 6


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
    recording = open_recording(write_recording(folder, LEFT, RIGHT, table))
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
    position_m = path_m(np.arange(30) / rate_hz)
    level = np.tile([1.0, 0, 0, 0], (30, 1))
    write_poses(folder / file, position_m, level)
    truth = truth_of(folder, file)
    assert truth.drones == ("dron1",)
    # Row 0 of a pose file is a placeholder.
    expected_m = path_m(np.arange(6) / 25)
    np.testing.assert_allclose(truth.position_m[1:, 0], expected_m[1:], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(truth.orientation_wxyz[1:, 0], level[:5])


# --- warnings


def test_what_does_not_meet_in_time_is_a_warning(folder, caplog):
    write_reference(folder / "drone.tum")
    assert not truth_of(folder, "drone.tum", "time_offset_s = 100.0").seen.any()
    assert "it lasts from 100.000 to 101.990 s on the recording's clock" in caplog.text
    open_recording(
        write_recording(folder, camera("left", 'video = "left.avi"', "time_offset_s = 9.0", PLACE), RIGHT)
    )
    assert "cameras.left: no other camera films while it does, from 9.000 to 9.200 s" in caplog.text


WITH_BOXES = camera("left", 'video = "left.avi"', 'detections = "left.csv"', PLACE)


@pytest.mark.parametrize(("first", "used"), [(0, 6), (2, 4), (5, 1)])
def test_detections_beyond_the_end_of_the_video_are_a_warning(folder, caplog, first, used):
    write_boxes(folder / "left.csv", range(first, first + 6))
    recording = open_recording(write_recording(folder, WITH_BOXES, RIGHT))
    recording.check_detections(recording.detections)
    words = (
        f"left.csv: {6 - used} of 6 detections are not used, because camera left (left.avi) ends with frame 5"
    )
    assert (words in caplog.text) == (used < 6)


def test_detections_that_all_lie_beyond_the_end_of_the_video(run_psotrack, folder):
    write_boxes(folder / "left.csv", [6])
    path = write_recording(folder, WITH_BOXES, RIGHT)
    words = (
        "left.csv: expected detections in the frames 0 to 5 of camera left (left.avi), found none before frame 6; ",
        "are they detections in another video?",
    )
    assert_refused(lambda: run_psotrack("doctor", path), *words, unchanged=folder)


# --- streams


@pytest.mark.parametrize(
    ("video", "stream"),
    [
        ("rtsp://left/1", "rtsp://left/1"),
        (0, "device 0"),
        # An address without the name of a host.
        ("gstreamer://videotestsrc ! appsink", "gstreamer://videotestsrc ! appsink"),
    ],
)
def test_streams_wait_for_live_tracking(folder, video, stream):
    recording = open_recording(write_recording(folder, camera("left", f"video = {video!r}"), RIGHT))
    assert [each.stream for each in recording.cameras] == [stream, None]
    assert recording.usable(["right"]).rig.names == ("right",)


# --- what is refused


def nothing(folder):
    return None


def write(file, text):
    """Function that writes a file of a folder."""

    def change(folder):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(text, encoding="utf-8")

    return change


def remove(pattern):
    def change(folder):
        for path in folder.glob(pattern):
            path.unlink()

    return change


def copy(source, target):
    return lambda folder: shutil.copy(folder / source, folder / target)


# --- folders of the dataset

S, R, ANY = "S99_D9", "R99_D9", "any"
CAMERAS, POSES, INTRINSICS = f"{S}/{CALIBRATION}", f"{S}/dron1_pos_25.csv", f"{S}/{ONBOARD_CALIBRATION}"


def five_coefficients(folder):
    """Five coefficients in the calibration of the first camera, where the layout has four."""
    header, row, *_ = (folder / CAMERAS).read_text().splitlines()
    coefficients = ";".join(f"coeff_{number}" for number in range(1, 6))
    (folder / CAMERAS).write_text(f"{header};{coefficients}\n{row};0.1;0;0;0;0\n")


#: Name of the case -> what happens to the simulated sequence, words of the line; the first ones say where.
SEQUENCES = {
    "no videos": (remove(f"{S}/*.avi"), "S99_D9: expected videos named like the cameras, cam1i.avi ...", "no .avi"),
    "two videos": (copy(f"{S}/cam1i_s.avi", f"{S}/cam1i.avi"),
                   "cam1i_s.avi: expected one such file per camera, found cam1i.avi as well"),
    "a video of another size": (lambda folder: write_video(folder / S / "cam1i_s.avi", size_wh=(96, 64)),
                                "cam1i_s.avi: expected images", "principal point (32, 24), found 96 x 64 pixels"),
    "feet": (edit(CAMERAS, "cam_x[m]", "cam_x[ft]"),
             ": expected a column cam_x[m] or cam_x[cm] or cam_x[mm], found cam_x[ft]"),
    "a column twice": (edit(CAMERAS, "cam_y[m]", "cam_x[m]"), ", line 1: expected each column once, found cam_x again"),
    "five coefficients": (five_coefficients, "4 distortion coefficients, found 5"),
    "a camera twice": (edit(CAMERAS, "cam2i;2", "cam1i_s;2"),
                       ", line 3, column cam_name: expected each camera once, found cam1i_s again"),
    "focal length 0": (edit(CAMERAS, "1158.3", "0"), "line 3, column focal_length: expected a focal length above 0 "),
    "a frame twice": (edit(POSES, "\n2;0.2", "\n1;0.2"),
                      "line 4, column id: expected each frame once, found 1 again, after line 3"),
    "a long quaternion": (edit(POSES, "0;0;0;1\n2", "0;0;0;7\n2"),
                          "line 3, column q_w: expected a quaternion of length 1, found length 7"),
    "a drone twice": (copy(POSES, f"{S}/drone1_pos_25.csv"),
                      "drone1_pos_25.csv: expected one file per drone, found dron1 in ", "dron1_pos_25.csv as well"),
}  # fmt: skip


def corners(old, new):
    """Function that writes a wrong table of marker corners."""

    def change(folder):
        write_marker_corners(folder / MARKER_CORNERS, {5: np.zeros((4, 3)), 7: np.full((4, 3), 0.5)})
        edit(MARKER_CORNERS, old, new)(folder)

    return change


# --- recording.toml

VIDEO = "cameras.left.video"
#: Lines of the camera left -> words of the line.
KEYS = {
    "fsp = 25": ("cameras.left.fsp", "did you mean fps?"),
    "fps = 1e9": ("cameras.left.fps", "0.001 to 20000 frames per second", "found 1e+09"),
    "size = [128, 96]": ("cameras.left.size", "64 x 48 pixels as in the video", "128 x 96"),
    "frames = 5": ("cameras.left", "expected video or frames, found both"),
    'ignore = "ignore.png"': ("ignore.png", "64 x 48 pixels as camera left", "10 x 10"),
    "line_time_s = 0.001": ("cameras.left.line_time_s", "at most 0.00083 s, a frame's time for 48 rows", "0.001"),
    'video = "rtps://left/1"': ("a file, the number of a device, or an address that begins with rtsp://, rtsps://",),
    'video = "rtsp:///stream"': (VIDEO, "an address with a host, and a port below 65536", "found rtsp:///stream"),
    'video = "pictures"': ("cameras.left.fps", "expected frames per second of the pictures, or timestamps"),
}  # fmt: skip
#: Text of the file after its version -> words of the line.
FILES = {
    "": ("cameras", "[cameras.NAME]", "none"),
    f"fps = 25\n{LEFT}": ("fps", "below [cameras.NAME]"),
    f'calibration = "no.toml"\n{LEFT}': ("calibration", "a file that exists", "no.toml"),
    f"calibration_unit = 'm'\n{LEFT}": ("calibration", "because there is a calibration_unit"),
    f"{LEFT}{LEFT.replace('left]', 'Left]')}": ("cameras.Left", "each camera once", "left"),
    f"{LEFT}{LEFT.replace('left]', 'a/b]')}".replace("a/b", '"a/b"'): ("cameras", "names of files", "a/b"),
    f"{LEFT}{RIGHT.replace('right.avi', './left.avi')}": ("cameras.right", "a video of its own", "that of left"),
    f"{LEFT}[world]\nbounds_m = [[0, 0, 0], [1, 0, 1]]": ("world.bounds_m", "lowest"),
    f"{LEFT}[reference]\nfiles = ['left.avi']": ("left.avi: expected a file that ends in .csv",),
    f"{LEFT}[reference]\nfiles = ['drone.tum', 'tracks.csv']": ("tracks.csv", "one file per drone", "drone.tum"),
    "[cameras.left]\nsize = [64, 48]\n": ("cameras.left.fps", "no video"),
    f"[cameras.left]\nfps = 25\n{PLACE}": ("cameras.left.size", "no video"),
    "[cameras.left]\nimages = 'x/*.png'\nfps = 5": ("cameras.left.images", "x/*.png"),
}  # fmt: skip
#: Times of the six frames, or rows of the file -> words of the line.
TIMES = {
    (0, 0.04, 0.03, 0.12, 0.16, 0.2): ("times that increase", "found 0.03 s for frame 2 after 0.04 s"),
    (0, 0.04): ("times of the 6 frames of the video", "found 2"),
    (0, "0.04\n3,0.08"): ("line 4, column frame", "frame 2: every frame once", "found 3"),
    (0, 40, 80, 120, 160, 200): ("times in seconds, of about 25 frames per second as in left.avi", "0.025",
                                 "divide the times by 1000"),
}  # fmt: skip


def toml(text):
    return write(f"{ANY}/recording.toml", f"version = 1\n{text}")


def with_line(line):
    """A `recording.toml` with a line of the camera left, instead of the lines that would stand in its way."""
    key = line.partition(" ")[0]
    kept = [each for each in LEFT.splitlines()[1:] if each.partition(" ")[0] != key]
    return toml("\n".join(["[cameras.left]", line, *kept, ""]))


def with_times(times):
    def change(folder):
        rows = "".join(f"{index},{time}\n" for index, time in enumerate(times))
        write(f"{ANY}/times.csv", f"frame,time_s\n{rows}")(folder)
        with_line('timestamps = "times.csv"')(folder)

    return change


def another_size(folder):
    toml('calibration = "rig.toml"\n[cameras.c0]\nvideo = "left.avi"\n')(folder)
    write_rig(folder / ANY / "rig.toml", ring_rig(1, image_size_wh=(128, 80)))


def other_names(folder):
    toml("calibration = 'rig.toml'\n[cameras.K1]\nvideo = 'left.avi'\n[cameras.K2]\nvideo = 'right.avi'\n")(
        folder
    )
    write_rig(folder / ANY / "rig.toml", ring_rig(2, image_size_wh=(64, 48)))


#: A recording whose clock counts from 1970, with cameras that begin one after the other.
SINCE_1970 = LEFT.replace("K =", "time_offset_s = 1700000000.25\nK =")
SINCE_1970 += RIGHT.replace("K =", "time_offset_s = 1700000000.5\nK =")


def opened(name=ANY):
    return lambda folder: open_recording(folder / name)


def usable(folder):
    return open_recording(folder / ANY).usable()


#: What is no recording -> what happens to the folder, what is opened, words of the line.
NO_RECORDINGS = {
    "a zip file": (nothing, opened("any/left.zip"), "left.zip", "found an archive; unpack it first"),
    "an archive": (nothing, lambda _: open_recording(OLD), "`psotrack archive ", "version_1.psotrack --out FOLDER`"),
    "a folder": (nothing, opened(), "neither recording.toml nor cameras_calibration.csv", "psotrack init"),
    "the folder above": (write("flights/late/recording.toml", ""), opened("flights"), "did you mean ", "flights/late?"),
    "no place": (toml(f"[cameras.left]\nvideo = 'left.avi'\nK = {K}"), usable,
                 "lens and place are known, found none for left; ", " calibrate rig"),
    "names of another rig": (other_names, opened(), "calibration: expected a camera of the recording, K1, K2, in rig.t",
                             "found only c0, c1; `psotrack init --force --match CAMERA=FILE` maps them"),
    "a stream": (toml(f"{LEFT.replace('left.avi', 'rtsp://left/1')}size = [64, 48]\n"), usable,
                 "camera left: expected a video file, found the stream rtsp://left/1"),
    "another shape": (another_size, usable, "128 x 80 pixels as calibrated, found 64 x 48 pixels", "--size 64,48"),
    # Refused before memory is used up.
    "times since 1970": (toml(SINCE_1970), lambda folder: open_recording(folder / ANY).timeline(),
        "frame times: expected at most 10000000 instants from time 0 on, found 4.3e+10: 25 Hz until 1700000000.70 s, ",
        "when camera right ends; ", " subtract 1700000000.25 s, the time of the first frame of camera left"),
}  # fmt: skip

# --- detections, videos and pictures

LINE = "4,10,20,30,40,25,40,0.9"
#: Second line of a file of detections -> words of the line.
DETECTIONS = {
    "5,1,2,3,4,5,6": ("line 2: expected a frame number and 7 values per detection ", ", found 6 values"),
    "5,1,2,-3,4,5,6,0.5": ("line 2, column 4: expected a size w of 0 or more pixels, found -3",),
    "5,1,2,3,4,5,6,1.5": ("line 2, column 8: expected a confidence from 0 to 1, found 1.5",),
    LINE: ("line 2, column 1: expected each frame once, found frame 4 again",),
}
WIDTH, HEIGHT = 64, 48


def without_frames(folder):
    cv2.VideoWriter(str(folder / "a.avi"), cv2.VideoWriter.fourcc(*"XVID"), 25, (WIDTH, HEIGHT)).release()


#: Name of the case -> what makes the file a.avi, words of the line.
VIDEOS = {
    "nothing": (nothing, "no such file"),
    "an empty file": (write("a.avi", ""), "an empty file"),
    "no frames": (without_frames, "no frames"),
}


def writes(name, fps=25.0, size_wh=(WIDTH, HEIGHT), frames=()):
    """A function that writes a video of a name into a folder."""

    def call(folder):
        with VideoWriter(folder / name, fps, size_wh) as writer:
            for frame in frames:
                writer.write(frame)

    return call


LAST = "any/pictures/frame11.png"


def frames_of(path, fps=None):
    return lambda folder: list(read_frames(open_video(folder / path, fps)))


#: Name of the case -> what happens to the folder, what is called, words of the line.
PICTURES = {
    "an ending": (nothing, writes("a.mkv"), "video: expected"),
    "an odd width": (nothing, writes("a.avi", size_wh=(WIDTH + 1, HEIGHT)), "image size: expected"),
    "no frames to write": (nothing, writes("a.avi"), "expected at least one frame"),
    # OpenCV drops such a frame without an error.
    "a frame of another size": (nothing, writes("a.avi", frames=[np.zeros((HEIGHT - 1, WIDTH, 3), np.uint8)]),
                                "frame: expected shape (48, 64, 3)"),
    "pictures of no rate": (nothing, frames_of("any/pictures"), "pictures: expected the rate of its pictures, "),
    "a single picture": (nothing, frames_of(LAST), "frame11.png: expected a video, or a folder of pictures"),
    "a small picture": (lambda folder: cv2.imwrite(str(folder / LAST), np.zeros((32, 64), np.uint8)),
                        frames_of("any/pictures", 25.0),
                        "frame11.png: expected 64 x 48 pixels as in frame0.png, found 64 x 32"),
}  # fmt: skip

# --- times, and what belongs together


def listed(*time_s):
    return lambda folder: FrameTimes.listed(np.array(time_s), where="left_times.csv")


def timeline(times, rate_hz=None):
    return lambda folder: make_timeline({"a": times}, rate_hz)


def together(*cameras, **changes):
    """Cameras that do not belong together, or all of a recording, are used."""
    return lambda folder: full_hd_recording(**changes).usable(cameras or None)


SIZE = "{}.avi: expected 1920 x 1080 pixels as calibrated, found {} pixels; {}"
ANOTHER = "is it the video of another camera? If both show the same field of view, `psotrack calibrate convert` resc"
#: Name of the case -> what is called, words of the line.
FRAME_TIMES = {
    "a rate of 0": (lambda folder: FrameTimes(10, 0.0), "fps: expected a number above 0"),
    "an infinite rate": (timeline(FrameTimes(10, 25.0), np.inf), "rate: expected a number above 0"),
    "a time of NaN": (listed(0.0, np.nan, 0.1), "expected finite times, found nan s for frame 1"),
    "nothing from time 0 on": (timeline(FrameTimes(10, 25.0, -1.0)), "a camera with a frame at time 0 s or later"),
    "no video is named": (together("a", "b", b=None), "a, b, found none for b"),
    "smaller": (together(a={"image_size_wh": (1280, 720)}), SIZE.format("a", "1280 x 720", ANOTHER)),
    "other sides": (together(c={"image_size_wh": (1920, 1200)}), SIZE.format("c", "1920 x 1200", ANOTHER)),
    "no frame near an instant": (
        timeline(FrameTimes.listed(np.array([0.1, 0.1078])), 25.0),
        "near one of the instants, 25 Hz from time 0 s on, found frames from 0.1 to 0.1078 s; choose another rate",
    ),
}  # fmt: skip
# --- tracks in the formats of other programs

INSTANTS = Recording("any", Path("any"), cameras_of(ring_rig(1), times={"c0": FrameTimes(50, 50.0)}))
#: Name of the case -> name of the file, its text, words of the line.
TRACKS = {
    "a file of boxes alone": ("boxes.txt", "1,1,10,10,5,5,1,-1,-1,-1\n", "positions in MOT15's 3D columns"),
    "MOT counts from 1": ("mot.txt", "0,1,-1,-1,-1,-1,1,1,2,3\n", "whole frame numbers from 1"),
    "KITTI of another length": ("k.txt", "1 0 0 1 0 1 0 2 0 0 1 3\n" * 3, "50 poses, one for each instant"),
    "no rotation": ("k.txt", "1 0 0 1 0 2 0 2 0 0 1 3\n", "a rotation matrix"),
    "an unknown ending": ("tracks.xyz", "1 2 3\n", "tracks as .csv, .parquet"),
    "a newer version": ("a.json", '{"format": "psotrack tracks", "version": 2}', "expected version 1, found 2"),
    "another clock": ("late.tum", "1.7e9 1 2 3 0 0 0 1\n", "times on the recording's clock, 0 to 0.98 s"),
}  # fmt: skip


def tracks(name, recording=INSTANTS):
    return lambda folder: read_tracks(folder / name, recording=recording)


def exported(to, name, change=nothing):
    """Function that writes tracks in a format into a folder, and changes what it wrote."""

    def make(folder):
        export_tracks(make_tracks(), to, folder / name)
        change(folder)

    return make


def export(to, name, footage=None, **changes):
    return lambda folder: export_tracks(
        replace(make_tracks(), **changes), to, folder / name, footage=footage, force=True
    )


CAMERA = Footage(INSTANTS)
#: Name of the case -> what happens to the folder, what is called, words of the line.
EXPORTS = {
    "a file of two": (nothing, export("tum", "a.tum"), "a folder, because a TUM file holds one drone and the tracks "),
    "a file without an ending": (nothing, export("c3d", "tracks"), "--out: expected a file that ends in .c3d"),
    "boxes of no size": (nothing, export("mot", "mot", CAMERA), "--drone-size"),
    "a folder with a note": (exported("tum", "tum", write("tum/notes.md", "mine")), export("tum", "tum"),
                             "notes.md", "name another folder"),
    "one name in ROS": (nothing, export("mcap", "a.mcap", CAMERA, drones=("a b", "a_b")), "differ as names of ROS"),
    "two times": (exported("kitti", "kitti", write("kitti/sequences/1/times.txt", "0.0\n0.1\n")), tracks("kitti"),
                  "14 times, as many as 1.txt has poses"),
    "MOT without a rate": (exported("mot", "a.txt"), tracks("a.txt", None), "name SEQ, too"),
}  # fmt: skip

# --- what the dataset's layout cannot hold

#: Words of the line -> fields of a camera.
LAYOUT = {
    "distortion by k1, k2, p1, p2 alone, found 5 coefficients": {"dist": (0.1, 0.0, 0.0, 0.0, 0.01)},
    "one focal length, found fx 1000 and fy 1001": {"K": PLAIN_K + np.diag([0, 1.0, 0])},
    "no skew, found 2.5": {"K": PLAIN_K + np.eye(3, k=1) * [0, 2.5, 0]},
    "OpenCV's pinhole model, found a fisheye": {"fisheye": True},
}


def calibration_of(fields):
    """The message names the camera that the file cannot hold, not the first one."""
    camera = make_camera(**UPRIGHT | fields)
    rig = make_rig({"a": make_camera(**UPRIGHT), "GoPro 3": camera, "z": camera})
    return lambda folder: write_calibration(folder / "a.csv", rig)


def poses(position_m, num_turns):
    turns = np.tile([1.0, 0, 0, 0], (num_turns, 1))
    return lambda folder: write_poses(folder / "a.csv", np.array(position_m), turns)


def intrinsics(cameras):
    return lambda folder: write_onboard_calibration(folder / "a.csv", cameras)


SKEW = {"dron1": (PLAIN_K + np.eye(3, k=1), (1920, 1080))}
#: Name of the case -> what happens to the folder, what is called, words of the line.
OTHERS = {
    "a focal length below 0 on board": (edit(INTRINSICS, "60.5", "-60.5"), lambda folder: read_onboard(folder / S),
                     "line 2, column focal_length_x: expected a number of pixels above 0, found -60.5"),
    "marker twice": (corners("7;", "5;"), lambda folder: read_marker_corners(folder / MARKER_CORNERS),
                     "line 3, column id: expected each marker once, found 5 again"),
    "unknown poses": (nothing, poses([[1, 1, 1], [1, np.nan, 1.0]], 2),
                      "poses: expected finite numbers, found NaN or infinity at frame 1"),
    "intrinsics with skew": (nothing, intrinsics(SKEW), "expected at least one camera, all without skew"),
    "two recordings": (copy(f"{R}/R99.c3d", f"{R}/R98.c3d"), opened(R),
                       "R99.c3d: expected one file per drone, found dron4"),
    "bodies of none": (remove(f"{R}/*.c3d"), lambda folder: read_sequence(folder / R, bodies={"cf1": ["a"]}),
                       "bodies cf1: expected one C3D file that holds their markers, found none"),
}  # fmt: skip


#: Name of the case -> what happens to the folder, what is called, words of the line.
BAD = NO_RECORDINGS | PICTURES | EXPORTS | OTHERS
for name, (change, *words) in SEQUENCES.items():
    BAD[f"sequence: {name}"] = (change, opened(S), *words)
for line, words in KEYS.items():
    BAD[line] = (with_line(line), opened(), *words)
for text, words in FILES.items():
    BAD[text] = (toml(text), opened(), *words)
for times, words in TIMES.items():
    BAD[f"times: {times}"] = (with_times(times), opened(), "times.csv", *words)
for line, words in DETECTIONS.items():
    text = f"{LINE}\n{line}\n"
    BAD[line] = (write("a.csv", text), lambda folder: read_detections(folder / "a.csv"), *words)
for name, (change, found) in VIDEOS.items():
    words = ("a.avi: expected a video", f"found {found}")
    BAD[f"video: {name}"] = (change, lambda folder: probe(folder / "a.avi"), *words)
for name, (call, *words) in FRAME_TIMES.items():
    BAD[name] = (nothing, call, *words)
for name, (file, text, *words) in TRACKS.items():
    BAD[f"tracks: {name}"] = (write(file, text), tracks(file), *words)
for words, fields in LAYOUT.items():
    BAD[words] = (nothing, calibration_of(fields), f"camera GoPro 3: expected {words}; ", "rig.toml")


@pytest.mark.parametrize("name", BAD)
def test_it_is_refused(sound, name, capfd):
    change, call, *words = BAD[name]
    change(sound)
    assert_refused(lambda: call(sound), *words, unchanged=sound)
    # Libraries write nothing either.
    assert capfd.readouterr().err == ""
