"""A path with orientations and its reference: known clock offsets, lever arms and turns, evo as oracle, the command."""

import functools
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from camera_paths import AHEAD, camera_path
from clock_worlds import random_motion
from evo.core import metrics, sync
from evo.tools import file_interface
from helpers import assert_refused
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from real_data import published
from scipy.spatial.transform import Rotation

from psotrack.evaluation import PathSettings, Statistics, compare_paths, find_offset, plots
from psotrack.inside_out import write_camera_path
from psotrack.recordings.exchange import export_tracks, read_tracks
from psotrack.support import COLOURS, FAINT
from psotrack.trajectories import Status, Trajectories, write_trajectories

FPS = 25.0
TURN = Rotation.from_euler("ZYX", [-90.0, 4.0, -97.0], degrees=True)
NO_TURN = Rotation.identity()
ARM_M = np.array([0.12, -0.03, 0.05])
#: Offsets of the clocks of the reference's files, of positions and of orientations.
CLOCK_S, TURN_CLOCK_S = 0.3137, -2.173


def flown_m(time_s, speed_m_s=1.0, seed=0):
    """Motion that never repeats, at about this speed: (times, 3), metres."""
    return random_motion(seed, speed_m_s)(time_s) - [3.0 * seed, 0.0, 0.0]


def body_orientations(time_s, seed=1):
    """Orientations of a body that turns about the vertical and sways a little; yaw passes 180 degrees."""
    sway_deg = 12.0 * flown_m(time_s, seed=seed)
    angles_deg = sway_deg * [15, 1, 1] + [170, -18, 0]
    return Rotation.from_euler("ZYX", angles_deg, degrees=True)


def body(time_s, position_m, wxyz=None, name="body"):
    """Poses of the reference's body."""
    frame = np.arange(len(time_s))
    poses = Trajectories(frame, time_s, (name,), position_m[:, None])
    return poses if wxyz is None else replace(poses, orientation_wxyz=wxyz[:, None])


def compare(path, time_s, position_m, wxyz=None, *, orientation_time_s=None, **options):
    """Comparison of a path with a reference of these times, positions and orientations."""
    path_settings = PathSettings(**options)
    if orientation_time_s is None:
        return compare_paths(path, body(time_s, position_m, wxyz), settings=path_settings)
    nowhere_m = np.zeros((len(orientation_time_s), 3))
    turns = body(orientation_time_s, nowhere_m, wxyz)
    return compare_paths(path, body(time_s, position_m), turns, path_settings)


def as_wxyz(rotation):
    return rotation.as_quat(scalar_first=True)


def rotations(wxyz):
    return Rotation.from_quat(wxyz, scalar_first=True)


def recording(rate_hz=100.0, seconds=13.0, clock_s=0.0):
    """Times by a clock that is `clock_s` ahead, and positions and orientations of the body at these times."""
    time_s = 0.0031 + np.arange(int(seconds * rate_hz)) / rate_hz
    return time_s + clock_s, flown_m(time_s), as_wxyz(body_orientations(time_s))


def filmed_path(
    arm_m=(0.0, 0.0, 0.0), turn=NO_TURN, seconds=10.0, start_s=1.5, noise_m=0.0, noise_deg=0.0, seed=0
):
    """Path of the camera on the body of `recording`."""
    rng = np.random.default_rng(seed)
    time_s = start_s + np.arange(int(seconds * FPS)) / FPS
    bodies = body_orientations(time_s)
    errors_m = rng.normal(0, noise_m, (len(time_s), 3))
    position_m = flown_m(time_s) + bodies.apply(arm_m) + errors_m
    errors_deg = rng.normal(0, noise_deg, (len(time_s), 3))
    camera = bodies * turn * Rotation.from_rotvec(errors_deg, degrees=True)
    status = np.full((len(time_s), 1), int(Status.TRACKED))
    return replace(body(time_s, position_m, as_wxyz(camera), "camera"), status=status)


def noisy_path(seed=0):
    return filmed_path(ARM_M, TURN, noise_m=0.005, noise_deg=0.2, seed=seed)


def compare_by_two_clocks(path, clock_s, turn_clock_s):
    """Positions are at 100 Hz by one clock; orientations are by the same clock, or at 40 Hz by another clock."""
    time_s, position_m, wxyz = recording(clock_s=clock_s)
    if turn_clock_s is None:
        return compare(path, time_s, position_m, wxyz)
    turns_s, _, wxyz = recording(rate_hz=40, clock_s=turn_clock_s)
    return compare(path, time_s, position_m, wxyz, orientation_time_s=turns_s)


def turn_error_deg(found):
    error = TURN.inv() * rotations(found.turning.turn_wxyz)
    return np.degrees(error.magnitude())


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=4)
def test_differences_and_angles_of_random_orientations(seed):
    """Compared with SciPy's Euler angles of the body, and with the angle of the rotation between the two."""
    path = filmed_path(seconds=4)
    rng = np.random.default_rng(seed)
    errors = Rotation.from_rotvec(rng.normal(0, 0.3, (path.num_frames, 3)))
    poses = rotations(path.orientation_wxyz[:, 0]) * errors
    path = replace(path, orientation_wxyz=as_wxyz(poses)[:, None])
    options = {"with_lever_arm": False, "with_turn": False, "max_offset_s": 0.1}
    comparison = compare(path, *recording(seconds=8), **options)
    found = comparison.turning
    # Splines over 10 ms are exact to 1e-4 degrees; the offset is found to a fraction of a millisecond.
    np.testing.assert_allclose(found.angle_deg, np.degrees(errors.magnitude()), atol=0.02)
    np.testing.assert_array_equal(found.turn_wxyz, [1, 0, 0, 0])
    assert found.offset_s == comparison.offset_s
    by_body = compare(path, *recording(seconds=8), axes="body", **options).turning
    to_body = Rotation.from_matrix(AHEAD).inv()
    for each, ahead in ((found, to_body), (by_body, NO_TURN)):
        own_deg = (poses * ahead).as_euler("ZYX", degrees=True)
        reference = rotations(each.reference_wxyz) * ahead
        difference_deg = own_deg - reference.as_euler("ZYX", degrees=True)
        difference_deg = (difference_deg[:, ::-1] + 180) % 360 - 180
        np.testing.assert_allclose(each.difference_deg, difference_deg, atol=1e-6)


class TestClocks:
    @pytest.mark.parametrize(("clock_s", "turn_clock_s"), [(0.3137, None), (512.2345, -77.03)])
    def test_known_offsets_arm_and_turn_are_found(self, clock_s, turn_clock_s):
        path = noisy_path()
        found = compare_by_two_clocks(path, clock_s, turn_clock_s)
        # The required accuracy is 0.1 frame. Here the noise allows a fiftieth of a frame.
        assert abs(found.offset_s - clock_s) * FPS < 0.05
        assert found.offset_std_s * FPS < 0.05
        expected_s = clock_s if turn_clock_s is None else turn_clock_s
        assert abs(found.turning.offset_s - expected_s) * FPS < 0.05
        # Medians of 250 values with noise of 5 mm and 0.2 degrees are good to 0.4 mm and 0.015 degrees; limits 6 times.
        np.testing.assert_allclose(found.lever_arm_m, ARM_M, atol=0.0024)
        assert turn_error_deg(found) < 0.1
        # The mean distance is √(8 / π) times the noise along each axis, good to 42 % / √250; limit three times that.
        mean_norm = np.sqrt(8 / np.pi)
        assert np.mean(found.distance_m) == pytest.approx(0.005 * mean_norm, rel=0.08)
        assert np.mean(found.turning.angle_deg) == pytest.approx(0.2 * mean_norm, rel=0.08)
        # The length of the arm, 0.13 m, within the noise.
        assert np.mean(found.distance_to_point_m) == pytest.approx(np.linalg.norm(ARM_M), abs=0.002)
        body_m = flown_m(path.time_s) + body_orientations(path.time_s).apply(ARM_M)
        np.testing.assert_allclose(found.reference_m, body_m, atol=0.006)
        length_m = np.linalg.norm(np.diff(body_m, axis=0), axis=1).sum()
        assert found.path_length_m == pytest.approx(length_m, rel=0.01)

    def test_a_lever_arm_without_orientations_of_the_reference(self):
        """The path's orientations turn the arm, which is returned in the camera's axes."""
        time_s, position_m, _ = recording(clock_s=0.3137)
        found = compare(noisy_path(), time_s, position_m)
        assert abs(found.offset_s - 0.3137) * FPS < 0.05
        np.testing.assert_allclose(found.lever_arm_m, TURN.inv().apply(ARM_M), atol=0.0024)
        assert found.turning is None
        # Offsets count at which half of the ten seconds are compared; 1.5 s of the reference are before and after them.
        time_s, _, _ = recording()
        searched = find_offset(filmed_path(), time_s, position_m[:, None], max_offset_s=8.0)
        compared_s = searched.curve_s[np.isfinite(searched.curve_m)]
        assert np.abs(compared_s).max() == pytest.approx(6.5, abs=1 / FPS)

    @pytest.mark.parametrize("turns_are_known", [False, True])
    def test_a_slow_drone_with_a_long_lever_arm_that_turns(self, turns_are_known):
        """If the arm were constant in the world instead of the body, it would cause most of the visible motion."""
        arm_m = np.array([0.2, -0.1, 0.12])
        path = filmed_path(noise_deg=0.2)
        noise_m = np.random.default_rng(1).normal(0, 0.002, (path.num_frames, 3))
        moved_m = flown_m(path.time_s, speed_m_s=0.3) + body_orientations(path.time_s).apply(arm_m)
        path = replace(path, position_m=(moved_m + noise_m)[:, None])
        time_s, _, _ = recording()
        slow_m = flown_m(time_s, speed_m_s=0.3)
        turns_s, _, wxyz = recording(rate_hz=40, clock_s=0.1573)
        turns = {"wxyz": wxyz, "orientation_time_s": turns_s} if turns_are_known else {}
        found = compare(path, time_s + 0.7, slow_m, **turns)
        assert abs(found.offset_s - 0.7) * FPS < 0.05
        length_m = np.linalg.norm(arm_m)
        assert np.linalg.norm(found.lever_arm_m) == pytest.approx(length_m, abs=2e-3)

    def test_outliers_are_counted_and_do_not_move_the_clocks(self):
        """Every eighth pose is anywhere in the room, and one pose is at a distance of ten kilometres."""
        path = noisy_path()
        wild = np.arange(3, path.num_frames, 8)
        rng = np.random.default_rng(2)
        path.position_m[wild, 0] += rng.uniform(-2, 2, (len(wild), 3))
        path.position_m[wild[4]] = 1e4
        path.orientation_wxyz[wild, 0] = as_wxyz(Rotation.random(len(wild), rng=rng))
        found = compare_by_two_clocks(path, -0.2719, 0.4)
        assert abs(found.offset_s + 0.2719) * FPS < 0.1
        assert abs(found.turning.offset_s - 0.4) * FPS < 0.1
        assert turn_error_deg(found) < 0.1
        # No outlier is left out: the distance of 10 km is in the mean and in the maximum.
        assert Statistics.of(found.distance_m).count == path.num_frames
        assert np.max(found.distance_m) > 9e3
        assert np.max(found.turning.angle_deg) > 90
        assert np.median(found.distance_m) < 0.012

    def test_lost_poses_and_gaps_of_the_reference_are_not_compared(self):
        path = noisy_path()
        path.status[40:60] = Status.LOST
        path.position_m[80:90] = np.nan
        path.orientation_wxyz[80:90] = np.nan
        time_s, position_m, wxyz = recording()
        position_m[(time_s > 8) & (time_s < 8.5)] = np.nan
        wxyz[(time_s > 9) & (time_s < 10)] = np.nan
        found = compare(path, time_s, position_m, wxyz)
        assert abs(found.offset_s) * FPS < 0.05
        lost = np.isin(path.frame, [*range(40, 60), *range(80, 90)])
        # The ends of a gap are exact to one step of 10 ms.
        no_position = (path.time_s > 7.99) & (path.time_s < 8.51)
        no_turn = (path.time_s > 8.99) & (path.time_s < 10.01)
        np.testing.assert_array_equal(np.isnan(found.distance_m), lost | no_position | no_turn)
        np.testing.assert_array_equal(np.isnan(found.distance_to_point_m), lost | no_position)
        np.testing.assert_array_equal(np.isnan(found.turning.angle_deg), lost | no_turn)
        np.testing.assert_array_equal(np.isnan(found.turning.difference_deg).any(axis=1), lost | no_turn)
        # A known reference is returned in frames without a pose, too.
        assert np.isfinite(found.reference_m[lost]).all()


def with_hovering():
    """A path and a reference that stay at one place; the orientations, which change, do not help."""
    path = filmed_path()
    time_s, position_m, wxyz = recording()
    still_m = np.array([1.0, 2.0, 1.5])
    noise_m = np.random.default_rng(0).normal(0, 0.01, path.position_m.shape)
    path.position_m[:] = still_m + noise_m
    position_m[:] = still_m
    return path, body(time_s, position_m, wxyz)


def with_unknown(positions=slice(0), turns=slice(0)):
    """A path, and a reference of which some rows are not known."""
    time_s, position_m, wxyz = recording()
    position_m[positions] = np.nan
    wxyz[turns] = np.nan
    return filmed_path(), body(time_s, position_m, wxyz)


EVERY = slice(None)
#: Name of the case -> path and reference, settings, and words of the line.
BAD = {
    "no common time": (
        (filmed_path(start_s=100.0), with_unknown()[1]),
        {"max_offset_s": 2.0},
        "expected positions of both at offsets within 2 s, found none",
    ),
    "no reference": (with_unknown(positions=EVERY), {}, "expected poses of both, found 250 and 0"),
    "orientations at other times than the path": (
        with_unknown(turns=slice(150, None)),
        {"with_lever_arm": False},
        "orientations of both in some frame, found none",
    ),
    "hovering": (with_hovering(), {}, "hover"),
    "a range below a step": (with_unknown(), {"max_offset_s": 0.001}, "max_offset_s: expected a step"),
}


@pytest.mark.parametrize("case", BAD)
def test_paths_that_cannot_be_compared_are_refused(case, tmp_path):
    flights, options, words = BAD[case]
    bad = functools.partial(compare_paths, *flights, settings=PathSettings(**options))
    assert_refused(bad, words, unchanged=tmp_path)


def test_figure_11(monkeypatch):
    figures = []

    def draw_alone(path, size, draw, force):
        figures.append(Figure())
        draw(figures[-1])

    monkeypatch.setattr(plots, "save_figure", draw_alone)
    path = noisy_path()
    time_s, position_m, wxyz = recording()
    compared = compare(path, time_s, position_m, wxyz)
    plots.save_paths("paths.png", {"filter": compared, "other": compared}, title="a flight")
    above, side, distance, angle = figures[0].axes
    assert [line.get_color() for line in above.lines] == [FAINT, *COLOURS[:2]]
    assert [text.get_text() for text in above.get_legend().get_texts()] == ["reference", "filter", "other"]
    # The axis along which the drone flies farther is to the right.
    flown_along_m = np.ptp(compared.reference_m, axis=0)
    along, across = (0, 1) if flown_along_m[0] > flown_along_m[1] else (1, 0)
    for axes, two in ((above, [along, across]), (side, [along, 2])):
        np.testing.assert_array_equal(axes.lines[0].get_xydata(), compared.reference_m[:, two])
        np.testing.assert_array_equal(axes.lines[1].get_xydata(), compared.position_m[:, two])
    np.testing.assert_allclose(distance.lines[0].get_ydata(), 1e3 * compared.distance_m)
    np.testing.assert_allclose(angle.lines[0].get_ydata(), compared.turning.angle_deg)
    # A pose far away does not change the scale of the views. Without orientations there is no panel of angles.
    path.position_m[100] = 1e4
    plots.save_paths("paths.png", {"wild": compare(path, time_s, position_m)}, title="a flight")
    again, _, _ = figures[1].axes
    np.testing.assert_allclose(again.get_xlim(), above.get_xlim(), atol=0.05)


# --- the command


def tum_file(folder, name, time_s, position_m, wxyz):
    export_tracks(body(time_s, position_m, wxyz), "tum", folder / f"{name}.tum")
    return folder / f"{name}.tum"


@pytest.fixture
def evaluated(run_psotrack):
    """What `psotrack evaluate WORDS` writes as JSON."""
    return lambda *words: json.loads(run_psotrack("evaluate", *words, "--json", "-").out)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The table of `localise` of a flight, the reference at 50 Hz and an IMU at 25 Hz by clocks of their own."""
    folder = tmp_path_factory.mktemp("paths")
    path, table = noisy_path(), folder / "dron1.csv"
    poses = rotations(path.orientation_wxyz[:, 0])
    covariance = np.tile(1e-5 * np.eye(6), (path.num_frames, 1, 1))
    localised = camera_path(path.position_m[:, 0], poses, covariance, first_s=path.time_s[0])
    write_camera_path(table, localised, "dron1")
    vicon = tum_file(folder, "vicon", *recording(rate_hz=50, clock_s=CLOCK_S))
    time_s, _, wxyz = recording(rate_hz=25, clock_s=TURN_CLOCK_S)
    imu = tum_file(folder, "imu", time_s, np.zeros((len(time_s), 3)), wxyz)
    return table, vicon, imu


def test_tables_7_and_8_of_a_localised_video(files, run_psotrack, tmp_path):
    """The command gives the numbers of the function that the experiment of Tables 7 and 8 calls, and a picture."""
    table, vicon, imu = files
    png, path = tmp_path / "path.png", tmp_path / "found.json"
    shown = run_psotrack("evaluate", table, vicon, "--orientations", imu, "--plot", png, "--json", path).out
    for words in ("clock is +0.31", "distance (mm)", "roll (deg)", "abs yaw (deg)", "lever arm +1"):
        assert words in shown
    assert png.read_bytes().startswith(b"\x89PNG")
    found = json.loads(path.read_text())
    time_s, position_m, _ = recording(rate_hz=50, clock_s=CLOCK_S)
    turns_s, _, wxyz = recording(rate_hz=25, clock_s=TURN_CLOCK_S)
    expected = compare(noisy_path(), time_s, position_m, wxyz, orientation_time_s=turns_s).to_dict()
    # The text of the files holds 64 bits, but unit quaternions are normalised anew.
    for name in found:
        assert found[name] == pytest.approx(expected[name], abs=1e-5), name
    assert found.keys() > {"distance_m", "distance_to_point_m", "angle_deg"}
    for name in ("roll_deg", "pitch_deg", "yaw_deg"):
        assert found.keys() > {name, f"abs_{name}"}
    assert found["offset_s"] == pytest.approx(CLOCK_S, abs=0.05 / FPS)
    assert found["orientation_offset_s"] == pytest.approx(TURN_CLOCK_S, abs=0.05 / FPS)
    np.testing.assert_allclose(found["lever_arm_m"], ARM_M, atol=0.0024)


def test_a_reference_of_several_drones_needs_a_name(files, run_psotrack, tmp_path):
    table, vicon, _ = files
    (tmp_path / "both").mkdir()
    for name in ("a", "b"):
        shutil.copy(vicon, tmp_path / "both" / f"{name}.tum")
    write_trajectories(tmp_path / "two.csv", read_tracks(tmp_path / "both"))
    bad = functools.partial(run_psotrack, "evaluate", table, tmp_path / "two.csv")
    assert_refused(bad, "expected a drone dron1, found a, b; name one with --drone", unchanged=tmp_path)


def evo_ape(estimate, reference, offset_s=0.0):
    """Statistics of evo's absolute pose errors, metres and degrees, of poses at equal times."""
    ref = file_interface.read_tum_trajectory_file(str(reference))
    est = file_interface.read_tum_trajectory_file(str(estimate))
    est.timestamps = est.timestamps + offset_s
    ref, est = sync.associate_trajectories(ref, est, max_diff=0.02)
    found = []
    for relation in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg):
        ape = metrics.APE(relation)
        ape.process_data((ref, est))
        found.append(ape.get_all_statistics())
    return found


def test_it_agrees_with_evo(tmp_path, evaluated):
    """Without lever arm and turn, at the given offset; the reference has a pose at each time of the path."""
    path = filmed_path(noise_m=0.03, noise_deg=2.0, seed=4, start_s=1.5031)
    estimate = tum_file(tmp_path, "slam", path.time_s, path.position_m[:, 0], path.orientation_wxyz[:, 0])
    reference = tum_file(tmp_path, "vicon", *recording(clock_s=0.25))
    options = ("--no-lever-arm", "--no-turn", "--axes", "body")
    found = evaluated(estimate, reference, "--offset", 0.25, *options)
    theirs_m, theirs_deg = evo_ape(estimate, reference, 0.25)
    names = {"minimum": "min", "maximum": "max", "mean": "mean", "median": "median", "std": "std"}
    for ours, theirs in names.items():
        assert found["distance_m"][ours] == pytest.approx(theirs_m[theirs], abs=1e-7), ours
        assert found["angle_deg"][ours] == pytest.approx(theirs_deg[theirs], abs=1e-5), ours
    assert found["distance_m"]["count"] == path.num_frames
    # The search finds an offset that is as good.
    searched = evaluated(estimate, reference, *options)
    assert searched["offset_s"] == pytest.approx(0.25, abs=0.1 / FPS)
    assert searched["distance_m"]["mean"] <= found["distance_m"]["mean"]


@pytest.mark.real
def test_it_agrees_with_evo_on_a_real_flight_of_a_camera(evaluated):
    """evo takes the nearest pose of the reference, within 10 ms, where psotrack interpolates."""
    folder = published("MichaelGrupp/evo") / "test/data"
    estimate = folder / "freiburg1_xyz-rgbdslam.txt"
    reference = folder / "freiburg1_xyz-groundtruth.txt"
    found = evaluated(estimate, reference, "--offset", 0, "--no-lever-arm", "--no-turn")
    position, rotation = evo_ape(estimate, reference)
    for name in ("mean", "median"):
        assert found["distance_m"][name] == pytest.approx(position[name], rel=0.02)
        assert found["angle_deg"][name] == pytest.approx(rotation[name], rel=0.02)
    # The clocks of the benchmark are synchronous.
    searched = evaluated(estimate, reference, "--max-offset", 1)
    assert abs(searched["offset_s"]) < 3 * searched["offset_std_s"]
