"""Metrics of an evaluation: compared with results by hand for five frames and with brute force, and invariants."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from evaluation_flights import ROUNDING, TRUTH, on_x_axis, pairings, random_flights, seeds
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.evaluation import evaluate
from psotrack.trajectories import GATE_M, UNASSIGNED, Status
from psotrack.trajectories.association import align, fixed_identity, identity_switches, partners_per_frame


class TestFiveFrames:
    def test_no_confusion(self):
        evaluation = evaluate(on_x_axis([0.1] * 5, [10, 10, 10.2, 10.2, 10.4]), TRUTH)
        errors_m = [0.1] * 5 + [0, 0, 0.2, 0.2, 0.4]
        assert (evaluation.frames, evaluation.drones) == (5, 2)
        assert (evaluation.missed_rate, evaluation.id_switches) == (0, 0)
        assert (evaluation.mota, evaluation.idf1) == (1, 1)
        mean_m = 13 / 100
        assert evaluation.mean_error_m == pytest.approx(mean_m, abs=ROUNDING)
        assert evaluation.matched_mean_error_m == pytest.approx(mean_m, abs=ROUNDING)
        assert evaluation.motp_m == pytest.approx(mean_m, abs=ROUNDING)
        assert evaluation.median_error_m == pytest.approx(1 / 10, abs=ROUNDING)
        # Five deviations of 0.03, two of 0.13, two of 0.07, one of 0.27.
        variance_m2 = (5 * 0.03**2 + 2 * 0.13**2 + 2 * 0.07**2 + 0.27**2) / 10
        assert evaluation.std_error_m == pytest.approx(variance_m2**0.5, abs=ROUNDING)
        # The 95th percentile of ten sorted errors is at rank 8.55, counted from 0: between 0.2 and 0.4.
        assert evaluation.p95_error_m == pytest.approx(0.2 + 0.55 * 0.2, abs=ROUNDING)
        assert evaluation.max_error_m == pytest.approx(max(errors_m), abs=ROUNDING)

    def test_a_swap(self):
        evaluation = evaluate(on_x_axis([0, 0, 0, 10, 10], [10, 10, 10, 0, 0]), TRUTH)
        assert evaluation.mean_error_m == pytest.approx(4 * 10 / 10, abs=ROUNDING)
        assert evaluation.matched_mean_error_m == 0.0
        assert evaluation.motp_m == 0.0
        assert evaluation.id_switches == 2
        assert evaluation.mota == pytest.approx(1 - 2 / 10, abs=ROUNDING)
        assert evaluation.idf1 == pytest.approx(2 * 6 / (10 + 10), abs=ROUNDING)
        assert evaluation.missed_rate == 0.0

    def test_a_missed_drone(self):
        evaluation = evaluate(on_x_axis([10.2] * 5), TRUTH)
        assert evaluation.mean_error_m == pytest.approx(1 / 5, abs=ROUNDING)
        assert evaluation.missed_rate == 5 / 10
        assert evaluation.mota == 1 - 5 / 10
        assert evaluation.idf1 == pytest.approx(2 * 5 / (10 + 5), abs=ROUNDING)
        missed, found = evaluation.per_drone
        assert (missed.estimate, missed.missed_rate, missed.mean_error_m, missed.offset_m) == (
            None,
            1,
            None,
            None,
        )
        assert (found.estimate, found.missed_rate) == ("d0", 0)

    def test_a_false_track(self):
        evaluation = evaluate(on_x_axis([50] * 5, [10] * 5, [0] * 5), TRUTH)
        assert evaluation.mean_error_m == 0.0
        assert evaluation.missed_rate == 0.0
        assert evaluation.mota == 1 - 5 / 10
        assert evaluation.idf1 == pytest.approx(2 * 10 / (10 + 15), abs=ROUNDING)

    def test_lost_rows_are_missed_and_coasting_rows_are_not(self):
        status = np.full((5, 2), Status.TRACKED)
        status[2:4, 1], status[4, 1] = Status.LOST, Status.COASTING
        evaluation = evaluate(on_x_axis([0] * 5, [10, 10, 99, 99, 10.2], status=status), TRUTH)
        assert evaluation.missed_rate == 2 / 10
        assert evaluation.mean_error_m == pytest.approx(0.2 / 8, abs=ROUNDING)
        assert evaluation.mota == pytest.approx(1 - 2 / 10, abs=ROUNDING)
        assert evaluation.idf1 == pytest.approx(2 * 8 / (10 + 8), abs=ROUNDING)

    def test_frames_without_an_estimate_are_missed(self):
        evaluation = evaluate(on_x_axis([0, 0], [10, 10], frame=[1, 3]), TRUTH)
        assert evaluation.frames == 5
        assert evaluation.missed_rate == pytest.approx(6 / 10, abs=ROUNDING)

    def test_frames_outside_the_reference_are_ignored(self):
        outside = on_x_axis([0] * 7, [10] * 5 + [99] * 2)
        assert evaluate(outside, TRUTH) == evaluate(on_x_axis([0] * 5, [10] * 5), TRUTH)

    def test_unknown_positions_of_the_reference_are_ignored(self):
        evaluation = evaluate(on_x_axis([0] * 5, [10.2] * 5), on_x_axis([0] * 5, [10, 10, None, None, 10]))
        assert evaluation.frames == 5
        assert evaluation.per_drone[1].frames == 3
        assert evaluation.mean_error_m == pytest.approx(3 * 0.2 / 8, abs=ROUNDING)
        # The track of a drone whose position is unknown is no false positive.
        assert (evaluation.missed_rate, evaluation.mota, evaluation.idf1) == (0, 1, 1)

    def test_a_track_that_moves_from_its_unknown_drone_to_another_is_a_false_positive(self):
        evaluation = evaluate(
            on_x_axis([0] * 5, [10, 10, 0.3, 0.3, 10]), on_x_axis([0] * 5, [10, 10, None, None, 10])
        )
        assert evaluation.mota == pytest.approx(1 - 2 / 8, abs=ROUNDING)
        assert evaluation.idf1 == pytest.approx(2 * 8 / (8 + 10), abs=ROUNDING)

    def test_frames_and_drones_without_known_positions_are_ignored(self):
        truth = on_x_axis([0, 0, None, 0, 0], [None] * 5)
        evaluation = evaluate(on_x_axis([0.1, 0.1, 9, 0.1, 0.1]), truth)
        assert (evaluation.frames, evaluation.drones, len(evaluation.per_drone)) == (4, 1, 1)
        assert evaluation.mean_error_m == pytest.approx(1 / 10, abs=ROUNDING)

    def test_outside_the_gate_is_a_miss_and_a_false_positive(self):
        evaluation = evaluate(on_x_axis([0] * 5, [10, 10, 10, 10, 10.6]), TRUTH)
        assert evaluation.mean_error_m == pytest.approx(0.6 / 10, abs=ROUNDING)
        assert evaluation.matched_mean_error_m == 0.0
        assert evaluation.mota == pytest.approx(1 - 2 / 10, abs=ROUNDING)
        assert evaluation.idf1 == pytest.approx(2 * 9 / (10 + 10), abs=ROUNDING)

    def test_motp_keeps_pairs_of_the_previous_frame_and_the_matched_error_does_not(self):
        truth = on_x_axis([0] * 5, [0.4] * 5)
        evaluation = evaluate(on_x_axis([0, 0, 0.3, 0, 0], [0.4, 0.4, 0.1, 0.4, 0.4]), truth)
        assert evaluation.id_switches == 0
        assert evaluation.motp_m == pytest.approx((0.3 + 0.3) / 10, abs=ROUNDING)
        assert evaluation.matched_mean_error_m == pytest.approx((0.1 + 0.1) / 10, abs=ROUNDING)

    def test_another_track_after_a_gap_is_a_switch(self):
        evaluation = evaluate(
            on_x_axis([0, 0, None, None, None], [None, None, None, 0, 0]), on_x_axis([0] * 5)
        )
        assert evaluation.id_switches == 1
        assert evaluation.mota == pytest.approx(1 - (1 + 1) / 5, abs=ROUNDING)
        assert evaluation.idf1 == pytest.approx(2 * 2 / (5 + 4), abs=ROUNDING)

    def test_drones_that_appear_after_the_first_second_get_the_remaining_tracks(self):
        truth = on_x_axis([0] * 5, [None, None, 10, 10, 10])
        evaluation = evaluate(on_x_axis([None, None, None, 10.1, 10.1], [0.1] * 5), truth)
        assert [drone.estimate for drone in evaluation.per_drone] == ["d1", "d0"]
        assert evaluation.missed_rate == 1 / 8
        assert evaluation.mean_error_m == pytest.approx(1 / 10, abs=ROUNDING)

    def test_identity_is_fixed_by_the_first_second_alone(self):
        evaluation = evaluate(on_x_axis([0, 0, 10, 10, 10], [10, 10, 0, 0, 0]), TRUTH)
        assert [drone.estimate for drone in evaluation.per_drone] == ["d0", "d1"]

    def test_without_orientations_offsets_are_in_the_world_frame(self):
        evaluation = evaluate(on_x_axis([0.1, 0.1, 0.1, 0.2, 0.5], [9] * 5), TRUTH)
        first, second = evaluation.per_drone
        assert (first.offset_frame, second.offset_frame) == ("world", "world")
        np.testing.assert_allclose(first.offset_m, (1 / 5, 0, 0), atol=ROUNDING)
        np.testing.assert_allclose(second.offset_m, (-1, 0, 0), atol=ROUNDING)
        assert first.offset_removed_mean_error_m == pytest.approx((3 * 0.1 + 0 + 0.3) / 5, abs=ROUNDING)
        assert evaluation.offset_removed_mean_error_m == pytest.approx(0.6 / 10, abs=ROUNDING)

    def test_an_estimate_without_positions(self):
        evaluation = evaluate(on_x_axis([None] * 5), TRUTH)
        assert evaluation.missed_rate == 1.0
        assert evaluation.mota == 0.0
        assert evaluation.idf1 == 0.0
        assert evaluation.mean_error_m is None
        assert evaluation.motp_m is None

    def test_an_estimate_without_drones(self):
        empty = replace(on_x_axis([0] * 5), drones=(), position_m=np.empty((5, 0, 3)))
        assert evaluate(empty, TRUTH).missed_rate == 1.0


KEYS = {
    *("frames", "drones", "missed_rate", "id_switches", "mota", "motp_m", "idf1", "per_drone"),
    *("mean_error_m", "median_error_m", "std_error_m", "p95_error_m", "max_error_m"),
    *("matched_mean_error_m", "offset_removed_mean_error_m"),
    *("hota", "deta", "assa", "loca"),
    *("gospa_m", "gospa_localisation_m", "gospa_missed_m", "gospa_false_m"),
    *("ate_rmse_m", "ate_aligned_rmse_m", "rpe_1s_rmse_m", "rpe_1s_rotation_rmse_deg"),
    *("inside_90_rate", "mean_nees", "offset_removed_inside_90_rate", "offset_removed_mean_nees"),
}


class TestContract:
    def test_keys(self):
        assert evaluate(TRUTH, TRUTH).to_dict().keys() == KEYS

    def test_json_is_strict_if_values_are_undefined(self):
        text = json.dumps(evaluate(on_x_axis([0] * 5), TRUTH).to_dict(), allow_nan=False)
        seen, missed = json.loads(text)["per_drone"]
        assert (seen["drone"], seen["offset_m"]) == ("d0", [0, 0, 0])
        assert (missed["drone"], missed["offset_m"], missed["mean_error_m"]) == ("d1", None, None)

    def test_no_common_frame(self):
        with pytest.raises(
            InputError, match=r"expected frames of the reference.*0 to 4, found frames 7 to 8"
        ):
            evaluate(on_x_axis([0, 0], frame=[7, 8]), TRUTH)
        with pytest.raises(InputError, match="found no frames"):
            evaluate(on_x_axis([]), TRUTH)

    def test_no_truth(self):
        with pytest.raises(InputError, match="reference: expected a known position"):
            evaluate(TRUTH, on_x_axis([None] * 5))


def assert_same(first, second, tolerance: float) -> None:
    """Assert that two evaluations are equal, up to rounding, names of the estimates and the order of the drones."""
    one, two = first.to_dict(), second.to_dict()
    for evaluation in (one, two):
        evaluation["per_drone"].sort(key=lambda drone: drone["drone"])
        for drone in evaluation["per_drone"]:
            del drone["estimate"]

    def flatten(value):
        if isinstance(value, dict):
            return [leaf for part in value.values() for leaf in flatten(part)]
        if isinstance(value, list | tuple):
            return [leaf for part in value for leaf in flatten(part)]
        return [value]

    for left, right in zip(flatten(one), flatten(two), strict=True):
        assert left == (pytest.approx(right, abs=tolerance) if isinstance(right, float) else right)


def with_covariances(est, ref):
    """Estimate and reference, with random orientations and covariances added to the estimate."""
    rng = np.random.default_rng(est.num_frames)
    root = rng.normal(0, 0.1, (est.num_frames, est.num_drones, 3, 3))
    orientation_wxyz = Rotation.random(est.num_frames * est.num_drones, rng=rng).as_quat(scalar_first=True)
    return replace(
        est,
        orientation_wxyz=orientation_wxyz.reshape(est.num_frames, est.num_drones, 4),
        covariance_m2=root @ root.swapaxes(-1, -2) + 0.01 * np.eye(3),
    ), ref


class TestProperties:
    @given(seeds, st.permutations(range(4)))
    @settings(max_examples=50, deadline=None)
    def test_names_and_order_of_the_estimates_do_not_matter(self, seed, order):
        est, ref = random_flights(seed)
        shuffled = replace(est, drones=tuple("wxyz"), position_m=est.position_m[:, list(order)])
        assert_same(evaluate(est, ref), evaluate(shuffled, ref), ROUNDING)

    @given(seeds, st.permutations(range(3)))
    @settings(max_examples=30, deadline=None)
    def test_the_order_of_the_references_drones_does_not_matter(self, seed, order):
        est, ref = random_flights(seed)
        shuffled = replace(
            ref,
            drones=tuple(ref.drones[drone] for drone in order),
            position_m=ref.position_m[:, list(order)],
            orientation_wxyz=ref.orientation_wxyz[:, list(order)],
        )
        assert_same(evaluate(est, ref), evaluate(est, shuffled), ROUNDING)

    @given(seeds)
    @settings(max_examples=30, deadline=None)
    def test_turning_and_moving_the_world_changes_nothing(self, seed):
        est, ref = with_covariances(*random_flights(seed))
        turn = Rotation.random(rng=np.random.default_rng(seed))
        moved = [
            replace(
                flight,
                position_m=flight.position_m @ turn.as_matrix().T + np.array([3.0, -5.0, 7.0]),
                orientation_wxyz=(
                    turn * Rotation.from_quat(flight.orientation_wxyz.reshape(-1, 4), scalar_first=True)
                )
                .as_quat(scalar_first=True)
                .reshape(flight.orientation_wxyz.shape),
            )
            for flight in (est, ref)
        ]
        R = turn.as_matrix()
        moved[0] = replace(moved[0], covariance_m2=R @ est.covariance_m2 @ R.T)
        first, second = evaluate(est, ref), evaluate(*moved)
        # Offsets in the body frame do not turn with the world. All drones here have orientations, so all offsets are
        # in the body frame.
        for drone, other in zip(first.per_drone, second.per_drone, strict=True):
            if drone.offset_m is not None:
                assert drone.offset_frame == other.offset_frame == "body"
        # In float64, positions of 10 m are exact to 2e-15 m; NEES divides by the squared standard deviation of 0.1 m.
        # Angles are exact to 1e-16 rad, and near 180 degrees, because of the arc cosine, to 1e-8. No distance of these
        # random flights is that close to the gate.
        assert_same(first, second, 1e-9)

    @given(seeds)
    @settings(max_examples=30, deadline=None)
    def test_a_constant_offset_in_the_body_is_found_and_removed(self, seed):
        _, ref = random_flights(seed)
        # Drones are farther apart than the offsets are long, so that identities are clear.
        ref = replace(ref, position_m=ref.position_m + np.arange(3)[:, None] * [5.0, 0.0, 0.0])
        offset_m = np.random.default_rng(seed).uniform(-0.2, 0.2, (3, 3))
        body_to_world = Rotation.from_quat(ref.orientation_wxyz.reshape(-1, 4), scalar_first=True)
        added_m = body_to_world.apply(np.tile(offset_m, (ref.num_frames, 1))).reshape(ref.position_m.shape)
        evaluation = evaluate(replace(ref, position_m=ref.position_m + added_m, orientation_wxyz=None), ref)
        assert evaluation.offset_removed_mean_error_m == pytest.approx(0, abs=1e-12)
        for drone in evaluation.per_drone:
            assert drone.offset_frame == "body"
            np.testing.assert_allclose(drone.offset_m, offset_m[ref.drones.index(drone.drone)], atol=1e-12)

    @given(seeds)
    @settings(max_examples=30, deadline=None)
    def test_a_reference_evaluated_against_itself_is_perfect(self, seed):
        _, ref = random_flights(seed)
        evaluation = evaluate(ref, ref)
        assert (evaluation.max_error_m, evaluation.missed_rate, evaluation.id_switches) == (0, 0, 0)
        assert (evaluation.mota, evaluation.idf1, evaluation.motp_m) == (1, 1, 0)
        hota = (evaluation.hota, evaluation.deta, evaluation.assa, evaluation.loca)
        assert hota == pytest.approx((1, 1, 1, 1), abs=ROUNDING)
        assert (evaluation.gospa_m, evaluation.ate_rmse_m, evaluation.rpe_1s_rmse_m) == (0, 0, 0)
        assert evaluation.ate_aligned_rmse_m == pytest.approx(0, abs=ROUNDING)


class TestAgainstBruteForce:
    @pytest.mark.parametrize("seed", range(5))
    def test_matching_within_a_frame(self, seed):
        est, ref = random_flights(seed)
        distance_m = align(est, ref).distance_m
        for here_m, partner in zip(distance_m, partners_per_frame(distance_m, keep=False), strict=True):

            def value(pairing, here_m=here_m):
                """Sort key of an assignment: first the number of pairs, then minus the sum of distances."""
                lengths_m = [here_m[d, e] for d, e in enumerate(pairing) if e != UNASSIGNED]
                possible = all(length_m <= GATE_M for length_m in lengths_m)
                return (len(lengths_m), -sum(lengths_m)) if possible else (-1, 0.0)

            assert value(tuple(partner)) == pytest.approx(max(map(value, pairings(3, 4))), abs=ROUNDING)

    @pytest.mark.parametrize("seed", range(5))
    def test_identity_of_the_first_second(self, seed):
        est, ref = random_flights(seed)
        est = replace(est, position_m=np.nan_to_num(est.position_m))
        ref = replace(ref, position_m=np.nan_to_num(ref.position_m))
        pair = align(est, ref)
        mean_m = pair.distance_m[:2].mean(axis=0)
        best = min(itertools.permutations(range(4), 3), key=lambda order: sum(mean_m[range(3), order]))
        assert tuple(fixed_identity(pair)) == best

    def test_identity_switches(self):
        partners = np.array([[0, 1], [0, -1], [1, 1], [-1, 0], [1, 0]])
        assert identity_switches(partners).astype(int).tolist() == [[0, 0], [0, 0], [1, 0], [0, 1], [0, 0]]
