"""Checks of a rig against its detections: each single fault is named, and a correct rig gives no finding."""

import json
import re
from dataclasses import replace

import cv2
import jaxtyping
import numpy as np
import pytest
from click.testing import CliRunner
from helpers import ring_rig
from scipy.spatial.transform import Rotation

import psotrack as pt
from psotrack.calibration.doctor import examine, sampled_frames
from psotrack.cli.doctor import doctor
from psotrack.errors import InputError
from psotrack.geometry import Rig, look_at, make_camera, make_rig, project
from psotrack.geometry.rig_files import write_calibration
from psotrack.recordings import Detections, write_detections
from psotrack.recordings.datasets import write_poses
from psotrack.tracking.matching import from_detections
from psotrack.trajectories import Trajectories

#: Each test takes some seconds.
pytestmark = pytest.mark.slow

FPS, FRAMES = 25.0, 30
SPAN_M = np.array([0.5, 0.2])


def flights(num_drones, frames=FRAMES, seed=0):
    """(frames, drones, 3), curves through the room, each drone at its own height, with speeds of about 1.5 m/s."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(frames)[:, None] / FPS
    phase = rng.uniform(0, 2 * np.pi, (3, num_drones))
    x_m = 1.5 * np.sin(0.9 * time_s + phase[0])
    y_m = 1.2 * np.sin(1.1 * time_s + phase[1])
    z_m = 0.6 + 0.45 * np.arange(num_drones) + 0.1 * np.sin(1.7 * time_s + phase[2])
    return np.stack([x_m, y_m, z_m], axis=-1)


def simulate_detections(rig, truth_m, *, late=None, missed=0.05, false_alarms=0.1, jitter=0.02, seed=0):
    """Simulate a detector's boxes around the drones.

    Args:
        rig: the true rig.
        truth_m: (frames, drones, 3), true positions.
        late: index of a camera -> frames by which its video shows the scene late.
        missed: share of drones that have no box.
        false_alarms: share of frames that have a false box.
        jitter: standard deviation of a box's middle, relative to its size.
        seed: of the random numbers.
    """
    rng = np.random.default_rng(seed)
    number = np.arange(len(truth_m))
    found = {}
    for index, name in enumerate(rig.names):
        one = rig.cameras[index]
        delay = (late or {}).get(index, 0.0)
        then = np.clip(number - delay, 0, len(truth_m) - 1)
        before = np.minimum(then.astype(int), len(truth_m) - 2)
        share = (then - before)[:, None, None]
        pixels, depth = project(one, (1 - share) * truth_m[before] + share * truth_m[before + 1])
        size = one.K[0, 0] * SPAN_M / depth[..., None]
        middle = pixels + 0.5 + jitter * size * rng.standard_normal(pixels.shape)
        inside = ((middle > 0) & (middle < one.image_size_wh)).all(axis=-1) & (
            rng.random(depth.shape) >= missed
        )
        frame, drone = np.nonzero(inside)
        low, high = (middle + sign * size / 2 for sign in (-1, 1))
        xyxy = np.concatenate([low, high], axis=-1)[frame, drone]
        alarm = np.flatnonzero(rng.random(len(truth_m)) < false_alarms)
        corner = rng.random((len(alarm), 2)) * (one.image_size_wh - 100)
        frame, xyxy = np.append(frame, alarm), np.concatenate([xyxy, np.hstack([corner, corner + 60])])
        order = np.argsort(frame, kind="stable")
        found[name] = Detections(frame[order], xyxy[order], np.ones(len(order)))
    return found


def make_reference(position_m):
    frame = np.arange(len(position_m))
    names = tuple(f"dron{drone + 1}" for drone in range(position_m.shape[1]))
    return Trajectories(frame, frame / FPS, names, position_m)


@pytest.fixture(autouse=True)
def _checked_once(request):
    """Check types only in the test of the command, which runs all of the code; checks in every test take minutes."""
    jaxtyping.config.update("jaxtyping_disable", request.function is not test_the_command)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


RIG = ring_rig(5, coefficients=4, image_size_wh=(1920, 1080))
TRUTH_M = flights(2)
SEEN = simulate_detections(RIG, TRUTH_M)


def examine_rig(rig, seen=SEEN, reference_m=TRUTH_M):
    sightings = from_detections(seen, rig, FRAMES)
    reference = None if reference_m is None else make_reference(reference_m)
    return examine(rig, sightings, fps=FPS, reference=reference)


def only_finding(*args, **kwargs):
    (finding,) = examine_rig(*args, **kwargs).findings
    return finding


def with_poses(R, t_m, rig=RIG):
    T = rig.cameras.T_cam_world.copy()
    T[:, :3, :3], T[:, :3, 3] = R, t_m
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


def with_displaced_camera(index, turn=(0.0, 0.0, 0.0), shift_m=(0.0, 0.0, 0.0)):
    """The rig with one camera that is turned about its own axes, degrees, and moved, metres."""
    R, centre = RIG.cameras.T_cam_world[:, :3, :3].copy(), RIG.cameras.centre_world.copy()
    R[index] = Rotation.from_rotvec(turn, degrees=True).as_matrix() @ R[index]
    centre[index] += shift_m
    return with_poses(R, -np.matvec(R, centre))


def with_focal_length(index, factor):
    """The rig with scaled focal lengths."""
    K = RIG.cameras.K.copy()
    K[index, :2, :2] *= factor
    return Rig(RIG.names, replace(RIG.cameras, K=K))


R, T_M = RIG.cameras.T_cam_world[:, :3, :3], RIG.cameras.T_cam_world[:, :3, 3]


@pytest.mark.parametrize("seed", range(10))
def test_a_correct_rig_has_no_findings(seed):
    """Rigs of 4 to 6 cameras, 2 or 3 drones, with and without distortion, with good and bad detectors."""
    rng = np.random.default_rng(seed)
    num_cameras, num_drones = 4 + seed % 3, 2 + seed % 2
    rig = ring_rig(num_cameras, coefficients=(0, 4, 5, 8)[seed % 4], image_size_wh=(1920, 1080))
    truth_m = flights(num_drones, seed=seed)
    noise = {"missed": 0.15 * rng.random(), "false_alarms": 0.3 * rng.random(), "jitter": 0.05 * rng.random()}
    diagnosis = examine_rig(rig, simulate_detections(rig, truth_m, seed=seed, **noise), truth_m)
    assert diagnosis.findings == ()
    assert diagnosis.reference_m < 0.05
    # An error of a quarter of a frame would be a finding.
    assert np.nanmax(np.abs(diagnosis.late_frames)) < 0.25


def test_a_turned_camera():
    finding = only_finding(with_displaced_camera(2, turn=(0.0, 1.0, 0.0)))
    assert (finding.kind, finding.cameras) == ("turned", ("c2",))
    (found,) = re.findall(r"turned by (\S+) degrees", finding.message)
    assert abs(float(found) - 1.0) < 0.15


def test_a_moved_camera():
    seen = simulate_detections(RIG, TRUTH_M, missed=0.0, false_alarms=0.0, jitter=0.0)
    finding = only_finding(with_displaced_camera(4, shift_m=(0.06, 0.06, 0.0)), seen)
    assert (finding.kind, finding.cameras) == ("moved", ("c4",))
    # Without noise, the shift is found exactly, except for errors from boxes that are matched with the wrong drone.
    assert "moved by 8 cm" in finding.message


@pytest.mark.parametrize(
    ("index", "displaced"),
    [
        (2, {"turn": (0.0, 8.0, 0.0)}),
        (4, {"shift_m": (0.3, 0.3, 0.0)}),
        (1, {"shift_m": (1.0, 0.0, 0.5)}),
    ],
)
def test_a_camera_that_was_turned_or_moved_far(index, displaced):
    finding = only_finding(with_displaced_camera(index, **displaced))
    assert (finding.kind, finding.cameras) == ("disagrees", (f"c{index}",))
    assert "it was turned or moved far" in finding.message


@pytest.mark.parametrize("delay", [0.6, 3.0])
def test_a_late_camera(delay):
    diagnosis = examine_rig(RIG, simulate_detections(RIG, TRUTH_M, late={1: delay}))
    (finding,) = diagnosis.findings
    assert (finding.kind, finding.cameras) == ("clock", ("c1",))
    assert "late" in finding.message
    reported_ms = float(finding.message.split(" ms late")[0].split()[-1])
    # A seventh of a frame, whose errors are those of the boxes.
    assert abs(reported_ms - 1e3 * delay / FPS) < 6


def test_camera_centres_instead_of_translations():
    finding = only_finding(with_poses(R, RIG.cameras.centre_world))
    assert (finding.kind, finding.cameras) == ("translation or centre", ())
    assert "rotation" not in finding.message


def test_poses_from_camera_to_world():
    finding = only_finding(with_poses(R.swapaxes(1, 2), RIG.cameras.centre_world))
    assert finding.kind == "translation or centre"
    assert "from camera to world" in finding.message


@pytest.mark.parametrize(
    ("factor", "words"), [(1e3, "millimetres were read as metres"), (1e-3, "metres were read as millimetres")]
)
def test_a_wrong_unit_of_length(factor, words):
    finding = only_finding(with_poses(R, factor * T_M))
    assert finding.kind == "unit"
    assert words in finding.message


def test_camera_axes_of_opengl():
    flip = np.array([1.0, -1.0, -1.0])
    finding = only_finding(with_poses(flip[:, None] * R, flip * T_M))
    assert finding.kind == "mirrored axes"
    assert "y, z are mirrored as in OpenGL" in finding.message


def test_a_left_handed_world():
    """The third axis of the world and of the cameras is mirrored, so rotations remain rotations."""
    flip = np.array([1.0, 1.0, -1.0])
    finding = only_finding(with_poses(flip[:, None] * R * flip, flip * T_M))
    assert finding.kind == "mirrored axes"
    assert "left-handed" in finding.message


def test_two_exchanged_cameras():
    """With two of four cameras exchanged, no three cameras agree."""
    rig = ring_rig(4, image_size_wh=(1920, 1080))
    seen = simulate_detections(rig, TRUTH_M)
    seen["c1"], seen["c3"] = seen["c3"], seen["c1"]
    finding = only_finding(rig, seen)
    assert (finding.kind, finding.cameras) == ("exchanged", ("c1", "c3"))


def test_a_wrong_focal_length():
    finding = only_finding(with_focal_length(3, 1.06))
    assert (finding.kind, finding.cameras) == ("focal length", ("c3",))
    assert re.search(r"(5\.[5-9]|6\.[0-3]) % too long", finding.message)


def test_all_focal_lengths_wrong():
    finding = only_finding(with_focal_length(slice(None), 1.15))
    assert (finding.kind, finding.cameras) == ("focal lengths", ())
    assert "too long" in finding.message


@pytest.mark.parametrize("factor", [0.96, 1.04])
def test_all_focal_lengths_a_little_wrong(factor):
    """The error is too small to be visible in a single sighting or in a single camera."""
    finding = only_finding(with_focal_length(slice(None), factor))
    assert (finding.kind, finding.cameras) == ("focal lengths", ())
    found = re.search(r"[34] % too (long|short) \(± (\S+) %\)", finding.message)
    assert found is not None, finding.message
    assert found[1] == ("long" if factor > 1 else "short")
    assert 0 < float(found[2]) < 0.7


@pytest.mark.parametrize(
    ("words", "reference_m"),
    [
        ("its extent is 1e+03 times theirs", 1e3 * TRUTH_M),
        ("`psotrack doctor --tracks`", np.roll(TRUTH_M, 8, axis=0)),
        ("check its unit and its axes", TRUTH_M * [1.0, -1.0, 1.0]),
        ("it is 1.1", TRUTH_M + np.array([1.0, 0.5, 0.0])),
        ("of this flight", flights(2, seed=9) * [0.2, 3.0, 1.0]),
    ],
)
def test_a_reference_that_contradicts_the_rig(words, reference_m):
    finding = only_finding(RIG, reference_m=reference_m)
    assert finding.kind == "reference"
    assert words in str(finding)


def test_detections_of_different_flights_have_no_explanation():
    """Each camera sees another flight, so no fault of the rig may be reported."""
    seen = {
        name: simulate_detections(RIG, flights(2, seed=20 + index))[name]
        for index, name in enumerate(RIG.names)
    }
    assert only_finding(RIG, seen).kind == "no agreement"


@pytest.mark.parametrize("num_boxes", [0, 1])
def test_too_few_detections(num_boxes):
    seen = {name: Detections(boxes.frame[:num_boxes], boxes.xyxy[:num_boxes], boxes.confidence[:num_boxes])
            for name, boxes in SEEN.items()}  # fmt: skip
    assert only_finding(RIG, seen).kind == "too little seen"
    assert only_finding(RIG, {}).kind == "too little seen"


def test_sampled_frames_are_in_the_video():
    for num_frames in (0, 1, 10, 15, 40, 5000):
        frames = sampled_frames(num_frames)
        assert len(frames) == min(num_frames, 168) or 12 <= len(frames) <= 168
        assert ((frames >= 0) & (frames < num_frames)).all()


def write_sequence(folder, rig, seen, truth_m):
    (folder / "dl_data").mkdir(parents=True)
    write_calibration(folder / "cameras_calibration.csv", rig)
    for name in rig.names:
        write_detections(folder / "dl_data" / f"{name}.csv", seen[name])
        video = cv2.VideoWriter(str(folder / f"{name}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), FPS, (320, 240))
        for _ in range(len(truth_m)):
            video.write(np.zeros((240, 320, 3), np.uint8))
        video.release()
    for drone in range(truth_m.shape[1]):
        turned = np.tile([1.0, 0.0, 0.0, 0.0], (len(truth_m), 1))
        write_poses(folder / f"dron{drone + 1}_pos_25.csv", truth_m[:, drone], turned)
    return folder


def test_the_command(tmp_path):
    small = ring_rig(4)
    K = small.cameras.K.copy()
    K[:, 1, 1] = K[:, 0, 0]
    small = Rig(small.names, replace(small.cameras, K=K))
    seen = simulate_detections(small, TRUTH_M)
    folder = write_sequence(tmp_path / "correct", small, seen, TRUTH_M)
    result = CliRunner(env={"COLUMNS": "200"}).invoke(doctor, [str(folder)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "nothing disagrees" in result.output
    found = pt.doctor(folder)
    assert len(str(found).splitlines()) == len(result.output.splitlines())
    assert repr(found) == "Diagnosis(nothing disagrees)"
    assert "detections/frame" in found._repr_html_()

    with_centres = with_poses(small.cameras.T_cam_world[:, :3, :3], small.cameras.centre_world, small)
    folder = write_sequence(tmp_path / "with_centres", with_centres, seen, TRUTH_M)
    result = CliRunner(env={"COLUMNS": "200"}).invoke(doctor, [str(folder), "-q"], catch_exceptions=False)
    assert result.exit_code == 1
    assert result.output.count("\n") == 1
    assert "write t = -R C" in result.output
    result = CliRunner().invoke(doctor, [str(folder), "--json", "-"], catch_exceptions=False)
    assert result.exit_code == 1
    content = json.loads(result.output)
    assert json.loads(json.dumps(pt.doctor(folder).to_dict())) == content
    assert [finding["kind"] for finding in content["findings"]] == ["translation or centre"]
    assert [row["camera"] for row in content["cameras"]] == list(small.names)


def test_a_correct_rig_with_few_frames_gets_no_finding_about_the_rig():
    """Ten frames of one drone agree with the rig, but are too few to judge it."""
    truth_m = flights(1)[:10]
    seen = from_detections(simulate_detections(RIG, truth_m), RIG, len(truth_m))
    (finding,) = examine(RIG, seen, fps=FPS).findings
    assert finding.kind == "too little seen"
    assert "the rig" not in finding.message


def follow(rig, body_m, rng, *, white_px, correlated_px, correlated_s):
    """Boxes of one body whose middles have white noise and an error that is correlated for some seconds."""
    seen, keep = {}, np.exp(-1 / (60.0 * correlated_s))
    for index, name in enumerate(rig.names):
        slow = rng.standard_normal((len(body_m), 2))
        for frame in range(1, len(slow)):
            slow[frame] = keep * slow[frame - 1] + np.sqrt(1 - keep**2) * slow[frame]
        error_px = correlated_px * slow + white_px * rng.standard_normal(slow.shape)
        middle = project(rig.cameras[index], body_m)[0] + 0.5 + error_px
        xyxy = np.concatenate([middle - 8, middle + 8], axis=-1)
        seen[name] = Detections(np.arange(len(middle)), xyxy, np.ones(len(middle)))
    return from_detections(seen, rig, len(body_m))


def outdoors(rng, angles, frames=900, fps=60.0):
    """Cameras on a circle of 60 m, and the path of a body above its middle."""
    K, cameras = np.array([[1400.0, 0.0, 960.0], [0.0, 1400.0, 540.0], [0.0, 0.0, 1.0]]), {}
    for index, angle in enumerate(angles):
        R, t_m = look_at([60 * np.cos(angle), 60 * np.sin(angle), 2.0], (0.0, 0.0, 15.0))
        cameras[f"cam{index + 1}"] = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1920, 1080))
    phase, rate = rng.uniform(0, 6.28, 3), rng.uniform(0.2, 0.5, 3)
    angle = np.arange(frames)[:, None] / fps * rate + phase
    return make_rig(cameras), np.array([6.0, 6.0, 2.4]) * np.sin(angle) + np.array([0.0, 0.0, 15.0])


@pytest.mark.parametrize("seed", [0, 10, 12])
def test_a_rig_that_explains_nothing_is_not_sound(seed):
    """Every camera is turned by about a degree, 20 px: no three cameras agree, and no single fault explains it."""
    rng = np.random.default_rng(seed)
    rig, body_m = outdoors(rng, [0.0, 2.1, 4.2])
    sightings = follow(rig, body_m, rng, white_px=0.3, correlated_px=0.5, correlated_s=0.3)
    T = rig.cameras.T_cam_world.copy()
    for index in range(3):
        degrees, axis = rng.uniform(0.4, 1.2), rng.normal(size=3)
        turn = Rotation.from_rotvec(degrees * axis / np.linalg.norm(axis), degrees=True)
        T[index, :3] = turn.as_matrix() @ T[index, :3]
    diagnosis = examine(Rig(rig.names, replace(rig.cameras, T_cam_world=T)), sightings, fps=60.0)
    assert diagnosis.to_dict()["explained"] < 0.05
    assert diagnosis.findings


@pytest.mark.parametrize("seed", [4, 5, 7])
def test_a_verdict_agrees_with_the_residuals(seed):
    """Sound rigs of three cameras and one body; correlated errors look a little like a turn of several pixels."""
    rng = np.random.default_rng(seed)
    rig, body_m = outdoors(rng, [-0.5, 0.0, 0.5])
    sightings = follow(rig, body_m, rng, white_px=0.3, correlated_px=2.5, correlated_s=2.0)
    assert examine(rig, sightings, fps=60.0).findings == ()


def test_two_cameras_are_checked():
    """Two cameras show whether they agree, but not which of them is wrong."""
    rig, truth_m = RIG.select(RIG.names[:2]), flights(2, frames=200)
    seen = simulate_detections(rig, truth_m)
    diagnosis = examine(rig, from_detections(seen, rig, 200), fps=FPS, reference=make_reference(truth_m))
    assert diagnosis.findings == ()
    assert diagnosis.to_dict()["explained"] > 0.85
    T = rig.cameras.T_cam_world.copy()
    T[1, :3] = Rotation.from_rotvec([1.0, 0.0, 0.0], degrees=True).as_matrix() @ T[1, :3]
    wrong = Rig(rig.names, replace(rig.cameras, T_cam_world=T))
    diagnosis = examine(wrong, from_detections(seen, rig, 200), fps=FPS)
    (finding,) = diagnosis.findings
    assert (finding.kind, finding.cameras) == ("unclear", rig.names)
    assert diagnosis.residual_px.min() > 10


def test_cameras_without_a_place_are_named(tmp_path):
    """Detections, sizes and rates are known, but no camera has a place."""
    lines = ["version = 1"]
    for name in ("left", "right"):
        write_detections(tmp_path / f"{name}.csv", SEEN["c0"])
        lines += [
            f"[cameras.{name}]",
            f'detections = "{name}.csv"',
            "size = [1920, 1080]",
            "fps = 25.0",
        ]
    (tmp_path / "recording.toml").write_text("\n".join(lines) + "\n")
    with pytest.raises(
        InputError, match="cameras whose lens and place are known, found none for left, right"
    ):
        pt.doctor(tmp_path)
