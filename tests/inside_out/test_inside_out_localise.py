"""`psotrack onboard localise`: from videos, image folders and streams of a drawn room to the path of the camera."""

import json
import signal
import subprocess
import sys
import textwrap
import threading
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from psotrack.calibration import lens_of_view
from psotrack.cli.onboard.localise import localise as command
from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.foreground.markers import marker_dictionary
from psotrack.geometry import look_at, make_camera, make_rig, project
from psotrack.geometry.rig_files import write_calibration, write_rig
from psotrack.inside_out import (
    Flag,
    LocaliseSettings,
    MarkerMap,
    localise_video,
    open_source,
    read_camera_path,
    read_marker_map,
)
from psotrack.inside_out.frames import read_ahead
from psotrack.inside_out.lens_files import read_lens, scale_lens
from psotrack.recordings import VideoWriter, natural_key
from psotrack.recordings.datasets import write_marker_corners
from psotrack.trajectories import Status

SIZE_WH = (640, 480)
FPS = 25.0
SIDE_M = 0.3
FRAMES = 12
LENS = lens_of_view(70.0, 55.4, SIZE_WH)
#: Number of the frame with only three markers, and of the frame without markers.
FEW_MARKERS_FRAME, NO_MARKERS_FRAME = 6, 8


@dataclass(frozen=True)
class Room:
    """A drawn room, as files that a user would have."""

    folder: Path
    marker_map: MarkerMap
    position_m: np.ndarray
    R_world_cam: np.ndarray
    images: list

    @property
    def markers(self):
        return self.folder / "corners.csv"

    @property
    def video(self):
        return self.folder / "flight.avi"

    @property
    def lens(self):
        return self.folder / "lens.toml"


def wall_markers():
    """Nine markers on a wall at y = 4, and four on a wall at x = 3; ids with gaps."""
    corners = {}
    for index in range(9):
        x, z = -1.6 + 1.3 * (index % 3), 0.7 + 0.75 * (index // 3)
        corners[5 + 3 * index] = np.array(
            [[x, 4, z + SIDE_M], [x + SIDE_M, 4, z + SIDE_M], [x + SIDE_M, 4, z], [x, 4, z]], float
        )
    for index in range(4):
        y, z = 2.2 + 0.8 * (index % 2), 0.9 + 0.9 * (index // 2)
        corners[40 + index] = np.array(
            [[3, y + SIDE_M, z + SIDE_M], [3, y, z + SIDE_M], [3, y, z], [3, y + SIDE_M, z]], float
        )
    return corners


def draw_markers(corners_m, posed):
    """An image of markers seen from their front, drawn in light at three times the size and then reduced."""
    width, height = SIZE_WH
    image = np.full((3 * height, 3 * width), 150.0**2, np.float32)
    for marker, corners in corners_m.items():
        pixels, depth = project(posed, corners)
        if depth.min() < 0.3:
            continue
        # A marker has four cells, two cells of border, and one white cell at each side.
        cell = 24
        own = cv2.copyMakeBorder(
            cv2.aruco.generateImageMarker(marker_dictionary("4x4_1000"), marker, 6 * cell),
            *[cell] * 4,
            cv2.BORDER_CONSTANT,
            value=255,
        )
        low, high = cell - 0.5, 7 * cell - 0.5
        at = np.array([[low, low], [high, low], [high, high], [low, high]], np.float32)
        # Pixel centres are at whole numbers at both sizes.
        towards = cv2.getPerspectiveTransform(at, (3 * pixels + 1).astype(np.float32))
        size = image.shape[1], image.shape[0]
        warped = cv2.warpPerspective(own, towards, size, flags=cv2.INTER_AREA)
        inside = cv2.warpPerspective(np.full_like(own, 255), towards, size, flags=cv2.INTER_NEAREST) > 0
        image[inside] = (30 + (180 / 255) * warped[inside]) ** 2
    # The light of a pixel is the mean of its parts; its grey level is the square root of the light.
    small = np.sqrt(cv2.resize(image, SIZE_WH, interpolation=cv2.INTER_AREA)).round().astype(np.uint8)
    return cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A room with twelve frames of a camera that moves to the right and forward: images, video and calibration."""
    folder = tmp_path_factory.mktemp("room")
    corners_m = wall_markers()
    write_marker_corners(folder / "corners.csv", corners_m)
    write_rig(folder / "lens.toml", make_rig({"front": LENS}))
    (folder / "images").mkdir()
    positions, rotations, images = [], [], []
    with VideoWriter(folder / "flight.avi", FPS, SIZE_WH) as writer:
        for index in range(FRAMES):
            centre = np.array([-0.3 + 0.04 * index, -0.2 + 0.02 * index, 1.4])
            R, t_m = look_at(tuple(centre), (0.5 + 0.03 * index, 4.0, 1.5))
            posed = make_camera(R=R, t_m=t_m, K=LENS.K, image_size_wh=SIZE_WH)
            shown = corners_m
            if index in (FEW_MARKERS_FRAME, NO_MARKERS_FRAME):
                shown = (
                    {} if index == NO_MARKERS_FRAME else {marker: corners_m[marker] for marker in (5, 8, 17)}
                )
            # A marker that is not in the map, in every frame.
            unmapped = {900: np.array([[0, 3.9, 0.6], [0.3, 3.9, 0.6], [0.3, 3.9, 0.3], [0, 3.9, 0.3]])}
            image = draw_markers(shown | ({} if index == NO_MARKERS_FRAME else unmapped), posed)
            # File names without leading zeros: 10 must come after 9.
            cv2.imwrite(str(folder / "images" / f"frame{index}.png"), image)
            writer.write(image)
            positions.append(centre)
            rotations.append(R.T)
            images.append(image)
    return Room(
        folder, read_marker_map(folder / "corners.csv"), np.array(positions), np.array(rotations), images
    )


def run(*arguments):
    """Run the command; errors of psotrack are raised here."""
    result = CliRunner().invoke(command, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def shows_all_markers(path):
    """Mask of frames in which all markers are drawn."""
    return ~np.isin(path.frame, (FEW_MARKERS_FRAME, NO_MARKERS_FRAME))


def error_m(path, room):
    return np.linalg.norm(path.position_m - room.position_m[path.frame], axis=-1)


def error_deg(path, room, rows):
    found = Rotation.from_quat(path.orientation_wxyz[rows], scalar_first=True)
    true = Rotation.from_matrix(room.R_world_cam[path.frame[rows]])
    return np.rad2deg((found.inv() * true).magnitude())


def test_the_path_from_a_folder_of_images_agrees_with_the_cameras(room, tmp_path):
    out = tmp_path / "track.csv"
    result = run(
        room.folder / "images", "--fps", 25, "--markers", room.markers, "--camera", room.lens,
        "--out", out, "--no-filter",
    )  # fmt: skip
    path, name = read_camera_path(out)
    there = shows_all_markers(path)
    assert name == "images"
    np.testing.assert_array_equal(path.frame, np.arange(FRAMES))
    np.testing.assert_allclose(path.time_s, np.arange(FRAMES) / 25, rtol=1e-12)
    # Measured 4.4 mm and 0.06 degrees, from an error of a tenth of a pixel in each of 36 corners at 4 m.
    assert error_m(path, room)[there].max() < 0.01
    assert error_deg(path, room, there).max() < 0.15
    assert (path.status[there] == Status.TRACKED).all()
    assert (path.num_markers[there] >= 8).all()
    assert (path.flags[there] == 0).all()
    assert "10 of 12 frames" in result.output
    assert "frames per second (decode" in result.output


def test_a_video_gives_the_same_path_as_its_images(room, tmp_path):
    tracks = {}
    for source, options in ((room.video, []), (room.folder / "images", ["--fps", FPS])):
        out = tmp_path / f"{source.stem}.csv"
        run(source, *options, "--markers", room.markers, "--camera", room.lens, "--out", out, "--no-filter")
        tracks[source.stem] = read_camera_path(out)[0]
    video, images = tracks["flight"], tracks["images"]
    # The codec is lossy: a marker may be missing, and positions move by 1 mm (measured).
    np.testing.assert_allclose(video.num_markers, images.num_markers, atol=1)
    np.testing.assert_allclose(video.position_m, images.position_m, atol=0.005)


@pytest.mark.parametrize(
    ("pairs", "roll"), [([(5, 8)], 0), pytest.param([(5, 20), (14, 29)], 1, marks=pytest.mark.slow)]
)
def test_exchanged_markers_of_a_map_are_named(room, tmp_path, pairs, roll):
    """Also where the map counts their corners from another one."""
    corners_m = wall_markers()
    for one, other in pairs:
        exchanged = corners_m[other], corners_m[one]
        corners_m[one], corners_m[other] = (np.roll(corners, roll, axis=0) for corners in exchanged)
    write_marker_corners(tmp_path / "wrong.csv", corners_m)
    result = run(
        room.video, "--markers", tmp_path / "wrong.csv", "--camera", room.lens, "--out", tmp_path / "o.csv",
        "--json", tmp_path / "o.json",
    )  # fmt: skip
    assert result.exit_code == 0
    named = json.loads((tmp_path / "o.json").read_text())["wrong_markers"]
    assert named == sorted(marker for pair in pairs for marker in pair)
    path, _ = read_camera_path(tmp_path / "o.csv")
    # As without the wrong markers, of which few frames have others.
    assert np.nanmax(error_m(path, room)[shows_all_markers(path)]) < 0.02


def test_two_markers_at_one_place_are_refused(room, tmp_path):
    corners_m = wall_markers()
    write_marker_corners(tmp_path / "wrong.csv", corners_m | {5: corners_m[40]})
    message = r"wrong\.csv, line 11, marker 40: .* found both markers at the place of marker 5"
    with pytest.raises(InputError, match=message):
        run(room.video, "--markers", tmp_path / "wrong.csv", "--fov", "70,55.4", "--out", tmp_path / "o.csv")
    assert not (tmp_path / "o.csv").exists()


def test_frames_with_few_or_no_markers_are_reported(room, tmp_path):
    source = open_source(room.folder / "images", fps=FPS)
    raw = localise_video(source, room.marker_map, LENS, LocaliseSettings(filter=None)).path
    assert (raw.status[[FEW_MARKERS_FRAME, NO_MARKERS_FRAME]] == Status.LOST).all()
    assert raw.num_markers[[FEW_MARKERS_FRAME, NO_MARKERS_FRAME]].tolist() == [3, 0]
    assert raw.flags[[FEW_MARKERS_FRAME, NO_MARKERS_FRAME]].tolist() == [Flag.FEW_MARKERS, 0]
    assert np.isnan(raw.position_m[[FEW_MARKERS_FRAME, NO_MARKERS_FRAME]]).all()


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        (["--fov", "70,55.4", "--dictionary", "5x5_1000"], "no frame shows a marker of the map: check --dictionary"),
        (["--fov", "70,55.4", "--min-markers", "14"], "of the map: --min-markers requires 14"),
        (["--fov", "20,70"], "no pose fits the markers: check --markers, and --camera or --fov"),
        (["--fov", "70,55.4", "--frames", "1"], None),
        (["--fov", "70,55.4", "--frames", "1", "--no-filter"], None),
    ],
)  # fmt: skip
def test_without_any_pose_the_output_says_what_to_check(room, tmp_path, options, advice):
    output = run(room.video, "--markers", room.markers, *options, "--out", tmp_path / "track.csv").output
    if advice is None:
        assert "flight in 1 of 1 frames" in output
        assert "check --" not in output
    else:
        assert "flight in 0 of" in output
        assert advice in output
    assert output.count("\n") == 1


def test_fewer_markers_are_allowed_and_flagged(room, tmp_path):
    out = tmp_path / "track.csv"
    run(
        room.video,
        "--markers",
        room.markers,
        "--camera",
        room.lens,
        "--out",
        out,
        "--no-filter",
        "--min-markers",
        1,
    )
    path, _ = read_camera_path(out)
    assert path.status[[FEW_MARKERS_FRAME, NO_MARKERS_FRAME]].tolist() == [Status.TRACKED, Status.LOST]
    assert path.flags[FEW_MARKERS_FRAME] & Flag.FEW_MARKERS
    # Three markers in a plane at 4 m. Measured 31 mm, and 12 mm without the codec.
    assert error_m(path, room)[FEW_MARKERS_FRAME] < 0.1


def test_the_first_frame_has_a_pose_if_its_markers_agree_beyond_chance(room, tmp_path):
    run(room.video, "--markers", room.markers, "--camera", room.lens, "--out", tmp_path / "track.csv")
    path, _ = read_camera_path(tmp_path / "track.csv")
    assert path.seen.all()
    # Measured 3 mm.
    assert error_m(path, room).max() < 0.02


@pytest.mark.parametrize(("frame", "options"), [(0, []), (FEW_MARKERS_FRAME, ["--min-markers", 1])])
@pytest.mark.parametrize("smooth", [[], ["--smooth"]])
def test_a_folder_with_one_image_has_its_pose(room, tmp_path, frame, options, smooth):
    (tmp_path / "one").mkdir()
    cv2.imwrite(str(tmp_path / "one" / "frame.png"), room.images[frame])
    out = tmp_path / "track.csv"
    room_files = ["--markers", room.markers, "--camera", room.lens, "--fps", 25]
    result = run(tmp_path / "one", *room_files, *options, *smooth, "--out", out)
    path, _ = read_camera_path(out)
    assert "one in 1 of 1 frames" in result.output
    assert path.status.tolist() == [Status.TRACKED]
    # Three markers in a plane. Measured 12 mm.
    assert np.linalg.norm(path.position_m[0] - room.position_m[frame]) < 0.05


def test_the_covariance_includes_the_error_of_the_focal_length(room, tmp_path):
    """The lens is 1 % too long and the map has a marker 5 mm too high: stated errors improve poses and covariances."""
    lens = tmp_path / "lens.toml"
    K = LENS.K * np.array([[1.01, 1.01, 1], [1.01, 1.01, 1], [1, 1, 1]])
    write_rig(
        lens, make_rig({"front": make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=SIZE_WH)})
    )
    markers, out, report = tmp_path / "corners.csv", tmp_path / "track.csv", tmp_path / "report.json"
    write_marker_corners(
        markers, {i: c + 0.005 * (i == 17) * np.eye(3)[2] for i, c in wall_markers().items()}
    )
    files = ["--markers", markers, "--camera", lens, "--out", out, "--json", report, "--force"]
    median_m, inside = {}, {}
    for name, stated in (("without", []), ("with", ["--map-error", 3, "--focal-error", 1])):
        run(room.folder / "images", "--fps", 25, *files, *stated)
        path, _ = read_camera_path(out)
        off_m = (path.position_m - room.position_m)[path.seen]
        covariance = path.covariance[path.seen][:, :3, :3]
        squared = np.einsum("ni,nij,nj->n", off_m, np.linalg.inv(covariance), off_m)
        # The 90 % ellipsoid.
        inside[name] = np.mean(squared < 6.25)
        median_m[name] = np.median(np.linalg.norm(off_m, axis=1))
    assert inside["without"] < 0.2
    assert inside["with"] > 0.8
    # Markers on two walls determine most of the focal length.
    assert median_m["with"] < 0.7 * median_m["without"]
    content = json.loads(report.read_text())
    assert (content["map_error_m"], content["focal_error"]) == (0.003, 0.01)


def test_the_filter_bridges_frames_without_markers(room, tmp_path):
    out, report = tmp_path / "track.csv", tmp_path / "report.json"
    run(
        room.video,
        "--markers",
        room.markers,
        "--camera",
        room.lens,
        "--out",
        out,
        "--json",
        report,
        "--name",
        "dron1",
    )
    path, name = read_camera_path(out)
    content = json.loads(report.read_text())
    assert name == "dron1"
    assert (path.status[[FEW_MARKERS_FRAME, NO_MARKERS_FRAME]] == Status.COASTING).all()
    # Measured 3 mm, because the motion is even.
    assert np.nanmax(error_m(path, room)) < 0.02
    assert path.velocity_m_s is not None
    assert content["status"]["coasting"] == 2
    assert content["frames"] == FRAMES
    assert set(content["stage_s"]) == {"decode", "grey", "detect", "locate", "filter"}
    assert content["frames_per_second"] == pytest.approx(FRAMES / content["wall_s"])


def test_the_smoother_estimates_the_first_frames_too(room, tmp_path):
    out = tmp_path / "track.csv"
    run(room.video, "--markers", room.markers, "--camera", room.lens, "--out", out, "--smooth")
    path, _ = read_camera_path(out)
    assert path.seen.all()
    # Measured 1.5 mm.
    assert error_m(path, room).max() < 0.01


def test_a_field_of_view_replaces_a_calibration_file(room, tmp_path):
    for name, options in (("fov", ["--fov", "70,55.4"]), ("file", ["--camera", room.lens])):
        run(room.video, *options, "--markers", room.markers, "--out", tmp_path / f"{name}.csv", "--frames", 3)
    assert (tmp_path / "fov.csv").read_text().split("\n")[0] == (tmp_path / "file.csv").read_text().split(
        "\n"
    )[0]
    fov, file = (read_camera_path(tmp_path / f"{name}.csv")[0] for name in ("fov", "file"))
    assert fov.num_frames == 3
    np.testing.assert_array_equal(fov.position_m, file.position_m)


def test_a_stream_gives_the_path_of_its_file(room, tmp_path):
    """FFmpeg opens a file by its address; its times are the timestamps in the file."""
    for name, source in (("file", room.video), ("stream", f"file://{room.video}")):
        # Without a readout, a file is searched for a rolling shutter, and a stream is not.
        lens = ["--camera", room.lens, "--readout", "0"]
        run(source, "--markers", room.markers, *lens, "--out", tmp_path / f"{name}.csv")
    (file, _), (stream, name) = (read_camera_path(tmp_path / f"{name}.csv") for name in ("file", "stream"))
    assert name == "camera"
    np.testing.assert_allclose(stream.time_s, file.time_s, atol=1e-6)
    # A stream does not learn the errors of its corners: weights differ, and its covariances are larger.
    off_m = np.linalg.norm(stream.position_m - file.position_m, axis=1)
    assert (off_m < np.sqrt(np.trace(stream.covariance[:, :3, :3], axis1=1, axis2=2))).all()
    assert np.trace(stream.covariance.mean(axis=0)) > np.trace(file.covariance.mean(axis=0))


class Capture:
    """A camera that shows images without timestamps and then calls `press`, or ends the stream."""

    def __init__(self, images, press=None):
        self.images, self.press, self.released = list(images), press, threading.Event()

    def isOpened(self):
        return True

    def get(self, _):
        return 0.0

    def read(self):
        if self.images:
            return True, self.images.pop(0)
        if self.press:
            self.press()
        return False, None

    def release(self):
        self.released.set()


def test_ctrl_c_ends_a_live_stream_and_keeps_its_frames(room, tmp_path, monkeypatch):
    kept, heard, opened = threading.Event(), threading.Event(), []

    def counted(detected, done):
        for one in detected:
            yield one
            # When the next frame is requested, this one has been kept; it is the only one if the others came too fast.
            kept.set()

    def interrupt(*_):
        if not heard.is_set():
            heard.set()
            raise KeyboardInterrupt

    def press():
        # A frame must have been localised before Ctrl-C, and the stream must not end before Ctrl-C arrives.
        assert kept.wait(300)
        # A signal that comes just before the main thread waits for the next frame does not wake the main thread.
        for _ in range(300):
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
            if heard.wait(1):
                return
        pytest.fail("no signal was heard")

    capture = Capture(room.images[:FEW_MARKERS_FRAME], press)
    monkeypatch.setattr(cv2, "VideoCapture", lambda device: opened.append(device) or capture)
    monkeypatch.setattr("psotrack.inside_out.localising.video._counted", counted)
    out, before = tmp_path / "track.csv", signal.signal(signal.SIGINT, interrupt)
    try:
        options = ("--live", "--fps", 25, "--markers", room.markers, "--camera", room.lens, "--no-filter")
        result = run("0", *options, "--out", out)
    finally:
        signal.signal(signal.SIGINT, before)
    path, _ = read_camera_path(out)
    assert opened == [0]
    assert capture.released.wait(300)
    assert "ended by Ctrl-C" in result.output
    # The last frame is always used; frames that arrive while another frame is processed are left out.
    assert set(path.frame.tolist()) <= set(range(FEW_MARKERS_FRAME))
    np.testing.assert_allclose(path.time_s, path.frame / 25, rtol=1e-12)
    assert error_m(path, room).max() < 0.01


def test_a_stream_that_ends_is_not_interrupted(room, monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", lambda device: Capture(room.images[:5]))
    found = localise_video(
        open_source("rtsp://camera/1"), room.marker_map, LENS, LocaliseSettings(filter=None)
    )
    assert found.path.num_frames == 5
    assert not found.interrupted
    # Without timestamps, the times of arrival are used.
    assert (np.diff(found.path.time_s) > 0).all()


def test_ctrl_c_in_a_recording_writes_nothing(room, tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("psotrack.inside_out.localising.frame_poses.estimate_pose", interrupted)
    with pytest.raises(KeyboardInterrupt):
        localise_video(open_source(room.video), room.marker_map, LENS)
    out = tmp_path / "track.csv"
    result = run(room.video, "--markers", room.markers, "--camera", room.lens, "--out", out)
    assert result.exit_code != 0
    assert not out.exists()


def test_an_unknown_stream_is_refused_in_one_line(tmp_path):
    with pytest.raises(
        InputError, match=r"file:///nowhere.avi: expected a camera or a stream, found none that can be op"
    ):
        open_source("file:///nowhere.avi")


@pytest.fixture
def sequence(room, tmp_path):
    """The folder of a sequence with the videos of two drones."""
    folder = tmp_path / "S01_D2_A"
    folder.mkdir()
    for drone in ("dron1", "dron2"):
        (folder / f"{drone}_cam_s.avi").write_bytes(room.video.read_bytes())
    (folder / "aruco_corners.csv").write_bytes(room.markers.read_bytes())
    rows = [f"dron{number};{LENS.K[0, 0]};{LENS.K[1, 1]};319.5;239.5;640;480" for number in (1, 2)]
    header = "cam_name;focal_length_x;focal_length_y;cx;cy;width;height"
    (folder / "drone_cameras_calibration.csv").write_text("\n".join([header, *rows]) + "\n")
    return folder


def test_a_sequence_provides_markers_and_intrinsics(room, sequence, tmp_path):
    out = tmp_path / "track.csv"
    # A picture in the folder does not make it a folder of images.
    cv2.imwrite(str(sequence / "plot.png"), np.zeros((20, 30), np.uint8))
    run(sequence, "--drone", "dron2", "--out", out)
    path, name = read_camera_path(out)
    assert name == "dron2"
    assert np.nanmax(error_m(path, room)) < 0.02
    calibration = sequence / "drone_cameras_calibration.csv"
    options = ["--markers", room.markers, "--camera", calibration, "--camera-name", "dron2", "--out"]
    run(sequence / "dron2_cam_s.avi", *options, tmp_path / "same.csv")
    same, _ = read_camera_path(tmp_path / "same.csv")
    np.testing.assert_array_equal(same.position_m, path.position_m)


@pytest.mark.parametrize("options", [[], ["--drone", "dron7"]], ids=["none", "unknown"])
def test_a_sequence_of_several_drones_lists_its_drones(sequence, tmp_path, options):
    with pytest.raises(SettingsError, match=r"--drone: expected .* dron1, dron2, found"):
        run(sequence, *options, "--out", tmp_path / "track.csv")


def test_a_folder_without_images_or_videos_is_refused_in_one_line(room, tmp_path):
    with pytest.raises(
        InputError,
        match=r"expected images, which end in \.png.*, or an _A sequence of the dataset, found neither; to use",
    ):
        run(tmp_path, "--markers", room.markers, "--fov", "70,55", "--out", tmp_path / "track.csv")


def test_intrinsics_for_another_size_are_refused_in_one_line_with_the_file(room, tmp_path):
    lens = tmp_path / "lens.toml"
    write_rig(lens, make_rig({"front": scale_lens(LENS, (1280, 960))}))
    arguments = [room.video, "--markers", room.markers, "--camera", lens, "--out", tmp_path / "track.csv"]
    with pytest.raises(
        InputError,
        match=r"lens.toml: expected intrinsics for 640 x 480 pixels.*found 1280 x 960; pass --scale-camera",
    ):
        run(*arguments)
    assert not (tmp_path / "track.csv").exists()
    run(*arguments, "--scale-camera", "--frames", 3)
    path, _ = read_camera_path(tmp_path / "track.csv")
    assert np.nanmax(error_m(path, room)) < 0.01


def test_a_scaled_lens_maps_to_the_same_position_in_the_scaled_image():
    """The edges of the image, half a pixel beyond the centres of the outer pixels, do not move."""
    small, large = LENS, scale_lens(LENS, (1920, 1440))
    points = np.random.default_rng(0).uniform((-1, -1, 2), (1, 1, 4), (20, 3))
    np.testing.assert_allclose(
        project(large, points)[0] + 0.5, 3 * (project(small, points)[0] + 0.5), rtol=1e-12
    )


def test_lenses_are_not_scaled_to_other_aspect_ratios(tmp_path):
    lens = tmp_path / "lens.yml"
    write_rig(lens, make_rig({"front": LENS}))
    with pytest.raises(InputError, match="found 640 x 480; calibrate at this size: the shape differs"):
        read_lens(lens, (1920, 1080), scale=True)


def test_a_csv_without_sizes_is_refused_where_its_axis_is_far_off_the_middle(tmp_path):
    lens = tmp_path / "cameras_calibration.csv"
    K = np.array([[400.0, 0.0, 319.5], [0.0, 400.0, 239.5], [0.0, 0.0, 1.0]])
    one = make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=SIZE_WH)
    write_calibration(lens, make_rig({"cam1i": one}))
    assert read_lens(lens, SIZE_WH).K[0, 2] == 319.5
    with pytest.raises(
        InputError, match=r"expected intrinsics for 1920 x 1080.*found an optical axis at \(320, 240\)"
    ):
        read_lens(lens, (1920, 1080))


def test_one_of_several_cameras_in_a_file_must_be_chosen(tmp_path):
    lens = tmp_path / "lens.toml"
    write_rig(lens, make_rig({"left": LENS, "right": LENS}))
    with pytest.raises(InputError, match="expected one camera, found left, right; name it by --camera-name"):
        read_lens(lens, SIZE_WH)
    with pytest.raises(InputError, match="expected a camera up, found left, right"):
        read_lens(lens, SIZE_WH, name="up")
    assert read_lens(lens, SIZE_WH, name="right").K[0, 0] == LENS.K[0, 0]


def test_a_video_that_ends_early_is_refused_unless_fewer_frames_are_requested(room, tmp_path):
    content = room.video.read_bytes()
    short, out = tmp_path / "short.avi", tmp_path / "track.csv"
    short.write_bytes(content[: len(content) * 6 // 10])
    options = ["--markers", room.markers, "--camera", room.lens, "--out", out]
    with pytest.raises(
        InputError, match=rf"short.avi: expected {FRAMES} frames, found that only \d+ can be decoded \(frame"
    ):
        run(short, *options)
    assert not out.exists()
    run(short, *options, "--frames", 3)
    assert read_camera_path(out)[0].num_frames == 3


def test_existing_files_are_not_overwritten(room, tmp_path):
    out = tmp_path / "track.csv"
    out.write_text("mine")
    options = ["--markers", room.markers, "--camera", room.lens, "--out", out, "--frames", 2]
    with pytest.raises(OutputError, match="pass --force to replace it"):
        run(room.video, *options)
    assert out.read_text() == "mine"
    run(room.video, *options, "--force")
    assert read_camera_path(out)[0].num_frames == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.avi", "--fov", "70,55"], r"nowhere.avi: expected a video, found no such file"),
        (["VIDEO"], r"lens: expected --camera FILE or --fov H,V, found neither"),
        (["VIDEO", "--camera", "x.toml", "--fov", "70,55"], r"lens: .*found both"),
        (["VIDEO", "--camera", "nowhere.toml"], r"nowhere.toml: expected a file to read"),
        (["VIDEO", "--fov", "70,55", "--frames", "99"], r"frames: expected 1 to 12, the frames of .*avi, found 99"),
        (["VIDEO", "--fov", "70,55", "--dictionary", "3x3"], r"dictionary: expected one of"),
        (["VIDEO", "--fov", "70,55", "--drone", "dron1"], r"--drone: expected a folder with videos of drones' own"),
        (["0", "--fov", "70,55"], r"0: expected a video, found no such file; pass --live if it is a camera's number"),
        (["VIDEO", "--fov", "70,55", "--json", "OUT"], r"--json: expected another file than --out"),
        (["IMAGES", "--fov", "70,55"],
         r"--fps: expected the rate at which the images in .*images were taken, because images do not state it, "
         r"found no --fps; add it in frames per second, such as --fps 25$"),
        (["ONE"], r"frame0\.png: expected a video, or a folder of images, found one image; name the images' folder"),
        (["IMAGES", "--fov", "70,55", "--fps", "0"], r"--fps: expected a number above 0, found 0"),
    ],
)  # fmt: skip
def test_invalid_input_is_refused_in_one_line(room, tmp_path, arguments, message):
    words = {"VIDEO": room.video, "IMAGES": room.folder / "images", "OUT": tmp_path / "track.csv"}
    words["ONE"] = room.folder / "images" / "frame0.png"
    with pytest.raises((InputError, SettingsError), match=message) as error:
        run(
            *[words.get(word, word) for word in arguments],
            "--markers",
            room.markers,
            "--out",
            tmp_path / "track.csv",
        )
    assert "\n" not in str(error.value)
    assert not (tmp_path / "track.csv").exists()


def test_markers_are_needed(room, tmp_path):
    with pytest.raises(SettingsError, match="--markers: expected a table of marker corners, found none"):
        run(room.video, "--fov", "70,55", "--out", tmp_path / "track.csv")


def test_the_image_of_another_size_is_named(tmp_path):
    for name, shape in (("a1.png", (20, 30)), ("a2.png", (20, 32))):
        cv2.imwrite(str(tmp_path / name), np.zeros(shape, np.uint8))
    with pytest.raises(InputError, match=r"a2.png: expected 30 x 20 pixels as in a1.png, found 32 x 20"):
        list(open_source(tmp_path, fps=25.0).frames())


def test_an_unreadable_folder_is_named(tmp_path, monkeypatch):
    def refused(_):
        raise PermissionError(13, "Permission denied")

    # Tests may run as root, and root may read every folder.
    monkeypatch.setattr(Path, "iterdir", refused)
    with pytest.raises(InputError, match="expected a folder to read, found permission denied"):
        open_source(tmp_path)
    with pytest.raises(InputError, match="expected a folder to read, found permission denied"):
        run(tmp_path, "--markers", "corners.csv", "--fov", "70,55", "--out", tmp_path / "track.csv")


def test_a_broken_image_is_named(tmp_path):
    (tmp_path / "a1.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"a1.png: expected an image, found a file that is no PNG"):
        open_source(tmp_path, fps=25.0)


def test_file_names_sort_in_natural_order():
    names = ["b1.png", "a10.png", "a9.png", "a09b.png"]
    assert sorted(names, key=lambda name: natural_key(Path(name))) == [
        "a9.png",
        "a09b.png",
        "a10.png",
        "b1.png",
    ]


def test_reading_ahead_keeps_order_and_raises_errors():
    assert list(read_ahead(iter(range(100)))) == list(range(100))

    def broken():
        yield 1
        raise InputError("frame 1", expected="an image", found="none")

    found = []
    with pytest.raises(InputError, match="frame 1"):
        found.extend(read_ahead(broken()))
    assert list(read_ahead(iter([]))) == []


def test_ctrl_c_ends_the_wait_for_an_item_though_another_thread_received_the_signal():
    program = """
        import signal, threading, time
        from psotrack.inside_out.frames import read_ahead

        # A test run in the background ignores SIGINT, and its children inherit this.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        # The kernel gives the signal to this thread, because the main thread and the reader block the signal.
        threading.Thread(target=time.sleep, args=(300,), daemon=True).start()
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})

        def frames():
            print("reading", flush=True)
            time.sleep(300)
            yield 0

        list(read_ahead(frames()))
    """
    with subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as child:
        try:
            assert child.stdout.readline() == "reading\n"
            child.send_signal(signal.SIGINT)
            # One second suffices on an idle machine.
            _, stderr = child.communicate(timeout=30)
        finally:
            child.kill()
    assert child.returncode == -signal.SIGINT
    assert stderr.endswith("KeyboardInterrupt\n")


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
