"""Fusion of inside-out and outside-in tracks, compared with dense Gaussians and ground truth, and with faulty input."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import chi2

from psotrack.errors import InputError
from psotrack.inside_out import CameraPath, fuse
from psotrack.trajectories import Status, Trajectories

FPS = 25.0
ARM_M = np.array([0.01, 0.03, -0.12])
INSIDE_M, OUTSIDE_M = np.array([0.001, 0.001, 0.003]), np.array([0.004, 0.004, 0.004])


def flight(rng, num_frames, offset_s=0.0):
    """Positions (frames, 3) and rotations of a camera that flies and turns smoothly."""
    time_s = np.arange(num_frames) / FPS + offset_s
    frequency, phase = rng.uniform(0.1, 0.5, (3, 3, 1)), rng.uniform(0, 6, (3, 3, 1))
    waves = np.sin(2 * np.pi * frequency * time_s + phase).sum(axis=0).T
    knots_s = np.arange(-5.0, num_frames / FPS + 7.0)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.4, size=(len(knots_s), 3)), axis=0))
    return 0.8 * waves + [0, 0, 2.0], Slerp(knots_s, turns)(time_s)


def correlated_errors(rng, num_frames, time_s):
    """Gauss-Markov errors with a variance of 1: (frames, 3)."""
    left = np.exp(-1 / FPS / time_s)
    values = rng.normal(size=(num_frames, 3))
    for k in range(1, num_frames):
        values[k] = left * values[k - 1] + np.sqrt(1 - left**2) * values[k]
    return values


#: Errors of both sources: standard deviations, metres, and factors on the stated ones; the parts of the variances that
#: are correlated, over 0.3 s inside and `outside_s` outside.
USUAL = {
    "inside_m": INSIDE_M,
    "inside_stated": 1.0,
    "inside_part": 0.5,
    "outside_stated": 1.0,
    "outside_part": 1.0,
    "outside_s": 0.3,
}


def recording(seed, num_frames=150, num_drones=1, *, distance_m=4.0, **given):
    """Inside paths by name, outside tracks, and each drone's true camera positions (frames, 3) and rotations."""
    given = USUAL | given
    rng = np.random.default_rng(seed)

    def errors(part, time_s):
        white = rng.normal(size=(num_frames, 3))
        return np.sqrt(1 - part) * white + np.sqrt(part) * correlated_errors(rng, num_frames, time_s)

    paths, middles, truths = {}, [], []
    for drone in range(num_drones):
        position_m, rotation = flight(rng, num_frames)
        position_m = position_m + np.array([distance_m * drone, 0, 0])
        error_m = rotation.apply(errors(given["inside_part"], 0.3) * given["inside_m"])
        covariance = np.zeros((num_frames, 6, 6))
        root = rotation.as_matrix() * (given["inside_stated"] * np.asarray(given["inside_m"]))
        covariance[:, :3, :3] = root @ root.mT
        covariance[:, 3:, 3:] = 1e-6 * np.eye(3)
        paths[f"dron{drone + 1}"] = camera_path(position_m + error_m, rotation, covariance)
        middles.append(
            position_m + rotation.apply(ARM_M) + errors(given["outside_part"], given["outside_s"]) * OUTSIDE_M
        )
        truths.append((position_m, rotation))
    middle_m = np.stack(middles, axis=1)
    stated_m2 = np.broadcast_to(
        np.diag((given["outside_stated"] * OUTSIDE_M) ** 2), (*middle_m.shape, 3)
    ).copy()
    return paths, outside_tracks(middle_m, stated_m2), truths


def camera_path(position_m, rotation, covariance, first_s=0.0):
    n = len(position_m)
    return CameraPath(
        frame=np.arange(n),
        time_s=np.arange(n) / FPS + first_s,
        position_m=position_m,
        orientation_wxyz=rotation.as_quat(scalar_first=True),
        covariance=covariance,
        num_markers=np.full(n, 8),
        reprojection_px=np.full(n, 0.3),
        ambiguity=np.zeros(n),
        status=np.full(n, int(Status.TRACKED)),
        flags=np.zeros(n, int),
    )


def outside_tracks(middle_m, covariance_m2, first=0):
    n = len(middle_m)
    return Trajectories(
        frame=np.arange(first, first + n),
        time_s=np.arange(first, first + n) / FPS,
        drones=tuple(str(drone) for drone in range(middle_m.shape[1])),
        position_m=middle_m,
        status=np.full(middle_m.shape[:2], int(Status.TRACKED)),
        covariance_m2=covariance_m2,
    )


def remove_poses(path, rows):
    """The path with some frames lost."""
    status, position_m, orientation_wxyz = (
        path.status.copy(),
        path.position_m.copy(),
        path.orientation_wxyz.copy(),
    )
    status[rows], position_m[rows], orientation_wxyz[rows] = Status.LOST, np.nan, np.nan
    return replace(path, status=status, position_m=position_m, orientation_wxyz=orientation_wxyz)


def remove_positions(tracks, rows, drone=0):
    """The tracks with some frames of one track lost."""
    status = tracks.status.copy()
    status[rows, drone] = Status.LOST
    return replace(tracks, status=status)


def rms(error_m):
    return float(np.sqrt(np.mean(np.sum(error_m**2, axis=-1))))


# Whole flights


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"inside_part": 0.0, "outside_part": 0.0},
        {"inside_part": 1.0},
        {"outside_s": 1.0},
        {"inside_stated": 1 / 3},
        {"outside_stated": 1 / 3},
        {"outside_stated": 5.0},
        {"inside_stated": 0.4, "outside_stated": 0.4},
        {"inside_m": (0.008, 0.008, 0.02)},
        {"inside_m": (0.008, 0.008, 0.02), "inside_part": 0.0},
    ],
    ids=str,
)
def test_ellipsoids_hold_the_truth_also_with_correlated_errors_and_wrong_covariances(given) -> None:
    inside, better = [], []
    for seed in range(5):
        paths, outside, ((truth_m, rotation),) = recording(seed, **given)
        found = fuse(paths, outside).trajectories
        error_m = found.position_m[:, 0] - truth_m
        misfit = np.vecdot(error_m, np.linalg.solve(found.covariance_m2[:, 0], error_m[..., None])[..., 0])
        inside.append(np.mean(misfit < chi2.ppf(0.9, 3)))
        outside_m = outside.position_m[:, 0] - truth_m - rotation.apply(ARM_M)
        better.append(rms(error_m) / min(rms(paths["dron1"].position_m - truth_m), rms(outside_m)))
    # 6 s hold about 10 independent errors of 0.3 s, so the fraction of 5 flights has a standard deviation of 0.05.
    assert 0.78 < np.mean(inside) < 0.99
    # The arm, which is the mean difference of both sources, has the errors of the worse one.
    assert np.mean(better) < (1.6 if "inside_m" in given else 1.0)


def test_a_path_that_states_too_large_errors_is_weighted_by_the_differences() -> None:
    ratios = []
    for seed in range(5):
        paths, outside, ((truth_m, _),) = recording(seed, inside_stated=3.0)
        fused = fuse(paths, outside)
        ratios.append(
            rms(fused.trajectories.position_m[:, 0] - truth_m) / rms(paths["dron1"].position_m - truth_m)
        )
        assert fused.drones[0].weighted.scale[0] < 0.9
    assert np.mean(ratios) < 1.0


def test_a_path_that_was_smoothed_before_is_not_smoothed_again() -> None:
    paths, outside, ((truth_m, _),) = recording(24)
    velocity_m_s = np.gradient(truth_m, 1 / FPS, axis=0)
    before = replace(paths["dron1"], position_m=truth_m, velocity_m_s=velocity_m_s)
    vague = replace(outside, covariance_m2=1e8 * outside.covariance_m2)
    found = fuse(before, vague).trajectories
    # The outside's scale is learned, so it has a little weight; a smoother would move the path by 1 mm and more.
    assert rms(found.position_m[:, 0] - truth_m) < 1.5e-3


def test_few_common_frames_and_a_drone_at_rest() -> None:
    paths, outside, ((truth_m, _),) = recording(23, 60)
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
    paths, outside, ((truth_m, rotation),) = recording(5)
    fused = fuse(paths, outside, point="middle")
    error_m = fused.trajectories.position_m[:, 0] - truth_m - rotation.apply(ARM_M)
    assert rms(error_m) < rms(outside.position_m[:, 0] - truth_m - rotation.apply(ARM_M))
    np.testing.assert_allclose(
        fused.trajectories.orientation_wxyz[:, 0] * np.sign(fused.trajectories.orientation_wxyz[:, :1, 0]),
        rotation.as_quat(scalar_first=True) * np.sign(rotation.as_quat(scalar_first=True)[:, :1]),
        atol=1e-12,
    )


def test_a_single_path_without_a_name_and_tracks_without_covariances() -> None:
    paths, outside, ((truth_m, _),) = recording(6)
    fused = fuse(paths["dron1"], replace(outside, covariance_m2=None, status=None))
    assert fused.trajectories.drones == ("drone",)
    assert rms(fused.trajectories.position_m[:, 0] - truth_m) < rms(paths["dron1"].position_m - truth_m)


def test_the_clock_offset_of_a_camera_is_estimated() -> None:
    paths, outside, ((truth_m, _),) = recording(7, 200)
    late = replace(paths["dron1"], time_s=paths["dron1"].time_s + 0.815)
    fused = fuse({"dron1": late}, outside, max_offset_s=2.0)
    offset = fused.drones[0].offset
    assert offset.offset_s == pytest.approx(0.815, abs=4 * offset.std_s)
    assert offset.std_s < 0.1 / FPS
    both = fused.source[:, 0] == 3
    assert both.sum() >= 198
    assert rms((fused.trajectories.position_m[:, 0] - truth_m)[both]) < rms(
        paths["dron1"].position_m - truth_m
    )


def test_samples_between_frames_are_used_at_their_own_times() -> None:
    """The camera has the same rate, half a step later; the drone flies at up to 4 m/s: no interpolation, and no lag."""
    rng = np.random.default_rng(8)
    _, outside, ((truth_m, _),) = recording(8)
    again = np.random.default_rng(8)
    between_m, rotation = flight(again, 150, offset_s=0.02)
    covariance = np.broadcast_to(np.diag([1e-6] * 6), (150, 6, 6)).copy()
    path = camera_path(between_m + rng.normal(scale=0.001, size=(150, 3)), rotation, covariance, first_s=0.02)
    fused = fuse({"dron1": path}, outside)
    assert fused.drones[0].frames_both >= 149
    # The noise is 1.7 mm; a lag of half a step would be 20 mm.
    assert rms(fused.trajectories.position_m[:, 0] - truth_m) < 0.0025


# Faulty input


def test_gaps_of_either_source_are_bridged_without_a_jump() -> None:
    paths, outside, ((truth_m, _),) = recording(9)
    inside_gap, outside_gap = slice(40, 70), slice(90, 120)
    fused = fuse({"dron1": remove_poses(paths["dron1"], inside_gap)}, remove_positions(outside, outside_gap))
    assert (fused.source[inside_gap] == 2).all()
    assert (fused.source[outside_gap] == 1).all()
    assert (fused.trajectories.status == Status.TRACKED).all()
    error_m = fused.trajectories.position_m[:, 0] - truth_m
    # The outside's errors are 7 mm; their change between two frames is smaller.
    assert np.linalg.norm(np.diff(error_m, axis=0), axis=1).max() < 0.006
    spread_m = np.sqrt(np.trace(fused.trajectories.covariance_m2[:, 0], axis1=1, axis2=2))
    # In the gap, the orientation is unknown, and so is the direction of the arm of 0.12 m.
    assert spread_m[55] > 2 * spread_m[20]
    assert np.linalg.norm(error_m[55]) < 4 * spread_m[55]
    assert np.isnan(fused.trajectories.orientation_wxyz[45:65, 0]).all()


def test_without_both_sources_a_drone_coasts_and_is_then_lost() -> None:
    paths, outside, _ = recording(10)
    fused = fuse(
        {"dron1": remove_poses(paths["dron1"], slice(50, 100))}, remove_positions(outside, slice(50, 100))
    )
    status = fused.trajectories.status[:, 0]
    assert (status[50:60] == Status.COASTING).all()
    assert (status[90:100] == Status.COASTING).all()
    assert (status[65:85] == Status.LOST).all()
    assert np.isnan(fused.trajectories.position_m[65:85]).all()
    assert (status[[0, 49, 100, 149]] == Status.TRACKED).all()


def test_coasting_and_lost_frames_are_not_used() -> None:
    paths, outside, _ = recording(11)
    path, rows = paths["dron1"], slice(60, 80)
    astray_m, status = path.position_m.copy(), path.status.copy()
    astray_m[rows] += 0.01
    status[rows] = Status.COASTING
    expected = fuse({"dron1": replace(path, status=status)}, outside)
    found = fuse({"dron1": replace(path, status=status, position_m=astray_m)}, outside)
    np.testing.assert_array_equal(found.trajectories.position_m, expected.trajectories.position_m)
    assert (found.source[rows] == 2).all()


@pytest.mark.parametrize("which", ["inside", "outside"])
def test_the_source_with_gross_errors_is_left_out(which) -> None:
    paths, outside, ((truth_m, _),) = recording(12)
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
    fused = fuse(
        {"dron1": replace(path, position_m=position_m, orientation_wxyz=orientation_wxyz)},
        replace(outside, position_m=middle_m),
    )
    kept = 2 if which == "inside" else 1
    assert (fused.source[wrong, 0] == kept).all()
    gross = fused.drones[0].weighted.gross.sum(axis=0)
    # Poses next to gross ones may be left out with them.
    assert len(wrong) - 2 <= gross[0 if which == "inside" else 1] <= len(wrong) + 12
    assert gross[1 if which == "inside" else 0] <= 2
    right = np.setdiff1d(np.arange(150), wrong)
    error_m = np.linalg.norm(fused.trajectories.position_m[:, 0] - truth_m, axis=1)
    # The result is as good as without gross errors, except for the missing frames.
    assert rms(error_m[right][:, None]) < 1.5 * rms(plain.trajectories.position_m[:, 0] - truth_m)
    # The outside alone is off by 7 mm, and by 7 mm more if the arm's direction is interpolated between poses.
    assert error_m[wrong].max() < (0.04 if which == "inside" else 0.015)


def test_identity_swaps_are_resolved() -> None:
    paths, outside, _ = recording(13, num_drones=2, distance_m=1.5)
    exchanged_m = outside.position_m.copy()
    exchanged_m[70:, [0, 1]] = exchanged_m[70:, [1, 0]]
    swapped = replace(outside, position_m=exchanged_m[:, [1, 0]], drones=("b", "a"))
    fused, plain = fuse(paths, swapped), fuse(paths, outside)
    assert [(one.drone, one.frame, one.before, one.after) for one in fused.identity_swaps] == [
        ("dron1", 70, "a", "b"),
        ("dron2", 70, "b", "a"),
    ]
    assert not plain.identity_swaps
    assert fused.trajectories.drones == ("dron1", "dron2")
    np.testing.assert_allclose(fused.trajectories.position_m, plain.trajectories.position_m, atol=1e-12)


def test_a_drone_without_a_camera_keeps_its_track_through_an_identity_swap() -> None:
    paths, outside, _ = recording(14, num_drones=2, distance_m=1.5)
    exchanged_m = outside.position_m.copy()
    exchanged_m[70:, [0, 1]] = exchanged_m[70:, [1, 0]]
    fused = fuse({"dron1": paths["dron1"]}, replace(outside, position_m=exchanged_m))
    assert fused.trajectories.drones == ("dron1", "1")
    np.testing.assert_array_equal(fused.trajectories.position_m[:, 1], outside.position_m[:, 1])
    assert [one.frame for one in fused.identity_swaps] == [70]


def test_a_path_without_a_track_is_smoothed_and_a_track_without_a_path_is_kept() -> None:
    paths, outside, truths = recording(15, num_drones=2)
    far = {"dron2": paths["dron2"], "0": replace(paths["dron1"], position_m=paths["dron1"].position_m - 20)}
    fused = fuse(far, outside)
    assert fused.trajectories.drones == ("dron2", "0", "0 outside")
    assert fused.drones[1].tracks == ()
    assert fused.drones[1].weighted is None
    truth_m = truths[0][0] - 20
    assert rms(fused.trajectories.position_m[:, 1] - truth_m) < rms(far["0"].position_m - truth_m)
    assert (fused.source[:, 1] == 1).all()
    np.testing.assert_array_equal(fused.trajectories.position_m[:, 2], outside.position_m[:, 0])
    np.testing.assert_array_equal(fused.trajectories.covariance_m2[:, 2], outside.covariance_m2[:, 0])


def test_sources_without_common_frames() -> None:
    paths, outside, _ = recording(16, 60)
    later = outside_tracks(outside.position_m, outside.covariance_m2, first=100)
    fused = fuse(paths, later)
    assert fused.trajectories.drones == ("dron1", "0")
    np.testing.assert_array_equal(fused.trajectories.frame, [*range(60), *range(100, 160)])
    assert (fused.source[:60] == [1, 0]).all()
    assert (fused.source[60:] == [0, 2]).all()


@pytest.mark.parametrize("value", [np.inf, np.nan, 1e7])
def test_frames_without_information_change_nothing(value) -> None:
    paths, outside, _ = recording(17)
    rows = slice(50, 90)
    covariance = paths["dron1"].covariance.copy()
    covariance[rows, :3, :3] = value
    vague = fuse({"dron1": replace(paths["dron1"], covariance=covariance)}, outside)
    status = paths["dron1"].status.copy()
    status[rows] = Status.COASTING
    expected = fuse({"dron1": replace(paths["dron1"], status=status)}, outside)
    np.testing.assert_array_equal(vague.trajectories.position_m, expected.trajectories.position_m)


def test_orientations_are_at_most_as_uncertain_as_unknown_ones() -> None:
    paths, outside, _ = recording(17)
    rows, fused = slice(50, 90), []
    for variance_rad2 in (3.0, 1e30):
        covariance = paths["dron1"].covariance.copy()
        covariance[rows, 3:, 3:] = variance_rad2 * np.eye(3)
        fused.append(fuse({"dron1": replace(paths["dron1"], covariance=covariance)}, outside))
    np.testing.assert_array_equal(fused[0].trajectories.position_m, fused[1].trajectories.position_m)
    assert np.isfinite(fused[0].trajectories.position_m).all()


def test_tracks_with_unknown_uncertainty_are_not_used() -> None:
    paths, outside, ((truth_m, _),) = recording(17, 60)
    covariance_m2 = outside.covariance_m2.copy()
    covariance_m2[:50] = np.nan
    fused = fuse(paths, remove_positions(replace(outside, covariance_m2=covariance_m2), slice(50, 60)))
    assert fused.trajectories.drones == ("dron1",)
    assert (fused.source == 1).all()
    assert rms(fused.trajectories.position_m[:, 0] - truth_m) < rms(paths["dron1"].position_m - truth_m)


def test_a_path_far_from_all_tracks_is_refused() -> None:
    paths, outside, _ = recording(17, 60)
    away = replace(outside, position_m=outside.position_m + 20)
    with pytest.raises(InputError, match=r"outside tracks: expected a track within 0.5 m .* nearest is 3"):
        fuse(paths, away)


def test_empty_sources_are_refused() -> None:
    paths, outside, _ = recording(18, 30)
    with pytest.raises(InputError, match="inside paths: expected a pose in at least one frame, found none"):
        fuse({"dron1": remove_poses(paths["dron1"], slice(None))}, outside)
    with pytest.raises(InputError, match="outside tracks: expected a position in at least one frame"):
        fuse(paths, remove_positions(outside, slice(None)))


def test_a_motion_that_determines_no_offset_is_refused() -> None:
    paths, outside, _ = recording(19, 60)
    still = replace(paths["dron1"], position_m=np.tile(paths["dron1"].position_m[0], (60, 1)))
    with pytest.raises(InputError, match="the clock of dron1: expected an offset, found none"):
        fuse({"dron1": still}, outside, max_offset_s=0.5)


@settings(max_examples=4, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-3, 3)] * 3),
    shift_m=st.tuples(*[st.floats(-10, 10)] * 3),
    seed=st.integers(20, 99),
)
def test_turning_and_shifting_the_world_turns_and_shifts_the_result(turn, shift_m, seed) -> None:
    paths, outside, _ = recording(seed, 60)
    R, path = Rotation.from_rotvec(turn), paths["dron1"]
    turn_both = np.zeros((6, 6))
    turn_both[:3, :3], turn_both[3:, 3:] = R.as_matrix(), np.eye(3)
    turned = replace(
        path,
        position_m=R.apply(path.position_m) + shift_m,
        orientation_wxyz=(R * Rotation.from_quat(path.orientation_wxyz, scalar_first=True)).as_quat(
            scalar_first=True
        ),
        covariance=turn_both @ path.covariance @ turn_both.T,
    )
    spread_m2 = R.as_matrix() @ outside.covariance_m2 @ R.as_matrix().T
    moved = replace(
        outside,
        position_m=R.apply(outside.position_m[:, 0])[:, None] + shift_m,
        covariance_m2=(spread_m2 + spread_m2.swapaxes(-1, -2)) / 2,
    )
    expected, found = fuse(paths, outside), fuse({"dron1": turned}, moved)
    # The search for the scales ends about 1e-5 from its minimum, because the cost is flat there. Measured 2e-6 m.
    np.testing.assert_allclose(
        found.trajectories.position_m[:, 0],
        R.apply(expected.trajectories.position_m[:, 0]) + shift_m,
        atol=5e-5,
    )
    np.testing.assert_allclose(found.drones[0].weighted.arm_m, expected.drones[0].weighted.arm_m, atol=5e-5)
