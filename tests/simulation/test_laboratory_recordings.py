"""Recordings as a laboratory makes them: own cameras and a board; and the layout of the dataset's real half."""

import json
import shutil

import cv2
import numpy as np
import pytest
from helpers import make_once, read_mocap_markers
from msgspec.structs import replace
from placed_drones import S02
from scipy.interpolate import CubicSpline

from psotrack.geometry import Rig, look_at, make_camera, project
from psotrack.geometry.rig_files import read_rig, write_calibration
from psotrack.recordings import probe
from psotrack.recordings.datasets import CALIBRATION, DETECTIONS, read_sequence
from psotrack.recordings.mocap import Markers, write_c3d
from psotrack.simulation import OWN_CAMERAS, SimulationSettings, simulate
from psotrack.simulation.imaging.lens_image import lens_image
from psotrack.simulation.imaging.posed_board import PosedBoard, board_poses, draw_board, own_board
from psotrack.simulation.imaging.raster import pinhole
from psotrack.simulation.own_cameras import own_rig
from psotrack.simulation.world.halls import RIGS


def lens():
    R, t_m = look_at((0.3, -3.0, 1.5), (0.0, 0.2, 1.0))
    K = np.array([[620.0, 0, 318.0], [0, 625.0, 242.0], [0, 0, 1]])
    return make_camera(R=R, t_m=t_m, K=K, image_size_wh=(640, 480), dist=(-0.2, 0.05, 0.001, -0.0005))


def board(turn_deg=(0.0, 0.0)):
    R, _ = look_at((0.3 + turn_deg[0] / 20, -3.0, 1.5), (0.1, 0.0, 1.1))
    return PosedBoard(R.T, np.array([-0.35, 0.0, 1.7]))


def grey_image(cam):
    return np.full((cam.height, cam.width, 3), 90, np.uint8)


def test_the_board_is_where_opencv_projects_it():
    """Drawn into the images of which the lens's image consists, against `projectPoints` with distortion."""
    camera, places = lens(), board((15.0, 0.0))
    seen = lens_image(camera)
    image = seen.assemble([draw_board(grey_image(cam), cam, places) for cam in seen.faces])
    assert image.shape == (480, 640, 3)
    found, ids, *_ = cv2.aruco.CharucoDetector(own_board().opencv()).detectBoard(image)
    on_board = own_board().corners_m[np.asarray(ids).ravel()]
    points_m = places.corner_m + on_board @ places.axes.T
    T = camera.T_cam_world
    expected = cv2.projectPoints(points_m, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.K, camera.dist)[0]
    assert len(found) == own_board().num_corners
    np.testing.assert_allclose(found.reshape(-1, 2), expected[:, 0], rtol=0, atol=0.2)


def test_the_back_of_the_board_shows_nothing_and_a_board_behind_the_camera_is_not_seen():
    cam, places = pinhole(lens()), board()
    grey = grey_image(cam)
    turned = PosedBoard(places.axes * [-1, 1, -1], places.corner_m + places.axes[:, 0])
    seen = draw_board(grey, cam, turned)
    assert set(np.unique(seen)) <= set(range(90, 121))
    assert (seen == 120).sum() > 10_000
    behind = PosedBoard(places.axes, np.array([0.0, -9.0, 1.0]))
    np.testing.assert_array_equal(draw_board(grey, cam, behind), grey)


def test_neighbours_see_the_board_together_and_it_is_tilted():
    rig = own_rig(1.0)
    places = board_poses(rig, 33, seed=1)
    assert [place.corner_m[2] for place in places].count(0.0) == 1
    for place in places:
        np.testing.assert_allclose(place.axes @ place.axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(place.axes) == pytest.approx(1)
    corners = np.stack([place.corner_m + own_board().corners_m @ place.axes.T for place in places])
    front = np.stack([-place.axes[:, 2] for place in places])
    seen = []
    for camera in (rig.cameras[index] for index in range(len(rig))):
        pixels, depth = project(camera, corners)
        inside = ((pixels > 0) & (pixels < camera.image_size_wh - 1)).all(axis=(1, 2)) & (depth > 0).all(
            axis=1
        )
        towards = ((camera.centre_world - corners.mean(axis=1)) * front).sum(axis=-1)
        seen.append(inside & (towards > 0))
    shared = np.array(seen, int) @ np.array(seen, int).T
    assert (np.diag(shared) >= 8).all()
    left, right, gopro, serial = range(4)
    assert min(shared[left, gopro], shared[gopro, serial], shared[serial, right]) >= 4


def test_the_folder_of_a_laboratory(tmp_path, run_psotrack):
    folder = tmp_path / "lab"
    small = ("--scale", 0.1, "--frames", 6, "--jobs", 1, "-q")
    result = run_psotrack("simulate", "S01_D2_A", "--as-own-cameras", "--out", folder, *small)
    assert result.code == 0, result.err
    for camera in OWN_CAMERAS:
        flight, calibration = probe(folder / camera.flight), probe(folder / "board" / f"{camera.name}.avi")
        size = tuple(round(side * 0.1) for side in camera.size)
        assert flight.image_size_wh == calibration.image_size_wh == size
        assert flight.fps == pytest.approx(camera.fps, abs=1e-3)
        # The flight takes 0.24 s.
        assert flight.num_frames == int((0.24 - camera.start_s) * camera.fps)
        assert calibration.num_frames == 48
    assert len({camera.fps for camera in OWN_CAMERAS}) == 3
    rig = read_rig(folder / "truth" / "rig.toml")
    assert rig.names == tuple(camera.name for camera in OWN_CAMERAS)
    record = json.loads((folder / "simulation.json").read_text())
    assert record["board"]["squares_wh"] == [4, 5]
    # The board's corner on the floor is the origin of the world in which rig and reference are written.
    for name in ("dron1", "dron2"):
        # Columns of TUM files: time, x, y, z, quaternion.
        rows = np.loadtxt(folder / f"{name}.tum")
        assert rows.shape == (25, 8)
        assert (rows[:, 3] > 0.3).all()
    heights = rig.cameras.centre_world[:, 2]
    np.testing.assert_allclose(heights, [camera.position_m[2] for camera in OWN_CAMERAS], atol=1e-9)


# --- the real half


#: Serial numbers of the dataset's cameras, without the fifth camera, which was a spare.
SERIALS = ("55260362", "56339527", "60881257", "61016180")
#: Focal length of the real half's calibration at the full image size, pixels.
FOCAL_LENGTH_PX = 1158.7
#: A weak barrel distortion, usual for this field of view. The distortion of the dataset's lenses is not known.
LENS = (-0.08, 0.02, 0.0004, -0.0003)
#: The reference's clock is ahead of the videos by this time, seconds: 9.4 frames of 25 Hz.
OFFSET_S = 0.377
#: Largest error of the offset that is estimated from the drones' motion, seconds: a tenth of a frame.
OFFSET_TOLERANCE_S = 0.004


def write_real_half(folder):
    """A sequence in the form of the real half of DPJAIT, which a Vicon system recorded, in Real_Data/R02_D4.

    Four cameras of one type with lens distortion are named by serial number, with a calibration in millimetres. The
    reference is one C3D file of marker crosses at 100 Hz, whose clock began earlier, with noise and a reflection on the
    floor. The middle of a cross is not the drone's body origin: evaluation finds the lever arm.
    """
    lens = {"focal_length_px": FOCAL_LENGTH_PX, "distortion": LENS}
    cameras = tuple(replace(place, **lens) for place in RIGS["laboratory_corners"])
    size = SimulationSettings(num_frames=80, scale=0.25, masks=False, onboard=False)
    simulated = read_sequence(simulate(replace(S02, cameras=cameras, markers=False), folder, size, jobs=1))
    real = folder / "Real_Data" / "R02_D4"
    (real / DETECTIONS).mkdir(parents=True)
    write_calibration(real / CALIBRATION, Rig(SERIALS, simulated.rig.cameras), unit="mm")
    for name, serial in zip(simulated.rig.names, SERIALS, strict=True):
        shutil.copy(simulated.videos[name].path, real / f"{serial}.avi")
        shutil.copy(simulated.detections[name], real / DETECTIONS / f"{serial}.csv")
    paths = sorted(simulated.folder.glob("dron*_markers_*.csv"))
    crosses_m = np.concatenate([read_mocap_markers(path) for path in paths], axis=1)
    # Before frame 0 the drones stand still.
    time_s = np.arange(0, 79 / 25 + OFFSET_S, 0.01) - OFFSET_S
    shown_m = CubicSpline(np.arange(80) / 25, crosses_m)(np.maximum(time_s, 0.0))
    shown_m += np.random.default_rng(0).normal(0.0, 0.0002, shown_m.shape)
    labels = [f"Dron{drone}:Dron{drone}{marker}" for drone in range(1, 5) for marker in range(1, 5)]
    reflection_m = np.tile((1.3, -1.1, 0.02), (len(time_s), 1, 1))
    markers = Markers((*labels, "*1"), np.concatenate([shown_m, reflection_m], axis=1), 100.0)
    write_c3d(real / "R02_D4.c3d", markers)


@pytest.mark.slow
def test_a_sequence_in_the_layout_of_the_real_half_through_every_command(
    tmp_path_factory, tmp_path, run_psotrack
):
    """The reference's clock is ahead of the videos; `evaluate` finds by how much, and removes it."""

    def run(*words):
        result = run_psotrack(*words, "--json", "-")
        assert result.code == 0, result.err
        return json.loads(result.out)

    sequence = make_once(tmp_path_factory, "real_half", write_real_half) / "Real_Data" / "R02_D4"
    content = run("init", "--show", sequence)
    assert list(content["cameras"]) == list(SERIALS)
    assert content["cameras"][SERIALS[0]]["focal_length_px"] == pytest.approx(0.25 * FOCAL_LENGTH_PX)
    tracks = tmp_path / "lines.csv"
    assert run_psotrack("track", sequence, "--out", tracks, "--method", "projection-lines", "-q").code == 0
    late, auto, given = (
        run("evaluate", tracks, sequence, *words)
        for words in ((), ("--offset", "auto"), ("--offset", OFFSET_S))
    )
    assert "reference_offset_s" not in late
    assert given["reference_offset_s"] == OFFSET_S
    assert auto["reference_offset_s"] == pytest.approx(OFFSET_S, abs=OFFSET_TOLERANCE_S)
    # Drones at about 1 m/s fly more than a third of a metre in 0.377 s.
    assert late["offset_removed_mean_error_m"] > 0.15
    for errors in (auto, given):
        assert (errors["id_switches"], errors["missed_rate"]) == (0, 0.0)
        # Measured 26 mm with four cameras at a third of the full image size.
        assert errors["offset_removed_mean_error_m"] < 0.04
        # The reference is the marker cross above the body; the tracked point is the centre of the whole drone's box.
        assert all(drone["offset_m"][2] < -0.03 for drone in errors["per_drone"])
    refused = run_psotrack("evaluate", tracks, sequence, "--offset", "soon")
    assert "expected a number of seconds, or auto, found 'soon'" in refused.err
