"""Scores of an evaluation: results by hand for five frames, properties, brute force, and other packages as oracles.

trackeval 1.3.0 is the code of HOTA's authors; motmetrics 1.4.0 is an independent implementation of CLEAR and IDF1.
trackeval depends on opencv-python, which would replace opencv-python-headless. Therefore trackeval is not in the `test`
extra, and its tests are skipped if it is not installed.
"""

import itertools
import json
from dataclasses import replace

import motmetrics
import numpy as np
import pytest
from evaluation_flights import ERROR_KEYS, FPS, ROUNDING, TRUTH, on_x_axis, random_flights, with_covariance
from helpers import assert_refused
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.evaluation import INSIDE_90, errors_over_time, evaluate
from psotrack.trajectories import GATE_M, UNASSIGNED, Status, Trajectories

seeds = st.integers(0, 2**32 - 1)
#: The first drone has errors of 0.1 m, the second of 0, 0, 0.2, 0.2 and 0.4 m.
EST = on_x_axis([0.1] * 5, [10, 10, 10.2, 10.2, 10.4])


def check(evaluation, tolerance=ROUNDING, **expected):
    """Assert that an evaluation, or one of its drones, has these values."""
    found = {name: getattr(evaluation, name) for name in expected}
    assert found == {
        name: pytest.approx(value, abs=tolerance) if isinstance(value, float) else value
        for name, value in expected.items()
    }


def turning(yaw_deg, **others):
    """Trajectories of one drone that stays at one place and turns about the vertical."""
    still = on_x_axis([0] * len(yaw_deg))
    about_z = Rotation.from_euler("z", np.array(yaw_deg, float)[:, None], degrees=True)
    return replace(still, orientation_wxyz=about_z.as_quat(scalar_first=True)[:, None], **others)


def test_errors_without_confusion():
    evaluation = evaluate(with_covariance(EST, 0.01 * np.eye(3)), TRUTH)
    # The errors have five deviations of 0.03 from their mean, two of 0.13, two of 0.07 and one of 0.27.
    variance_m2 = (5 * 0.03**2 + 2 * 0.13**2 + 2 * 0.07**2 + 0.27**2) / 10
    check(
        evaluation,
        frames=5,
        drones=2,
        missed_rate=0.0,
        id_switches=0,
        mota=1.0,
        idf1=1.0,
        mean_error_m=0.13,
        matched_mean_error_m=0.13,
        # Without the offsets of 0.1 and 0.16 m: 5 x 0, then 2 x 0.16, 2 x 0.04 and 0.24.
        offset_removed_mean_error_m=0.64 / 10,
        motp_m=0.13,
        median_error_m=0.1,
        std_error_m=variance_m2**0.5,
        # The 95th percentile of ten sorted errors is at rank 8.55, counted from 0: between 0.2 and 0.4.
        p95_error_m=0.2 + 0.55 * 0.2,
        max_error_m=0.4,
        ate_rmse_m=((0.05 + 0.24) / 10) ** 0.5,
        # All positions are on a line, so alignment only removes the mean.
        ate_aligned_rmse_m=variance_m2**0.5,
        # A constant offset gives no error; the second drone's error grows by 0.2 m in every second.
        rpe_1s_rmse_m=(3 * 0.04 / 6) ** 0.5,
        rpe_1s_rotation_rmse_deg=None,
        # NEES is the squared error divided by 0.01 m2: 5 x 1, then 0, 0, 4, 4, 16. Only the last is above 6.25.
        inside_90_rate=0.9,
        mean_nees=(5 * 1 + 4 + 4 + 16) / 10,
        # Without the offsets: 5 x 0, then 2.56, 2.56, 0.16, 0.16, 5.76.
        offset_removed_inside_90_rate=1.0,
        offset_removed_mean_nees=1.12,
    )
    first, second = evaluation.per_drone
    assert first.offset_frame == second.offset_frame == "world"
    np.testing.assert_allclose(first.offset_m, [0.1, 0, 0], atol=ROUNDING)
    np.testing.assert_allclose(second.offset_m, [0.16, 0, 0], atol=ROUNDING)
    check(first, ate_rmse_m=0.1, ate_aligned_rmse_m=0.0, rpe_1s_rmse_m=0.0, inside_90_rate=1.0, mean_nees=1.0)
    # The drone stands still, so alignment removes 0.16 m: errors of 2 x 0.16, 2 x 0.04 and 0.24 remain.
    aligned_m = ((2 * 0.0256 + 2 * 0.0016 + 0.0576) / 5) ** 0.5
    check(
        second, ate_rmse_m=(0.24 / 5) ** 0.5, ate_aligned_rmse_m=aligned_m, rpe_1s_rmse_m=0.2, mean_nees=4.8
    )


STILL = on_x_axis([0] * 5)
UNKNOWN = on_x_axis([0] * 5, [10, 10, None, None, 10])
STATUS = np.full((5, 2), Status.TRACKED)
STATUS[2:4, 1] = Status.LOST
STATUS[4, 1] = Status.COASTING
NOTHING = {"hota": 0.0, "deta": 0.0, "assa": 0.0, "loca": None}
#: Name of the case -> estimate, reference, and scores by hand.
BY_HAND = {
    # Each drone matches one track in 3 frames: TPA = 3, FNA = FPA = 2, so 3/7 for each of these 3 matches. It matches
    # the other track in 2 frames: TPA = 2, FNA = FPA = 3, so 2/8 for each of these 2 matches. The mean is
    # (3 x 3/7 + 2 x 1/4) / 5 = 5/14.
    "a swap": (
        on_x_axis([0, 0, 0, 10, 10], [10, 10, 10, 0, 0]),
        TRUTH,
        {"mean_error_m": 4.0, "matched_mean_error_m": 0.0, "missed_rate": 0.0, "gospa_m": 0.0}
        | {"id_switches": 2, "mota": 1 - 2 / 10, "idf1": 2 * 6 / (10 + 10)}
        | {"deta": 1.0, "loca": 1.0, "assa": 5 / 14, "hota": (5 / 14) ** 0.5},
    ),
    "lost rows are missed, coasting ones not": (
        on_x_axis([0] * 5, [10, 10, 99, 99, 10.2], status=STATUS),
        TRUTH,
        {"missed_rate": 0.2, "mean_error_m": 0.2 / 8, "mota": 1 - 2 / 10, "idf1": 2 * 8 / (10 + 8)},
    ),
    # The track of a drone whose position is unknown is no false positive, unless it is near another drone. The third
    # track is one in all frames. 0.1 m is a similarity of 0.8: all match at 16 thresholds, and 5 at the other three.
    "unknown places": (
        on_x_axis([0] * 5, [10.1] * 5, [50] * 5),
        UNKNOWN,
        {"frames": 5, "mean_error_m": 3 * 0.1 / 8, "missed_rate": 0.0, "mota": 1 - 5 / 8}
        | {"idf1": 2 * 8 / (8 + 13), "deta": (16 * 8 / 13 + 3 * 5 / 16) / 19},
    ),
    "a track near another drone": (
        on_x_axis([0] * 5, [10, 10, 0.3, 0.3, 10]),
        UNKNOWN,
        {"mota": 1 - 2 / 8, "idf1": 2 * 8 / (8 + 10)},
    ),
    "a frame and a drone without places": (
        on_x_axis([0.1, 0.1, 9, 0.1, 0.1]),
        on_x_axis([0, 0, None, 0, 0], [None] * 5),
        {"frames": 4, "drones": 1, "mean_error_m": 0.1},
    ),
    "a drone that comes later gets the remaining track": (
        on_x_axis([None, None, None, 10.1, 10.1], [0.1] * 5),
        on_x_axis([0] * 5, [None, None, 10, 10, 10]),
        {"missed_rate": 1 / 8, "mean_error_m": 0.1},
    ),
    # Two missed drones in each frame cost 0.125 m2 each.
    "no places": (
        on_x_axis([None] * 5),
        TRUTH,
        {"missed_rate": 1.0, "mota": 0.0, "idf1": 0.0, "mean_error_m": None, "motp_m": None, **NOTHING}
        | {"gospa_m": 0.5, "gospa_missed_m": 0.5, "gospa_localisation_m": 0.0, "gospa_false_m": 0.0},
    ),
    "no tracks": (STILL.of_drones([]), TRUTH, {"missed_rate": 1.0, "mean_error_m": None, **NOTHING}),
    # The lowest threshold of HOTA corresponds to 0.475 m.
    "below all thresholds": (on_x_axis([0.48] * 5), TRUTH, NOTHING),
    # Costs in m2, frame: 0     1             2                   3              4
    # localisation        0.01  0.01          0.01                0.01           0.01 + 0.09
    # missed                                  0.125 (0.6 > 0.5)   0.125
    # false                     0.125         0.125
    "parts of GOSPA": (
        on_x_axis([0.1] * 5, [10, 10, 10.6, None, 10.3], [None, 50, None, None, None]),
        TRUTH,
        {"gospa_localisation_m": (0.14 / 5) ** 0.5, "gospa_missed_m": (0.25 / 5) ** 0.5}
        | {"gospa_false_m": (0.25 / 5) ** 0.5, "gospa_m": (0.64 / 5) ** 0.5},
    ),
    # A second is two frames: only the pair of frames 1 and 3 remains.
    "a missed frame": (on_x_axis([0, 0, None, 0.3, 0.9]), STILL, {"rpe_1s_rmse_m": 0.3}),
    "less than a second": (on_x_axis([0, 0.1]), on_x_axis([0, 0]), {"rpe_1s_rmse_m": None}),
    # The inverse of [[2, 1], [1, 2]] is [[2, -1], [-1, 2]] / 3, so an error of (1, 0, 0) has a NEES of 2/3.
    "correlated errors": (
        with_covariance(on_x_axis([1.0] * 5), [[2, 1, 0], [1, 2, 0], [0, 0, 1]]),
        STILL,
        {"mean_nees": 2 / 3},
    ),
    "no covariances": (TRUTH, TRUTH, {"inside_90_rate": None, "mean_nees": None}),
}


@pytest.mark.parametrize("case", BY_HAND)
def test_scores_by_hand(case):
    est, truth, expected = BY_HAND[case]
    check(evaluate(est, truth), **expected)


def test_a_missed_drone_has_none_of_the_values_in_json_too():
    evaluation = evaluate(on_x_axis([10.2] * 5), TRUTH)
    check(evaluation, mean_error_m=0.2, missed_rate=0.5, mota=0.5, idf1=2 * 5 / (10 + 5))
    assert evaluation.to_dict().keys() == ERROR_KEYS
    text = json.dumps(evaluation.to_dict(), allow_nan=False)
    missed, found = json.loads(text)["per_drone"]
    assert (missed["drone"], missed["missed_rate"]) == ("d0", 1)
    assert (found["drone"], found["missed_rate"], found["estimate"]) == ("d1", 0, "d0")
    for name in ("estimate", "offset_m", "mean_error_m", "ate_rmse_m", "ate_aligned_rmse_m", "rpe_1s_rmse_m"):
        assert missed[name] is None


def test_rotations_over_a_second():
    # The estimate turns by 10, 0 and 20 degrees per second; the drone does not turn.
    expected_deg = ((100 + 0 + 400) / 3) ** 0.5
    turned = turning([0, 0, 10, 0, 30])
    check(evaluate(turned, turning([0] * 5)), 1e-9, rpe_1s_rotation_rmse_deg=expected_deg)
    # A constant offset of the heading gives no error, nor does the sign of a quaternion.
    ahead = turning([90, 90, 100, 90, 120])
    ahead.orientation_wxyz[1::2] *= -1
    check(evaluate(ahead, turning([0] * 5)), 1e-9, rpe_1s_rotation_rmse_deg=expected_deg)
    check(evaluate(ahead, STILL), rpe_1s_rotation_rmse_deg=None)


def test_places_without_a_covariance_have_no_nees():
    """One position of the first drone and five of the second have a covariance."""
    est = with_covariance(on_x_axis([0.1] * 5, [10.2] * 5), 0.01 * np.eye(3))
    est.covariance_m2[1:, 0] = np.nan
    check(evaluate(est, TRUTH), 1e-9, mean_nees=(1 * 1 + 5 * 4) / 6)


def test_errors_over_time_are_those_of_evaluate():
    est = on_x_axis([0.1, 0.1, 0.1, 10.1, 10.1], [10.1, None, 10.1, 0.1, 0.1])
    errors, evaluation = errors_over_time(est, TRUTH), evaluate(est, TRUTH)
    assert list(errors) == ["frame", "time_s", "drone", "error_m", "switch"]
    assert list(errors["drone"]) == ["d0"] * 5 + ["d1"] * 5
    assert list(errors["frame"]) == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4]
    np.testing.assert_allclose(errors["time_s"], errors["frame"] / FPS)
    np.testing.assert_allclose(errors["error_m"], [0.1] * 3 + [10.1] * 2 + [0.1, np.nan, 0.1, 9.9, 9.9])
    assert list(np.flatnonzero(errors["switch"])) == [3, 8]
    assert errors["error_m"].mean() == pytest.approx(evaluation.mean_error_m)
    # Frames without a reference have no row.
    assert len(errors_over_time(est, on_x_axis([0, 0, None, 0, 0], [10] * 5))) == 9


#: Name of the case -> estimate and reference, and words of the line.
BAD = {
    "no common frame": (
        (on_x_axis([0, 0], frame=[7, 8]), TRUTH),
        ("expected frames of the reference", "0 to 4, found frames 7 to 8"),
    ),
    "no frame": ((on_x_axis([]), TRUTH), ("found no frames",)),
    "frames of other times": (
        (replace(TRUTH, time_s=TRUTH.time_s + 1 / FPS), TRUTH),
        ("estimate: expected frame 0 at 0 s, as in the reference, found 0.5 s; read_tracks(",),
    ),
    "no reference": ((TRUTH, on_x_axis([None] * 5)), ("reference: expected a known position",)),
    "no variance": (
        (with_covariance(TRUTH, np.diag([0.01, 0.01, 0.0])), TRUTH),
        ("estimate: expected covariances that are positive definite",),
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_flights_that_cannot_be_compared_are_refused(case, tmp_path):
    flights, words = BAD[case]
    assert_refused(lambda: evaluate(*flights), *words, unchanged=tmp_path)


def moved(flight, turn, shift_m):
    """A flight in a world that is turned and shifted."""
    position_m = flight.position_m @ turn.as_matrix().T + shift_m
    flight = replace(flight, position_m=position_m)
    if flight.orientation_wxyz is None:
        return flight
    turns = turn * Rotation.from_quat(flight.orientation_wxyz.reshape(-1, 4), scalar_first=True)
    turns_wxyz = turns.as_quat(scalar_first=True).reshape(flight.orientation_wxyz.shape)
    return replace(flight, orientation_wxyz=turns_wxyz)


def assert_equal_values(left, right):
    """Values of two records are equal, to rounding, but for the names of estimates."""
    for name in left.keys() - {"per_drone", "estimate"}:
        if left[name] is None or isinstance(left[name], str):
            assert left[name] == right[name], name
        else:
            np.testing.assert_allclose(left[name], right[name], rtol=0, atol=1e-9, err_msg=name)


def per_drone(record):
    return sorted(record["per_drone"], key=lambda drone: drone["drone"])


@given(seeds, st.permutations(range(4)), st.permutations(range(3)))
@settings(max_examples=25)
def test_names_orders_and_the_worlds_axes_do_not_matter(seed, order, drones):
    est, ref = random_flights(seed)
    est_shuffled = replace(est.of_drones(list(order)), drones=tuple("wxyz"))
    turn = Rotation.random(rng=np.random.default_rng(seed))
    est_moved = moved(est_shuffled, turn, [3.0, -5.0, 7.0])
    ref_moved = moved(ref.of_drones(list(drones)), turn, [3.0, -5.0, 7.0])
    # In float64, positions of 10 m are exact to 2e-15 m. No distance of these random flights is that close to the gate.
    # Offsets are in the body's frame, which turns with the world.
    before = evaluate(est, ref).to_dict()
    after = evaluate(est_moved, ref_moved).to_dict()
    assert_equal_values(before, after)
    for left, right in zip(per_drone(before), per_drone(after), strict=True):
        assert_equal_values(left, right)


@given(seeds)
@settings(max_examples=15)
def test_a_constant_offset_in_the_body_is_found_and_removed_and_a_flight_equals_itself(seed):
    _, ref = random_flights(seed)
    # Drones are farther apart than the offsets are long, so that identities are clear.
    ref.position_m[..., 0] += [0.0, 5.0, 10.0]
    offset_m = np.random.default_rng(seed).uniform(-0.2, 0.2, (3, 3))
    est_m = ref.position_m.copy()
    for drone in range(3):
        body_to_world = Rotation.from_quat(ref.orientation_wxyz[:, drone], scalar_first=True)
        est_m[:, drone] += body_to_world.apply(offset_m[drone])
    evaluation = evaluate(replace(ref, position_m=est_m, orientation_wxyz=None), ref)
    check(evaluation, offset_removed_mean_error_m=0.0)
    for drone in evaluation.per_drone:
        assert drone.offset_frame == "body"
        np.testing.assert_allclose(drone.offset_m, offset_m[ref.drones.index(drone.drone)], atol=1e-12)
    of_itself = evaluate(ref, ref)
    check(of_itself, id_switches=0, missed_rate=0.0, max_error_m=0.0, motp_m=0.0, gospa_m=0.0)
    check(of_itself, ate_rmse_m=0.0, ate_aligned_rmse_m=0.0, rpe_1s_rmse_m=0.0)
    check(of_itself, mota=1.0, idf1=1.0, hota=1.0, deta=1.0, assa=1.0, loca=1.0)


def aligned_rmse_m(ref_m, est_m):
    """The root mean square error that is left after SciPy has aligned points."""
    _, rssd_m = Rotation.align_vectors(ref_m - ref_m.mean(axis=0), est_m - est_m.mean(axis=0))
    return rssd_m / len(ref_m) ** 0.5


@given(seeds)
@settings(max_examples=15)
def test_alignment_is_that_of_scipy(seed):
    est, ref = random_flights(seed, missing=0, num_estimates=3)
    evaluation = evaluate(est, ref)
    all_of_ref_m, all_of_est_m = [], []
    for drone in evaluation.per_drone:
        ref_m = ref.position_m[:, ref.drones.index(drone.drone)]
        est_m = est.position_m[:, est.drones.index(drone.estimate)]
        check(drone, 1e-9, ate_aligned_rmse_m=aligned_rmse_m(ref_m, est_m))
        all_of_ref_m.append(ref_m)
        all_of_est_m.append(est_m)
    rmse_m = aligned_rmse_m(np.concatenate(all_of_ref_m), np.concatenate(all_of_est_m))
    check(evaluation, 1e-9, ate_aligned_rmse_m=rmse_m)


@pytest.mark.parametrize("seed", range(5))
def test_matches_gospa_and_identities_are_the_best_of_all_pairings(seed):
    est, ref = random_flights(seed, missing=0)
    distance_m = np.linalg.norm(ref.position_m[:, :, None] - est.position_m[:, None], axis=-1)
    # Each drone has an estimate of its own, or none.
    pairings = set(itertools.permutations([*range(4), *[UNASSIGNED] * 3], 3))
    matched_m, cost_m2 = [], []
    for here_m in distance_m:
        # Pairs and sum of distances of each pairing within the gate, and its cost.
        sums, costs_m2 = [], []
        for pairing in pairings:
            pairs_m = [here_m[drone, each] for drone, each in enumerate(pairing) if each != UNASSIGNED]
            # Three drones and four estimates; each that is left over costs half the square of the gate.
            num_left = 7 - 2 * len(pairs_m)
            costs_m2.append(np.sum(np.square(pairs_m)) + GATE_M**2 / 2 * num_left)
            if max(pairs_m, default=0) <= GATE_M:
                sums.append((-len(pairs_m), sum(pairs_m), pairs_m))
        cost_m2.append(min(costs_m2))
        # As many pairs as possible, and among these the smallest sum of distances.
        _, _, best_m = min(sums)
        matched_m += best_m
    evaluation = evaluate(est, ref)
    check(evaluation, gospa_m=np.mean(cost_m2) ** 0.5, matched_mean_error_m=np.mean(matched_m))
    # Identities are the best permutation of the first second.
    mean_m = distance_m[:2].mean(axis=0)
    orders = list(itertools.permutations(range(4), 3))
    best = np.argmin([mean_m[range(3), order].sum() for order in orders])
    names = [est.drones[each] for each in orders[best]]
    assert [drone.estimate for drone in evaluation.per_drone] == names


def test_correct_covariances_have_the_expected_nees():
    assert pytest.approx(chi2(3).ppf(0.9), rel=1e-12) == INSIDE_90
    num_frames = 2000
    root_m = np.array([[0.03, 0, 0], [0.01, 0.02, 0], [0.01, -0.02, 0.05]])
    truth = turning(np.linspace(0, 720, num_frames))
    noise_m = np.random.default_rng(0).normal(size=(num_frames, 1, 3)) @ root_m.T
    est = with_covariance(replace(truth, position_m=truth.position_m + noise_m), root_m @ root_m.T)
    off = evaluate(replace(est, position_m=est.position_m + np.array([0.0, 0.0, 0.03])), truth)
    # Limits are four standard deviations: sqrt(0.09 / n) for a share of 0.9, sqrt(6 / n) for the mean of chi-square.
    share = pytest.approx(0.9, abs=4 * (0.09 / num_frames) ** 0.5)
    mean = pytest.approx(3, abs=4 * (6 / num_frames) ** 0.5)
    on_the_point = evaluate(est, truth)
    assert on_the_point.inside_90_rate == share
    assert on_the_point.mean_nees == mean
    assert off.offset_removed_inside_90_rate == share
    assert off.offset_removed_mean_nees == mean
    assert off.mean_nees > 3.3


# --- other packages


def crowded_flights(seed):
    """Flights within a metre, so that many pairs are possible; some estimates are missing, but no reference."""
    est, _ = random_flights(seed, num_frames=12)
    _, ref = random_flights(seed, num_frames=12, missing=0)
    return est, ref


def separate_flights(seed):
    """Flights 3 m apart, with missing positions, identity switches, distances beyond the gate and a false track."""
    rng = np.random.default_rng(seed)
    num_frames, num_drones = 20, 4
    ref_m = np.zeros((num_frames, num_drones, 3)) + np.arange(num_drones)[:, None] * [3.0, 0.0, 0.0]
    ref_m += rng.normal(0, 0.1, ref_m.shape)
    # A third of the distances exceed the gate.
    est_m = ref_m + rng.normal(0, 0.25, ref_m.shape)
    known, seen = rng.random((2, num_frames, num_drones)) > 0.15
    # Frame 0 defines the identities, and every drone is known in it.
    known[0], seen[0] = True, True
    est_m[~seen] = np.nan
    ref_m[~known] = np.nan
    for start in rng.integers(3, num_frames, 3):
        est_m[start:] = est_m[start:, rng.permutation(num_drones)]
    # Tracks are removed where their drone is unknown; other tests show that such tracks do not count.
    est_m[~known] = np.nan
    false_m = np.full((num_frames, 1, 3), 50.0)
    false_m[rng.random(num_frames) < 0.5] = np.nan
    # psotrack ignores frames without any known drone; the other packages count the false track in such frames.
    false_m[~known.any(axis=1)] = np.nan
    est_m = np.concatenate([est_m, false_m], axis=1)
    frame = np.arange(num_frames)
    est = Trajectories(frame, frame / FPS, tuple("abcde"), est_m)
    return est, Trajectories(frame, frame / FPS, tuple("wxyz"), ref_m)


def frames(est, ref):
    """Iterate over frames: numbers of the known drones, numbers of the present estimates, and their distances."""
    for frame in range(ref.num_frames):
        drones = np.flatnonzero(ref.seen[frame])
        estimates = np.flatnonzero(est.seen[frame])
        ref_m = ref.position_m[frame, drones]
        est_m = est.position_m[frame, estimates]
        yield drones, estimates, np.linalg.norm(ref_m[:, None] - est_m, axis=-1)


def for_trackeval(est, ref):
    """Input of trackeval's metrics, with the similarity 1 - distance / `GATE_M`."""
    drones, estimates, distances_m = zip(*frames(est, ref), strict=True)
    return {
        "num_gt_ids": ref.num_drones,
        "num_tracker_ids": est.num_drones,
        "num_gt_dets": sum(map(len, drones)),
        "num_tracker_dets": sum(map(len, estimates)),
        "gt_ids": list(drones),
        "tracker_ids": list(estimates),
        "similarity_scores": [np.maximum(0, 1 - distance_m / GATE_M) for distance_m in distances_m],
        "num_timesteps": ref.num_frames,
    }


@pytest.mark.parametrize("flights", [crowded_flights, separate_flights])
@given(seed=seeds)
@settings(max_examples=20)
def test_hota_is_that_of_trackeval(flights, seed):
    metrics = pytest.importorskip("trackeval").metrics
    est, ref = flights(seed)
    theirs = metrics.HOTA().eval_sequence(for_trackeval(est, ref))
    ours = evaluate(est, ref)
    for name in ("HOTA", "DetA", "AssA", "LocA"):
        check(ours, **{name.lower(): theirs[name].mean()})


@given(seed=seeds)
@settings(max_examples=15)
def test_clear_and_identity_are_those_of_motmetrics(seed):
    est, ref = separate_flights(seed)
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    for drones, estimates, distance_m in frames(est, ref):
        distance_m[distance_m > GATE_M] = np.nan
        accumulator.update(drones, estimates, distance_m)
    names = ["mota", "motp", "idf1", "num_switches"]
    mota, motp_m, idf1, switches = motmetrics.metrics.create().compute(accumulator, metrics=names).iloc[0]
    check(evaluate(est, ref), id_switches=switches, mota=float(mota), motp_m=float(motp_m), idf1=float(idf1))
