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
    make_paths_and_tracks,
    outside_tracks,
    remove_poses,
    remove_positions,
    smooth_flight,
)
from helpers import make_once
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.inside_out import fuse, read_camera_path, write_camera_path
from psotrack.recordings.exchange import export_tracks
from psotrack.trajectories import Status, read_trajectories, write_trajectories


def rms(error_m):
    return float(np.sqrt(np.mean(np.sum(error_m**2, axis=-1))))


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
def test_ellipsoids_hold_the_truth_also_with_correlated_errors_and_wrong_covariances(given) -> None:
    inside, better, scales = [], [], []
    for seed in range(4):
        paths, outside, ((truth_m, rotation),) = fly_twice_seen(seed, **given)
        fused = fuse(paths, outside)
        found = fused.trajectories
        error_m = found.position_m[:, 0] - truth_m
        misfit = np.vecdot(error_m, np.linalg.solve(found.covariance_m2[:, 0], error_m[..., None])[..., 0])
        inside.append(np.mean(misfit < chi2.ppf(0.9, 3)))
        outside_m = outside.position_m[:, 0] - truth_m - rotation.apply(ARM_M)
        better.append(rms(error_m) / min(rms(paths["dron1"].position_m - truth_m), rms(outside_m)))
        scales.append(fused.drones[0].weighted.scale[0])
    # 6 s hold about 10 independent errors of 0.3 s, so the fraction of 4 flights has a standard deviation of 0.055.
    assert 0.76 < np.mean(inside) < 0.99
    # The arm, which is the mean difference of both sources, has the errors of the worse one.
    assert np.mean(better) < (1.6 if "inside_m" in given else 1.0)
    if given.get("inside_stated") == 3.0:
        assert max(scales) < 0.9


def test_a_path_that_was_smoothed_before_is_not_smoothed_again() -> None:
    paths, outside, ((truth_m, _),) = fly_twice_seen(24)
    velocity_m_s = np.gradient(truth_m, 1 / FPS, axis=0)
    before = replace(paths["dron1"], position_m=truth_m, velocity_m_s=velocity_m_s)
    vague = replace(outside, covariance_m2=1e8 * outside.covariance_m2)
    found = fuse(before, vague).trajectories
    # The outside's scale is learned, so it has a little weight; a smoother would move the path by 1 mm and more.
    assert rms(found.position_m[:, 0] - truth_m) < 1.5e-3


def test_few_common_frames_and_a_drone_at_rest() -> None:
    paths, outside, ((truth_m, _),) = fly_twice_seen(23, 60)
    few = fuse(paths, remove_positions(outside, np.r_[0:20, 23:60]))
    assert few.drones[0].frames_both == 3
    # With one source alone, the motion model removes a part of the white errors.
    assert rms(few.trajectories.position_m[:, 0] - truth_m) < rms(paths["dron1"].position_m - truth_m)
    at_m, turns = np.tile(truth_m[0], (60, 1)), Rotation.from_rotvec(np.zeros((60, 3)))
    still = camera_path(at_m, turns, paths["dron1"].covariance)
    fused = fuse(still, outside_tracks((at_m + ARM_M)[:, None], outside.covariance_m2))
    # The input has no errors, so only rounding remains.
    np.testing.assert_allclose(fused.trajectories.position_m[:, 0], at_m, atol=1e-9)
    np.testing.assert_allclose(fused.drones[0].weighted.arm_m, ARM_M, atol=1e-9)


def test_fusion_of_the_middle() -> None:
    paths, outside, ((truth_m, rotation),) = fly_twice_seen(5)
    found = fuse(paths, outside, point="middle").trajectories
    middle_m = truth_m + rotation.apply(ARM_M)
    assert rms(found.position_m[:, 0] - middle_m) < rms(outside.position_m[:, 0] - middle_m)
    apart = Rotation.from_quat(found.orientation_wxyz[:, 0], scalar_first=True).inv() * rotation
    # Rounding of a product of unit quaternions.
    np.testing.assert_allclose(apart.magnitude(), 0, atol=1e-7)


def test_a_single_path_without_a_name_and_tracks_without_covariances() -> None:
    paths, outside, ((truth_m, _),) = fly_twice_seen(6)
    fused = fuse(paths["dron1"], replace(outside, covariance_m2=None, status=None))
    assert fused.trajectories.drones == ("drone",)
    assert rms(fused.trajectories.position_m[:, 0] - truth_m) < rms(paths["dron1"].position_m - truth_m)


def test_the_clock_offset_of_a_camera_is_estimated() -> None:
    paths, outside, ((truth_m, _),) = fly_twice_seen(7, 150)
    late = replace(paths["dron1"], time_s=paths["dron1"].time_s + 0.815)
    fused = fuse({"dron1": late}, outside, max_offset_s=2.0)
    offset = fused.drones[0].offset
    assert offset.offset_s == pytest.approx(0.815, abs=4 * offset.std_s)
    assert offset.std_s < 0.1 / FPS
    both = fused.source[:, 0] == 3
    assert both.sum() >= 148
    error_m = (fused.trajectories.position_m[:, 0] - truth_m)[both]
    assert rms(error_m) < rms(paths["dron1"].position_m - truth_m)


def test_samples_between_frames_are_used_at_their_own_times() -> None:
    """The camera has the same rate, half a step later; the drone flies at up to 4 m/s: no interpolation, and no lag."""
    rng = np.random.default_rng(8)
    _, outside, ((truth_m, _),) = fly_twice_seen(8)
    between_m, rotation = smooth_flight(np.random.default_rng(8), 150, offset_s=0.02)
    covariance = np.broadcast_to(np.diag([1e-6] * 6), (150, 6, 6)).copy()
    path = camera_path(between_m + rng.normal(scale=0.001, size=(150, 3)), rotation, covariance, first_s=0.02)
    fused = fuse({"dron1": path}, outside)
    assert fused.drones[0].frames_both >= 149
    # The noise is 1.7 mm; a lag of half a step would be 20 mm.
    assert rms(fused.trajectories.position_m[:, 0] - truth_m) < 0.0025


# Faulty input


def test_gaps_of_either_source_are_bridged_without_a_jump() -> None:
    paths, outside, ((truth_m, _),) = fly_twice_seen(9)
    inside_gap, outside_gap = slice(40, 70), slice(90, 120)
    fused = fuse({"dron1": remove_poses(paths["dron1"], inside_gap)}, remove_positions(outside, outside_gap))
    assert (fused.source[inside_gap] == 2).all()
    assert (fused.source[outside_gap] == 1).all()
    found = fused.trajectories
    assert (found.status == Status.TRACKED).all()
    error_m = found.position_m[:, 0] - truth_m
    # The outside's errors are 7 mm; their change between two frames is smaller.
    assert np.linalg.norm(np.diff(error_m, axis=0), axis=1).max() < 0.006
    spread_m = np.sqrt(np.trace(found.covariance_m2[:, 0], axis1=1, axis2=2))
    # In the gap, the orientation is unknown, and so is the direction of the arm of 0.12 m.
    assert spread_m[55] > 2 * spread_m[20]
    assert np.linalg.norm(error_m[55]) < 4 * spread_m[55]
    assert np.isnan(found.orientation_wxyz[45:65, 0]).all()
    # Without both sources, the drone coasts and is then lost.
    gone = slice(50, 100)
    status, position_m = (
        getattr(fuse(remove_poses(paths["dron1"], gone), remove_positions(outside, gone)).trajectories, name)[
            :, 0
        ]
        for name in ("status", "position_m")
    )
    assert (status[np.r_[50:60, 90:100]] == Status.COASTING).all()
    assert (status[65:85] == Status.LOST).all()
    assert np.isnan(position_m[65:85]).all()
    assert (status[[0, 49, 100, 149]] == Status.TRACKED).all()


@pytest.mark.parametrize("which", ["inside", "outside"])
def test_the_source_with_gross_errors_is_left_out(which) -> None:
    paths, outside, ((truth_m, _),) = fly_twice_seen(12)
    rng = np.random.default_rng(12)
    # Gross errors in the very first frame, in single frames, and for more than a second.
    wrong = np.unique([0, 1, *rng.choice(np.arange(5, 60), 6, replace=False), *range(80, 110)])
    path, middle_m = paths["dron1"], outside.position_m.copy()
    position_m, orientation_wxyz = path.position_m.copy(), path.orientation_wxyz.copy()
    if which == "inside":
        position_m[wrong] += [0.3, -0.2, 0.3]
        orientation_wxyz[wrong] = Rotation.random(len(wrong), rng=rng).as_quat(scalar_first=True)
    else:
        middle_m[wrong, 0] += [0.2, 0.2, -0.1]
    plain = fuse(paths, outside)
    spoilt = replace(path, position_m=position_m, orientation_wxyz=orientation_wxyz)
    fused = fuse({"dron1": spoilt}, replace(outside, position_m=middle_m))
    index = ("inside", "outside").index(which)
    assert (fused.source[wrong, 0] == 2 - index).all()
    gross = fused.drones[0].weighted.gross.sum(axis=0)
    # Poses next to gross ones may be left out with them.
    assert len(wrong) - 2 <= gross[index] <= len(wrong) + 12
    assert gross[1 - index] <= 2
    right = np.setdiff1d(np.arange(150), wrong)
    error_m = np.linalg.norm(fused.trajectories.position_m[:, 0] - truth_m, axis=1)
    # The result is as good as without gross errors, except for the missing frames.
    assert rms(error_m[right][:, None]) < 1.5 * rms(plain.trajectories.position_m[:, 0] - truth_m)
    # The outside alone is off by 7 mm, and by 7 mm more if the arm's direction is interpolated between poses.
    assert error_m[wrong].max() < (0.04 if which == "inside" else 0.015)


def test_identity_swaps_are_resolved() -> None:
    paths, outside, _ = fly_twice_seen(13, 100, num_drones=2, distance_m=1.5)
    position_m = outside.position_m.copy()
    position_m[70:, [0, 1]] = position_m[70:, [1, 0]]
    swapped = replace(outside, position_m=position_m)
    named = replace(swapped, position_m=swapped.position_m[:, [1, 0]], drones=("b", "a"))
    fused, plain = fuse(paths, named), fuse(paths, outside)
    assert [(one.drone, one.frame, one.before, one.after) for one in fused.identity_swaps] == [
        ("dron1", 70, "a", "b"),
        ("dron2", 70, "b", "a"),
    ]
    assert not plain.identity_swaps
    assert fused.trajectories.drones == ("dron1", "dron2")
    np.testing.assert_allclose(fused.trajectories.position_m, plain.trajectories.position_m, atol=1e-12)
    # A drone without a camera keeps its track.
    fused = fuse({"dron1": paths["dron1"]}, swapped)
    assert fused.trajectories.drones == ("dron1", "1")
    np.testing.assert_array_equal(fused.trajectories.position_m[:, 1], outside.position_m[:, 1])
    assert [one.frame for one in fused.identity_swaps] == [70]


def test_a_path_without_a_track_is_smoothed_and_a_track_without_a_path_is_kept() -> None:
    paths, outside, truths = fly_twice_seen(15, 100, num_drones=2)
    far = {"dron2": paths["dron2"], "0": replace(paths["dron1"], position_m=paths["dron1"].position_m - 20)}
    fused = fuse(far, outside)
    found = fused.trajectories
    assert found.drones == ("dron2", "0", "0 outside")
    assert fused.drones[1].tracks == ()
    assert fused.drones[1].weighted is None
    truth_m = truths[0][0] - 20
    assert rms(found.position_m[:, 1] - truth_m) < rms(far["0"].position_m - truth_m)
    assert (fused.source[:, 1] == 1).all()
    np.testing.assert_array_equal(found.position_m[:, 2], outside.position_m[:, 0])
    np.testing.assert_array_equal(found.covariance_m2[:, 2], outside.covariance_m2[:, 0])
    # Sources without common frames.
    later = outside_tracks(outside.position_m[:, :1], outside.covariance_m2[:, :1], first=130)
    fused = fuse({"dron1": paths["dron1"]}, later)
    assert fused.trajectories.drones == ("dron1", "0")
    np.testing.assert_array_equal(fused.trajectories.frame, [*range(100), *range(130, 230)])
    assert (fused.source[:100] == [1, 0]).all()
    assert (fused.source[100:] == [0, 2]).all()


def test_frames_that_coast_or_have_no_information_change_nothing() -> None:
    paths, outside, _ = fly_twice_seen(17, 60)
    path, rows = paths["dron1"], slice(20, 40)
    status, astray_m = path.status.copy(), path.position_m.copy()
    status[rows] = Status.COASTING
    astray_m[rows] += 0.01
    coasting = replace(path, status=status)
    without = [replace(coasting, position_m=astray_m)]
    for value in (np.inf, np.nan, 1e7):
        covariance = path.covariance.copy()
        covariance[rows, :3, :3] = value
        without.append(replace(path, covariance=covariance))
    expected = fuse(coasting, outside)
    for found in (fuse(one, outside) for one in without):
        np.testing.assert_array_equal(found.trajectories.position_m, expected.trajectories.position_m)
        assert (found.source[rows] == 2).all()
    # Orientations are at most as uncertain as unknown ones.
    turned_m = []
    for variance_rad2 in (3.0, 1e30):
        covariance = path.covariance.copy()
        covariance[rows, 3:, 3:] = variance_rad2 * np.eye(3)
        turned_m.append(fuse(replace(path, covariance=covariance), outside).trajectories.position_m)
    np.testing.assert_array_equal(*turned_m)
    assert np.isfinite(turned_m).all()


def test_tracks_with_unknown_uncertainty_are_not_used() -> None:
    paths, outside, ((truth_m, _),) = fly_twice_seen(17, 60)
    covariance_m2 = outside.covariance_m2.copy()
    covariance_m2[:50] = np.nan
    fused = fuse(paths, remove_positions(replace(outside, covariance_m2=covariance_m2), slice(50, 60)))
    assert fused.trajectories.drones == ("dron1",)
    assert (fused.source == 1).all()
    assert rms(fused.trajectories.position_m[:, 0] - truth_m) < rms(paths["dron1"].position_m - truth_m)


@settings(max_examples=4)
@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    shift_m=st.tuples(*[st.floats(-10, 10)] * 3),
    seed=st.integers(20, 99),
)
def test_turning_and_shifting_the_world_turns_and_shifts_the_result(turn, shift_m, seed) -> None:
    paths, outside, _ = fly_twice_seen(seed, 60)
    R, path, by_world = Rotation.from_rotvec(turn), paths["dron1"], np.eye(6)
    by_world[:3, :3] = R.as_matrix()
    orientation = R * Rotation.from_quat(path.orientation_wxyz, scalar_first=True)
    turned = replace(
        path,
        position_m=R.apply(path.position_m) + shift_m,
        orientation_wxyz=orientation.as_quat(scalar_first=True),
        covariance=by_world @ path.covariance @ by_world.T,
    )
    spread_m2 = R.as_matrix() @ outside.covariance_m2 @ R.as_matrix().T
    spread_m2 = (spread_m2 + spread_m2.swapaxes(-1, -2)) / 2
    middle_m = R.apply(outside.position_m[:, 0])[:, None] + shift_m
    expected, found = (
        fuse(paths, outside),
        fuse(turned, replace(outside, position_m=middle_m, covariance_m2=spread_m2)),
    )
    there_m = R.apply(expected.trajectories.position_m[:, 0]) + shift_m
    # The search for the scales ends about 1e-5 from its minimum, because the cost is flat there. Measured 2e-6 m.
    np.testing.assert_allclose(found.trajectories.position_m[:, 0], there_m, atol=5e-5)
    np.testing.assert_allclose(found.drones[0].weighted.arm_m, expected.drones[0].weighted.arm_m, atol=5e-5)


# The command


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return make_once(tmp_path_factory, "paths_and_tracks", make_paths_and_tracks)


@pytest.fixture
def run_fuse(run_psotrack, files):
    """Runs `onboard fuse` on words, of which those that end in .csv without a folder are in `files`."""

    def call(words, *more):
        done = run_psotrack("onboard", "fuse", *(files / word for word in words.split()), *more)
        assert done.code == 0, done.err
        return done.out

    return call


def test_files_are_fused_into_tracks_that_other_commands_read(run_fuse, files, tmp_path) -> None:
    out, report = tmp_path / "fused.csv", tmp_path / "report.json"
    said = run_fuse("dron1.csv dron2.csv tracks.csv", "--out", out, "--json", report)
    assert "dron1: track 0 and track 1" in said
    assert "from frame 60: dron1 is track 1 instead of 0" in said
    fused = read_trajectories(out)
    assert fused.drones == ("dron1", "dron2")
    for drone, (truth_m, _) in enumerate(fly_with_a_swap()[2]):
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
    drone = content["drones"][0]
    # Track 0 is lost from frame 80 to 89, and in these frames it belongs to the second drone.
    assert (drone["frames_both"], drone["frames_inside"], drone["frames_outside"]) == (90, 0, 10)
    assert content["drones"][1]["frames_inside"] == 10
    assert np.allclose(drone["lever_arm_m"], ARM_M, atol=0.005)
    assert len(drone["lever_arm_std_m"]) == 3
    assert drone["offset_s"] is None
    assert drone["inside"]["scale"] > 0
    # Tracks may have any format.
    export_tracks(read_trajectories(files / "tracks.csv"), "json", tmp_path / "tracks.json")
    run_fuse("dron1.csv dron2.csv", tmp_path / "tracks.json", "--out", tmp_path / "same.csv")
    assert (tmp_path / "same.csv").read_bytes() == out.read_bytes()


def test_options_of_the_point_and_of_the_clock(run_fuse, tmp_path) -> None:
    options = ("--at", "middle", "--max-offset", 0.5, "--json", "-")
    content = json.loads(run_fuse("dron2.csv tracks.csv", "--out", tmp_path / "fused.csv", *options))
    assert content["point"] == "middle"
    assert content["others"] == ["0"]
    # Both clocks are the same. The limit is four standard deviations.
    assert abs(content["drones"][0]["offset_s"]) < 4 * content["drones"][0]["offset_std_s"]


def test_drones_and_tracks_that_are_not_fused_are_kept_with_a_note(run_fuse, files, tmp_path) -> None:
    said = run_fuse("dron1.csv blind.csv tracks.csv", "--out", tmp_path / "two.csv")
    assert "dron3: no track, kept as it is" in said
    assert "nothing was fused" not in said
    tracks = read_trajectories(files / "tracks.csv")
    write_trajectories(tmp_path / "first.csv", tracks.at_frames(np.arange(40)))
    path, name = read_camera_path(files / "dron1.csv")
    write_camera_path(tmp_path / "second.csv", remove_poses(path, slice(0, 60)), name)
    said = run_fuse("", tmp_path / "second.csv", tmp_path / "first.csv", "--out", tmp_path / "fused.csv")
    assert "nothing was fused, because no frame has both a pose and a track" in said.splitlines()[-1]
