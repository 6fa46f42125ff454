"""Comparison of a camera's path with a reference: tables by hand, and known clock offsets, lever arms and turns."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.evaluation import PathSettings, Statistics, compare_paths
from psotrack.evaluation.path_comparison import mean_rotation, wrap_deg
from psotrack.evaluation.plots import save_paths
from psotrack.support import COLOURS, FAINT
from psotrack.trajectories import Status, Trajectories

FPS = 25.0
#: Columns: the axes of a camera that looks ahead, in the axes of a body (x ahead, z up).
LOOKS_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def camera_path(time_s, position_m, wxyz) -> Trajectories:
    count = len(time_s)
    return Trajectories(
        np.arange(count),
        np.asarray(time_s, float),
        ("camera",),
        np.array(position_m, float)[:, None],
        orientation_wxyz=np.array(wxyz, float)[:, None],
        status=np.full((count, 1), int(Status.TRACKED)),
    )


def flown_m(time_s, speed_m_s=1.0, seed=0):
    """Motion that never repeats, at about this speed: (times, 3), metres."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.4, 1.6, (4, 3)), rng.uniform(0, 2 * np.pi, (4, 3))
    angle = rate * np.asarray(time_s)[:, None, None] + phase
    return np.array([0.0, 0.0, 1.5]) + (speed_m_s / np.sqrt(6) / rate * np.sin(angle)).sum(axis=1)


def body_orientations(time_s, seed=1) -> Rotation:
    """Orientations of a body that turns about the vertical and sways a little; yaw passes 180 degrees."""
    sway_deg = 12.0 * flown_m(time_s, 1.0, seed)
    return Rotation.from_euler("ZYX", sway_deg * [15, 1, 1] + [170, -18, 0], degrees=True)


def body(time_s, position_m, wxyz=None) -> Trajectories:
    """Poses of the reference's body."""
    turns = None if wxyz is None else wxyz[:, None]
    return Trajectories(
        np.arange(len(time_s)), time_s, ("body",), position_m[:, None], orientation_wxyz=turns
    )


def compare(path, time_s, position_m, wxyz=None, *, orientation_time_s=None, **options):
    """Comparison of a path with a reference of these times, positions and orientations."""
    if orientation_time_s is None:
        return compare_paths(path, body(time_s, position_m, wxyz), settings=PathSettings(**options))
    turns = body(orientation_time_s, np.zeros((len(orientation_time_s), 3)), wxyz)
    return compare_paths(path, body(time_s, position_m), turns, PathSettings(**options))


def as_wxyz(rotation: Rotation):
    return rotation.as_quat(scalar_first=True)


def recording(rate_hz=100.0, seconds=13.0, clock_s=0.0):
    """Times by a clock that is `clock_s` ahead, and positions and orientations of the body at these times."""
    time_s = 0.0031 + np.arange(int(seconds * rate_hz)) / rate_hz
    return time_s + clock_s, flown_m(time_s), as_wxyz(body_orientations(time_s))


def filmed_path(
    arm_m=(0.0, 0.0, 0.0), turn=None, seconds=10.0, start_s=1.5, noise_m=0.0, noise_deg=0.0, seed=0
):
    """Path of the camera on the body of `recording`."""
    rng = np.random.default_rng(seed)
    time_s = start_s + np.arange(int(seconds * FPS)) / FPS
    body = body_orientations(time_s)
    position_m = flown_m(time_s) + body.apply(arm_m) + rng.normal(0, noise_m, (len(time_s), 3))
    camera = body * (turn or Rotation.identity())
    camera = camera * Rotation.from_rotvec(rng.normal(0, noise_deg, (len(time_s), 3)), degrees=True)
    return camera_path(time_s, position_m, as_wxyz(camera))


class TestTablesByHand:
    """Five frames of a flight in the horizontal plane, with a longer reference at four times the rate."""

    TIME_S = 0.2 + np.arange(5) / FPS
    SAMPLES_S = np.arange(60) / 100

    @staticmethod
    def level_m(time_s):
        return np.stack([3 * np.sin(3 * time_s), 2 * np.cos(4 * time_s), 0 * time_s + 1], axis=-1)

    @staticmethod
    def camera_orientations(yaw_deg):
        """Orientations of cameras that look along the horizon, at these yaw angles."""
        ahead = Rotation.from_matrix(LOOKS_AHEAD)
        return Rotation.from_euler("Z", np.reshape(yaw_deg, (-1, 1)), degrees=True) * ahead

    def test_table_7(self):
        """All errors are vertical, so no clock offset makes them smaller."""
        error_m = np.array([0.01, 0.02, 0.03, 0.04, 0.10])
        position_m = self.level_m(self.TIME_S) + error_m[:, None] * [0, 0, 1]
        path = camera_path(self.TIME_S, position_m, np.tile([1.0, 0, 0, 0], (5, 1)))
        found = compare(
            path, self.SAMPLES_S, self.level_m(self.SAMPLES_S), with_lever_arm=False, max_offset_s=0.1
        )
        # The offset is found to 1e-6 s, in which the drone flies 1e-5 m. This adds 5e-9 m to an error of 0.01 m.
        assert found.offset_s == pytest.approx(0, abs=2e-6)
        np.testing.assert_allclose(found.distance_m, error_m, atol=1e-8)
        table = Statistics.of(found.distance_m)
        # Deviations of -3, -2, -1, 0 and 6 hundredths have a mean square of 50 / 5.
        expected = [0.20 / 5, 0.03, np.sqrt(50 / 5) / 100, 0.01, 0.10]
        assert [table.mean, table.median, table.std, table.minimum, table.maximum] == pytest.approx(expected)
        assert table.count == 5
        assert found.turning is None
        np.testing.assert_array_equal(found.lever_arm_m, 0)
        np.testing.assert_allclose(found.distance_to_point_m, found.distance_m)

    def test_table_8(self):
        """Yaw goes from 176 to 184 degrees, which is the same as -176 degrees, so differences must be wrapped."""
        yaw_deg, error_deg = 176.0 + 2 * np.arange(5), np.array([1.0, 3.0, -2.0, 0.5, -5.0])
        path = camera_path(
            self.TIME_S, self.level_m(self.TIME_S), as_wxyz(self.camera_orientations(yaw_deg + error_deg))
        )
        yaws_deg = 176.0 + 2 * FPS * (self.SAMPLES_S - 0.2)
        found = compare(
            path,
            self.SAMPLES_S,
            self.level_m(self.SAMPLES_S),
            as_wxyz(self.camera_orientations(yaws_deg)),
            with_lever_arm=False,
            with_turn=False,
            max_offset_s=0.1,
        )
        # The body turns by 50 degrees per second, and the offset has an error of 2e-6 s.
        np.testing.assert_allclose(found.turning.difference_deg[:, 2], error_deg, atol=1e-4)
        np.testing.assert_allclose(found.turning.difference_deg[:, :2], 0, atol=1e-6)
        np.testing.assert_allclose(found.turning.angle_deg, np.abs(error_deg), atol=1e-4)
        np.testing.assert_array_equal(found.turning.turn_wxyz, [1, 0, 0, 0])
        assert found.turning.offset_s == found.offset_s
        table = Statistics.of(found.turning.difference_deg[:, 2])
        # Deviations from the mean of -1/2 are 1.5, 3.5, -1.5, 1 and -4.5, with a mean square of 38 / 5.
        expected = [-2.5 / 5, 0.5, np.sqrt(38 / 5), -5.0, 3.0]
        assert [table.mean, table.median, table.std, table.minimum, table.maximum] == pytest.approx(
            expected, abs=1e-4
        )

    def test_statistics_without_values_are_nan(self):
        table = Statistics.of(np.full(3, np.nan))
        assert table.count == 0
        assert np.isnan([table.mean, table.median, table.std, table.minimum, table.maximum]).all()


class TestAngles:
    @pytest.mark.parametrize(
        ("angle_deg", "expected_deg"),
        [(180, 180), (-180, 180), (181, -179), (-181, 179), (359, -1), (-359, 1), (540, 180), (0, 0)],
    )
    def test_wrapping(self, angle_deg, expected_deg):
        assert wrap_deg(np.array([float(angle_deg)])) == pytest.approx([expected_deg])

    @given(st.floats(-1e4, 1e4))
    def test_wrapped_angles_are_the_same_angles(self, angle_deg):
        found = wrap_deg(np.array([angle_deg]))[0]
        assert -180 < found <= 180
        # Sums of up to 1e4 have rounding errors of 2e-12.
        assert np.exp(1j * np.radians(found)) == pytest.approx(np.exp(1j * np.radians(angle_deg)), abs=1e-12)

    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=5)
    def test_differences_and_angles_of_random_orientations(self, seed):
        """Compared with SciPy's Euler angles of the body, and with the angle of the rotation between the two."""
        path = filmed_path(seconds=4)
        rng = np.random.default_rng(seed)
        errors = Rotation.from_rotvec(rng.normal(0, 0.3, (path.num_frames, 3)))
        poses = Rotation.from_quat(path.orientation_wxyz[:, 0], scalar_first=True) * errors
        time_s, position_m, wxyz = recording(seconds=8)
        found = compare(
            replace(path, orientation_wxyz=as_wxyz(poses)[:, None]),
            time_s,
            position_m,
            wxyz,
            with_lever_arm=False,
            with_turn=False,
            max_offset_s=0.1,
        ).turning
        # Splines over 10 ms are exact to 1e-4 degrees; the offset is found to a fraction of a millisecond.
        np.testing.assert_allclose(found.angle_deg, np.degrees(errors.magnitude()), atol=0.02)
        ahead = Rotation.from_matrix(LOOKS_AHEAD).inv()
        euler_deg = [
            (one * ahead).as_euler("ZYX", degrees=True)[:, ::-1]
            for one in (poses, Rotation.from_quat(found.reference_wxyz, scalar_first=True))
        ]
        difference_deg = (euler_deg[0] - euler_deg[1] + 180) % 360 - 180
        np.testing.assert_allclose(wrap_deg(found.difference_deg - difference_deg), 0, atol=1e-6)

    @pytest.mark.parametrize("share", [0.0, 0.3])
    def test_the_mean_rotation_is_robust_to_outliers(self, share):
        rng = np.random.default_rng(5)
        true = Rotation.random(rng=rng)
        near = true * Rotation.from_rotvec(rng.normal(0, 0.01, (200, 3)))
        wild = Rotation.random(int(200 * share / (1 - share)), rng=rng)
        found = mean_rotation(Rotation.concatenate([near, wild]))
        # The mean of 200 rotations with errors of 0.01 rad is good to 0.0007 rad along each axis; outliers add to that.
        assert (true.inv() * found).magnitude() < (0.0025 if share == 0 else 0.006)


TURN = Rotation.from_euler("ZYX", [-90.0, 4.0, -97.0], degrees=True)
ARM_M = np.array([0.12, -0.03, 0.05])


class TestClocks:
    @pytest.mark.parametrize(
        ("clock_s", "turn_clock_s"),
        [(0.3137, None), (-0.2719, None), (-0.2719, 0.1573), (512.2345, -77.03)],
    )
    def test_known_offsets_arm_and_turn_are_found(self, clock_s, turn_clock_s):
        """Positions are at 100 Hz by one clock; orientations are by the same clock, or at 40 Hz by another clock."""
        path = filmed_path(ARM_M, TURN, noise_m=0.005, noise_deg=0.2)
        time_s, position_m, wxyz = recording(clock_s=clock_s)
        turns = {}
        if turn_clock_s is not None:
            orientation_time_s, _, wxyz = recording(rate_hz=40, clock_s=turn_clock_s)
            turns = {"orientation_time_s": orientation_time_s}
        found = compare(path, time_s, position_m, wxyz, **turns)
        # The required accuracy is 0.1 frame. Here the noise allows a fiftieth of a frame.
        assert abs(found.offset_s - clock_s) * FPS < 0.05
        assert found.offset_std_s * FPS < 0.05
        expected_s = clock_s if turn_clock_s is None else turn_clock_s
        assert abs(found.turning.offset_s - expected_s) * FPS < 0.05
        # Medians of 250 values with noise of 5 mm and 0.2 degrees are good to 0.4 mm and 0.015 degrees; limits 6 times.
        np.testing.assert_allclose(found.lever_arm_m, ARM_M, atol=0.0024)
        turn = Rotation.from_quat(found.turning.turn_wxyz, scalar_first=True)
        assert np.degrees((TURN.inv() * turn).magnitude()) < 0.1
        # The mean distance is √(8 / π) times the noise along each axis, good to 42 % / √250; limit three times that.
        mean_norm = np.sqrt(8 / np.pi)
        assert np.mean(found.distance_m) == pytest.approx(0.005 * mean_norm, rel=0.08)
        assert np.mean(found.turning.angle_deg) == pytest.approx(0.2 * mean_norm, rel=0.08)
        # The length of the arm, 0.13 m, within the noise.
        assert np.mean(found.distance_to_point_m) == pytest.approx(np.linalg.norm(ARM_M), abs=0.002)
        body_m = flown_m(path.time_s) + body_orientations(path.time_s).apply(ARM_M)
        np.testing.assert_allclose(found.reference_m, body_m, atol=0.006)
        assert found.path_length_m == pytest.approx(
            np.linalg.norm(np.diff(body_m, axis=0), axis=1).sum(), rel=0.01
        )

    def test_a_lever_arm_without_orientations_of_the_reference(self):
        """The path's orientations turn the arm, which is returned in the camera's axes."""
        path = filmed_path(ARM_M, TURN, noise_m=0.005, noise_deg=0.2)
        time_s, position_m, _ = recording(clock_s=0.3137)
        found = compare(path, time_s, position_m)
        assert abs(found.offset_s - 0.3137) * FPS < 0.05
        np.testing.assert_allclose(found.lever_arm_m, TURN.inv().apply(ARM_M), atol=0.0024)
        assert found.turning is None

    @pytest.mark.parametrize("turn_clock_s", [None, 0.1573])
    def test_a_slow_drone_with_a_long_lever_arm_that_turns(self, turn_clock_s):
        """If the arm were constant in the world instead of the body, it would cause most of the visible motion."""
        path, (time_s, _, _) = filmed_path(noise_deg=0.2), recording()
        slow_m = [flown_m(each_s, speed_m_s=0.3) for each_s in (path.time_s, time_s)]
        moved_m = slow_m[0] + body_orientations(path.time_s).apply([0.2, -0.1, 0.12])
        moved_m = moved_m + np.random.default_rng(1).normal(0, 0.002, moved_m.shape)
        path = replace(path, position_m=moved_m[:, None])
        turns_s, _, wxyz = recording(rate_hz=40, clock_s=turn_clock_s or 0)
        by_own_clock = {} if turn_clock_s is None else {"orientation_time_s": turns_s}
        found = compare(path, time_s + 0.7, slow_m[1], wxyz if by_own_clock else None, **by_own_clock)
        assert abs(found.offset_s - 0.7) * FPS < 0.05
        np.testing.assert_allclose(
            np.linalg.norm(found.lever_arm_m), np.linalg.norm([0.2, -0.1, 0.12]), atol=2e-3
        )

    @pytest.mark.parametrize("turn_clock_s", [0.1573, -0.4081])
    def test_a_camera_with_the_axes_of_the_body(self, turn_clock_s):
        path = filmed_path(noise_deg=0.2)
        turns_s, _, wxyz = recording(rate_hz=40, clock_s=turn_clock_s)
        time_s, position_m, _ = recording()
        found = compare(
            path, time_s, position_m, wxyz, orientation_time_s=turns_s, with_turn=False, with_lever_arm=False
        )
        assert abs(found.turning.offset_s - turn_clock_s) * FPS < 0.05
        np.testing.assert_array_equal(found.turning.turn_wxyz, [1, 0, 0, 0])
        assert np.median(found.turning.angle_deg) < 0.5

    def test_outliers_are_counted_and_do_not_move_the_clocks(self):
        """Every eighth pose is anywhere in the room, and one pose is at a distance of ten kilometres."""
        path = filmed_path(ARM_M, TURN, noise_m=0.005, noise_deg=0.2)
        wild = np.arange(3, path.num_frames, 8)
        rng = np.random.default_rng(2)
        position_m, orientation_wxyz = path.position_m.copy(), path.orientation_wxyz.copy()
        position_m[wild, 0] += rng.uniform(-2, 2, (len(wild), 3))
        position_m[wild[4]] = 1e4
        orientation_wxyz[wild, 0] = as_wxyz(Rotation.random(len(wild), rng=rng))
        time_s, reference_m, wxyz = recording(clock_s=-0.2719)
        turns_s, _, turns_wxyz = recording(rate_hz=40, clock_s=0.4)
        wrong = replace(path, position_m=position_m, orientation_wxyz=orientation_wxyz)
        for turns, wxyz_used in (({}, wxyz), ({"orientation_time_s": turns_s}, turns_wxyz)):
            found = compare(wrong, time_s, reference_m, wxyz_used, **turns)
            assert abs(found.offset_s + 0.2719) * FPS < 0.1
            assert abs(found.turning.offset_s - (0.4 if turns else -0.2719)) * FPS < 0.1
            # No outlier is left out: the distance of 10 km is in the mean and in the maximum.
            assert Statistics.of(found.distance_m).count == path.num_frames
            assert np.max(found.distance_m) > 9e3
            assert np.max(found.turning.angle_deg) > 90
            assert np.median(found.distance_m) < 0.012

    def test_lost_poses_and_gaps_of_the_reference_are_not_compared(self):
        path = filmed_path(ARM_M, TURN, noise_m=0.005, noise_deg=0.2)
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

    @given(st.integers(0, 2**32 - 1), st.floats(-100, 100))
    @settings(max_examples=2)
    def test_the_comparison_does_not_depend_on_the_worlds_axes(self, seed, later_s):
        path = filmed_path(ARM_M, TURN, noise_m=0.01, noise_deg=0.5, seed=seed, seconds=8)
        time_s, position_m, wxyz = recording(rate_hz=50, seconds=12)
        first = compare(path, time_s, position_m, wxyz)
        world = Rotation.random(rng=np.random.default_rng(seed))
        moved = replace(
            path,
            time_s=path.time_s + later_s,
            position_m=world.apply(path.position_m[:, 0])[:, None] + 7.0,
            orientation_wxyz=as_wxyz(
                world * Rotation.from_quat(path.orientation_wxyz[:, 0], scalar_first=True)
            )[:, None],
        )
        turned_wxyz = as_wxyz(world * Rotation.from_quat(wxyz, scalar_first=True))
        again = compare(moved, time_s + later_s, world.apply(position_m) + 7.0, turned_wxyz)
        # Offsets are found to 1e-6 s, in which the camera moves by 1e-6 m and turns by 1e-4 degrees.
        assert again.offset_s == pytest.approx(first.offset_s, abs=5e-6)
        np.testing.assert_allclose(again.distance_m, first.distance_m, atol=2e-5)
        np.testing.assert_allclose(again.lever_arm_m, first.lever_arm_m, atol=2e-5)
        np.testing.assert_allclose(again.turning.angle_deg, first.turning.angle_deg, atol=2e-3)


class TestRefusedComparisons:
    def refused(self, text, path, *reference, error=InputError, **options):
        with pytest.raises(error, match=text) as caught:
            compare(path, *reference, **options)
        assert "\n" not in str(caught.value)

    def test_clocks_too_far_apart(self):
        """Path and reference have no common time at any allowed offset."""
        time_s, position_m, _ = recording(clock_s=100)
        self.refused(
            "expected positions of both at offsets within 2 s, found none",
            filmed_path(),
            time_s,
            position_m,
            max_offset_s=2.0,
        )

    def test_no_poses_or_no_reference(self):
        path, (time_s, position_m, wxyz) = filmed_path(), recording()
        lost = replace(path, status=np.full((path.num_frames, 1), int(Status.LOST)))
        self.refused("expected poses of both, found 0 and 1300", lost, time_s, position_m)
        self.refused(
            "expected poses of both, found 250 and 0", path, time_s, np.full_like(position_m, np.nan)
        )
        self.refused(
            "expected poses of both, found 250 and 0",
            path,
            time_s,
            position_m,
            np.full_like(wxyz, np.nan),
            orientation_time_s=time_s,
        )

    def test_orientations_at_other_times_than_the_path(self):
        path, (time_s, position_m, wxyz) = filmed_path(), recording()
        wxyz[time_s > 1.5] = np.nan
        self.refused(
            "orientations of both in some frame, found none",
            path,
            time_s,
            position_m,
            wxyz,
            with_lever_arm=False,
        )

    def test_a_camera_that_hovers(self):
        path = filmed_path(noise_m=0.01)
        still_m = np.array([1.0, 2.0, 1.5])
        rng = np.random.default_rng(0)
        path.position_m[:] = still_m + rng.normal(0, 0.01, path.position_m.shape)
        time_s, _, wxyz = recording()
        reference_m = np.tile(still_m, (len(time_s), 1))
        # Known orientations do not help.
        self.refused("hover", path, time_s, reference_m)
        self.refused("hover", path, time_s, reference_m, wxyz)
        self.refused("hover", path, time_s, reference_m, wxyz, orientation_time_s=time_s)
        self.refused("hover", path, time_s, reference_m, with_lever_arm=False)

    def test_a_range_below_a_step(self):
        time_s, position_m, _ = recording()
        self.refused(
            "max_offset_s: expected a step",
            filmed_path(),
            time_s,
            position_m,
            max_offset_s=0.001,
            error=SettingsError,
        )


@pytest.fixture(scope="module")
def noisy_flight():
    path = filmed_path(ARM_M, TURN, noise_m=0.05, noise_deg=0.5)
    return path, compare(path, *recording())


class TestPlots:
    @staticmethod
    def has_colour(png, colour):
        """Mask of the pixels with about this colour, #rrggbb."""
        bgr = [int(colour[place : place + 2], 16) for place in (5, 3, 1)]
        return np.abs(cv2.imread(str(png)).astype(int) - bgr).max(axis=-1) < 40

    def test_figure_11(self, tmp_path, noisy_flight):
        path, comparison = noisy_flight
        png = tmp_path / "paths.png"
        save_paths(png, {"filter": comparison}, title="a flight")
        for colour in (COLOURS[0], FAINT):
            assert self.has_colour(png, colour).sum() > 500
        with pytest.raises(OutputError, match="expected a path that does not exist yet"):
            save_paths(png, {"filter": comparison})
        # A pose far away does not change the scale of the views; it is cut off.
        wild = replace(path, position_m=path.position_m.copy())
        wild.position_m[100] = 1e4
        save_paths(tmp_path / "wild.png", {"wild": compare(wild, *recording())})
        # Measured 0.99 of the pixels, because a piece of the line is missing.
        assert self.has_colour(tmp_path / "wild.png", FAINT).sum() > 0.9 * self.has_colour(png, FAINT).sum()

    def test_without_orientations_there_is_no_panel_of_angles(self, tmp_path, noisy_flight):
        path, comparison = noisy_flight
        time_s, position_m, _ = recording()
        save_paths(tmp_path / "both.png", {"one": comparison, "other": comparison})
        save_paths(tmp_path / "distances.png", {"one": compare(path, time_s, position_m)})
        heights = [cv2.imread(str(tmp_path / f"{name}.png")).shape[0] for name in ("both", "distances")]
        assert heights[1] < 0.9 * heights[0]
        # The second path has a colour of its own, in the panels over time too.
        assert self.has_colour(tmp_path / "both.png", COLOURS[1]).sum() > 500
