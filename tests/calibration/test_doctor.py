"""Checks of a rig against its detections: each single fault is named, and a correct rig gives no finding."""

import json
import re
import runpy
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from helpers import ring_rig
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

import psotrack as pt
from psotrack.calibration.doctor import evidence, examine, sampled_frames
from psotrack.calibration.doctor.common_points import CommonPoints
from psotrack.calibration.doctor.corrections import PER_CAMERA, Corrected, WeightedPoints, linearise, weigh
from psotrack.geometry import Rig, look_at, make_camera, make_rig, project
from psotrack.geometry.rig_files import write_calibration
from psotrack.recordings import Detections, VideoWriter, write_detections
from psotrack.recordings.datasets import write_poses
from psotrack.tracking.matching import from_detections
from psotrack.trajectories import Trajectories

FPS, FRAMES = 25.0, 30
SPAN_M = np.array([0.5, 0.2])
SIZE_WH = (1920, 1080)
#: The rigs, bodies and detectors of the study, and whether a finding names what was planted.
JUDGE = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "calibration" / "doctor.py"))
make_case, judge, STUDY_FPS = JUDGE["make_case"], JUDGE["judge"], JUDGE["FPS"]


def flights(num_drones, frames=FRAMES, seed=0):
    """(frames, drones, 3), curves through the room, each drone at its own height, with speeds of about 1.5 m/s."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(frames)[:, None] / FPS
    phase = rng.uniform(0, 2 * np.pi, (3, num_drones))
    x_m = 1.5 * np.sin(0.9 * time_s + phase[0])
    y_m = 1.2 * np.sin(1.1 * time_s + phase[1])
    z_m = 0.6 + 0.45 * np.arange(num_drones) + 0.1 * np.sin(1.7 * time_s + phase[2])
    return np.stack([x_m, y_m, z_m], axis=-1)


def boxes_at(middle, half):
    """Boxes of one body in each frame, whose middles are pixels."""
    xyxy = np.concatenate([middle + 0.5 - half, middle + 0.5 + half], axis=-1)
    return Detections(np.arange(len(middle)), xyxy, np.ones(len(middle)))


def detect(rig, truth_m, *, late=None, missed=0.05, false_alarms=0.1, jitter=0.02, seed=0):
    """Boxes of a detector around the drones, by the name of the camera.

    Args:
        rig: the true rig.
        truth_m: (frames, drones, 3), true positions.
        late: index of a camera -> frames by which its video shows the scene late.
        missed: share of drones that have no box.
        false_alarms: share of frames that have a false box.
        jitter: standard deviation of a box's middle, relative to its size.
        seed: of the random numbers.
    """
    rng, number, found = np.random.default_rng(seed), np.arange(len(truth_m)), {}
    for index, name in enumerate(rig.names):
        one = rig.cameras[index]
        then = np.clip(number - (late or {}).get(index, 0.0), 0, len(truth_m) - 1)
        before = np.minimum(then.astype(int), len(truth_m) - 2)
        share = (then - before)[:, None, None]
        pixels, depth = project(one, (1 - share) * truth_m[before] + share * truth_m[before + 1])
        size = one.K[0, 0] * SPAN_M / depth[..., None]
        middle = pixels + 0.5 + jitter * size * rng.standard_normal(pixels.shape)
        inside = ((middle > 0) & (middle < one.image_size_wh)).all(axis=-1)
        frame, drone = np.nonzero(inside & (rng.random(depth.shape) >= missed))
        xyxy = np.concatenate([middle - size / 2, middle + size / 2], axis=-1)[frame, drone]
        alarm = np.flatnonzero(rng.random(len(truth_m)) < false_alarms)
        corner = rng.random((len(alarm), 2)) * (one.image_size_wh - 100)
        frame, xyxy = np.append(frame, alarm), np.concatenate([xyxy, np.hstack([corner, corner + 60])])
        order = np.argsort(frame, kind="stable")
        found[name] = Detections(frame[order], xyxy[order], np.ones(len(order)))
    return found


def reference_of(position_m):
    frame = np.arange(len(position_m))
    names = tuple(f"dron{drone + 1}" for drone in range(position_m.shape[1]))
    return Trajectories(frame, frame / FPS, names, position_m)


RIG = ring_rig(5, coefficients=4, image_size_wh=SIZE_WH)
TRUTH_M = flights(2)
SEEN = detect(RIG, TRUTH_M)


def examined(rig, seen=SEEN, reference_m=TRUTH_M, frames=FRAMES):
    reference = None if reference_m is None else reference_of(reference_m)
    return examine(rig, from_detections(seen, rig, frames), fps=FPS, reference=reference)


def only_finding(*args, **kwargs):
    (finding,) = examined(*args, **kwargs).findings
    return finding


def with_poses(R, t_m, rig=RIG):
    T = rig.cameras.T_cam_world.copy()
    T[:, :3, :3], T[:, :3, 3] = R, t_m
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


def turned(rig, index, turn_deg):
    """The rig with one camera that is turned about its own axes."""
    T = rig.cameras.T_cam_world.copy()
    T[index, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix() @ T[index, :3]
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


def moved(index, shift_m):
    T = RIG.cameras.T_cam_world
    centre = RIG.cameras.centre_world + np.outer(np.arange(len(RIG)) == index, shift_m)
    return with_poses(T[:, :3, :3], -np.matvec(T[:, :3, :3], centre))


def with_focal_length(index, factor):
    """The rig with scaled focal lengths."""
    K = RIG.cameras.K.copy()
    K[index, :2, :2] *= factor
    return Rig(RIG.names, replace(RIG.cameras, K=K))


R, T_M, CENTRES_M = (
    RIG.cameras.T_cam_world[:, :3, :3],
    RIG.cameras.T_cam_world[:, :3, 3],
    RIG.cameras.centre_world,
)
SLOW, NIGHTLY = pytest.mark.slow, pytest.mark.nightly
OPENGL, LEFT = np.array([1.0, -1.0, -1.0]), np.array([1.0, 1.0, -1.0])
EXACT = {"missed": 0.0, "false_alarms": 0.0, "jitter": 0.0}
IN_OPENGL = with_poses(OPENGL[:, None] * R, OPENGL * T_M)
#: The third axis of the world and of the cameras is mirrored, so rotations remain rotations.
LEFT_HANDED = with_poses(LEFT[:, None] * R * LEFT, LEFT * T_M)
ALL_WRONG, ALL_A_LITTLE = with_focal_length(slice(None), 1.15), with_focal_length(slice(None), 0.96)
#: Name of the fault -> a wrong rig, kind and cameras of the finding, and an expression for its message.
FAULTS = {
    "turned": (
        turned(RIG, 2, (0.0, 1.0, 0.0)),
        "turned",
        ("c2",),
        r"turned by (0\.[89]\d*|1\.[01]\d*) degrees",
    ),
    "turned far": (turned(RIG, 2, (0.0, 8.0, 0.0)), "disagrees", ("c2",), "it was turned or moved far"),
    "moved far": (moved(1, (1.0, 0.0, 0.5)), "disagrees", ("c1",), "it was turned or moved far"),
    "centres": (with_poses(R, CENTRES_M), "translation or centre", (), "^(?!.*rotation)"),
    "to the world": (with_poses(R.mT, CENTRES_M), "translation or centre", (), "from camera to world"),
    "millimetres": (with_poses(R, 1e3 * T_M), "unit", (), "millimetres were read as metres"),
    "metres": (with_poses(R, 1e-3 * T_M), "unit", (), "metres were read as millimetres"),
    "axes of OpenGL": (IN_OPENGL, "mirrored axes", (), "y, z are mirrored as in OpenGL"),
    "a left-handed world": (LEFT_HANDED, "mirrored axes", (), "left-handed"),
    "a lens": (with_focal_length(3, 1.06), "focal length", ("c3",), r"(5\.[5-9]|6\.[0-3]) % too long"),
    "all lenses": (ALL_WRONG, "focal lengths", (), "too long"),
    # The error is too small to be visible in a single sighting or in a single camera.
    "all a little": (ALL_A_LITTLE, "focal lengths", (), r"[34] % too short \(± 0\.[1-6]\d* %\)"),
}


@pytest.mark.parametrize(("rig", "kind", "cameras", "message"), FAULTS.values(), ids=FAULTS)
def test_a_fault_of_the_rig_is_named(rig, kind, cameras, message):
    finding = only_finding(rig)
    assert (finding.kind, finding.cameras) == (kind, cameras), finding
    assert re.search(message, finding.message), finding.message


def test_a_moved_camera():
    finding = only_finding(moved(4, (0.06, 0.06, 0.0)), detect(RIG, TRUTH_M, **EXACT))
    assert (finding.kind, finding.cameras) == ("moved", ("c4",))
    # Without noise, the shift is found exactly, except for errors from boxes that are matched with the wrong drone.
    assert "moved by 8 cm" in finding.message


@pytest.mark.parametrize("delay", [0.6, 3.0])
def test_a_late_camera(delay):
    finding = only_finding(RIG, detect(RIG, TRUTH_M, late={1: delay}))
    assert (finding.kind, finding.cameras) == ("clock", ("c1",))
    late_ms = float(finding.message.split(" ms late")[0].split()[-1])
    # A seventh of a frame, whose errors are those of the boxes.
    assert abs(late_ms - 1e3 * delay / FPS) < 6
    assert "--clocks auto" in finding.remedy
    assert f"add {-late_ms / 1e3:.2f}" in finding.remedy


def test_two_exchanged_cameras():
    """With two of four cameras exchanged, no three cameras agree."""
    rig = ring_rig(4, image_size_wh=SIZE_WH)
    seen = detect(rig, TRUTH_M)
    seen["c1"], seen["c3"] = seen["c3"], seen["c1"]
    finding = only_finding(rig, seen)
    assert (finding.kind, finding.cameras) == ("exchanged", ("c1", "c3"))


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


# Sound rigs, and rigs of which too little is seen.


@pytest.mark.parametrize("seed", [0, 2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (3, 5, 9))])
def test_a_correct_rig_has_no_findings(seed):
    """Rigs of 4 to 6 cameras, 2 or 3 drones, with and without distortion, with good and bad detectors."""
    rng = np.random.default_rng(seed)
    rig = ring_rig(4 + seed % 3, coefficients=(0, 4, 5, 8)[seed % 4], image_size_wh=SIZE_WH)
    truth_m = flights(2 + seed % 2, seed=seed)
    noise = {"missed": 0.15 * rng.random(), "false_alarms": 0.3 * rng.random(), "jitter": 0.05 * rng.random()}
    diagnosis = examined(rig, detect(rig, truth_m, seed=seed, **noise), truth_m)
    assert diagnosis.findings == ()
    assert diagnosis.reference_m < 0.05
    # An error of a quarter of a frame would be a finding.
    assert np.nanmax(np.abs(diagnosis.late_frames)) < 0.25


def test_too_few_detections_and_detections_of_different_flights_accuse_no_camera():
    one = {
        name: Detections(boxes.frame[:1], boxes.xyxy[:1], boxes.confidence[:1])
        for name, boxes in SEEN.items()
    }
    for seen in (one, {}):
        assert only_finding(RIG, seen).kind == "too little seen"
    # Ten frames of one drone agree with the rig, but are too few to judge it.
    truth_m = flights(1)[:10]
    finding = only_finding(RIG, detect(RIG, truth_m), None, frames=10)
    assert finding.kind == "too little seen"
    assert "the rig" not in finding.message
    # Each camera sees another flight.
    seen = {name: detect(RIG, flights(2, seed=20 + index))[name] for index, name in enumerate(RIG.names)}
    assert only_finding(RIG, seen).kind == "no agreement"


def test_two_cameras_are_checked():
    """Two cameras show whether they agree, but not which of them is wrong."""
    rig, truth_m = RIG.select(RIG.names[:2]), flights(2, frames=200)
    seen = detect(rig, truth_m)
    diagnosis = examined(rig, seen, truth_m, 200)
    assert diagnosis.findings == ()
    assert diagnosis.to_dict()["explained"] > 0.85
    diagnosis = examined(turned(rig, 1, [1.0, 0.0, 0.0]), seen, None, 200)
    (finding,) = diagnosis.findings
    assert (finding.kind, finding.cameras) == ("unclear", rig.names)
    assert diagnosis.residual_px.min() > 10


def test_sampled_frames_are_in_the_video():
    for num_frames in (0, 1, 10, 15, 40, 5000):
        frames = sampled_frames(num_frames)
        assert len(frames) == min(num_frames, 168) or 12 <= len(frames) <= 168
        assert ((frames >= 0) & (frames < num_frames)).all()


def outdoors(rng, angles, *, correlated_px, correlated_s):
    """Cameras on a circle of 60 m, and boxes of a body above its middle at 60 frames per second for 15 s.

    The middles of the boxes have white noise of 0.3 px and an error that is correlated for some seconds.
    """
    K, cameras = np.array([[1400.0, 0.0, 960.0], [0.0, 1400.0, 540.0], [0.0, 0.0, 1.0]]), {}
    for index, angle in enumerate(angles):
        pose = look_at([60 * np.cos(angle), 60 * np.sin(angle), 2.0], (0.0, 0.0, 15.0))
        cameras[f"cam{index + 1}"] = make_camera(R=pose[0], t_m=pose[1], K=K, image_size_wh=SIZE_WH)
    phase, rate = rng.uniform(0, 6.28, 3), rng.uniform(0.2, 0.5, 3)
    angle = np.arange(900)[:, None] / 60.0 * rate + phase
    body_m = np.array([6.0, 6.0, 2.4]) * np.sin(angle) + np.array([0.0, 0.0, 15.0])
    rig, seen, keep = make_rig(cameras), {}, np.exp(-1 / (60.0 * correlated_s))
    for index, name in enumerate(rig.names):
        slow = rng.standard_normal((900, 2))
        for frame in range(1, len(slow)):
            slow[frame] = keep * slow[frame - 1] + np.sqrt(1 - keep**2) * slow[frame]
        error_px = correlated_px * slow + 0.3 * rng.standard_normal(slow.shape)
        seen[name] = boxes_at(project(rig.cameras[index], body_m)[0] + error_px, 8)
    return rig, from_detections(seen, rig, 900)


@pytest.mark.parametrize("seed", [0, 10])
def test_a_rig_that_explains_nothing_is_not_sound(seed):
    """Every camera is turned by about a degree, 20 px: no three cameras agree, and no single fault explains it."""
    rng = np.random.default_rng(seed)
    rig, sightings = outdoors(rng, [0.0, 2.1, 4.2], correlated_px=0.5, correlated_s=0.3)
    for index in range(3):
        degrees, axis = rng.uniform(0.4, 1.2), rng.normal(size=3)
        rig = turned(rig, index, degrees * axis / np.linalg.norm(axis))
    diagnosis = examine(rig, sightings, fps=60.0)
    assert diagnosis.to_dict()["explained"] < 0.05
    assert diagnosis.findings


@pytest.mark.parametrize("seed", [4, 7])
def test_a_verdict_agrees_with_the_residuals(seed):
    """Sound rigs of three cameras and one body; correlated errors look a little like a turn of several pixels."""
    rng = np.random.default_rng(seed)
    rig, sightings = outdoors(rng, [-0.5, 0.0, 0.5], correlated_px=2.5, correlated_s=2.0)
    assert examine(rig, sightings, fps=60.0).findings == ()


def test_far_cameras_that_see_bodies_of_plausible_size_are_no_wrong_unit():
    """Cameras 400 m apart that see a body of two metres: metres, not millimetres."""
    rig, phase = ring_rig(4, image_size_wh=SIZE_WH, radius_m=4.0), 2 * np.pi * np.arange(60) / 60
    far = with_poses(rig.cameras.T_cam_world[:, :3, :3], 100 * rig.cameras.T_cam_world[:, :3, 3], rig)
    body_m, seen = 100 * np.stack([np.sin(phase), np.cos(phase), 1.2 + 0 * phase], axis=-1), {}
    for index, name in enumerate(far.names):
        middle, depth = project(far.cameras[index], body_m)
        noise = np.random.default_rng(index).normal(0, 0.3, middle.shape)
        seen[name] = boxes_at(middle + noise, (far.cameras.K[index, 0, 0] * 1.0 / depth)[:, None])
    assert examine(far, from_detections(seen, far, 60), fps=25.0).findings == ()


@pytest.mark.slow
def test_a_small_lag_does_not_hide_a_turned_camera():
    """One video lags by a small part of a frame, which many frames show for certain; another camera is turned."""
    rig, frames, seen = ring_rig(5, image_size_wh=SIZE_WH), np.arange(300), {}
    for index, name in enumerate(rig.names):
        angle = (frames - (0.06 if index == 1 else 0.0)) / 25
        body_m = [1.2 * np.sin(1.5 * angle), 0.9 * np.cos(1.1 * angle), 1.2 + 0.1 * np.sin(2 * angle)]
        noise = np.random.default_rng(index).normal(0, 0.2, (len(frames), 2))
        seen[name] = boxes_at(project(rig.cameras[index], np.stack(body_m, axis=-1))[0] + noise, 25)
    sightings = from_detections(seen, rig, len(frames))
    assert examine(rig, sightings, fps=25.0).findings == ()
    (finding,) = examine(turned(rig, 3, [0.0, 0.4, 0.0]), sightings, fps=25.0).findings
    assert (finding.kind, finding.cameras) == ("turned", ("c3",))
    assert "place it anew with `psotrack calibrate rig --pairs`" in finding.remedy


# The cases of the study.


def diagnosed(number, fault="", cameras=None):
    case = make_case(number, fault, cameras)
    return case, examine(case.rig, from_detections(case.seen, case.rig, case.frames), fps=STUDY_FPS)


# Few frames of three small drones indoors; one small drone; one large lopsided body with three cameras.
SOUND = [4, 8, *(pytest.param(number, marks=SLOW) for number in (3, 6))]
MORE_SOUND = [pytest.param(number, marks=NIGHTLY) for number in (0, 1, 2, 5, 10, 15, 17, 18, 20)]


@pytest.mark.parametrize("number", [*SOUND, *MORE_SOUND])
def test_a_sound_rig_is_left_alone(number):
    assert diagnosed(number)[1].findings == ()


@pytest.mark.parametrize(
    ("number", "fault", "cameras"),
    [
        (4, "late 0.5", None),
        (4, "exchanged", 3),
        pytest.param(5, "turned 1", None, marks=SLOW),
        pytest.param(0, "millimetres", None, marks=SLOW),
        pytest.param(1, "moved 5 cm", 3, marks=SLOW),
        pytest.param(2, "turned 0.5", 3, marks=SLOW),
    ],
)
def test_a_planted_fault_is_named(number, fault, cameras):
    case, diagnosis = diagnosed(number, fault, cameras)
    assert judge(case, diagnosis)["named first"], diagnosis.findings


@pytest.mark.nightly
@pytest.mark.parametrize("fault", JUDGE["FAULTS"])
def test_faults_of_small_bodies_are_named(fault):
    """Of faults that move small bodies by 3 px, at most one is not named, and none is named wrongly.

    The exceptions are a focal length and a small turn of which a single drone in 40 frames (rig 8) tells too little.
    """
    rows = []
    # Rig 1 is of four drones in 500 frames, which takes as long as ten others: larger faults are left out.
    for number in (4, 8) if fault in ("turned 1", "late 2", "early 2") else (1, 4, 8):
        if make_case(number, fault).shift_px >= 3:
            rows.append(judge(*diagnosed(number, fault)))
    assert not any(row["wrong"] for row in rows), rows
    missed = fault in ("focal length 2 %", "turned 0.5")
    assert sum(bool(row["named first"]) for row in rows) >= len(rows) - missed, rows


# The arithmetic.


def small_problem():
    """Four cameras, two pieces of paths of five points each, with noise."""
    rng = np.random.default_rng(3)
    rig = ring_rig(4, coefficients=5, image_size_wh=SIZE_WH)
    point_m = rng.uniform((-1, -1, 0.5), (1, 1, 2), (10, 3))
    velocity_m = rng.normal(0, 0.05, (10, 3))
    centre_px = project(rig.cameras, point_m[:, None])[0] + rng.normal(0, 2.0, (10, 4, 2))
    centre_px[3, 2] = np.nan
    side_px = np.where(np.isfinite(centre_px[..., 0]), rng.uniform(20, 60, (10, 4)), np.nan)
    whole = np.zeros((10, 4)), np.ones((10, 4)), np.ones(4)
    piece = np.repeat([0, 1], 5)
    points = CommonPoints(np.arange(10), piece, point_m, velocity_m, centre_px, side_px, *whole)
    weight = np.where(np.isfinite(side_px), rng.uniform(0.3, 1.0, side_px.shape), 0.0)
    return rig, WeightedPoints(points, point_m, weight)


def test_derivatives_are_those_of_finite_differences():
    rig, data = small_problem()
    at = Corrected(rig, np.array([0.3, 0.0, -1.0, 2.0]))
    slopes = linearise(at, data.points, data.position_m)
    for column, step in enumerate(1e-6 * np.eye(PER_CAMERA * 4 + 1)):
        ahead, behind = (
            linearise(at.by(sign * step), data.points, data.position_m).residual_px for sign in (1, -1)
        )
        expected = np.where(np.isfinite(ahead), slopes.by_parameter[..., column], 0.0)
        np.testing.assert_allclose(np.nan_to_num(behind - ahead) / 2e-6, expected, rtol=1e-4, atol=1e-3)


def test_the_evidence_is_that_of_the_dense_normal_distribution():
    """The same marginal likelihoods from the covariance of all pixels, with points of a wide prior distribution."""
    rig, data = small_problem()
    points, at = data.points, Corrected(rig, np.zeros(4))
    hypothesis = next(
        each for each in evidence.list_hypotheses(4, range(4)) if (each.kind, each.camera) == ("turned", 1)
    )
    gathered = evidence.gather(at, data)
    std = gathered.prior_std
    found = gathered.judge(hypothesis, gathered.as_sound).log_odds

    slopes = linearise(at, points, data.position_m)
    rows = np.argwhere(np.repeat((data.weight > 0)[..., None], 2, axis=-1))
    e = np.array([slopes.residual_px[tuple(row)] for row in rows])
    same_point = rows[:, None, 0] == rows[None, :, 0]
    by_point = np.array([slopes.by_point[tuple(row)] for row in rows])
    base = np.where(same_point, 4.0 * by_point @ by_point.T, 0.0)
    base += np.diag([1 / data.weight[p, c] for p, c, _ in rows])
    same = (rows[:, None, 1:] == rows[None, :, 1:]).all(axis=-1)
    piece = points.piece[rows[:, 0]]
    side = np.array([points.side_px[p, c] for p, c, _ in rows])
    floor = np.hypot(side, evidence._SMALL_BOX_PX)
    image = (points.centre_px - rig.cameras.K[:, :2, 2]) / (rig.cameras.image_size_wh / 2)
    over = np.array([[1.0, *image[p, c]] for p, c, _ in rows])
    theta = np.array([slopes.by_parameter[tuple(row)][list(hypothesis.columns)] for row in rows])
    theta = np.where((rows[:, 1] == 1)[:, None], theta, 0.0)
    logs: dict[str, list[float]] = {"sound": [], "turned": []}
    sizes = product(evidence._PIECE_ERRORS, evidence._CAMERA_ERRORS, evidence._CALIBRATION_PX)
    for of_piece, of_camera, of_calibration in sizes:
        rare = evidence._RARE * ((of_camera > 0.1) + (of_calibration > 0.7))
        shared = np.where(piece[:, None] == piece, np.outer(floor, floor), 0.0)
        covariance = base + np.where(same, shared * of_piece**2, 0.0)
        smooth = over @ over.T
        covariance += np.where(same, smooth * (of_camera**2 * np.outer(side, side) + of_calibration**2), 0.0)
        logs["sound"].append(rare + multivariate_normal.logpdf(e, cov=covariance))
        for factor in evidence._PRIOR_FACTORS:
            wide = theta * factor * std[list(hypothesis.columns)]
            logs["turned"].append(rare + multivariate_normal.logpdf(e, cov=covariance + wide @ wide.T))
    expected = np.logaddexp.reduce(logs["turned"]) - np.log(len(evidence._PRIOR_FACTORS))
    expected -= np.logaddexp.reduce(logs["sound"])
    assert found == pytest.approx(expected, abs=0.01)


def test_sightings_that_agree_by_chance_do_not_go_on_from_frame_to_frame(monkeypatch):
    """A rig is not judged by matches of spots of noise, as the blobs of a noisy background are."""
    rig, data = small_problem()

    def consistent(points):
        return weigh(Corrected(rig, np.zeros(4)), points).used.sum() / points.seen.sum()

    assert consistent(data.points) > 0.9
    jumps_px = np.random.default_rng(1).standard_t(1, data.points.centre_px.shape) * 40
    spots = replace(data.points, centre_px=data.points.centre_px + jumps_px)
    # The scale of the noise is the median's, so that the far tenth of these jumps are outliers.
    assert consistent(spots) < 0.85
    monkeypatch.setattr("psotrack.calibration.doctor.examination.MIN_CONSISTENT", 1.01)
    (finding,) = diagnosed(4, "late 0.5")[1].findings
    assert finding.kind == "too little seen"
    assert "agree by chance" in finding.message


# The command.


def write_sequence(folder, rig, seen):
    (folder / "dl_data").mkdir(parents=True)
    write_calibration(folder / "cameras_calibration.csv", rig)
    for name in rig.names:
        write_detections(folder / "dl_data" / f"{name}.csv", seen[name])
        with VideoWriter(folder / f"{name}.avi", FPS, (320, 240)) as writer:
            for _ in range(FRAMES):
                writer.write(np.zeros((240, 320, 3), np.uint8))
    for drone in range(2):
        wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (FRAMES, 1))
        write_poses(folder / f"dron{drone + 1}_pos_25.csv", TRUTH_M[:, drone], wxyz)
    return folder


def test_the_command(run_psotrack, tmp_path):
    small = ring_rig(4)
    K = small.cameras.K.copy()
    K[:, 1, 1] = K[:, 0, 0]
    small = Rig(small.names, replace(small.cameras, K=K))
    seen = detect(small, TRUTH_M)
    folder = write_sequence(tmp_path / "correct", small, seen)
    done = run_psotrack("doctor", folder)
    assert done.code == 0, done.err
    assert "nothing disagrees" in done.out
    found = pt.doctor(folder)
    assert repr(found) == "Diagnosis(nothing disagrees)"
    assert "detections/frame" in found._repr_html_()

    with_centres = with_poses(small.cameras.T_cam_world[:, :3, :3], small.cameras.centre_world, small)
    folder = write_sequence(tmp_path / "with_centres", with_centres, seen)
    done = run_psotrack("doctor", folder, "-q")
    assert (done.code, done.out.count("\n")) == (1, 1)
    assert "write t = -R C" in done.out
    done = run_psotrack("doctor", folder, "--json", "-")
    assert done.code == 1
    content = json.loads(done.out)
    assert json.loads(json.dumps(pt.doctor(folder).to_dict())) == content
    assert [finding["kind"] for finding in content["findings"]] == ["translation or centre"]
    assert [row["camera"] for row in content["cameras"]] == list(small.names)
