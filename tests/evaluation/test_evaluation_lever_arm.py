"""The offset of each drone's tracked point and its standard error: values, JSON and table."""

import json
from dataclasses import replace

import numpy as np
import pytest
from evaluation_flights import ROUNDING, on_x_axis
from scipy.spatial.transform import Rotation

from psotrack.evaluation import evaluate, tables
from psotrack.support import standard_error
from psotrack.trajectories import Trajectories

ARM_M = np.array([0.03, -0.02, -0.117])


def autoregressive(rng, count: int, persistence: float):
    """(count,), stationary autoregressive series of variance 1."""
    values = rng.normal(size=count)
    for i in range(1, count):
        values[i] = persistence * values[i - 1] + np.sqrt(1 - persistence**2) * values[i]
    return values


def turning_flight(num_frames: int = 400, noise_m: float = 0.0):
    """Estimate and reference of a drone that flies and turns; the tracked point is at the end of the lever arm."""
    rng = np.random.default_rng(0)
    time_s = np.arange(num_frames) / 25
    ref_m = np.stack([np.cos(time_s), np.sin(0.7 * time_s), 1 + 0.2 * np.sin(2 * time_s)], axis=-1)[:, None]
    turn = Rotation.from_euler("ZYX", np.stack([2 * time_s, 0.1 * np.sin(time_s), 0 * time_s], axis=-1))
    est_m = ref_m + turn.apply(ARM_M)[:, None] + rng.normal(0, noise_m, ref_m.shape)
    frame = np.arange(num_frames)
    orientation_wxyz = turn.as_quat(scalar_first=True)[:, None]
    return (
        Trajectories(frame, time_s, ("0",), est_m),
        Trajectories(frame, time_s, ("dron1",), ref_m, orientation_wxyz=orientation_wxyz),
    )


class TestStandardError:
    @pytest.mark.parametrize("persistence", [0.0, 0.5, 0.9])
    def test_it_equals_the_spread_of_means(self, persistence):
        """The oracle is the spread of the means of 300 series of 1000 frames."""
        rng = np.random.default_rng(1)
        series = np.stack([autoregressive(rng, 1000, persistence) for _ in range(300)], axis=1)
        error = standard_error(series)
        spread = series.mean(axis=0).std()
        # The spread of 300 means has an error of 4 %; blocks of 50 frames miss 10 % where 19 frames count as one.
        assert np.sqrt((error**2).mean()) == pytest.approx(spread, rel=0.15)

    def test_two_values(self):
        # s² = (0.1² + 0.1²) / (2 - 1), divided by 2: 0.1².
        assert standard_error(np.array([[0.1], [0.3]])) == pytest.approx(0.1)

    def test_rows_with_nan_are_ignored(self):
        values = np.random.default_rng(2).normal(size=(50, 3))
        with_gaps = np.insert(values, [20, 50], np.nan, axis=0)
        np.testing.assert_allclose(standard_error(with_gaps), standard_error(values), atol=ROUNDING)
        assert np.isnan(standard_error(values[:1])).all()
        assert np.isnan(standard_error(np.full((5, 2), np.nan))).all()

    def test_it_is_not_below_the_standard_error_of_independent_frames(self):
        flipping = np.tile([[1.0], [-1.0]], (50, 1))
        assert standard_error(flipping)[0] == pytest.approx(1 / np.sqrt(99))


class TestLeverArm:
    def test_in_the_body_frame_it_is_exact_without_noise(self):
        evaluation = evaluate(*turning_flight())
        (drone,) = evaluation.per_drone
        assert drone.offset_frame == "body"
        np.testing.assert_allclose(drone.offset_m, ARM_M, atol=ROUNDING)
        np.testing.assert_allclose(drone.offset_standard_error_m, 0, atol=ROUNDING)
        # Errors with the offset, and with the offset removed.
        assert evaluation.mean_error_m == pytest.approx(np.linalg.norm(ARM_M))
        assert evaluation.offset_removed_mean_error_m == pytest.approx(0, abs=ROUNDING)

    def test_in_the_world_frame_the_offset_of_a_turning_drone_is_less_certain(self):
        est, ref = turning_flight(noise_m=0.02)
        (body,) = evaluate(est, ref).per_drone
        (world,) = evaluate(est, replace(ref, orientation_wxyz=None)).per_drone
        assert world.offset_frame == "world"
        # The standard error is 20 mm / √400 = 1 mm, estimated from 20 blocks, with an error of √(1/38) = 16 %.
        np.testing.assert_allclose(body.offset_standard_error_m, 1e-3, rtol=0.5)
        assert np.abs(np.subtract(body.offset_m, ARM_M)).max() < 4e-3
        # The horizontal components, 36 mm, turn with the drone, so that their mean over five turns is nearly 0.
        assert world.offset_standard_error_m[0] > 2 * body.offset_standard_error_m[0]
        assert world.offset_m[2] == pytest.approx(ARM_M[2], abs=5e-3)

    def test_one_frame_has_no_standard_error(self):
        (drone,) = evaluate(on_x_axis([None, 2, None]), on_x_axis([0, 0, 0])).per_drone
        assert drone.offset_m == (2, 0, 0)
        assert drone.offset_standard_error_m is None

    def test_json_has_the_standard_error_beside_the_offset(self):
        (drone,) = evaluate(*turning_flight(noise_m=0.02)).to_dict()["per_drone"]
        keys = list(drone)
        place = keys.index("offset_m")
        assert keys[place : place + 3] == ["offset_m", "offset_standard_error_m", "offset_frame"]
        assert len(json.loads(json.dumps(drone, allow_nan=False))["offset_standard_error_m"]) == 3

    def test_the_table_shows_the_largest_standard_error(self):
        evaluation = evaluate(*turning_flight(noise_m=0.02))
        largest_mm = 1e3 * max(evaluation.per_drone[0].offset_standard_error_m)
        assert f"without each drone's offset (body frame, known to {largest_mm:.1f} mm)" in tables.as_text(
            evaluation
        )
        assert "(world frame)" in tables.as_text(evaluate(on_x_axis([None, 2, None]), on_x_axis([0, 0, 0])))
