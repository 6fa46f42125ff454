"""A simulated sequence, written in the form of the real half: file layout, lens distortion, markers and their clock."""

import numpy as np
import pytest
from helpers import read_mocap_markers
from real_form import SERIALS, write_as_real
from scipy.spatial.transform import Rotation

from psotrack.geometry import project
from psotrack.recordings import read_detections
from psotrack.recordings.datasets import read_poses, read_sequence
from psotrack.recordings.mocap import marker_bodies, read_c3d
from psotrack.simulation import (
    SimulationSettings,
    change_scenario,
    scenario,
    simulate,
)
from psotrack.trajectories import Status, resample

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
    return write_as_real(simulated_folder, tmp_path_factory.mktemp("real"), offset_s=OFFSET_S, seed=3)


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


def at_frames(mocap, offset_s):
    """The drones of a recording at the frames of the videos."""
    frame = np.arange(NUM_FRAMES)
    return resample(marker_bodies(mocap, "R02_D4.c3d"), frame, frame / 25.0, later_s=offset_s)


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
    assert (marker_bodies(mocap, real_folder).status == Status.TRACKED).mean() > 0.9
    truth = at_frames(mocap, OFFSET_S)
    for drone in range(4):
        position_m, orientation_wxyz = read_poses(simulated_folder / f"dron{drone + 1}_pos_25.csv")
        body = Rotation.from_quat(orientation_wxyz[1:], scalar_first=True)
        seen = truth.seen[1:, drone]
        # For 0.2 s of the one second, two labels are swapped.
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
    late = at_frames(mocap, 0.0)
    off_m = np.linalg.norm(late.position_m - truth.position_m, axis=-1)
    assert np.nanmedian(off_m) > 0.05


@pytest.mark.parametrize("offset_s", [-0.5, 0.0, 1.0])
def test_the_mocap_recording_begins_at_the_offset(simulated_folder, tmp_path, offset_s):
    folder = write_as_real(simulated_folder, tmp_path, offset_s=offset_s, rate_hz=120.0)
    mocap = read_c3d(folder / "R02_D4.c3d")
    # The last frame of the videos is at 0.96 s.
    assert len(mocap.position_m) == round((0.96 + offset_s) * 120 - 0.25) + 1
    truth = at_frames(mocap, offset_s)
    first = next(frame for frame in range(NUM_FRAMES) if frame / 25 + offset_s >= 0)
    assert not truth.seen[:first].any()
    assert truth.seen[first:].mean() > 0.9


def test_one_video_can_be_left_out(simulated_folder, tmp_path):
    folder = write_as_real(simulated_folder, tmp_path, three_videos=True)
    recording = read_sequence(folder)
    assert recording.rig.names == SERIALS
    assert tuple(recording.videos) == tuple(recording.detections) == SERIALS[:3]
    assert recording.usable().rig.names == SERIALS[:3]
    assert recording.usable(SERIALS[:3]).num_frames == NUM_FRAMES
