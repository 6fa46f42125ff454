"""ATE, RPE and consistency: compared with results by hand on five frames and with independent formulas."""

from dataclasses import replace

import numpy as np
import pytest
from evaluation_flights import ROUNDING, TRUTH, on_x_axis, random_flights, seeds
from hypothesis import given, settings
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.errors import InputError
from psotrack.evaluation import evaluate
from psotrack.evaluation.consistency import INSIDE_90
from psotrack.trajectories import Trajectories


def one_drone(position_m, yaw_deg=None, **others) -> Trajectories:
    """A drone at two frames per second."""
    position_m = np.array(position_m, float)[:, None]
    frame = np.arange(len(position_m))
    orientation_wxyz = None
    if yaw_deg is not None:
        about_z = Rotation.from_euler("z", np.array(yaw_deg, float)[:, None], degrees=True)
        orientation_wxyz = about_z.as_quat(scalar_first=True)[:, None]
    return Trajectories(frame, frame / 2, ("d",), position_m, orientation_wxyz=orientation_wxyz, **others)


class TestAbsolute:
    # Errors of 0.1 m throughout, and of 0, 0, 0.2, 0.2, 0.4 m.
    EST = on_x_axis([0.1] * 5, [10, 10, 10.2, 10.2, 10.4])

    def test_by_drone_and_over_all(self):
        evaluation = evaluate(self.EST, TRUTH)
        first, second = evaluation.per_drone
        assert first.ate_rmse_m == pytest.approx(0.1, abs=ROUNDING)
        assert second.ate_rmse_m == pytest.approx(((0.04 + 0.04 + 0.16) / 5) ** 0.5, abs=ROUNDING)
        assert evaluation.ate_rmse_m == pytest.approx(((0.05 + 0.24) / 10) ** 0.5, abs=ROUNDING)

    def test_aligned_by_drone_and_by_one_motion_of_all(self):
        evaluation = evaluate(self.EST, TRUTH)
        first, second = evaluation.per_drone
        assert first.ate_aligned_rmse_m == pytest.approx(0, abs=ROUNDING)
        # The truth stands still, so only the mean, 0.16 m, can be taken out: two of 0.16, two of 0.04, one of 0.24.
        assert second.ate_aligned_rmse_m == pytest.approx(
            ((2 * 0.0256 + 2 * 0.0016 + 0.0576) / 5) ** 0.5, abs=ROUNDING
        )
        # All lie on a line, so that no turn helps: the mean of all, 0.13 m, leaves five of 0.03, two of 0.13, two of
        # 0.07, one of 0.27, with a mean square of 0.0121.
        assert evaluation.ate_aligned_rmse_m == pytest.approx(0.11, abs=ROUNDING)

    def test_a_turned_world_is_forgiven(self):
        square_m = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1], [0, 0, 1]])
        turned_m = square_m @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]).T
        evaluation = evaluate(one_drone(turned_m), one_drone(square_m))
        # A quarter turn about a corner moves the corners by 0, sqrt 2, 2, sqrt 2 and 0.
        assert evaluation.ate_rmse_m == pytest.approx(((0 + 2 + 4 + 2 + 0) / 5) ** 0.5, abs=ROUNDING)
        assert evaluation.ate_aligned_rmse_m == pytest.approx(0, abs=ROUNDING)

    def test_neither_mirror_nor_scale_is(self):
        # Points on the three axes have no mirror image that a turn brings back. The best turn of the image of a
        # shape along x, y, z with sums of squares 18, 8, 2 sacrifices z: its two points stay 2 off.
        shape_m = np.array([[3, 0, 0], [-3, 0, 0], [0, 2, 0], [0, -2, 0], [0, 0, 1], [0, 0, -1]])
        mirrored = evaluate(one_drone(shape_m * [-1, 1, 1]), one_drone(shape_m))
        assert mirrored.ate_aligned_rmse_m == pytest.approx(((4 + 4) / 6) ** 0.5, abs=ROUNDING)
        # Twice as large, each point is off by its own length.
        scaled = evaluate(one_drone(2 * shape_m), one_drone(shape_m))
        assert scaled.ate_aligned_rmse_m == pytest.approx(((18 + 8 + 2) / 6) ** 0.5, abs=ROUNDING)

    @given(seeds)
    @settings(max_examples=30)
    def test_alignment_against_scipy(self, seed):
        est, ref = random_flights(seed, missing=0, num_estimates=3)
        evaluation = evaluate(est, ref)
        for drone in evaluation.per_drone:
            est_m = est.position_m[:, est.drones.index(drone.estimate)]
            ref_m = ref.position_m[:, ref.drones.index(drone.drone)]
            turn, rssd_m = Rotation.align_vectors(ref_m - ref_m.mean(axis=0), est_m - est_m.mean(axis=0))
            assert drone.ate_aligned_rmse_m == pytest.approx(rssd_m / len(ref_m) ** 0.5, abs=1e-9)
            assert turn.single

    @given(seeds)
    @settings(max_examples=30)
    def test_alignment_never_costs(self, seed):
        evaluation = evaluate(*random_flights(seed))
        assert evaluation.ate_aligned_rmse_m <= evaluation.ate_rmse_m + ROUNDING
        for drone in evaluation.per_drone:
            if drone.ate_rmse_m is not None:
                assert drone.ate_aligned_rmse_m <= drone.ate_rmse_m + ROUNDING

    def test_never_seen(self):
        second = evaluate(on_x_axis([0] * 5), TRUTH).per_drone[1]
        assert (second.ate_rmse_m, second.ate_aligned_rmse_m, second.rpe_1s_rmse_m) == (None, None, None)


class TestRelative:
    """At two frames per second, so that a second is from frames 0, 1, 2 to 2, 3, 4."""

    def test_displacements(self):
        evaluation = evaluate(on_x_axis([0.1] * 5, [10, 10, 10.2, 10.2, 10.4]), TRUTH)
        first, second = evaluation.per_drone
        # A constant offset costs nothing; the errors of the second grow by 0.2 m in every second.
        assert first.rpe_1s_rmse_m == pytest.approx(0, abs=ROUNDING)
        assert second.rpe_1s_rmse_m == pytest.approx(0.2, abs=ROUNDING)
        assert evaluation.rpe_1s_rmse_m == pytest.approx((3 * 0.04 / 6) ** 0.5, abs=ROUNDING)
        assert evaluation.rpe_1s_rotation_rmse_deg is None

    def test_pairs_with_a_gap_at_either_end_do_not_count(self):
        truth, est = on_x_axis([0] * 5), on_x_axis([0, 0, None, 0.3, 0.9])
        # Left is 1 to 3; 0 to 2 and 2 to 4 are not.
        assert evaluate(est, truth).rpe_1s_rmse_m == pytest.approx(0.3, abs=ROUNDING)

    def test_a_second_is_counted_in_frame_numbers_and_not_in_rows(self):
        # Frame 2 is unknown and has no row: the pair 1 and 3 is in consecutive rows, 0 and 2, 2 and 4 are no pairs.
        truth, est = on_x_axis([0, 0, None, 0, 0]), on_x_axis([0.1, 0, 7, 0.3, 0.9])
        assert evaluate(est, truth).rpe_1s_rmse_m == pytest.approx(0.3, abs=ROUNDING)

    def test_shorter_than_a_second(self):
        assert evaluate(on_x_axis([0, 0.1]), on_x_axis([0, 0])).rpe_1s_rmse_m is None
        assert evaluate(on_x_axis([0.1]), on_x_axis([0])).rpe_1s_rmse_m is None

    def test_rotations(self):
        still_m = [[0, 0, 0]] * 5
        # Turns of 10, 0 and 20 degrees in a second, of a drone that does not turn.
        est = one_drone(still_m, yaw_deg=[0, 0, 10, 0, 30])
        evaluation = evaluate(est, one_drone(still_m, yaw_deg=[0] * 5))
        expected_deg = ((100 + 0 + 400) / 3) ** 0.5
        assert evaluation.rpe_1s_rotation_rmse_deg == pytest.approx(expected_deg, abs=1e-9)
        # An offset of the heading costs nothing, nor does the sign of a quaternion.
        turned = one_drone(still_m, yaw_deg=[90, 90, 100, 90, 120])
        turned.orientation_wxyz[1::2] *= -1
        ahead = evaluate(turned, one_drone(still_m, yaw_deg=[0] * 5))
        assert ahead.rpe_1s_rotation_rmse_deg == pytest.approx(expected_deg, abs=1e-9)
        assert evaluate(est, one_drone(still_m)).rpe_1s_rotation_rmse_deg is None


def with_covariance(est, covariance_m2):
    shape = (est.num_frames, est.num_drones, 3, 3)
    return replace(est, covariance_m2=np.broadcast_to(np.array(covariance_m2, float), shape).copy())


class TestConsistency:
    def test_raw_and_without_offsets(self):
        est = on_x_axis([0.1] * 5, [10, 10, 10.2, 10.2, 10.4])
        evaluation = evaluate(with_covariance(est, 0.01 * np.eye(3)), TRUTH)
        # NEES is the squared error by 0.01 m2: 1 five times, then 0, 0, 4, 4, 16, of which the last is above 6.25.
        assert evaluation.inside_90_rate == pytest.approx(9 / 10, abs=ROUNDING)
        assert evaluation.mean_nees == pytest.approx((5 * 1 + 4 + 4 + 16) / 10, abs=1e-9)
        # Offsets of 0.1 and 0.16 m: 0 five times, then 2.56, 2.56, 0.16, 0.16, 5.76.
        assert evaluation.offset_removed_inside_90_rate == 1
        assert evaluation.offset_removed_mean_nees == pytest.approx(1.12, abs=1e-9)
        assert [drone.inside_90_rate for drone in evaluation.per_drone] == pytest.approx([1, 0.8])
        assert [drone.mean_nees for drone in evaluation.per_drone] == pytest.approx([1, 24 / 5])

    def test_the_whole_matrix_counts(self):
        # Of [[2, 1], [1, 2]] the inverse is [[2, -1], [-1, 2]] / 3: an error of (1, 0, 0) has a NEES of 2/3.
        covariance_m2 = [[2, 1, 0], [1, 2, 0], [0, 0, 1]]
        evaluation = evaluate(with_covariance(on_x_axis([1.0] * 5), covariance_m2), on_x_axis([0] * 5))
        assert evaluation.mean_nees == pytest.approx(2 / 3, abs=ROUNDING)

    def test_none_where_there_is_none(self):
        evaluation = evaluate(TRUTH, TRUTH)
        assert (evaluation.inside_90_rate, evaluation.mean_nees) == (None, None)
        est = with_covariance(on_x_axis([0.1] * 5, [10.2] * 5), 0.01 * np.eye(3))
        est.covariance_m2[1:, 0] = np.nan
        evaluation = evaluate(est, TRUTH)
        # Counted: one of the first drone, five of the second.
        assert evaluation.mean_nees == pytest.approx((1 * 1 + 5 * 4) / 6, abs=1e-9)

    @pytest.mark.parametrize("variance_m2", [0.0, -0.01])
    def test_what_is_no_covariance_is_refused(self, variance_m2):
        est = with_covariance(TRUTH, np.diag([0.01, 0.01, variance_m2]))
        with pytest.raises(InputError, match="estimate: expected covariances that are positive definite"):
            evaluate(est, TRUTH)

    def test_limit(self):
        assert pytest.approx(chi2(3).ppf(0.9), rel=1e-12) == INSIDE_90

    def test_honest_covariances_are_found_honest(self):
        rng = np.random.default_rng(0)
        num_frames = 4000
        root_m = np.array([[0.03, 0, 0], [0.01, 0.02, 0], [0.01, -0.02, 0.05]])
        offset_m = np.array([0.0, 0.0, 0.03])
        yaw_deg = np.linspace(0, 720, num_frames)
        truth = one_drone(np.zeros((num_frames, 3)), yaw_deg=yaw_deg)
        noise_m = rng.normal(size=(num_frames, 1, 3)) @ root_m.T
        est = with_covariance(replace(truth, position_m=truth.position_m + noise_m), root_m @ root_m.T)
        evaluation = evaluate(est, truth)
        # Four standard deviations: of a share of 0.9, sqrt(0.09 / n); of the mean of chi-square, sqrt(6 / n).
        assert evaluation.inside_90_rate == pytest.approx(0.9, abs=4 * (0.09 / num_frames) ** 0.5)
        assert evaluation.mean_nees == pytest.approx(3, abs=4 * (6 / num_frames) ** 0.5)
        off = evaluate(replace(est, position_m=est.position_m + offset_m), truth)
        assert off.mean_nees > 3.3
        assert off.offset_removed_mean_nees == pytest.approx(3, abs=4 * (6 / num_frames) ** 0.5)
        assert off.offset_removed_inside_90_rate == pytest.approx(0.9, abs=4 * (0.09 / num_frames) ** 0.5)
