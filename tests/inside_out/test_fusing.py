"""Fusion of inside-out and outside-in tracks, compared with ground truth, and with faulty input; and its command."""

import json
from dataclasses import replace

import numpy as np
import pytest
from camera_paths import (
    ARM_M,
    FPS,
    camera_path,
    fly_twice_seen,
    fly_with_a_swap,
    in_other_world,
    make_paths_and_tracks,
    outside_tracks,
    remove_poses,
    remove_positions,
    smooth_flight,
    squared_errors,
)
from helpers import made_once
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.inside_out import fuse, read_camera_path, write_camera_path
from psotrack.trajectories import Status, read_trajectories, write_trajectories


def rms(error_m):
    return float(np.sqrt(np.mean(np.sum(error_m**2, axis=-1))))


def one_flight(seed, num_frames=150, **given):
    """The path and the tracks of one drone, and the camera's true positions (frames, 3) and rotations."""
    paths, outside, truths = fly_twice_seen(seed, num_frames, **given)
    truth_m, rotation = truths[0]
    return paths["dron1"], outside, truth_m, rotation


def fused_m(fused, drone=0):
    """Positions of a drone, (frames, 3)."""
    return fused.trajectories.position_m[:, drone]


# Whole flights


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"inside_part": 0.0, "outside_part": 0.0},
        {"outside_s": 1.0},
        {"inside_stated": 1 / 3},
        {"inside_m": (0.008, 0.008, 0.02)},
        {"inside_stated": 3.0},
    ],
    ids=str,
)
def test_ellipsoids_hold_the_truth_also_with_correlated_errors_and_wrong_covariances(given):
    inside, better, scales = [], [], []
    for seed in range(4):
        path, outside, truth_m, rotation = one_flight(seed, **given)
        fused = fuse(path, outside)
        error_m = fused_m(fused) - truth_m
        distances = squared_errors(error_m, fused.trajectories.covariance_m2[:, 0])
        inside.append(np.mean(distances < chi2.ppf(0.9, 3)))
        path_error_m = path.position_m - truth_m
        track_error_m = outside.position_m[:, 0] - truth_m - rotation.apply(ARM_M)
        better.append(rms(error_m) / min(rms(path_error_m), rms(track_error_m)))
        scales.append(fused.drones[0].weighted.scale[0])
    # 6 s hold about 10 independent errors of 0.3 s, so the fraction of 4 flights has a standard deviation of 0.055.
    assert 0.76 < np.mean(inside) < 0.99
    # The arm, which is the mean difference of both sources, has the errors of the worse one.
    assert np.mean(better) < (1.6 if "inside_m" in given else 1.0)
    if given.get("inside_stated") == 3.0:
        assert max(scales) < 0.9


def test_a_path_that_was_smoothed_before_is_not_smoothed_again():
    path, outside, truth_m, _ = one_flight(24)
    velocity_m_s = np.gradient(truth_m, 1 / FPS, axis=0)
    before = replace(path, position_m=truth_m, velocity_m_s=velocity_m_s)
    vague = replace(outside, covariance_m2=1e8 * outside.covariance_m2)
    # The outside's scale is learned, so it has a little weight; a smoother would move the path by 1 mm and more.
    assert rms(fused_m(fuse(before, vague)) - truth_m) < 1.5e-3


def test_a_drone_at_rest():
    path, outside, truth_m, _ = one_flight(23, 60)
    at_m = np.tile(truth_m[0], (60, 1))
    middle_m = at_m + ARM_M
    still = camera_path(at_m, Rotation.identity(60), path.covariance)
    fused = fuse(still, outside_tracks(middle_m[:, None], outside.covariance_m2))
    # The input has no errors, so only rounding remains.
    np.testing.assert_allclose(fused_m(fused), at_m, atol=1e-9)
    np.testing.assert_allclose(fused.drones[0].weighted.arm_m, ARM_M, atol=1e-9)


def test_fusion_of_the_middle():
    path, outside, truth_m, rotation = one_flight(5)
    fused = fuse(path, outside, point="middle")
    middle_m = truth_m + rotation.apply(ARM_M)
    assert rms(fused_m(fused) - middle_m) < rms(outside.position_m[:, 0] - middle_m)
    found = Rotation.from_quat(fused.trajectories.orientation_wxyz[:, 0], scalar_first=True)
    # Rounding of a product of unit quaternions.
    np.testing.assert_allclose((found.inv() * rotation).magnitude(), 0, atol=1e-7)


def test_a_single_path_without_a_name_and_tracks_without_covariances():
    path, outside, truth_m, _ = one_flight(6)
    fused = fuse(path, replace(outside, covariance_m2=None, status=None))
    assert fused.trajectories.drones == ("drone",)
    assert rms(fused_m(fused) - truth_m) < rms(path.position_m - truth_m)


def test_the_clock_offset_of_a_camera_is_estimated():
    path, outside, truth_m, _ = one_flight(7)
    late = replace(path, time_s=path.time_s + 0.815)
    fused = fuse(late, outside, max_offset_s=2.0)
    offset = fused.drones[0].offset
    assert offset.offset_s == pytest.approx(0.815, abs=4 * offset.std_s)
    assert offset.std_s < 0.1 / FPS
    both = fused.source[:, 0] == 3
    assert both.sum() >= 148
    error_m = (fused_m(fused) - truth_m)[both]
    assert rms(error_m) < rms(path.position_m - truth_m)


def test_samples_between_frames_are_used_at_their_own_times():
    """The camera has the same rate, half a step later; the drone flies at up to 4 m/s: no interpolation, and no lag."""
    _, outside, truth_m, _ = one_flight(8)
    between_m, rotation = smooth_flight(np.random.default_rng(8), 150, offset_s=0.02)
    noise_m = np.random.default_rng(8).normal(scale=0.001, size=(150, 3))
    covariance = np.tile(1e-6 * np.eye(6), (150, 1, 1))
    path = camera_path(between_m + noise_m, rotation, covariance, first_s=0.02)
    fused = fuse(path, outside)
    assert fused.drones[0].frames_both >= 149
    # The noise is 1.7 mm; a lag of half a step would be 20 mm.
    assert rms(fused_m(fused) - truth_m) < 0.0025


# Faulty input


def test_gaps_of_either_source_are_bridged_without_a_jump():
    path, outside, truth_m, _ = one_flight(9)
    inside_gap, outside_gap = slice(40, 70), slice(90, 120)
    fused = fuse(remove_poses(path, inside_gap), remove_positions(outside, outside_gap))
    assert (fused.source[inside_gap] == 2).all()
    assert (fused.source[outside_gap] == 1).all()
    found = fused.trajectories
    assert (found.status == Status.TRACKED).all()
    error_m = fused_m(fused) - truth_m
    jumps_m = np.linalg.norm(np.diff(error_m, axis=0), axis=1)
    # The outside's errors are 7 mm; their change between two frames is smaller.
    assert jumps_m.max() < 0.006
    spread_m = np.sqrt(np.trace(found.covariance_m2[:, 0], axis1=1, axis2=2))
    # In the gap, the orientation is unknown, and so is the direction of the arm of 0.12 m.
    assert spread_m[55] > 2 * spread_m[20]
    assert np.linalg.norm(error_m[55]) < 4 * spread_m[55]
    assert np.isnan(found.orientation_wxyz[45:65, 0]).all()


def test_a_drone_without_both_sources_coasts_and_is_then_lost():
    path, outside, _, _ = one_flight(9)
    gone = slice(50, 100)
    fused = fuse(remove_poses(path, gone), remove_positions(outside, gone))
    status = fused.trajectories.status[:, 0]
    assert (status[np.r_[50:60, 90:100]] == Status.COASTING).all()
    assert (status[65:85] == Status.LOST).all()
    assert np.isnan(fused_m(fused)[65:85]).all()
    assert (status[[0, 49, 100, 149]] == Status.TRACKED).all()


@pytest.mark.parametrize("which", ["inside", "outside"])
def test_the_source_with_gross_errors_is_left_out(which):
    path, outside, truth_m, _ = one_flight(12)
    plain = fuse(path, outside)
    rng = np.random.default_rng(12)
    # Gross errors in the very first frame, in single frames, and for more than a second.
    wrong = np.unique([0, 1, *rng.choice(np.arange(5, 60), 6, replace=False), *range(80, 110)])
    if which == "inside":
        path.position_m[wrong] += [0.3, -0.2, 0.3]
        path.orientation_wxyz[wrong] = Rotation.random(len(wrong), rng=rng).as_quat(scalar_first=True)
        index, limit_m = 0, 0.04
    else:
        outside.position_m[wrong, 0] += [0.2, 0.2, -0.1]
        index, limit_m = 1, 0.015
    fused = fuse(path, outside)
    assert (fused.source[wrong, 0] == 2 - index).all()
    gross = fused.drones[0].weighted.gross.sum(axis=0)
    # Poses next to gross ones may be left out with them.
    assert len(wrong) - 2 <= gross[index] <= len(wrong) + 12
    assert gross[1 - index] <= 2
    error_m = fused_m(fused) - truth_m
    # The result is as good as without gross errors, except for the missing frames.
    assert rms(np.delete(error_m, wrong, axis=0)) < 1.5 * rms(fused_m(plain) - truth_m)
    # The outside alone is off by 7 mm, and by 7 mm more if the arm's direction is interpolated between poses.
    assert np.linalg.norm(error_m[wrong], axis=1).max() < limit_m


def test_identity_swaps_are_resolved():
    paths, outside, _ = fly_twice_seen(13, 100, num_drones=2, distance_m=1.5)
    plain = fuse(paths, outside)
    assert not plain.identity_swaps
    position_m = outside.position_m.copy()
    position_m[70:] = position_m[70:, ::-1]
    swapped = replace(outside, position_m=position_m)
    fused = fuse(paths, swapped)
    first, second = fused.identity_swaps
    assert (first.drone, first.frame, first.before, first.after) == ("dron1", 70, "0", "1")
    assert (second.drone, second.frame, second.before, second.after) == ("dron2", 70, "1", "0")
    assert fused.trajectories.drones == ("dron1", "dron2")
    np.testing.assert_allclose(fused.trajectories.position_m, plain.trajectories.position_m, atol=1e-12)
    # A drone without a camera keeps its track.
    fused = fuse({"dron1": paths["dron1"]}, swapped)
    assert fused.trajectories.drones == ("dron1", "1")
    np.testing.assert_array_equal(fused_m(fused, 1), outside.position_m[:, 1])
    assert [one.frame for one in fused.identity_swaps] == [70]


def test_a_path_without_a_track_is_smoothed_and_a_track_without_a_path_is_kept():
    paths, outside, truths = fly_twice_seen(15, 100, num_drones=2)
    path, truth_m = paths["dron1"], truths[0][0] - 20
    far = replace(path, position_m=path.position_m - 20)
    fused = fuse({"dron2": paths["dron2"], "0": far}, outside)
    found = fused.trajectories
    assert found.drones == ("dron2", "0", "0 outside")
    assert fused.drones[1].tracks == ()
    assert fused.drones[1].weighted is None
    assert rms(fused_m(fused, 1) - truth_m) < rms(far.position_m - truth_m)
    assert (fused.source[:, 1] == 1).all()
    np.testing.assert_array_equal(found.position_m[:, 2], outside.position_m[:, 0])
    np.testing.assert_array_equal(found.covariance_m2[:, 2], outside.covariance_m2[:, 0])


def test_frames_that_coast_or_have_no_information_change_nothing():
    path, outside, _, _ = one_flight(17, 60)
    rows = slice(20, 40)
    status, astray_m = path.status.copy(), path.position_m.copy()
    status[rows] = Status.COASTING
    astray_m[rows] += 0.01
    without = [replace(path, status=status, position_m=astray_m)]
    for value in (np.inf, np.nan, 1e7):
        covariance = path.covariance.copy()
        covariance[rows, :3, :3] = value
        without.append(replace(path, covariance=covariance))
    expected = fuse(replace(path, status=status), outside)
    for one in without:
        found = fuse(one, outside)
        np.testing.assert_array_equal(fused_m(found), fused_m(expected))
        assert (found.source[rows] == 2).all()


def test_tracks_with_unknown_uncertainty_are_not_used():
    path, outside, truth_m, _ = one_flight(17, 60)
    outside.covariance_m2[:50] = np.nan
    fused = fuse(path, remove_positions(outside, slice(50, 60)))
    assert fused.trajectories.drones == ("drone",)
    assert (fused.source == 1).all()
    assert rms(fused_m(fused) - truth_m) < rms(path.position_m - truth_m)


@settings(max_examples=4)
@given(
    rotvec=st.tuples(*[st.floats(-3, 3)] * 3),
    shift_m=st.tuples(*[st.floats(-10, 10)] * 3),
    seed=st.integers(20, 99),
)
def test_turning_and_shifting_the_world_turns_and_shifts_the_result(rotvec, shift_m, seed):
    path, outside, _, _ = one_flight(seed, 60)
    turn = Rotation.from_rotvec(rotvec)
    R, middle_m = turn.as_matrix(), turn.apply(outside.position_m[:, 0]) + shift_m
    covariance_m2 = R @ outside.covariance_m2 @ R.T
    symmetric_m2 = (covariance_m2 + covariance_m2.mT) / 2
    there = outside_tracks(middle_m[:, None], symmetric_m2)
    expected, found = fuse(path, outside), fuse(in_other_world(path, turn, shift_m), there)
    # The search for the scales ends about 1e-5 from its minimum, because the cost is flat there. Measured 2e-6 m.
    np.testing.assert_allclose(fused_m(found), turn.apply(fused_m(expected)) + shift_m, atol=5e-5)
    np.testing.assert_allclose(found.drones[0].weighted.arm_m, expected.drones[0].weighted.arm_m, atol=5e-5)


# The command


files = made_once("paths_and_tracks", make_paths_and_tracks)


@pytest.fixture
def run_fuse(run_psotrack, files):
    """Runs `onboard fuse` on words, of which those that end in .csv without a folder are in `files`."""

    def call(words, *more):
        return run_psotrack("onboard", "fuse", *(files / word for word in words.split()), *more).ended().out

    return call


def test_files_are_fused_into_tracks_that_other_commands_read(run_fuse, files, tmp_path):
    out, report = tmp_path / "fused.csv", tmp_path / "report.json"
    said = run_fuse("dron1.csv dron2.csv tracks.csv", "--out", out, "--json", report)
    assert "dron1: track 0 and track 1" in said
    assert "from frame 60: dron1 is track 1 instead of 0" in said
    fused = read_trajectories(out)
    assert fused.drones == ("dron1", "dron2")
    _, _, truths = fly_with_a_swap()
    for drone, (truth_m, _) in enumerate(truths):
        # In frames without a pose, errors are those of the outside tracks, 7 mm, and of an interpolated orientation.
        assert rms(fused.position_m[:, drone] - truth_m) < 0.005
    assert np.isfinite(fused.covariance_m2).all()
    assert fused.seen.all()
    header, first = out.read_text().splitlines()[:2]
    assert {"qw", "qx", "qy", "qz", "source", "status"} <= set(header.split(","))
    assert first.endswith("both,tracked")
    content = json.loads(report.read_text())
    assert content["point"] == "camera"
    assert [exchange["frame"] for exchange in content["exchanges"]] == [60, 60]
    drone, other = content["drones"]
    # Track 0 is lost from frame 80 to 89, and in these frames it belongs to the second drone.
    assert (drone["frames_both"], drone["frames_inside"], drone["frames_outside"]) == (90, 0, 10)
    assert other["frames_inside"] == 10
    assert drone["lever_arm_m"] == pytest.approx(ARM_M, abs=0.005)
    assert len(drone["lever_arm_std_m"]) == 3
    assert drone["offset_s"] is None
    assert drone["inside"]["scale"] > 0


def test_options_of_the_point_and_of_the_clock(run_fuse, tmp_path):
    options = ("--at", "middle", "--max-offset", 0.5, "--json", "-")
    content = json.loads(run_fuse("dron2.csv tracks.csv", "--out", tmp_path / "fused.csv", *options))
    assert content["point"] == "middle"
    assert content["others"] == ["0"]
    # Both clocks are the same. The limit is four standard deviations.
    assert abs(content["drones"][0]["offset_s"]) < 4 * content["drones"][0]["offset_std_s"]


def test_drones_and_tracks_that_are_not_fused_are_kept_with_a_note(run_fuse, files, tmp_path):
    said = run_fuse("dron1.csv blind.csv tracks.csv", "--out", tmp_path / "two.csv")
    assert "dron3: no track, kept as it is" in said
    assert "nothing was fused" not in said
    tracks = read_trajectories(files / "tracks.csv")
    write_trajectories(tmp_path / "first.csv", tracks.at_frames(np.arange(40)))
    path, name = read_camera_path(files / "dron1.csv")
    write_camera_path(tmp_path / "second.csv", remove_poses(path, slice(0, 60)), name)
    said = run_fuse("", tmp_path / "second.csv", tmp_path / "first.csv", "--out", tmp_path / "fused.csv")
    assert "nothing was fused, because no frame has both a pose and a track" in said.splitlines()[-1]
