"""Simulated sequences on disk: file layout, determinism, resuming after interruptions, the command, own cameras."""

import contextlib
import functools
import hashlib
import json
import shutil
import zipfile
from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from helpers import assert_refused, content_of, made_once, read_mocap_markers
from placed_drones import S02, number_image, opencv_pixels
from scipy.spatial.transform import Rotation

from psotrack import __version__
from psotrack.geometry import look_at, make_camera, project
from psotrack.geometry.rig_files import read_rig
from psotrack.recordings import probe, read_detections, read_frames
from psotrack.recordings.datasets import MARKER_CORNERS, read_marker_corners, read_sequence
from psotrack.simulation import (
    OWN_CAMERAS,
    CameraRenderer,
    SimulationSettings,
    build,
    change_scenario,
    generate,
    preset_text,
    simulate,
)
from psotrack.simulation.generate import unfinished
from psotrack.simulation.imaging.lens_image import lens_image
from psotrack.simulation.imaging.raster import pinhole
from psotrack.simulation.imaging.renderer import OnboardRenderer
from psotrack.simulation.own_cameras import PosedBoard, board_poses, draw_board, own_board, own_rig

NAME = "S02_D4_A"
#: A scenario of two cameras and two drones.
PAIR = msgspec.structs.replace(
    change_scenario(
        S02,
        {
            "cameras": [
                {"position_m": [3.0, -2.5, 2.6], "target_m": [0.0, 0.0, 1.2]},
                {"position_m": [-3.0, -2.5, 2.6], "target_m": [0.0, 0.0, 1.2]},
            ]
        },
    ),
    drones=S02.drones[:2],
)
TINY = SimulationSettings(num_frames=7, scale=0.1)
ONE_FRAME = replace(TINY, num_frames=1)
#: Smallest accepted similarity of a decoded and a rendered frame, dB. The MPEG-4 encoder at its lowest quality in
#: use is above this limit; a wrong frame is near 15 dB.
MIN_PSNR_DB = 28.0


@pytest.fixture(scope="module")
def scene():
    return build(PAIR, scale=TINY.scale)


def make_pair(folder):
    """An uninterrupted simulation, to which interrupted simulations are compared."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generate, "SEGMENT_FRAMES", 2)
        simulate(PAIR, folder, TINY, jobs=1)


pair_folder = made_once("pair_sequence", make_pair, f"Simulated_Data/{NAME}")


@pytest.fixture
def short_segments(monkeypatch):
    monkeypatch.setattr(generate, "SEGMENT_FRAMES", 2)


def test_read_sequence_finds_every_file(pair_folder, scene):
    recording = read_sequence(pair_folder).usable()
    rig = recording.rig
    assert list(recording.videos) == list(rig.names) == list(recording.detections) == ["cam1", "cam2"]
    assert set(recording.onboard) == {"dron1", "dron2"}
    for name, video in recording.videos.items():
        assert video.path.name == f"{name}i_s.avi"
        assert (video.num_frames, video.fps, video.image_size_wh) == (7, 25.0, (192, 108))
    np.testing.assert_allclose(rig.cameras.T_cam_world, scene.rig.cameras.T_cam_world, atol=1e-9)
    np.testing.assert_allclose(rig.cameras.K, scene.rig.cameras.K, atol=1e-9)
    assert set(read_marker_corners(pair_folder / MARKER_CORNERS)) == set(range(1, 42))
    record = json.loads((pair_folder / "simulation.json").read_text())
    inputs = {"frames": 7, "scale": 0.1, "seed": 0, "masks": True, "onboard": True}
    assert inputs.items() <= record.items()
    # Another version starts an unfinished sequence again, because its two halves might differ.
    assert record["version"] == __version__
    assert record["libraries"] == {"numpy": np.__version__, "opencv": cv2.__version__}
    assert msgspec.convert(record["scenario"], type(PAIR)) == PAIR


def test_the_reference_is_the_flight_and_is_missing_in_frame_0(pair_folder, scene):
    truth = read_sequence(pair_folder).truth
    assert np.isnan(truth.position_m[0]).all()
    # Fewer frames are the first frames of the same flight. The text files hold sixteen digits.
    np.testing.assert_allclose(truth.position_m[1:], scene.positions_m(250)[1:7], atol=1e-12)
    np.testing.assert_allclose(truth.orientation_wxyz[1:], scene.orientations_wxyz(7)[1:], atol=1e-9)
    for drone, model in enumerate(scene.models):
        markers = read_mocap_markers(pair_folder / f"dron{drone + 1}_markers_25.csv")
        assert markers.shape == (7, 4, 3)
        on_body = []
        for frame in range(1, 7):
            body = Rotation.from_quat(truth.orientation_wxyz[frame, drone], scalar_first=True)
            on_body.append(body.inv().apply(markers[frame] - truth.position_m[frame, drone]))
        # Markers are fixed to the body, on top of it. Quaternions are rounded to sixteen digits.
        np.testing.assert_allclose(on_body, [on_body[0]] * 6, atol=1e-12)
        assert on_body[0][:, 2].min() > model.triangles_m[..., 2].max()
        assert np.linalg.norm(on_body[0], axis=-1).max() < 0.35


def test_videos_show_the_rendered_frames(pair_folder, scene):
    drawn = {
        "cam1i_s.avi": CameraRenderer(scene, 0),
        "cam2i_s.avi": CameraRenderer(scene, 1),
        "dron2_cam_s.avi": OnboardRenderer(scene, 1),
    }
    for name, renderer in drawn.items():
        frames = list(read_frames(probe(pair_folder / name)))
        assert len(frames) == 7
        for frame, shown in enumerate(frames):
            assert cv2.PSNR(shown, renderer.frame(frame)) > MIN_PSNR_DB


def test_masks_agree_with_the_renderer_and_detections_lie_on_the_drones(pair_folder, scene):
    recording = read_sequence(pair_folder)
    position_m = scene.positions_m(7)
    num_near = num_boxes = 0
    with zipfile.ZipFile(pair_folder / "drone_masks.zip") as archive:
        assert archive.testzip() is None
        data = archive.read("cam1i/dron1/000000.png")
        # Width, height, bit depth and colour type as the PNG standard defines them: one bit, grey.
        assert data[16:26] == (192).to_bytes(4, "big") + (108).to_bytes(4, "big") + b"\x01\x00"
        masks = {
            name: cv2.imdecode(np.frombuffer(archive.read(name), np.uint8), cv2.IMREAD_GRAYSCALE) > 0
            for name in archive.namelist()
        }
    assert len(masks) == 2 * 2 * 7
    for index, camera in enumerate(scene.rig.names):
        renderer = CameraRenderer(scene, index)
        found = read_detections(recording.detections[camera])
        for frame in range(7):
            numbers = number_image(renderer, frame)
            for drone in (1, 2):
                # The name of the camera is that of the video file.
                name = f"cam{index + 1}i/dron{drone}/{frame:06d}.png"
                np.testing.assert_array_equal(masks[name], numbers == drone)
            pixels, _ = project(recording.rig.cameras[index], position_m[frame])
            for box in found.in_frame(frame).xyxy:
                low, high = box[:2], box[2:]
                away_px = np.linalg.norm(pixels - (low + high - 1) / 2, axis=-1)
                num_boxes += 1
                # A box's centre differs from the body's origin by less than the box's diagonal.
                num_near += away_px.min() < np.linalg.norm(high - low)
    # About half of the 28 drones, boxes of about 10 px, are detected: 13; at most two boxes may be false detections.
    assert num_boxes >= 8
    assert num_near >= num_boxes - 2


def test_a_recorded_flight_at_another_rate_without_masks(tmp_path):
    path = tmp_path / "hover.csv"
    rows = [f"{k},{k / 10},a,0.0,0.0,1.5" for k in range(40)]
    path.write_text("\n".join(["frame,time_s,drone,x_m,y_m,z_m", *rows]) + "\n")
    drones = [{"flight": {"kind": "recording", "file": str(path)}}]
    recipe = change_scenario(PAIR, {"drones": drones, "num_frames": 3, "fps": 12.5})
    steps_done = []

    @contextlib.contextmanager
    def report(description, total):
        # Every frame of every video counts.
        assert total == 3 * (2 + 1)
        yield steps_done.append

    settings = replace(TINY, num_frames=3, masks=False)
    folder = simulate(recipe, tmp_path, settings, jobs=1, report=report)
    assert sum(steps_done) == 9
    record = json.loads((folder / "simulation.json").read_text())
    assert record["sha256"] == {str(path): hashlib.sha256(path.read_bytes()).hexdigest()}
    names = set(content_of(folder))
    assert {"dron1_pos_12.5.csv", "dron1_markers_12.5.csv", "dron1_cam_12.5.csv"} <= names
    assert not any("mask" in name for name in names)
    recording = read_sequence(folder)
    assert recording.videos["cam1"].fps == 12.5
    assert recording.truth.time_s.tolist() == [0.0, 0.08, 0.16]
    np.testing.assert_allclose(recording.truth.position_m[1:], [[[0.0, 0.0, 1.5]]] * 2, atol=1e-9)


def test_scale_keeps_the_world_and_shrinks_the_images():
    large, small = build(S02, scale=1.0), build(S02, scale=0.3)
    np.testing.assert_array_equal(small.positions_m(5), large.positions_m(5))
    here, there = small.rig.cameras, large.rig.cameras
    np.testing.assert_array_equal(here.T_cam_world, there.T_cam_world)
    assert there.K[0].tolist() == [[1156.3, 0, 960], [0, 1156.3, 540], [0, 0, 1]]
    # The image's corner is at -0.5 px, and the distance of a point from that corner shrinks by the scale.
    np.testing.assert_allclose(here.K[0, :2, 2] + 0.5, [0.3 * 960.5, 0.3 * 540.5])
    assert (here.image_size_wh % 2 == 0).all()


def test_segments_change_only_the_encoded_videos(pair_folder, tmp_path):
    """A video that is encoded in segments differs in bytes; all other files are equal to the byte."""
    unsegmented = content_of(simulate(PAIR, tmp_path, TINY, jobs=1))
    segmented = content_of(pair_folder)
    assert unsegmented.keys() == segmented.keys()
    for name in unsegmented:
        assert (unsegmented[name] != segmented[name]) == name.endswith(".avi"), name


@pytest.mark.usefixtures("short_segments")
@pytest.mark.slow
def test_the_number_of_jobs_changes_no_byte(pair_folder, tmp_path):
    assert content_of(simulate(PAIR, tmp_path, TINY, jobs=2)) == content_of(pair_folder)


# --- interruptions


def interrupt_after(after_frames):
    """Return a progress report that raises KeyboardInterrupt (Ctrl-C) after `after_frames` frames."""
    done = 0

    @contextlib.contextmanager
    def report(description, num_boxes):
        def advance(steps):
            nonlocal done
            done += steps
            if done >= after_frames:
                raise KeyboardInterrupt

        yield advance

    return report


@pytest.mark.usefixtures("short_segments")
def test_an_interrupted_simulation_continues_at_its_segment(pair_folder, tmp_path):
    parent = tmp_path / "Simulated_Data"

    def interrupt(settings, after_frames):
        with pytest.raises(KeyboardInterrupt):
            simulate(PAIR, tmp_path, settings, jobs=1, report=interrupt_after(after_frames))
        return {path: path.stat().st_mtime_ns for path in parent.rglob("video.avi")}

    # Segments of other settings are not used.
    interrupt(replace(TINY, seed=5), 4)
    kept = interrupt(TINY, 12)
    assert [path.name for path in parent.iterdir()] == [f".{NAME}.unfinished"]
    # Seven frames of the first camera, and the segments of frames 0-1 and 2-3 of the second camera.
    segments_of = {"cam1i": [], "cam2i": []}
    for path in sorted(kept):
        camera, start = path.parts[-3:-1]
        segments_of[camera].append(int(start))
    assert segments_of == {"cam1i": [0, 2, 4, 6], "cam2i": [0, 2]}
    assert not list(parent.rglob("*.partial*"))
    # The existing frames are reported as done at the start, which raises the interruption.
    assert interrupt(TINY, 12) == kept
    folder = simulate(PAIR, tmp_path, TINY, jobs=1)
    assert content_of(folder) == content_of(pair_folder)
    assert [path.name for path in parent.iterdir()] == [NAME]


def test_the_old_sequence_stays_until_the_new_one_is_complete(pair_folder, tmp_path):
    folder = shutil.copytree(pair_folder, tmp_path / "Simulated_Data" / NAME)
    before = content_of(folder)
    other = replace(ONE_FRAME, seed=1)
    with pytest.raises(KeyboardInterrupt):
        simulate(PAIR, tmp_path, other, jobs=1, force=True, report=interrupt_after(2))
    assert content_of(folder) == before
    simulate(PAIR, tmp_path, other, jobs=1, force=True)
    after = content_of(folder)
    assert after.keys() == before.keys()
    for name in ("dron1_pos_25.csv", "cam1i_s.avi"):
        assert after[name] != before[name]


def test_a_second_simulation_of_the_same_sequence_is_refused(tmp_path):
    folder = tmp_path / "Simulated_Data" / NAME
    again = functools.partial(simulate, PAIR, tmp_path, ONE_FRAME, jobs=1)
    words = f"{NAME}: expected no other simulation of this sequence at the same time, found another simulation; wait"
    with unfinished(folder, b"another record") as parts:
        parts.mkdir(parents=True)
        assert_refused(again, words, unchanged=tmp_path)
    # The lock ended with the other simulation, so a new simulation can start.
    again()
    assert [path.name for path in folder.parent.iterdir()] == [NAME]


# --- the command


def test_a_preset_can_be_edited_into_a_new_scenario(run_psotrack, tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text(preset_text("S11_D4").replace('name = "S11_D4"', 'name = "MINE"'))
    changes = ("--set", "image_size_wh=[1280,960]", "--no-onboard")
    small = ("--frames", 2, "--scale", 0.05, "--jobs", 1, "--json", "-", "--quiet")
    result = run_psotrack("simulate", "--scenario", mine, "--out", tmp_path, *changes, *small)
    folder = tmp_path / "Simulated_Data" / "MINE"
    assert json.loads(result.out) == {"sequence": str(folder)}
    recording = read_sequence(folder).usable()
    assert len(recording.rig) == len(recording.truth.drones) == 4
    assert recording.num_frames == 2
    np.testing.assert_array_equal(recording.rig.cameras.image_size_wh, [[64, 48]] * 4)


# --- recordings as a laboratory makes them: own cameras and a board


def lens():
    R, t_m = look_at((0.3, -3.0, 1.5), (0.0, 0.2, 1.0))
    K = np.array([[620.0, 0, 318.0], [0, 625.0, 242.0], [0, 0, 1]])
    return make_camera(R=R, t_m=t_m, K=K, image_size_wh=(640, 480), dist=(-0.2, 0.05, 0.001, -0.0005))


def grey_image(cam):
    return np.full((cam.height, cam.width, 3), 90, np.uint8)


def board_corners_m(places):
    """(corners, 3), the inner corners of a board at its place in the world, metres."""
    return places.corner_m + own_board().corners_m @ places.axes.T


def test_the_board_is_where_opencv_projects_it():
    """Drawn into the images of which the lens's image consists, against `projectPoints` with distortion."""
    camera = lens()
    R, _ = look_at((1.05, -3.0, 1.5), (0.1, 0.0, 1.1))
    places = PosedBoard(R.T, np.array([-0.35, 0.0, 1.7]))
    seen = lens_image(camera)
    image = seen.assemble([draw_board(grey_image(cam), cam, places) for cam in seen.faces])
    assert image.shape == (480, 640, 3)
    found, ids, *_ = cv2.aruco.CharucoDetector(own_board().opencv()).detectBoard(image)
    assert len(found) == own_board().num_corners
    points_m = board_corners_m(places)[ids.ravel()]
    expected = opencv_pixels(pinhole(camera), points_m, camera.dist)
    np.testing.assert_allclose(found.reshape(-1, 2), expected, rtol=0, atol=0.2)


def test_neighbours_see_the_board_together_and_it_is_tilted():
    rig = own_rig(1.0)
    places = board_poses(rig, 33, seed=1)
    assert [place.corner_m[2] for place in places].count(0.0) == 1
    #: For each camera and board, whether the camera sees the whole front, and the angle to it.
    seen, angle_deg = np.zeros((4, 33), int), np.zeros((4, 33))
    for number, place in enumerate(places):
        np.testing.assert_allclose(place.axes @ place.axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(place.axes) == pytest.approx(1)
        corners_m = board_corners_m(place)
        for index in range(4):
            camera = rig.cameras[index]
            pixels, depth_m = project(camera, corners_m)
            inside = ((pixels > 0) & (pixels < camera.image_size_wh - 1)).all() and depth_m.min() > 0
            way = camera.centre_world - corners_m.mean(axis=0)
            cosine = -place.axes[:, 2] @ way / np.linalg.norm(way)
            seen[index, number] = inside and cosine > 0
            angle_deg[index, number] = np.degrees(np.arccos(cosine))
    shared = seen @ seen.T
    assert shared.diagonal().min() >= 8
    left, right, gopro, serial = range(4)
    assert min(shared[left, gopro], shared[gopro, serial], shared[serial, right]) >= 4
    # Every second round of boards, one board per camera, is turned to the middle between two cameras: measured 31
    # degrees to the second camera, and 55 degrees when a board is turned to one camera.
    between = np.arange(33) // 4 % 2 == 1
    to_the_second = np.sort(angle_deg, axis=0)[1]
    assert to_the_second[between].max() < 45


def test_the_folder_of_a_laboratory(tmp_path, run_psotrack):
    folder = tmp_path / "lab"
    small = ("--scale", 0.1, "--frames", 6, "--jobs", 1, "-q")
    run_psotrack("simulate", "S01_D2_A", "--as-own-cameras", "--out", folder, *small).ended()
    for camera in OWN_CAMERAS:
        flight = probe(folder / camera.flight)
        calibration = probe(folder / "board" / f"{camera.name}.avi")
        width, height = camera.size
        small_wh = (round(width * 0.1), round(height * 0.1))
        assert flight.image_size_wh == calibration.image_size_wh == small_wh
        assert flight.fps == pytest.approx(camera.fps, abs=1e-3)
        # The flight takes 0.24 s.
        assert flight.num_frames == int((0.24 - camera.start_s) * camera.fps)
        assert calibration.num_frames == 48
    assert len({camera.fps for camera in OWN_CAMERAS}) == 3
    # The board's corner on the floor is the origin of the world in which rig and reference are written.
    rig = read_rig(folder / "truth" / "rig.toml")
    assert rig.names == tuple(camera.name for camera in OWN_CAMERAS)
    heights_m = [camera.position_m[2] for camera in OWN_CAMERAS]
    np.testing.assert_allclose(rig.cameras.centre_world[:, 2], heights_m, atol=1e-9)
    for name in ("dron1", "dron2"):
        # Columns of TUM files: time, x, y, z, quaternion.
        rows = np.loadtxt(folder / f"{name}.tum")
        assert rows.shape == (25, 8)
        assert rows[:, 3].min() > 0.3
    record = json.loads((folder / "simulation.json").read_text())
    assert record["board"]["squares_wh"] == [4, 5]
