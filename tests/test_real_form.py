"""A simulated sequence written as a real one: the layout, the lens, the markers and their clock."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from psotrack.cli.as_real import as_real
from psotrack.datasets.dpjait import read_detections, read_mocap_markers, read_poses, read_sequence
from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.geometry import project
from psotrack.recordings import body_trajectories, read_c3d, read_frames
from psotrack.simulation import (
    RealFormSettings,
    SimulationSettings,
    replaced,
    scenario,
    simulate,
    write_as_real,
)
from psotrack.simulation.real_form import SERIALS
from psotrack.trajectories import Status

NUM_FRAMES, OFFSET_S = 25, 0.377


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Four drones before the four cameras in the corners, a quarter of full size."""
    recipe = replaced(scenario("S02_D4_A"), {"cameras": "laboratory_corners", "markers": False})
    root = tmp_path_factory.mktemp("simulated")
    return simulate(
        recipe,
        root,
        SimulationSettings(num_frames=NUM_FRAMES, scale=0.25, masks=False, onboard=False),
        jobs=1,
    )


@pytest.fixture(scope="module")
def real(simulated, tmp_path_factory):
    return write_as_real(
        simulated, tmp_path_factory.mktemp("real"), RealFormSettings(offset_s=OFFSET_S, seed=3)
    )


def opencv(camera):
    """A camera's numbers as OpenCV takes them."""
    rvec, _ = cv2.Rodrigues(camera.T_cam_world[:3, :3])
    return rvec, camera.T_cam_world[:3, 3], camera.K, camera.dist


def test_the_layout_is_that_of_the_real_half(real):
    assert real.parts[-2:] == ("Real_Data", "R02_D4")
    videos, detections = {f"{serial}.avi" for serial in SERIALS}, {f"{serial}.csv" for serial in SERIALS}
    assert {path.name for path in real.iterdir()} == {
        "cameras_calibration.csv",
        "R02_D4.c3d",
        "dl_data",
        *videos,
    }
    assert {path.name for path in (real / "dl_data").iterdir()} == detections
    header = (real / "cameras_calibration.csv").read_text().splitlines()[0]
    assert header == (
        "cam_name;cam_x[mm];cam_y[mm];cam_z[mm];cam_or_x[rad];cam_or_y[rad];cam_or_z[rad];focal_length;cx;cy;"
        "coeff_1;coeff_2;coeff_3;coeff_4"
    )


def test_it_is_read_as_a_real_sequence(real, simulated):
    sequence, before = read_sequence(real).usable(), read_sequence(simulated)
    assert sequence.rig.names == SERIALS
    assert (sequence.fps, sequence.num_frames) == (25.0, NUM_FRAMES)
    cameras = sequence.rig.cameras
    # A quarter of 1924 x 1082, of even sides; focal length and centre likewise.
    assert cameras.image_size_wh.tolist() == [[480, 270]] * 4
    np.testing.assert_allclose(
        cameras.K[:, [0, 0], [0, 2]], [[1158.7 / 4, (962.5) / 4 - 0.5]] * 4, atol=1e-12
    )
    assert cameras.dist.shape == (4, 4)
    # Millimetres and rotation vectors, and back.
    np.testing.assert_allclose(cameras.centre_world, before.rig.cameras.centre_world, rtol=0, atol=1e-9)
    assert sequence.truth.drones == ("dron1", "dron2", "dron3", "dron4")
    assert set(sequence.detections) == set(SERIALS)


def test_pictures_are_those_that_the_lens_makes(real, simulated):
    """With the lens undone by OpenCV they are the simulated ones, in the middle of which nothing is repeated."""
    sequence, before = read_sequence(real), read_sequence(simulated)
    for serial, name in zip(SERIALS, before.rig.names, strict=True):
        cam, flat = (
            one.rig.cameras[one.rig.names.index(key)] for one, key in ((sequence, serial), (before, name))
        )
        maps = cv2.initUndistortRectifyMap(cam.K, cam.dist, np.eye(3), flat.K, (480, 270), cv2.CV_32FC1)
        frame = next(read_frames(sequence.videos[serial]))
        expected = next(read_frames(before.videos[name])).astype(float)
        undone = cv2.remap(frame, *maps, cv2.INTER_CUBIC).astype(float)
        inner = np.s_[20:-20, 30:-30]
        # Coding and resampling twice: measured 3.2 grey levels at most. With the lens left as it is: 6.7 and more.
        assert np.abs(undone - expected)[inner].mean() < 4
        assert np.abs(frame - expected)[inner].mean() > 5


def test_boxes_are_those_of_the_pictures(real, simulated):
    """OpenCV's lens puts the outlines of the simulated boxes inside the real ones, and up to their sides."""
    sequence, before = read_sequence(real), read_sequence(simulated)
    for serial, name in zip(SERIALS, before.rig.names, strict=True):
        found, there = (
            read_detections(one.detections[key]) for one, key in ((sequence, serial), (before, name))
        )
        assert found.frame.tolist() == there.frame.tolist()
        assert found.confidence.tolist() == there.confidence.tolist()
        cam, flat = (
            sequence.rig.cameras[SERIALS.index(serial)],
            before.rig.cameras[before.rig.names.index(name)],
        )
        for box, old in zip(found.xyxy, there.xyxy, strict=True):
            share = np.linspace(0, 1, 41)
            low, high = old[:2], old[2:]
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
            # Sides bend by less than a hundredth of a pixel more between the points that are looked at.
            np.testing.assert_allclose(box, expected, rtol=0, atol=0.02)


def test_drones_project_into_their_boxes(real, simulated):
    """What is drawn, boxed and calibrated fits together: half of the size of a box is far more than any fault."""
    sequence = read_sequence(real)
    position_m = np.stack(
        [read_poses(path)[0] for path in sorted(simulated.glob("dron?_pos_25.csv"))], axis=1
    )
    for serial, path in sequence.detections.items():
        detections, cam = read_detections(path), sequence.rig.cameras[SERIALS.index(serial)]
        pixels = project(cam, position_m[detections.frame])[0]
        low, high = detections.xyxy[:, None, :2], detections.xyxy[:, None, 2:]
        hit = ((pixels > low) & (pixels < high)).all(axis=-1).any(axis=1)
        # All but false alarms, and the placeholder of frame 0.
        assert hit[detections.frame > 0].mean() > 0.95


def test_the_reference_is_that_of_the_drones_at_its_offset(real, simulated):
    recording = read_c3d(real / "R02_D4.c3d")
    assert recording.rate_hz == 100.0
    assert recording.labels[:5] == (
        "Dron1:Dron11",
        "Dron1:Dron12",
        "Dron1:Dron13",
        "Dron1:Dron14",
        "Dron2:Dron21",
    )
    assert recording.labels[-1] == "*1"
    truth = body_trajectories(recording, fps=25.0, num_frames=NUM_FRAMES, where=real, offset_s=OFFSET_S)
    assert (truth.status == Status.TRACKED).mean() > 0.9
    for drone in range(4):
        position_m, orientation_wxyz = read_poses(simulated / f"dron{drone + 1}_pos_25.csv")
        body = Rotation.from_quat(orientation_wxyz[1:], scalar_first=True)
        seen = truth.seen[1:, drone]
        assert seen.mean() > 0.9
        arm_m = body.inv().apply(truth.position_m[1:, drone] - position_m[1:])[seen]
        in_body_m = body.inv().apply(
            read_mocap_markers(simulated / f"dron{drone + 1}_markers_25.csv")[1:].mean(axis=1)
            - position_m[1:]
        )
        # Noise of 0.2 mm in four markers or three, of which none is seen alone; a frame late is centimetres off.
        np.testing.assert_allclose(arm_m, in_body_m[seen], rtol=0, atol=1e-3)
        turned = Rotation.from_quat(truth.orientation_wxyz[1:, drone][seen], scalar_first=True)
        fixed = body[seen].inv() * turned
        assert np.degrees((fixed * fixed[0].inv()).magnitude()).max() < 0.7  # 0.3 mm in arms of 5 cm, twice
    late = body_trajectories(recording, fps=25.0, num_frames=NUM_FRAMES, where=real)
    off_m = np.linalg.norm(late.position_m - truth.position_m, axis=-1)
    assert np.nanmedian(off_m) > 0.05


def test_markers_hide_and_labels_swap(real):
    """The recording is no better than a real one: cleaned of this, it is what it should be (above)."""
    markers_m = read_c3d(real / "R02_D4.c3d").position_m[:, :-1]
    assert 0.001 < np.isnan(markers_m).all(axis=-1).mean() < 0.05
    by_drone = markers_m.reshape(len(markers_m), 4, 4, 3)
    arms_m = np.linalg.norm(by_drone[:, :, 1:] - by_drone[:, :, :-1], axis=-1)
    wrong = (np.abs(arms_m - np.nanmedian(arms_m, axis=0)) > 0.005).any(axis=-1)
    # Of each drone two labels for 20 frames, fewer where the recording ends.
    assert (wrong.sum(axis=0) <= 20).all()
    assert (wrong.sum(axis=0) >= 10).sum() >= 2


@pytest.mark.parametrize("offset_s", [-0.5, 0.0, 1.0])
def test_where_the_recording_begins(simulated, tmp_path, offset_s):
    folder = write_as_real(simulated, tmp_path, RealFormSettings(offset_s=offset_s, rate_hz=120.0))
    recording = read_c3d(folder / "R02_D4.c3d")
    # The videos' last frame is at 0.96 s.
    assert len(recording.position_m) == round((0.96 + offset_s) * 120 - 0.25) + 1
    truth = body_trajectories(recording, fps=25.0, num_frames=NUM_FRAMES, where=folder, offset_s=offset_s)
    first = next(frame for frame in range(NUM_FRAMES) if frame / 25 + offset_s >= 0)
    assert not truth.seen[:first].any()
    assert truth.seen[first:].mean() > 0.9


def test_three_videos(simulated, tmp_path):
    folder = write_as_real(simulated, tmp_path, RealFormSettings(three_videos=True))
    sequence = read_sequence(folder)
    assert sequence.rig.names == SERIALS
    assert tuple(sequence.videos) == tuple(sequence.detections) == SERIALS[:3]
    with pytest.raises(
        InputError, match="found none for 61016180; pass --cameras 55260362,56339527,60881257"
    ):
        sequence.usable()
    assert sequence.usable(SERIALS[:3]).num_frames == NUM_FRAMES


def test_the_seed_decides(simulated, real, tmp_path):
    one = write_as_real(simulated, tmp_path / "one", RealFormSettings(offset_s=OFFSET_S, seed=3))
    other = write_as_real(simulated, tmp_path / "other", RealFormSettings(offset_s=OFFSET_S, seed=4))
    assert (one / "R02_D4.c3d").read_bytes() == (real / "R02_D4.c3d").read_bytes()
    assert (other / "R02_D4.c3d").read_bytes() != (real / "R02_D4.c3d").read_bytes()


def test_what_cannot_be_written(simulated, real, tmp_path):
    with pytest.raises(
        OutputError,
        match=r"R02_D4: expected a path that does not exist yet, found an existing folder; pass --force",
    ):
        write_as_real(simulated, real.parents[1])
    with pytest.raises(SettingsError, match=r"offset_s: expected more than -0\.96 s, .* found -1"):
        write_as_real(simulated, tmp_path, RealFormSettings(offset_s=-1.0))
    with pytest.raises(SettingsError, match="rate_hz: expected a number above 0, found 0"):
        write_as_real(simulated, tmp_path, RealFormSettings(rate_hz=0.0))
    short = Path(shutil.copytree(simulated, tmp_path / "S77"))
    (short / "cam4i_s.avi").unlink()
    with pytest.raises(InputError, match="S77: expected videos of 4 cameras, found 3"):
        write_as_real(short, tmp_path)
    (tmp_path / "S78").mkdir()
    unmarked = Path(shutil.copytree(simulated, tmp_path / "S78", dirs_exist_ok=True))
    for path in unmarked.glob("dron*_markers_*"):
        path.unlink()
    with pytest.raises(InputError, match=r"S78: expected markers of its drones, dron1_markers_25\.csv"):
        write_as_real(unmarked, tmp_path)
    assert not (tmp_path / "Real_Data").exists()


def test_command(simulated, tmp_path):
    words = [
        simulated,
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
    result = CliRunner().invoke(as_real, [*map(str, words)], catch_exceptions=False)
    folder = tmp_path / "Real_Data" / "R02_D4"
    assert (result.exit_code, json.loads(result.stdout)) == (0, {"sequence": str(folder)})
    own = write_as_real(
        simulated, tmp_path / "own", RealFormSettings(offset_s=0.2, rate_hz=120.0, three_videos=True)
    )
    for path in own.iterdir():
        if path.is_file():
            assert (folder / path.name).read_bytes() == path.read_bytes(), path.name
    with pytest.raises(OutputError, match="R02_D4"):
        CliRunner().invoke(as_real, [*map(str, words)], catch_exceptions=False)
