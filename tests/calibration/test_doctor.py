"""Checks of a rig against its detections: each single fault is named, and a correct rig gives no finding."""

import json
import re
import runpy
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from board_rigs import record_detections
from helpers import project_points, ring_rig
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

import psotrack as pt
from psotrack.calibration.doctor import examine, fault_search
from psotrack.calibration.doctor.common_points import (
    PER_CAMERA,
    CommonPoints,
    Corrected,
    WeightedPoints,
    linearise,
    weigh,
)
from psotrack.geometry import Rig
from psotrack.recordings import Detections
from psotrack.tracking.matching import from_detections
from psotrack.trajectories import Trajectories

#: The rigs, bodies and detectors of the study, and whether a finding names what was planted.
JUDGE = runpy.run_path(str(Path(__file__).parents[2] / "experiments" / "calibration" / "doctor.py"))
make_case, judge, boxes, FPS = JUDGE["make_case"], JUDGE["judge"], JUDGE["_boxes"], JUDGE["FPS"]


#: Small white errors of the boxes.
WHITE = {"frames": 60, "noise_px": 0.3, "noise_share": 0.02, "lasting": 0.0, "turning": False}


class World:
    """A rig of the study, bodies, and what the cameras detect."""

    def __init__(self, seed=0, lags=None, *, far=1.0, **scene):
        rng = np.random.default_rng(seed)
        self.scene = boxes.Scene(**(WHITE | scene))
        rig = boxes.make_true_rig(self.scene, rng)
        flight = boxes.make_flight(self.scene, rng)
        self.rig = with_poses(rig, t_m=far * rig.cameras.T_cam_world[:, :3, 3])
        self.flight = replace(flight, middle_m=far * flight.middle_m, reach_m=far * flight.reach_m)
        self.seen = boxes.record(self.rig, self.flight, self.scene, rng, lags)
        self.truth_m, *_ = self.flight.at(np.arange(self.scene.frames) / FPS)

    def examined(self, rig=None, reference_m=None, seen=None):
        """The diagnosis of a rig, its own by default, with a reference of these positions, or none."""
        rig = rig or self.rig
        if seen is None:
            seen = self.seen
        reference = None
        if reference_m is not None:
            frame = np.arange(len(reference_m))
            names = tuple(f"dron{i}" for i in range(reference_m.shape[1]))
            reference = Trajectories(frame, frame / FPS, names, reference_m)
        sightings = from_detections(seen, rig, self.scene.frames)
        return examine(rig, sightings, fps=FPS, reference=reference)


def with_poses(rig, R=None, t_m=None):
    """The rig with other rotations or translations, or both."""
    T = rig.cameras.T_cam_world.copy()
    if R is not None:
        T[:, :3, :3] = R
    if t_m is not None:
        T[:, :3, 3] = t_m
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


def turned(rig, index, turn_deg):
    """The rig with one camera that is turned about its own axes."""
    turn = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    T = rig.cameras.T_cam_world.copy()
    T[index, :3] = turn @ T[index, :3]
    return with_poses(rig, T[:, :3, :3], T[:, :3, 3])


def turned_over(rig, index):
    """The rig whose cameras hang the other way up, or one of them."""
    T, K = rig.cameras.T_cam_world.copy(), rig.cameras.K.copy()
    T[index, :2] *= -1
    K[index, :2, 2] = np.array([1919, 1079]) - K[index, :2, 2]
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T, K=K))


def knocked(seen, name, frame, shift_px):
    """Detections of which one camera's are elsewhere from a frame on."""
    boxes = seen[name]
    after = (boxes.frame >= frame)[:, None]
    return {**seen, name: replace(boxes, xyxy=boxes.xyxy + after * np.tile(shift_px, 2))}


def without_frame(seen, name, frame):
    """Detections of which one camera lost a frame, and counts on."""
    boxes = seen[name]
    kept, number = boxes.frame != frame, boxes.frame - (boxes.frame > frame)
    return {**seen, name: Detections(number[kept], boxes.xyxy[kept], boxes.confidence[kept])}


def moved(rig, index, shift_m):
    t_m = rig.cameras.T_cam_world[:, :3, 3].copy()
    t_m[index] += shift_m
    return with_poses(rig, t_m=t_m)


INDOORS, FEW = World(), World(frames=40)
RIG = INDOORS.rig
R = RIG.cameras.T_cam_world[:, :3, :3]
T_M = RIG.cameras.T_cam_world[:, :3, 3]
CENTRES_M = RIG.cameras.centre_world
OPENGL, LEFT = np.array([1.0, -1.0, -1.0]), np.array([1.0, 1.0, -1.0])
#: The third axis of the world and of the cameras is mirrored, so rotations remain rotations.
LEFT_HANDED = with_poses(RIG, LEFT[:, None] * R * LEFT, LEFT * T_M)
IN_OPENGL = with_poses(RIG, OPENGL[:, None] * R, OPENGL * T_M)
#: Name of the fault -> a wrong rig, kind and cameras of the finding, and an expression for its message.
FAULTS = {
    "turned": (turned(RIG, 2, (0, 1, 0)), "turned", ("cam3",), r"turned by (0\.[89]\d*|1\.[01]\d*) degrees"),
    "moved": (moved(RIG, 4, (0.1, 0, 0)), "moved", ("cam5",), r"moved by ([89]|1[012]) cm"),
    "turned far": (turned(RIG, 2, (0, 12, 0)), "disagrees", ("cam3",), "it was turned or moved far"),
    "centres": (with_poses(RIG, R, CENTRES_M), "translation or centre", (), "^(?!.*rotation)"),
    "to the world": (with_poses(RIG, R.mT, CENTRES_M), "translation or centre", (), "from camera to world"),
    "millimetres": (with_poses(RIG, R, 1e3 * T_M), "unit", (), "millimetres were read as metres"),
    "all upside down": (turned_over(RIG, slice(None)), "upside down", (), "turned by 180 degrees"),
    "one upside down": (turned_over(RIG, 1), "upside down", ("cam2",), "turned by 180 degrees"),
    "axes of OpenGL": (IN_OPENGL, "mirrored axes", (), "y, z are mirrored as in OpenGL"),
    "a left-handed world": (LEFT_HANDED, "mirrored axes", (), "left-handed"),
    "a lens": (boxes.refocused(RIG, 3, 1.06), "focal length", ("cam4",), r"(5\.[5-9]|6\.[0-3]) % too long"),
    "all lenses": (boxes.refocused(RIG, slice(None), 1.15), "focal lengths", (), r"1[3-7]\.\d % too long"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_the_rig_is_named(name):
    rig, kind, cameras, message = FAULTS[name]
    diagnosis = FEW.examined(rig, FEW.truth_m)
    (finding,) = diagnosis.findings
    assert finding.kind == kind, finding
    assert finding.cameras == cameras, finding
    assert re.search(message, finding.message), finding.message
    # What is said agrees with the residuals that are printed.
    moved_px = re.search(r"moves its boxes by (\d+) px", finding.message)
    assert moved_px is None or 0.7 < float(moved_px[1]) / np.nanmax(diagnosis.residual_px) < 1.5


def test_an_error_that_no_single_sighting_shows_is_named():
    """All lenses are a little too short, which 60 frames of all cameras together show."""
    rig = boxes.refocused(RIG, slice(None), 0.96)
    (finding,) = INDOORS.examined(rig, INDOORS.truth_m).findings
    assert finding.kind == "focal lengths"
    assert re.search(r"[345]\.?\d* % too short \(± 0\.[1-6]\d* %\)", finding.message), finding.message


@pytest.mark.parametrize("delay", [0.6, 3.0])
def test_a_late_camera(delay):
    (finding,) = World(lags={"cam1": delay}).examined().findings
    assert (finding.kind, finding.cameras) == ("clock", ("cam1",))
    late_ms = float(finding.message.split(" ms late")[0].split()[-1])
    # A seventh of a frame, whose errors are those of the boxes.
    assert abs(late_ms - 1e3 * delay / FPS) < 6
    assert "--clocks auto" in finding.remedy
    added_s = re.search(r"add (-[\d.]+) to its time_offset_s", finding.remedy)[1]
    # The message has whole milliseconds.
    assert float(added_s) == pytest.approx(-late_ms / 1e3, abs=6e-4)


def test_a_camera_that_is_knocked_in_mid_flight():
    """By 4 px: the instant is named, and nothing else is wrong."""
    world = World(drones=3, size=0.4, frames=400)
    (finding,) = world.examined(seen=knocked(world.seen, "cam2", 230, (3.2, 2.4))).findings
    assert (finding.kind, finding.cameras) == ("knocked", ("cam2",))
    assert re.search(
        r"at frame (22[89]|23[0-2]) \(9\.\d\d s\), which moves its boxes by [345] px", finding.message
    )


@pytest.mark.parametrize(
    ("words", "reference_m"),
    [
        ("its extent is 9", 1e3 * INDOORS.truth_m),
        ("`psotrack doctor --tracks`", np.roll(INDOORS.truth_m, 8, axis=0)),
        ("check its unit and its axes", INDOORS.truth_m * [1.0, -1.0, 1.0]),
        ("it is 1.1", INDOORS.truth_m + np.array([1.0, 0.5, 0.0])),
        ("of this flight", World(9).truth_m * [0.2, 3.0, 1.0]),
    ],
)
def test_a_reference_that_contradicts_the_rig(words, reference_m):
    (finding,) = INDOORS.examined(reference_m=reference_m).findings
    assert finding.kind == "reference"
    assert words in str(finding)


# Sound rigs, and rigs of which too little is seen.


def test_a_sound_rig_agrees_with_its_reference_and_its_clocks():
    diagnosis = INDOORS.examined(reference_m=INDOORS.truth_m)
    assert diagnosis.findings == ()
    assert diagnosis.reference_m < 0.05
    # An error of a quarter of a frame would be a finding.
    assert np.nanmax(np.abs(diagnosis.late_frames)) < 0.25


def test_too_few_detections_accuse_no_camera():
    (finding,) = INDOORS.examined(seen={}).findings
    assert finding.kind == "too little seen"
    # Ten frames of one drone agree with the rig, but are too few to judge it.
    (finding,) = World(drones=1, frames=10).examined().findings
    assert finding.kind == "too little seen"
    assert "the rig" not in finding.message


def test_detections_of_different_flights_accuse_no_camera():
    seen = {}
    for index, name in enumerate(RIG.names):
        flight = World(40 + index).flight
        seen[name] = boxes.record(RIG, flight, INDOORS.scene, np.random.default_rng(0))[name]
    (finding,) = INDOORS.examined(seen=seen).findings
    assert finding.kind == "no agreement"


@pytest.mark.parametrize(("cameras", "of_third"), [(2, None), (3, 0), (3, 10)])
def test_two_cameras_are_checked(cameras, of_third):
    """Two cameras show whether they agree, but not which of them is wrong; a third may see next to nothing."""
    world = World(cameras=cameras, frames=200)
    seen, two = dict(world.seen), world.rig.names[:2]
    for name in world.rig.names[2:]:
        seen[name] = Detections(*(values[:of_third] for values in vars(seen[name]).values()))
    diagnosis = world.examined(reference_m=world.truth_m, seen=seen)
    assert diagnosis.findings == ()
    assert diagnosis.to_dict()["explained"] > 0.85
    (finding,) = world.examined(turned(world.rig, 1, (1, 0, 0)), seen=seen).findings
    assert finding.kind == "unclear"
    assert set(finding.cameras) >= set(two)


OUTDOORS = {"outdoors": True, "cameras": 3, "drones": 1, "frames": 400, "noise_share": 0, "false_alarms": 0}


def all_turned(rig, degrees):
    """The rig with every camera turned by about as much."""
    turns = np.array([(0.4, 0.9, 0.2), (0.2, 0.4, 0.9), (0.9, 0.2, 0.4)])
    for index in range(len(rig)):
        rig = turned(rig, index, degrees * turns[index % 3])
    return rig


@pytest.mark.parametrize(
    ("degrees", "kinds"), [(0.5, {"several"}), (1.0, {"several", "no agreement"}), (4.0, {"no agreement"})]
)
def test_a_rig_that_explains_nothing_is_not_sound(degrees, kinds):
    """Every camera is turned, by tens of pixels: no single fault explains it."""
    world = World(**OUTDOORS)
    diagnosis = world.examined(all_turned(world.rig, degrees))
    assert diagnosis.to_dict()["explained"] < 0.05
    assert {finding.kind for finding in diagnosis.findings} <= kinds
    assert diagnosis.findings


@pytest.mark.slow
def test_tracks_say_which_share_of_the_detections_they_explain(tmp_path, caplog):
    """False detections are no fault of the rig."""
    world = World(cameras=3, drones=1, frames=50, false_alarms=1.0)
    for name, degrees, low, high in [("sound", 0.0, 0.4, 0.6), ("wrong", 3.0, 0.0, 0.35)]:
        folder = record_detections(tmp_path / name, world.seen, all_turned(world.rig, degrees))
        caplog.clear()
        explained = pt.track(folder, method="projection-lines").record["explained"]
        assert low <= explained["share"] <= high
        assert list(explained["cameras"]) == list(world.rig.names)
        assert ("the tracks explain only" in caplog.text) == (name == "wrong"), caplog.text


@pytest.mark.slow
def test_a_knocked_camera_is_left_out_of_tracks_or_widens_their_covariances(tmp_path, caplog):
    # By 4 px, and so far that its sightings no longer count in the tracks.
    for cameras, px in ((5, 4), (3, 4), (4, 20)):
        world = World(cameras=cameras, drones=1, size=0.4, frames=200)
        seen = knocked(world.seen, "cam2", 120, (0.8 * px, 0.6 * px))
        tracked = pt.track(
            record_detections(tmp_path / f"{cameras}", seen, world.rig), method="projection-lines"
        )
        (knock,) = tracked.record["knocks"]
        assert (knock["camera"], knock["left_out"]) == ("cam2", cameras > 3)
        assert abs(knock["frame"] - 120) <= 2
        assert re.search(r"camera cam2: it was knocked at frame 1[12]\d", caplog.text)
        flown = tracked.trajectories
        off_m = flown.position_m[125:, 0] - world.truth_m[125:, 0]
        nees = np.einsum("fi,fij,fj->f", off_m, np.linalg.inv(flown.covariance_m2[125:, 0]), off_m)
        # The 90 % ellipsoid holds positions as before.
        assert np.median(nees) < 6.25
        caplog.clear()


def test_a_camera_that_loses_a_frame_is_named_with_the_frame(tmp_path, caplog):
    """By the doctor and by `track`; they were silent, or said that the camera was knocked."""
    world = World(cameras=3, drones=1, size=0.4, frames=200)
    seen = without_frame(world.seen, "cam2", 120)
    (finding,) = world.examined(seen=seen).findings
    assert (finding.kind, finding.cameras) == ("clock step", ("cam2",))
    pt.track(record_detections(tmp_path / "world", seen, world.rig), method="projection-lines")
    for said in (finding.message, caplog.text):
        found = re.search(r"from frame (\d+) \(.* on, its video is (\d+) ms earlier .* lost frames", said)
        assert abs(int(found[1]) - 120) <= 1
        assert abs(int(found[2]) - 1e3 / FPS) < 8


def test_errors_that_last_look_like_no_turn():
    """Sound rigs of three cameras and one body, whose errors of several pixels last for about a second."""
    assert World(4, noise_px=2.5, lasting=0.98, **OUTDOORS).examined().findings == ()


def test_far_cameras_that_see_bodies_of_plausible_size_are_no_wrong_unit():
    """Cameras hundreds of metres apart that see a drone: metres, not millimetres."""
    assert World(far=60.0, drones=1, frames=40, size=4.0).examined().findings == ()


# The cases of the study.


def diagnosed(number, fault="", cameras=None):
    case = make_case(number, fault, cameras)
    sightings = from_detections(case.seen, case.rig, case.frames)
    return case, examine(case.rig, sightings, fps=FPS)


# Few frames of three small drones indoors; one large lopsided body with three cameras.
@pytest.mark.parametrize("number", [8, pytest.param(6, marks=pytest.mark.slow)])
def test_a_sound_rig_is_left_alone(number):
    _, diagnosis = diagnosed(number)
    assert diagnosis.findings == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "fault", "cameras"),
    [(4, "exchanged", 3), (5, "turned 1", None), (1, "moved 5 cm", 3), (2, "turned 0.5", 3)],
)
def test_a_planted_fault_is_named(number, fault, cameras):
    case, diagnosis = diagnosed(number, fault, cameras)
    assert judge(case, diagnosis)["named first"], diagnosis.findings


# The arithmetic.


def small_problem():
    """Four cameras, two pieces of paths of five points each, with noise."""
    rng = np.random.default_rng(3)
    rig = ring_rig(4, coefficients=5, image_size_wh=(1920, 1080))
    point_m = rng.uniform((-1, -1, 0.5), (1, 1, 2), (10, 3))
    velocity_m = rng.normal(0, 0.05, (10, 3))
    centre_px = project_points(rig, point_m) + rng.normal(0, 2.0, (10, 4, 2))
    side_px = rng.uniform(20, 60, (10, 4))
    weight = rng.uniform(0.3, 1.0, (10, 4))
    centre_px[3, 2], side_px[3, 2], weight[3, 2] = np.nan, np.nan, 0.0
    piece = np.repeat([0, 1], 5)
    sound = np.zeros((10, 4)), np.ones((10, 4)), np.ones(4)
    points = CommonPoints(np.arange(10), piece, point_m, velocity_m, centre_px, side_px, *sound)
    return rig, WeightedPoints(points, point_m, weight)


def test_derivatives_are_those_of_finite_differences():
    rig, data = small_problem()
    at = Corrected(rig, np.array([0.3, 0.0, -1.0, 2.0]))
    slopes = linearise(at, data.points, data.position_m)
    for column, step in enumerate(1e-6 * np.eye(PER_CAMERA * 4 + 1)):
        ahead = linearise(at.by(step), data.points, data.position_m)
        behind = linearise(at.by(-step), data.points, data.position_m)
        found = (behind.residual_px - ahead.residual_px) / 2e-6
        seen = np.isfinite(found)
        expected = slopes.by_parameter[..., column]
        np.testing.assert_allclose(found[seen], expected[seen], rtol=1e-4, atol=1e-3)


def test_the_evidence_is_that_of_the_dense_normal_distribution():
    """The same marginal likelihoods from the covariance of all pixels, with points of a wide prior distribution."""
    rig, data = small_problem()
    points = data.points
    at = Corrected(rig, np.zeros(4))
    gathered = fault_search.gather(at, data)
    hypotheses = fault_search.list_hypotheses(4, range(4))
    (hypothesis,) = [each for each in hypotheses if each.kind == "turned" and each.camera == 1]
    found = gathered.judge(hypothesis, gathered.as_sound).log_odds

    # A row for each coordinate of a sighting.
    point, camera = np.nonzero(data.weight > 0)
    point, camera = np.repeat(point, 2), np.repeat(camera, 2)
    axis = np.tile([0, 1], len(point) // 2)
    slopes = linearise(at, points, data.position_m)
    residual_px = slopes.residual_px[point, camera, axis]
    by_point = slopes.by_point[point, camera, axis]
    same_point = point[:, None] == point
    white = np.where(same_point, 4.0 * by_point @ by_point.T, 0.0)
    white += np.diag(1 / data.weight[point, camera])
    same_axis = (camera[:, None] == camera) & (axis[:, None] == axis)
    piece = points.piece[point]
    same_piece = same_axis & (piece[:, None] == piece)
    side_px = points.side_px[point, camera]
    floor_px = np.hypot(side_px, fault_search._SMALL_BOX_PX)
    of_floor = np.where(same_piece, np.outer(floor_px, floor_px), 0.0)
    # An error that changes linearly over the image.
    image = (points.centre_px - rig.cameras.K[:, :2, 2]) / (rig.cameras.image_size_wh / 2)
    over = np.column_stack([np.ones(len(point)), image[point, camera]])
    smooth = np.where(same_axis, over @ over.T, 0.0)
    of_side = smooth * np.outer(side_px, side_px)
    columns = list(hypothesis.columns)
    turn = slopes.by_parameter[point, camera, axis][:, columns] * gathered.prior_std[columns]
    turn[camera != 1] = 0.0

    as_sound, as_turned = [], []
    sizes = product(fault_search._PIECE_ERRORS, fault_search._CAMERA_ERRORS, fault_search._CALIBRATION_PX)
    for of_piece, of_camera, of_calibration in sizes:
        rare = fault_search._RARE * ((of_camera > 0.1) + (of_calibration > 0.7))
        covariance = white + of_piece**2 * of_floor + of_camera**2 * of_side + of_calibration**2 * smooth
        as_sound.append(rare + multivariate_normal.logpdf(residual_px, cov=covariance))
        for factor in fault_search._PRIOR_FACTORS:
            wide = covariance + factor**2 * turn @ turn.T
            as_turned.append(rare + multivariate_normal.logpdf(residual_px, cov=wide))
    expected = np.logaddexp.reduce(as_turned) - np.log(len(fault_search._PRIOR_FACTORS))
    expected -= np.logaddexp.reduce(as_sound)
    assert found == pytest.approx(expected, abs=0.01)


def test_sightings_that_agree_by_chance_do_not_go_on_from_frame_to_frame():
    """A rig is not judged by matches of spots of noise, as the blobs of a noisy background are."""
    rig, data = small_problem()

    def consistent(points):
        used = weigh(Corrected(rig, np.zeros(4)), points).used
        return used.sum() / points.seen.sum()

    assert consistent(data.points) > 0.9
    centre_px = data.points.centre_px
    jumps_px = 40 * np.random.default_rng(1).standard_t(1, centre_px.shape)
    spots = replace(data.points, centre_px=centre_px + jumps_px)
    # The scale of the noise is the median's, so that the far tenth of these jumps are outliers.
    assert consistent(spots) < 0.85


# The command.


@pytest.mark.slow
def test_the_command(run_psotrack, tmp_path):
    folder = record_detections(tmp_path / "correct", INDOORS.seen, RIG)
    done = run_psotrack("doctor", folder).ended()
    assert "nothing disagrees" in done.out
    found = pt.doctor(folder)
    assert repr(found) == "Diagnosis(nothing disagrees)"
    assert "cam5" in found._repr_html_()

    wrong, *_ = FAULTS["centres"]
    folder = record_detections(tmp_path / "with_centres", INDOORS.seen, wrong)
    done = run_psotrack("doctor", folder, "-q").ended(1)
    assert done.out.count("\n") == 1
    assert "write t = -R C" in done.out
    content = json.loads(run_psotrack("doctor", folder, "--json", "-").ended(1).out)
    found = pt.doctor(folder).to_dict()
    assert json.loads(json.dumps(found)) == content
    assert [finding["kind"] for finding in content["findings"]] == ["translation or centre"]
    assert [row["camera"] for row in content["cameras"]] == list(RIG.names)
