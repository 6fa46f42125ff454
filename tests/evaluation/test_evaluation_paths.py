"""ATE, RPE and consistency: compared with results by hand for five frames and with independent formulas."""

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
    """Trajectories of one drone at two frames per second."""
    position_m = np.array(position_m, float)[:, None]
    frame = np.arange(len(position_m))
    orientation_wxyz = None
    if yaw_deg is not None:
        about_z = Rotation.from_euler("z", np.array(yaw_deg, float)[:, None], degrees=True)
        orientation_wxyz = about_z.as_quat(scalar_first=True)[:, None]
    return Trajectories(frame, frame / 2, ("d",), position_m, orientation_wxyz=orientation_wxyz, **others)


class TestAbsolute:
    # The first drone has errors of 0.1 m, the second 0, 0, 0.2, 0.2, 0.4 m.
    EST = on_x_axis([0.1] * 5, [10, 10, 10.2, 10.2, 10.4])

    def test_per_drone_and_for_all_drones(self):
        evaluation = evaluate(self.EST, TRUTH)
        first, second = evaluation.per_drone
        assert first.ate_rmse_m == pytest.approx(0.1, abs=ROUNDING)
        assert second.ate_rmse_m == pytest.approx(((0.04 + 0.04 + 0.16) / 5) ** 0.5, abs=ROUNDING)
        assert evaluation.ate_rmse_m == pytest.approx(((0.05 + 0.24) / 10) ** 0.5, abs=ROUNDING)

    def test_alignment_per_drone_and_of_all_drones_together(self):
        evaluation = evaluate(self.EST, TRUTH)
        first, second = evaluation.per_drone
        assert first.ate_aligned_rmse_m == pytest.approx(0, abs=ROUNDING)
        # The drone stands still, so alignment only removes the mean, 0.16 m: errors of 2 x 0.16, 2 x 0.04, 0.24 remain.
        assert second.ate_aligned_rmse_m == pytest.approx(
            ((2 * 0.0256 + 2 * 0.0016 + 0.0576) / 5) ** 0.5, abs=ROUNDING
        )
        # All positions are on a line, so a rotation does not help. Without the mean, 0.13 m, errors of 5 x 0.03,
        # 2 x 0.13, 2 x 0.07 and 0.27 remain, with a mean square of 0.0121.
        assert evaluation.ate_aligned_rmse_m == pytest.approx(0.11, abs=ROUNDING)

    def test_alignment_removes_a_rotation(self):
        square_m = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1], [0, 0, 1]])
        turned_m = square_m @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]).T
        evaluation = evaluate(one_drone(turned_m), one_drone(square_m))
        # A quarter turn about a corner moves the corners by 0, sqrt 2, 2, sqrt 2 and 0.
        assert evaluation.ate_rmse_m == pytest.approx(((0 + 2 + 4 + 2 + 0) / 5) ** 0.5, abs=ROUNDING)
        assert evaluation.ate_aligned_rmse_m == pytest.approx(0, abs=ROUNDING)

    def test_alignment_removes_neither_a_reflection_nor_a_scale(self):
        # The points have sums of squares of 18, 8 and 2 along x, y and z. The best rotation of their mirror image
        # mirrors z instead, so that the two points on z have errors of 2.
        shape_m = np.array([[3, 0, 0], [-3, 0, 0], [0, 2, 0], [0, -2, 0], [0, 0, 1], [0, 0, -1]])
        mirrored = evaluate(one_drone(shape_m * [-1, 1, 1]), one_drone(shape_m))
        assert mirrored.ate_aligned_rmse_m == pytest.approx(((4 + 4) / 6) ** 0.5, abs=ROUNDING)
        # If the shape is twice as large, each point's error is its own distance from the origin.
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
    def test_alignment_never_increases_the_error(self, seed):
        evaluation = evaluate(*random_flights(seed))
        assert evaluation.ate_aligned_rmse_m <= evaluation.ate_rmse_m + ROUNDING
        for drone in evaluation.per_drone:
            if drone.ate_rmse_m is not None:
                assert drone.ate_aligned_rmse_m <= drone.ate_rmse_m + ROUNDING

    def test_a_drone_without_a_track(self):
        second = evaluate(on_x_axis([0] * 5), TRUTH).per_drone[1]
        assert (second.ate_rmse_m, second.ate_aligned_rmse_m, second.rpe_1s_rmse_m) == (None, None, None)


class TestRelative:
    """Tests at two frames per second: a second is from frame 0 to 2, 1 to 3 and 2 to 4."""

    def test_displacements(self):
        evaluation = evaluate(on_x_axis([0.1] * 5, [10, 10, 10.2, 10.2, 10.4]), TRUTH)
        first, second = evaluation.per_drone
        # A constant offset gives no error; the second drone's error grows by 0.2 m in every second.
        assert first.rpe_1s_rmse_m == pytest.approx(0, abs=ROUNDING)
        assert second.rpe_1s_rmse_m == pytest.approx(0.2, abs=ROUNDING)
        assert evaluation.rpe_1s_rmse_m == pytest.approx((3 * 0.04 / 6) ** 0.5, abs=ROUNDING)
        assert evaluation.rpe_1s_rotation_rmse_deg is None

    def test_pairs_with_a_gap_at_either_end_do_not_count(self):
        truth, est = on_x_axis([0] * 5), on_x_axis([0, 0, None, 0.3, 0.9])
        # Only the pair of frames 1 and 3 remains.
        assert evaluate(est, truth).rpe_1s_rmse_m == pytest.approx(0.3, abs=ROUNDING)

    def test_a_second_is_counted_in_frame_numbers_and_not_in_rows(self):
        # Frame 2 is unknown and has no row: frames 1 and 3 are a pair, although their rows are consecutive.
        truth, est = on_x_axis([0, 0, None, 0, 0]), on_x_axis([0.1, 0, 7, 0.3, 0.9])
        assert evaluate(est, truth).rpe_1s_rmse_m == pytest.approx(0.3, abs=ROUNDING)

    def test_flights_shorter_than_a_second_have_no_rpe(self):
        assert evaluate(on_x_axis([0, 0.1]), on_x_axis([0, 0])).rpe_1s_rmse_m is None
        assert evaluate(on_x_axis([0.1]), on_x_axis([0])).rpe_1s_rmse_m is None

    def test_rotations(self):
        still_m = [[0, 0, 0]] * 5
        # The estimate turns by 10, 0 and 20 degrees per second; the drone does not turn.
        est = one_drone(still_m, yaw_deg=[0, 0, 10, 0, 30])
        evaluation = evaluate(est, one_drone(still_m, yaw_deg=[0] * 5))
        expected_deg = ((100 + 0 + 400) / 3) ** 0.5
        assert evaluation.rpe_1s_rotation_rmse_deg == pytest.approx(expected_deg, abs=1e-9)
        # A constant offset of the heading gives no error, nor does the sign of a quaternion.
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
        # NEES is the squared error divided by 0.01 m2: 5 x 1, then 0, 0, 4, 4, 16. Only the last is above 6.25.
        assert evaluation.inside_90_rate == pytest.approx(9 / 10, abs=ROUNDING)
        assert evaluation.mean_nees == pytest.approx((5 * 1 + 4 + 4 + 16) / 10, abs=1e-9)
        # Without the offsets of 0.1 and 0.16 m: 5 x 0, then 2.56, 2.56, 0.16, 0.16, 5.76.
        assert evaluation.offset_removed_inside_90_rate == 1
        assert evaluation.offset_removed_mean_nees == pytest.approx(1.12, abs=1e-9)
        assert [drone.inside_90_rate for drone in evaluation.per_drone] == pytest.approx([1, 0.8])
        assert [drone.mean_nees for drone in evaluation.per_drone] == pytest.approx([1, 24 / 5])

    def test_the_whole_matrix_counts(self):
        # The inverse of [[2, 1], [1, 2]] is [[2, -1], [-1, 2]] / 3, so an error of (1, 0, 0) has a NEES of 2/3.
        covariance_m2 = [[2, 1, 0], [1, 2, 0], [0, 0, 1]]
        evaluation = evaluate(with_covariance(on_x_axis([1.0] * 5), covariance_m2), on_x_axis([0] * 5))
        assert evaluation.mean_nees == pytest.approx(2 / 3, abs=ROUNDING)

    def test_positions_without_covariance_are_ignored(self):
        evaluation = evaluate(TRUTH, TRUTH)
        assert (evaluation.inside_90_rate, evaluation.mean_nees) == (None, None)
        est = with_covariance(on_x_axis([0.1] * 5, [10.2] * 5), 0.01 * np.eye(3))
        est.covariance_m2[1:, 0] = np.nan
        evaluation = evaluate(est, TRUTH)
        # One position of the first drone and five of the second have a covariance.
        assert evaluation.mean_nees == pytest.approx((1 * 1 + 5 * 4) / 6, abs=1e-9)

    @pytest.mark.parametrize("variance_m2", [0.0, -0.01])
    def test_invalid_covariances_are_refused(self, variance_m2):
        est = with_covariance(TRUTH, np.diag([0.01, 0.01, variance_m2]))
        with pytest.raises(InputError, match="estimate: expected covariances that are positive definite"):
            evaluate(est, TRUTH)

    def test_the_limit_is_that_of_the_90_percent_ellipsoid(self):
        assert pytest.approx(chi2(3).ppf(0.9), rel=1e-12) == INSIDE_90

    def test_correct_covariances_have_the_expected_nees(self):
        rng = np.random.default_rng(0)
        num_frames = 4000
        root_m = np.array([[0.03, 0, 0], [0.01, 0.02, 0], [0.01, -0.02, 0.05]])
        offset_m = np.array([0.0, 0.0, 0.03])
        yaw_deg = np.linspace(0, 720, num_frames)
        truth = one_drone(np.zeros((num_frames, 3)), yaw_deg=yaw_deg)
        noise_m = rng.normal(size=(num_frames, 1, 3)) @ root_m.T
        est = with_covariance(replace(truth, position_m=truth.position_m + noise_m), root_m @ root_m.T)
        evaluation = evaluate(est, truth)
        # Limits are four standard deviations: sqrt(0.09 / n) for a share of 0.9, sqrt(6 / n) for the mean of
        # chi-square.
        assert evaluation.inside_90_rate == pytest.approx(0.9, abs=4 * (0.09 / num_frames) ** 0.5)
        assert evaluation.mean_nees == pytest.approx(3, abs=4 * (6 / num_frames) ** 0.5)
        off = evaluate(replace(est, position_m=est.position_m + offset_m), truth)
        assert off.mean_nees > 3.3
        assert off.offset_removed_mean_nees == pytest.approx(3, abs=4 * (6 / num_frames) ** 0.5)
        assert off.offset_removed_inside_90_rate == pytest.approx(0.9, abs=4 * (0.09 / num_frames) ** 0.5)
