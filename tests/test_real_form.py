"""A simulated sequence, written in the form of the real half: file layout, lens distortion, markers and their clock."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from psotrack.cli.as_real import as_real
from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.geometry import project
from psotrack.recordings import read_detections, read_frames
from psotrack.recordings.datasets import read_mocap_markers, read_poses, read_sequence
from psotrack.recordings.mocap import body_trajectories, read_c3d
from psotrack.simulation import (
    RealFormSettings,
    SimulationSettings,
    change_scenario,
    scenario,
    simulate,
    write_as_real,
)
from psotrack.simulation.real_form import SERIALS
from psotrack.trajectories import Status

pytestmark = pytest.mark.slow

NUM_FRAMES, OFFSET_S = 25, 0.377


@pytest.fixture(scope="module")
def simulated_folder(tmp_path_factory):
    """A sequence of four drones and the four cameras in the corners, at a quarter of the full image size."""
    recipe = change_scenario(scenario("S02_D4_A"), {"cameras": "laboratory_corners", "markers": False})
    root = tmp_path_factory.mktemp("simulated")
    return simulate(
        recipe,
        root,
        SimulationSettings(num_frames=NUM_FRAMES, scale=0.25, masks=False, onboard=False),
        jobs=1,
    )


@pytest.fixture(scope="module")
def real_folder(simulated_folder, tmp_path_factory):
    return write_as_real(
        simulated_folder, tmp_path_factory.mktemp("real"), RealFormSettings(offset_s=OFFSET_S, seed=3)
    )


def opencv_camera(camera):
    """Return the parameters of a camera in OpenCV's form: rotation vector, translation, K, distortion."""
    rvec, _ = cv2.Rodrigues(camera.T_cam_world[:3, :3])
    return rvec, camera.T_cam_world[:3, 3], camera.K, camera.dist


def test_the_files_have_the_layout_of_the_real_half(real_folder):
    assert real_folder.parts[-2:] == ("Real_Data", "R02_D4")
    videos, detections = {f"{serial}.avi" for serial in SERIALS}, {f"{serial}.csv" for serial in SERIALS}
    assert {path.name for path in real_folder.iterdir()} == {
        "cameras_calibration.csv",
        "R02_D4.c3d",
        "dl_data",
        *videos,
    }
    assert {path.name for path in (real_folder / "dl_data").iterdir()} == detections
    header = (real_folder / "cameras_calibration.csv").read_text().splitlines()[0]
    assert header == (
        "cam_name;cam_x[mm];cam_y[mm];cam_z[mm];cam_or_x[rad];cam_or_y[rad];cam_or_z[rad];focal_length;cx;cy;"
        "coeff_1;coeff_2;coeff_3;coeff_4"
    )


def test_the_folder_is_read_as_a_real_sequence(real_folder, simulated_folder):
    recording, simulated_recording = read_sequence(real_folder).usable(), read_sequence(simulated_folder)
    assert recording.rig.names == SERIALS
    assert (recording.fps, recording.num_frames) == (25.0, NUM_FRAMES)
    cameras = recording.rig.cameras
    # The image size is a quarter of 1924 x 1082, rounded to even sides; focal length and centre are scaled too.
    assert cameras.image_size_wh.tolist() == [[480, 270]] * 4
    np.testing.assert_allclose(
        cameras.K[:, [0, 0], [0, 2]], [[1158.7 / 4, (962.5) / 4 - 0.5]] * 4, atol=1e-12
    )
    assert cameras.dist.shape == (4, 4)
    # The file stores millimetres and rotation vectors; converting them back is exact to 1e-9 m.
    np.testing.assert_allclose(
        cameras.centre_world, simulated_recording.rig.cameras.centre_world, rtol=0, atol=1e-9
    )
    assert recording.truth.drones == ("dron1", "dron2", "dron3", "dron4")
    assert set(recording.detections) == set(SERIALS)


def test_frames_are_distorted_by_the_lens(real_folder, simulated_folder):
    """Undistorting a frame by OpenCV gives the simulated frame; only the inner part is compared."""
    recording, simulated_recording = read_sequence(real_folder), read_sequence(simulated_folder)
    for serial, name in zip(SERIALS, simulated_recording.rig.names, strict=True):
        cam, flat = (
            source.rig.cameras[source.rig.names.index(key)]
            for source, key in ((recording, serial), (simulated_recording, name))
        )
        maps = cv2.initUndistortRectifyMap(cam.K, cam.dist, np.eye(3), flat.K, (480, 270), cv2.CV_32FC1)
        frame = next(read_frames(recording.videos[serial]))
        expected = next(read_frames(simulated_recording.videos[name])).astype(float)
        undistorted = cv2.remap(frame, *maps, cv2.INTER_CUBIC).astype(float)
        inner = np.s_[20:-20, 30:-30]
        # Encoding and resampling twice: measured 3.2 grey levels at most; without undistortion at least 6.7.
        assert np.abs(undistorted - expected)[inner].mean() < 4
        assert np.abs(frame - expected)[inner].mean() > 5


def test_boxes_are_distorted_like_the_frames(real_folder, simulated_folder):
    """OpenCV distorts the outline of a simulated box; the written box bounds the distorted outline."""
    recording, simulated_recording = read_sequence(real_folder), read_sequence(simulated_folder)
    for serial, name in zip(SERIALS, simulated_recording.rig.names, strict=True):
        found, simulated_boxes = (
            read_detections(source.detections[key])
            for source, key in ((recording, serial), (simulated_recording, name))
        )
        assert found.frame.tolist() == simulated_boxes.frame.tolist()
        assert found.confidence.tolist() == simulated_boxes.confidence.tolist()
        cam, flat = (
            recording.rig.cameras[SERIALS.index(serial)],
            simulated_recording.rig.cameras[simulated_recording.rig.names.index(name)],
        )
        for box, simulated_box in zip(found.xyxy, simulated_boxes.xyxy, strict=True):
            share = np.linspace(0, 1, 41)
            low, high = simulated_box[:2], simulated_box[2:]
            sides = [
                np.stack([low[0] + share * (high - low)[0], np.full(41, y)], -1) for y in (low[1], high[1])
            ]
            sides += [
                np.stack([np.full(41, x), low[1] + share * (high - low)[1]], -1) for x in (low[0], high[0])
            ]
            rays = (np.concatenate(sides) - flat.K[:2, 2]) / flat.K[0, 0]
            rays = np.column_stack([rays, np.ones(len(rays))])
            outline = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), cam.K, cam.dist)[0][:, 0]
            expected = np.hstack([outline.min(axis=0), outline.max(axis=0)])
            # Between the 41 points of a side, the curved side deviates by less than a hundredth of a pixel.
            np.testing.assert_allclose(box, expected, rtol=0, atol=0.02)


def test_drones_project_into_their_boxes(real_folder, simulated_folder):
    """Frames, boxes and calibration agree: each box holds the projection of a drone."""
    recording = read_sequence(real_folder)
    position_m = np.stack(
        [read_poses(path)[0] for path in sorted(simulated_folder.glob("dron?_pos_25.csv"))], axis=1
    )
    for serial, path in recording.detections.items():
        detections, cam = read_detections(path), recording.rig.cameras[SERIALS.index(serial)]
        pixels = project(cam, position_m[detections.frame])[0]
        low, high = detections.xyxy[:, None, :2], detections.xyxy[:, None, 2:]
        is_hit = ((pixels > low) & (pixels < high)).all(axis=-1).any(axis=1)
        # False alarms, and the placeholder pose of frame 0, are not hit.
        assert is_hit[detections.frame > 0].mean() > 0.95


def test_the_reference_follows_the_drones_with_its_clock_offset(real_folder, simulated_folder):
    mocap = read_c3d(real_folder / "R02_D4.c3d")
    assert mocap.rate_hz == 100.0
    assert mocap.labels[:5] == (
        "Dron1:Dron11",
        "Dron1:Dron12",
        "Dron1:Dron13",
        "Dron1:Dron14",
        "Dron2:Dron21",
    )
    assert mocap.labels[-1] == "*1"
    truth = body_trajectories(mocap, fps=25.0, num_frames=NUM_FRAMES, where=real_folder, offset_s=OFFSET_S)
    assert (truth.status == Status.TRACKED).mean() > 0.9
    for drone in range(4):
        position_m, orientation_wxyz = read_poses(simulated_folder / f"dron{drone + 1}_pos_25.csv")
        body = Rotation.from_quat(orientation_wxyz[1:], scalar_first=True)
        seen = truth.seen[1:, drone]
        assert seen.mean() > 0.9
        arm_m = body.inv().apply(truth.position_m[1:, drone] - position_m[1:])[seen]
        in_body_m = body.inv().apply(
            read_mocap_markers(simulated_folder / f"dron{drone + 1}_markers_25.csv")[1:].mean(axis=1)
            - position_m[1:]
        )
        # Three or four markers have a noise of 0.2 mm each; an error of one frame would be centimetres.
        np.testing.assert_allclose(arm_m, in_body_m[seen], rtol=0, atol=1e-3)
        turned = Rotation.from_quat(truth.orientation_wxyz[1:, drone][seen], scalar_first=True)
        fixed = body[seen].inv() * turned
        assert (
            np.degrees((fixed * fixed[0].inv()).magnitude()).max() < 0.7
        )  # errors of 0.3 mm in arms of 5 cm, in two frames
    late = body_trajectories(mocap, fps=25.0, num_frames=NUM_FRAMES, where=real_folder)
    off_m = np.linalg.norm(late.position_m - truth.position_m, axis=-1)
    assert np.nanmedian(off_m) > 0.05


def test_markers_are_missing_and_labels_are_swapped_sometimes(real_folder):
    """The written markers have the gaps and swapped labels of a real mocap recording.

    The test of the reference shows that reading repairs them.
    """
    markers_m = read_c3d(real_folder / "R02_D4.c3d").position_m[:, :-1]
    assert 0.001 < np.isnan(markers_m).all(axis=-1).mean() < 0.05
    by_drone = markers_m.reshape(len(markers_m), 4, 4, 3)
    arms_m = np.linalg.norm(by_drone[:, :, 1:] - by_drone[:, :, :-1], axis=-1)
    wrong = (np.abs(arms_m - np.nanmedian(arms_m, axis=0)) > 0.005).any(axis=-1)
    # Two labels of each drone are swapped for 20 frames, or fewer at the end of the recording.
    assert (wrong.sum(axis=0) <= 20).all()
    assert (wrong.sum(axis=0) >= 10).sum() >= 2


@pytest.mark.parametrize("offset_s", [-0.5, 0.0, 1.0])
def test_the_mocap_recording_begins_at_the_offset(simulated_folder, tmp_path, offset_s):
    folder = write_as_real(simulated_folder, tmp_path, RealFormSettings(offset_s=offset_s, rate_hz=120.0))
    mocap = read_c3d(folder / "R02_D4.c3d")
    # The last frame of the videos is at 0.96 s.
    assert len(mocap.position_m) == round((0.96 + offset_s) * 120 - 0.25) + 1
    truth = body_trajectories(mocap, fps=25.0, num_frames=NUM_FRAMES, where=folder, offset_s=offset_s)
    first = next(frame for frame in range(NUM_FRAMES) if frame / 25 + offset_s >= 0)
    assert not truth.seen[:first].any()
    assert truth.seen[first:].mean() > 0.9


def test_one_video_can_be_left_out(simulated_folder, tmp_path):
    folder = write_as_real(simulated_folder, tmp_path, RealFormSettings(three_videos=True))
    recording = read_sequence(folder)
    assert recording.rig.names == SERIALS
    assert tuple(recording.videos) == tuple(recording.detections) == SERIALS[:3]
    assert recording.usable().rig.names == SERIALS[:3]
    assert recording.usable(SERIALS[:3]).num_frames == NUM_FRAMES


def test_the_mocap_noise_depends_on_the_seed(simulated_folder, real_folder, tmp_path):
    same_seed = write_as_real(simulated_folder, tmp_path / "one", RealFormSettings(offset_s=OFFSET_S, seed=3))
    other_seed = write_as_real(
        simulated_folder, tmp_path / "other", RealFormSettings(offset_s=OFFSET_S, seed=4)
    )
    assert (same_seed / "R02_D4.c3d").read_bytes() == (real_folder / "R02_D4.c3d").read_bytes()
    assert (other_seed / "R02_D4.c3d").read_bytes() != (real_folder / "R02_D4.c3d").read_bytes()


def test_invalid_input_is_refused(simulated_folder, real_folder, tmp_path):
    with pytest.raises(
        OutputError,
        match=r"R02_D4: expected a path that does not exist yet, found an existing folder; pass --force",
    ):
        write_as_real(simulated_folder, real_folder.parents[1])
    with pytest.raises(SettingsError, match=r"offset_s: expected more than -0\.96 s, .* found -1"):
        write_as_real(simulated_folder, tmp_path, RealFormSettings(offset_s=-1.0))
    with pytest.raises(SettingsError, match="rate_hz: expected a number above 0, found 0"):
        write_as_real(simulated_folder, tmp_path, RealFormSettings(rate_hz=0.0))
    short = Path(shutil.copytree(simulated_folder, tmp_path / "S77"))
    (short / "cam4i_s.avi").unlink()
    with pytest.raises(InputError, match="S77: expected videos of 4 cameras, found 3"):
        write_as_real(short, tmp_path)
    (tmp_path / "S78").mkdir()
    unmarked = Path(shutil.copytree(simulated_folder, tmp_path / "S78", dirs_exist_ok=True))
    for path in unmarked.glob("dron*_markers_*"):
        path.unlink()
    with pytest.raises(InputError, match=r"S78: expected markers of its drones, dron1_markers_25\.csv"):
        write_as_real(unmarked, tmp_path)
    assert not (tmp_path / "Real_Data").exists()


def test_command(simulated_folder, tmp_path):
    arguments = [
        simulated_folder,
        "--out",
        tmp_path,
        "--offset",
        "0.2",
        "--rate",
        "120",
        "--three-videos",
        "--json",
        "-",
    ]
    result = CliRunner().invoke(as_real, [*map(str, arguments)], catch_exceptions=False)
    folder = tmp_path / "Real_Data" / "R02_D4"
    assert (result.exit_code, json.loads(result.stdout)) == (0, {"sequence": str(folder)})
    own = write_as_real(
        simulated_folder, tmp_path / "own", RealFormSettings(offset_s=0.2, rate_hz=120.0, three_videos=True)
    )
    for path in own.iterdir():
        if path.is_file():
            assert (folder / path.name).read_bytes() == path.read_bytes(), path.name
    with pytest.raises(OutputError, match="R02_D4"):
        CliRunner().invoke(as_real, [*map(str, arguments)], catch_exceptions=False)
