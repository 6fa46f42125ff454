"""`psotrack onboard localise`: from videos, image folders and streams of a drawn room to the path of the camera; and
wrong maps, by which every frame is lost or right while the wrong markers are named."""

import json
import os
import signal
import threading

import cv2
import numpy as np
import pytest
from camera_paths import AHEAD, distances_m, example_path, orientations
from helpers import made_once
from marker_worlds import (
    DRAWN_LENS,
    FEW_MARKERS_FRAME,
    NO_MARKERS_FRAME,
    NUM_FRAMES,
    PASSING_CAMERA,
    any_room,
    drawn_cameras,
    fly_past,
    make_drawn_flight,
    wall_markers,
    write_onboard_sequence,
)
from scipy.spatial.transform import Rotation

from psotrack.geometry import project, scale_lens
from psotrack.inside_out import (
    Flag,
    LocaliseSettings,
    MarkerMap,
    filtering,
    localise_video,
    open_source,
    read_camera_path,
    read_marker_map,
    write_camera_path,
)
from psotrack.inside_out.frames import read_ahead
from psotrack.inside_out.localising import frame_poses, localise_frames
from psotrack.recordings.datasets import write_marker_corners
from psotrack.trajectories import Status, read_trajectories, roll_pitch_yaw_deg

TRUTH_M = np.array([camera.centre_world for camera in drawn_cameras()])
#: The frames that show less than four markers, and the others.
BLIND = [FEW_MARKERS_FRAME, NO_MARKERS_FRAME]
SHOWN = np.delete(np.arange(NUM_FRAMES), BLIND)


drawn = made_once("drawn_flight", make_drawn_flight)


@pytest.fixture
def localise(run_psotrack, drawn, tmp_path):
    """Runs the command on a file of the drawn flight, or another; its path, JSON and words."""

    def call(source, *options, markers="corners.csv", lens=("--camera", "lens.toml")):
        out, report = tmp_path / "track.csv", tmp_path / "out.json"
        own_lens = drawn / lens[1] if ".toml" in str(lens[1]) else lens[1]
        room = ("--markers", drawn / markers, lens[0], own_lens)
        # A stream, or the number of a camera, is no file.
        source = source if "//" in str(source) or source == "0" else drawn / source
        done = run_psotrack(
            "onboard", "localise", source, *room, *options, "--out", out, "--json", report, "--force"
        ).ended()
        return read_camera_path(out)[0], json.loads(report.read_text()), done.out

    return call


def off_m(path, truth_m=TRUTH_M):
    return np.linalg.norm(path.position_m - truth_m[: path.num_frames], axis=-1)


def test_the_path_from_images_and_from_a_video_agrees_with_the_cameras(localise):
    path, content, said = localise("images", "--fps", 25, "--no-filter")
    np.testing.assert_array_equal(path.frame, np.arange(NUM_FRAMES))
    np.testing.assert_allclose(path.time_s, np.arange(NUM_FRAMES) / 25, rtol=1e-12)
    # Measured 2 mm and 0.03 degrees, from an error of a tenth of a pixel in each of 36 corners at 4 m.
    assert off_m(path)[SHOWN].max() < 0.006
    to_camera = Rotation.from_matrix([camera.T_cam_world[:3, :3] for camera in drawn_cameras()])
    turn = to_camera * orientations(path)
    assert np.rad2deg(turn[SHOWN].magnitude()).max() < 0.1
    assert (path.status[SHOWN] == Status.TRACKED).all()
    assert (path.num_markers[SHOWN] >= 8).all()
    assert (path.flags[SHOWN] == 0).all()
    assert path.status[BLIND].tolist() == [Status.LOST] * 2
    assert path.num_markers[BLIND].tolist() == [3, 0]
    assert path.flags[BLIND].tolist() == [Flag.FEW_MARKERS, 0]
    assert np.isnan(path.position_m[BLIND]).all()
    assert content["drone"] == "images"
    assert "12 of 14 frames" in said
    assert "frames per second (decode" in said
    video = localise("flight.avi", "--no-filter")[0]
    # The codec is lossy: a marker may be missing, and positions move by 1 mm (measured).
    np.testing.assert_allclose(video.num_markers, path.num_markers, atol=1)
    np.testing.assert_allclose(video.position_m, path.position_m, atol=0.005)


def test_the_filter_and_the_smoother_bridge_frames_without_markers(localise):
    """The first frame has a pose, because its markers agree beyond chance."""
    path, content, _ = localise("flight.avi", "--name", "dron1")
    assert path.seen.all()
    assert (path.status[BLIND] == Status.COASTING).all()
    # Measured 2 mm, because the motion is even.
    assert off_m(path).max() < 0.01
    assert path.velocity_m_s is not None
    assert content["drone"] == "dron1"
    assert content["status"]["coasting"] == 2
    assert content["frames"] == NUM_FRAMES
    assert set(content["stage_s"]) == {"decode", "grey", "detect", "locate", "filter"}
    assert content["frames_per_second"] == pytest.approx(NUM_FRAMES / content["wall_s"])
    smoothed = localise("flight.avi", "--smooth")[0]
    assert smoothed.seen.all()
    assert off_m(smoothed).max() < 0.01


def test_pictures_that_a_conversion_to_a_higher_rate_repeated_are_left_out(localise, drawn, tmp_path, caplog):
    """From 25 to 30 frames per second, one picture in six is shown twice, and others at times that are 13 ms off."""
    shown = np.floor(np.arange(NUM_FRAMES * 6 // 5) * 5 / 6 + 0.5).astype(int)
    shown = shown[shown < NUM_FRAMES]
    writer = cv2.VideoWriter(str(tmp_path / "30.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (640, 480))
    for number in shown.tolist():
        writer.write(cv2.imread(str(drawn / "images" / f"frame{number}.png")))
    writer.release()
    path = localise(tmp_path / "30.avi", "--smooth")[0]
    again = np.append(False, np.diff(shown) == 0)
    assert again.sum() == 2
    assert (
        f"{again.sum()} of {len(shown)} frames repeat the picture before, and are left out: the"
        in caplog.text
    )
    assert "converted from about 25 frames per second" in caplog.text
    assert path.seen.all()
    assert off_m(path, TRUTH_M[shown])[~again].max() < 0.01


def test_the_json_names_the_shutter_and_the_reference_row(localise):
    _, content, _ = localise("flight.avi", "--frames", 3, "--readout", "0.024")
    assert content["shutter"] == {
        "line_time_s": pytest.approx(0.024 / 480),
        "line_time_std_s": 0.0,
        "readout_s": pytest.approx(0.024),
        "reference_row": 239.5,
        "shown": None,
        "source": "given",
    }


def test_a_folder_with_one_image_of_few_markers_has_its_pose(localise, drawn, tmp_path):
    """Stated errors of the map and of the focal length widen its covariance."""
    (tmp_path / "one").mkdir()
    image, options = drawn / "images" / f"frame{FEW_MARKERS_FRAME}.png", ("--min-markers", 1, "--smooth")
    (tmp_path / "one" / "frame.png").write_bytes(image.read_bytes())
    path, _, said = localise(tmp_path / "one", "--fps", 25, *options)
    assert "one in 1 of 1 frames" in said
    assert path.status.tolist() == [Status.TRACKED]
    # Fewer markers are allowed, and flagged. Three in a plane at 4 m.
    assert path.flags[0] & Flag.FEW_MARKERS
    assert off_m(path, TRUTH_M[[FEW_MARKERS_FRAME]])[0] < 0.05
    stated = ("--map-error", 3, "--focal-error", 1)
    wide, content, _ = localise(tmp_path / "one", "--fps", 25, *options, *stated)
    assert (content["map_error_m"], content["focal_error"]) == (0.003, 0.01)
    assert np.trace(wide.covariance[0]) > 2 * np.trace(path.covariance[0])


@pytest.mark.parametrize(
    ("fov", "option", "advice"),
    [
        ("70,55.4", "--dictionary=5x5_1000", "no frame shows a marker of the map: check --dictionary"),
        ("70,55.4", "--min-markers=14", "of the map: --min-markers requires 14"),
        (
            "20,70",
            "--smooth",
            "no pose fits the markers: check --markers, --camera or --fov, and that no image is mirrored",
        ),
    ],
)
def test_without_any_pose_the_output_says_what_to_check(localise, fov, option, advice):
    said = localise("flight.avi", "--frames", 3, option, lens=("--fov", fov))[2]
    assert "flight in 0 of 3 frames" in said
    assert advice in said
    assert said.count("\n") == 1


def test_a_table_may_have_centres_alone(localise, tmp_path):
    rows = ["id,x_m,y_m,z_m"]
    for marker, corners in wall_markers().items():
        x, y, z = corners.mean(axis=0)
        rows.append(f"{marker},{x},{y},{z}")
    centres = tmp_path / "centres.csv"
    centres.write_text("\n".join(rows))
    path, content, said = localise("flight.avi", "--marker-size", 0.3, markers=centres)
    assert content["map"] == "centres"
    assert "centres alone, a weaker map: corners of" in said
    assert np.nanmax(off_m(path)) < 0.05


def test_a_sequence_provides_markers_and_intrinsics(run_psotrack, localise, drawn, tmp_path):
    folder = write_onboard_sequence(drawn, tmp_path / "S01_D2_A")
    out = tmp_path / "own.csv"
    run_psotrack("onboard", "localise", folder, "--drone", "dron2", "--frames", 6, "--out", out).ended()
    path, name = read_camera_path(out)
    assert name == "dron2"
    assert off_m(path).max() < 0.02
    lens = ("--camera", folder / "drone_cameras_calibration.csv")
    same = localise(folder / "dron2_cam_s.avi", "--camera-name", "dron2", "--frames", 6, lens=lens)[0]
    np.testing.assert_array_equal(same.position_m, path.position_m)
    several = run_psotrack("onboard", "localise", folder, "--out", tmp_path / "other.csv")
    assert "--drone: expected one of dron1, dron2, found none" in several.err


def test_the_edges_of_an_image_stay_where_a_lens_is_scaled():
    large = scale_lens(DRAWN_LENS, (1920, 1440))
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 4), (20, 3))
    # The edges of the image, half a pixel beyond the centres of the outer pixels, do not move.
    small_px, large_px = project(DRAWN_LENS, points)[0], project(large, points)[0]
    np.testing.assert_allclose(large_px + 0.5, 3 * (small_px + 0.5), rtol=1e-12)


# Streams.


def test_a_stream_gives_the_path_of_its_file(localise, drawn):
    """FFmpeg opens a file by its address; its times are the timestamps in the file."""
    # Without a readout, a file is searched for a rolling shutter, and a stream is not.
    file = localise("flight.avi", "--readout", "0")[0]
    stream, content, _ = localise(f"file://{drawn / 'flight.avi'}", "--readout", "0")
    assert content["drone"] == "camera"
    np.testing.assert_allclose(stream.time_s, file.time_s, atol=1e-6)
    # A stream does not learn the errors of its corners, so weights differ.
    std_m = np.sqrt(np.trace(stream.covariance[:, :3, :3], axis1=1, axis2=2))
    assert (distances_m(stream, file.position_m) < 2 * std_m).all()


class Capture:
    """A camera that shows images without timestamps, and then ends the stream or raises an error."""

    def __init__(self, images, error=None):
        self.images, self.error = list(images), error
        self.released = threading.Event()

    def isOpened(self):
        return True

    def get(self, _):
        return 0.0

    def read(self):
        if self.images:
            return True, self.images.pop(0)
        if self.error:
            raise self.error
        return False, None

    def release(self):
        self.released.set()


def first_images(drawn):
    return [cv2.imread(str(drawn / "images" / f"frame{number}.png")) for number in range(FEW_MARKERS_FRAME)]


def test_ctrl_c_ends_a_live_stream_and_keeps_its_frames(localise, drawn, monkeypatch):
    """An interruption of the thread that reads is raised where the frames are used, as that of the main thread."""
    capture, opened = Capture(first_images(drawn), KeyboardInterrupt()), []
    monkeypatch.setattr(cv2, "VideoCapture", lambda device: opened.append(device) or capture)
    path, _, said = localise("0", "--live", "--fps", 25, "--no-filter")
    assert opened == [0]
    assert capture.released.wait(300)
    assert "ended by Ctrl-C" in said
    # The last frame is always used; frames that arrive while another frame is processed are left out.
    assert path.frame[-1] == FEW_MARKERS_FRAME - 1
    np.testing.assert_allclose(path.time_s, path.frame / 25, rtol=1e-12)
    assert off_m(path, TRUTH_M[path.frame]).max() < 0.01


def test_a_stream_that_ends_is_not_interrupted(drawn, monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", lambda device: Capture(first_images(drawn)))
    marker_map = read_marker_map(drawn / "corners.csv")
    found = localise_video(
        open_source("rtsp://camera/1"), marker_map, DRAWN_LENS, LocaliseSettings(filter=None)
    )
    assert found.path.num_frames == FEW_MARKERS_FRAME
    assert not found.interrupted
    # Without timestamps, the times of arrival are used.
    assert (np.diff(found.path.time_s) > 0).all()


def test_newest_items_are_used_and_the_last_is_never_left_out():
    made = threading.Event()

    def many():
        yield from range(50)
        made.set()

    found = []
    for item in read_ahead(many(), newest=True):
        found.append(item)
        assert made.wait(300)
    # While the first item was processed, all other items were made; the last item replaced the items before it.
    assert found[-1] == 49
    assert len(found) <= 2


def test_ctrl_c_ends_the_wait_for_an_item_though_another_thread_received_the_signal():
    """The kernel gives the signal to `other`, because the main thread and the reader block it."""
    interrupted, too_late = threading.Event(), threading.Event()

    def frames():
        os.kill(os.getpid(), signal.SIGINT)
        if not interrupted.wait(120):
            too_late.set()
        yield 0

    other = threading.Thread(target=interrupted.wait, daemon=True)
    other.start()
    # A test run in the background ignores SIGINT.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with pytest.raises(KeyboardInterrupt):
            list(read_ahead(frames()))
        assert not too_late.is_set()
    finally:
        interrupted.set()
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, before)


# Wrong maps, and markers turned any way.

ROOM = any_room()


def path_of(frames, corners_m):
    """The filtered path, without the markers that the video says are wrong; and those markers."""
    found = localise_frames(frames, MarkerMap(corners_m), PASSING_CAMERA, LocaliseSettings())
    return found.path, found.wrong_markers


def test_markers_may_be_turned_any_way():
    """Found: a marker on a pillar was refused, because all other markers are behind it."""
    frames, centres_m = fly_past(15)
    assert {21, 30, 40} <= {int(each) for _, _, found in frames for each in found.ids}
    path, wrong = path_of(frames, ROOM)
    assert wrong == ()
    # Measured 11 mm, of corners that are 0.3 px off.
    assert off_m(path, centres_m).max() < 0.05


@pytest.mark.slow
def test_exchanged_markers_of_a_map_are_named(localise, tmp_path):
    """Found: `numpy.linalg.LinAlgError: Singular matrix`. One pair has its corners counted from another one."""
    corners_m = wall_markers()
    corners_m[5], corners_m[14] = corners_m[14], np.roll(corners_m[5], 1, axis=0)
    write_marker_corners(tmp_path / "wrong.csv", corners_m)
    path, content, said = localise("flight.avi", markers=tmp_path / "wrong.csv")
    assert content["wrong_markers"] == [5, 14]
    assert "elsewhere: markers 5, 14; `psotrack onboard map" in said
    # As without the wrong markers, of which few frames have others.
    assert off_m(path)[SHOWN].max() < 0.02


def test_a_mirrored_marker_and_a_shuffled_map_end_in_lost_frames():
    frames, _ = fly_past(8)
    assert path_of(frames, {**ROOM, 2: ROOM[2][[0, 3, 2, 1]]})[1] == (2,)
    names = list(ROOM)
    shuffled = {name: ROOM[other] for name, other in zip(names, names[7:] + names[:7], strict=True)}
    assert not path_of(frames, shuffled)[0].seen.any()


@pytest.mark.parametrize(("module", "stage"), [(frame_poses, "estimate_pose"), (filtering, "step")])
def test_a_frame_without_a_solution_ends_nothing(module, stage, monkeypatch):
    """A singular matrix in one frame: the frame has no pose, or the filter starts anew; the others are answered."""
    frames, centres_m = fly_past(12)
    working, calls = getattr(module, stage), []

    def once_singular(*arguments, **options):
        calls.append(1)
        if len(calls) == 6:
            raise np.linalg.LinAlgError("Singular matrix")
        return working(*arguments, **options)

    monkeypatch.setattr(module, stage, once_singular)
    found_m = off_m(path_of(frames, ROOM)[0], centres_m)
    assert np.isfinite(np.delete(found_m, 5)).all()
    assert np.nanmax(found_m) < 0.1


# The table of a path.


def test_angles_equal_those_of_scipy_straight_down_too():
    bodies = Rotation.random(200, rng=np.random.default_rng(5))
    cameras = bodies * Rotation.from_matrix(AHEAD)
    found = roll_pitch_yaw_deg(cameras.as_quat(scalar_first=True))
    yaw, pitch, roll = bodies.as_euler("ZYX", degrees=True).T
    # Near a pitch of 90 degrees, angles lose half of their digits.
    np.testing.assert_allclose(found.T, [roll, pitch, yaw], atol=1e-6)
    down = Rotation.from_rotvec([0, 90.0, 0], degrees=True) * Rotation.from_matrix(AHEAD)
    assert roll_pitch_yaw_deg(down.as_quat(scalar_first=True))[1] == pytest.approx(90, abs=1e-5)
    assert np.isnan(roll_pitch_yaw_deg(np.full(4, np.nan))).all()


@pytest.mark.parametrize("with_velocity", [True, False])
def test_a_table_is_read_as_it_was_written_also_by_the_reader_of_tracks(tmp_path, with_velocity):
    written = example_path(with_velocity)
    write_camera_path(tmp_path / "path.csv", written, "dron2")
    read, name = read_camera_path(tmp_path / "path.csv")
    assert name == "dron2"
    for field in vars(written):
        np.testing.assert_array_equal(getattr(read, field), getattr(written, field), err_msg=field)
    tracks, own = read_trajectories(tmp_path / "path.csv"), written.trajectories("dron2")
    assert tracks.drones == ("dron2",)
    for field in ("position_m", "seen", "covariance_m2"):
        np.testing.assert_array_equal(getattr(tracks, field), getattr(own, field), err_msg=field)
    np.testing.assert_array_equal(tracks.seen[:, 0], written.seen)
