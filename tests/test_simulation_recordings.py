"""Recorded flights: file formats, error messages, and resampling compared with the formula that was sampled."""

import re
import shutil

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.recordings.datasets import pose_file, write_poses
from psotrack.simulation import Scenario, write_recorded_flight
from psotrack.simulation.flights.formulas import HarmonicFlight
from psotrack.simulation.flights.motion import Heading
from psotrack.simulation.flights.planning import plan
from psotrack.simulation.flights.recordings import (
    Recorded,
    RecordedFlight,
    read_recorded_flight,
    recorded_flight,
)
from psotrack.simulation.scenarios import Drone, FlightFromFile, Limits
from psotrack.trajectories import Trajectories, write_trajectories

HEADING = Heading(0.4, 0.6, 0.8, 0.1)
#: A flight with up to 2.4 m/s, 4 m/s^2 and 23 degrees of tilt, similar to the scenarios of the dataset.
FORMULA = HarmonicFlight(
    centre_m=np.array([0.1, -0.2, 1.5]),
    amplitude_m=np.array([[1.5, 1.2, 0.2], [0.2, 0.1, 0.1]]),
    angular_rad_s=np.array([1.2, 2.9]),
    phase_rad=np.array([[0.0, 1.5, 0.3], [0.5, 2.0, 1.0]]),
    heading=HEADING,
)
EVEN_S = np.arange(1001) / 100
#: Uneven sample times at rates of 70 to 160 Hz, seconds.
UNEVEN_S = np.cumsum(np.random.default_rng([5]).uniform(0.006, 0.0145, 1001))
FRAMES_S = np.arange(240) / 25


def sample_formula(time_s, *, oriented=False, noise_m=0.0):
    position_m = FORMULA.position_m(time_s)
    position_m = position_m + np.random.default_rng([7]).normal(0.0, noise_m, position_m.shape)
    return Recorded(time_s, position_m, FORMULA.orientation_wxyz(time_s) if oriented else None)


def make_replay(recorded, heading=HEADING, start_s=0.0, offset_m=(0.0, 0.0, 0.0)):
    return RecordedFlight(recorded, heading, start_s, np.array(offset_m), "loop.csv")


def angle_deg(a, b):
    """Return the angles between two stacks of rotation matrices, (times,), degrees."""
    return np.degrees(Rotation.from_matrix(np.swapaxes(a, -1, -2) @ b).magnitude())


def csv_lines(*rows, separator=","):
    return "".join(f"{separator.join(map(str, row))}\n" for row in rows)


def csv_table(separator=",", header=("time_s", "x_m", "y_m", "z_m"), count=8):
    return csv_lines(
        header,
        *((k / 10, k, 2 * k, 3 * k, 1, 0, 0, 0)[: len(header)] for k in range(count)),
        separator=separator,
    )


# --- resampling


@pytest.mark.parametrize("time_s", [EVEN_S, UNEVEN_S, np.arange(260) / 25], ids=["100 Hz", "uneven", "25 Hz"])
def test_a_recording_without_noise_replays_the_formula_at_any_time(time_s):
    replay = make_replay(sample_formula(time_s))
    query_s = FRAMES_S + 0.0137
    true_s = query_s + time_s[0]
    # The error of a quintic spline has order h^6 x^(6), and its derivatives have one and two orders less. The largest
    # errors, at 25 Hz near the ends: measured 2e-8 m, 2e-6 m/s and 2e-4 m/s^2.
    np.testing.assert_allclose(replay.position_m(query_s), FORMULA.position_m(true_s), atol=1e-6)
    np.testing.assert_allclose(replay.velocity_m_s(query_s), FORMULA.velocity_m_s(true_s), atol=1e-4)
    np.testing.assert_allclose(
        replay.acceleration_m_s2(query_s), FORMULA.acceleration_m_s2(true_s), atol=5e-3
    )


def test_without_orientations_the_attitude_follows_acceleration_and_heading():
    replay = make_replay(sample_formula(EVEN_S))
    # An error of 1e-4 m/s^2 relative to 9.81 m/s^2 tilts the thrust by 6e-4 degrees.
    assert angle_deg(replay.rotation(FRAMES_S), FORMULA.rotation(FRAMES_S)).max() < 6e-4


@pytest.mark.parametrize("rate_hz", [25, 100])
def test_recorded_orientations_are_kept_for_any_heading(rate_hz):
    replay = make_replay(
        sample_formula(np.arange(10 * rate_hz) / rate_hz, oriented=True), heading=Heading(2.0)
    )
    between_s = FRAMES_S + 0.0137
    # The error of a cubic spline of rotations is h^4 / 384 times the fourth derivative, about 25 rad/s^4: 1e-5 degrees
    # at 25 Hz, as measured. Near the ends the spline sets the curvature to 0: measured 0.014 degrees.
    assert angle_deg(replay.rotation(between_s), FORMULA.rotation(between_s))[20:-20].max() < 3e-5
    assert angle_deg(replay.rotation(between_s), FORMULA.rotation(between_s)).max() < 0.03
    signs = (replay.orientation_wxyz(between_s) * FORMULA.orientation_wxyz(between_s)).sum(axis=1)
    np.testing.assert_allclose(np.abs(signs), 1.0, atol=1e-6)


@pytest.mark.parametrize(("time_s", "oriented"), [(EVEN_S, False), (UNEVEN_S, False), (EVEN_S, True)])
def test_noise_of_a_millimetre_gives_small_errors_of_the_acceleration(time_s, oriented):
    noisy = sample_formula(time_s, oriented=oriented, noise_m=1e-3)
    replay, query_s = make_replay(noisy), FRAMES_S + 0.1
    true_s = query_s + time_s[0]
    interpolated = make_interp_spline(noisy.time_s, noisy.position_m, k=5)(true_s, 2)
    assert np.abs(interpolated - FORMULA.acceleration_m_s2(true_s)).max() > 100, (
        "interpolation must amplify the noise"
    )
    wrong_m_s2 = replay.acceleration_m_s2(query_s) - FORMULA.acceleration_m_s2(true_s)
    # Least squares with 25 samples per knot: measured standard deviation 0.015 m/s^2, largest error 0.06 m/s^2.
    assert np.abs(wrong_m_s2).max() < 0.2
    assert wrong_m_s2.std() < 0.03
    # A third of the noise of the positions remains, measured 0.8 mm at most.
    assert np.abs(replay.position_m(query_s) - FORMULA.position_m(true_s)).max() < 1.2e-3
    # An error of 0.2 m/s^2 relative to 9.81 m/s^2 tilts the thrust by 1.2 degrees.
    assert angle_deg(replay.rotation(query_s), FORMULA.rotation(true_s)).max() < 1.2
    # At the two ends, with samples on one side only: measured 0.18 and 0.54 m/s^2.
    end_s = np.array([0.0, noisy.duration_s])
    assert np.abs(replay.acceleration_m_s2(end_s) - FORMULA.acceleration_m_s2(time_s[[0, -1]])).max() < 1.0


def test_two_nearly_simultaneous_samples_give_small_errors_of_the_acceleration():
    """Noise of 0.01 mm is harmless at 100 Hz, but harmful between two samples that are half a millisecond apart."""
    time_s = np.sort(np.append(EVEN_S, 4.0005))
    noisy, query_s = sample_formula(time_s, noise_m=1e-5), np.linspace(3.9, 4.1, 401)
    true_m_s2 = FORMULA.acceleration_m_s2(query_s)
    interpolated = make_interp_spline(noisy.time_s, noisy.position_m, k=5)(query_s, 2)
    assert np.abs(interpolated - true_m_s2).max() > 5, "interpolation must amplify the noise"
    # Least squares with 25 samples per knot: measured 0.0005 m/s^2.
    assert np.abs(make_replay(noisy).acceleration_m_s2(query_s) - true_m_s2).max() < 0.01


def test_a_gap_in_a_noisy_recording_is_bridged_without_an_excursion():
    kept = (EVEN_S < 4.0) | (EVEN_S > 4.4)
    complete = sample_formula(EVEN_S, noise_m=1e-3)
    replay = make_replay(Recorded(EVEN_S[kept], complete.position_m[kept], None))
    missing_s = np.linspace(4.0, 4.4, 21)
    # Largest measured error 0.5 mm.
    assert np.abs(replay.position_m(missing_s) - FORMULA.position_m(missing_s)).max() < 2e-3


@pytest.mark.parametrize("count", [6, 7, 8, 30])
def test_the_shortest_recordings_are_replayed_with_noise(count):
    time_s = np.arange(count) / 100
    replay = make_replay(sample_formula(time_s, noise_m=1e-3))
    # The tolerance is the largest value of the noise, about 3.5 mm, and the shift by smoothing.
    np.testing.assert_allclose(replay.position_m(time_s), FORMULA.position_m(time_s), atol=5e-3)


@given(
    st.integers(10, 120),
    st.tuples(*[st.floats(-5, 5)] * 3),
    st.floats(-100.0, 1000.0),
)
def test_shifting_a_recording_in_space_and_time_shifts_the_flight(rate_hz, offset_m, later_s):
    time_s = np.arange(2 * rate_hz) / rate_hz
    original = sample_formula(time_s)
    shifted = Recorded(time_s + later_s, original.position_m + offset_m, None)
    query_s = np.linspace(0.0, 1.9, 20)
    # Times near 1000 s are rounded to 1e-13 s; the spline's equations amplify this by less than 1e4, at 2 m/s.
    np.testing.assert_allclose(
        make_replay(shifted).position_m(query_s),
        make_replay(original, offset_m=offset_m).position_m(query_s),
        atol=1e-8,
    )


def test_start_and_offset_of_a_flight_are_applied(tmp_path):
    path = tmp_path / "loop.csv"
    write_recorded_flight(path, EVEN_S + 3.0, FORMULA.position_m(EVEN_S), FORMULA.orientation_wxyz(EVEN_S))
    record = FlightFromFile(file=str(path), start_s=2.5, offset_m=(1.0, -2.0, 0.5))
    replay = recorded_flight(record, HEADING)
    time_s = np.arange(180) / 25
    np.testing.assert_allclose(
        replay.position_m(time_s), FORMULA.position_m(time_s + 2.5) + np.array([1.0, -2.0, 0.5]), atol=1e-6
    )
    assert angle_deg(replay.rotation(time_s), FORMULA.rotation(time_s + 2.5)).max() < 0.06


def test_a_flight_is_extrapolated_by_half_an_exposure():
    replay = make_replay(sample_formula(EVEN_S))
    edge_s = np.array([-0.02, -0.004, 10.004, 10.02])
    # The jerk j is below 7.5 m/s^3 per axis: j t^3 / 6 is 10 micrometres, and j t^2 / 2 is 1.5 mm/s.
    np.testing.assert_allclose(replay.position_m(edge_s), FORMULA.position_m(edge_s), atol=1.1e-5)
    np.testing.assert_allclose(replay.velocity_m_s(edge_s), FORMULA.velocity_m_s(edge_s), atol=1.6e-3)


def test_too_many_frames_are_refused_with_the_number_that_fits():
    replay = make_replay(sample_formula(EVEN_S), start_s=2.0)
    time_s = np.arange(500) / 25
    replay.check(time_s[:201])
    sentence = (
        "loop.csv: expected a recording of at least 10.04 s, found 10 s; 201 of the 202 frames would fit"
    )
    with pytest.raises(SettingsError, match=f"^{re.escape(sentence)}$"):
        replay.check(time_s[:202])
    for method in (
        replay.check,
        replay.position_m,
        replay.velocity_m_s,
        replay.acceleration_m_s2,
        replay.rotation,
    ):
        with pytest.raises(SettingsError, match=r"expected a recording of at least 21\.96 s, found 10 s"):
            method(time_s)


def test_a_scenario_with_more_frames_than_its_recording_is_refused_when_it_is_planned(tmp_path):
    path = tmp_path / "loop.csv"
    write_recorded_flight(path, EVEN_S, FORMULA.position_m(EVEN_S), None)
    drone = Drone(flight=FlightFromFile(file=str(path)))
    limits = Limits(
        max_speed_m_s=3.0,
        max_acceleration_m_s2=5.0,
        max_tilt_deg=30.0,
        min_distance_m=0.0,
        lower_m=(-4.0, -3.0, 0.5),
        upper_m=(4.0, 3.0, 3.0),
    )
    fits = Scenario(
        name="replay", hall="laboratory", cameras="laboratory", num_frames=251, drones=(drone,), limits=limits
    )
    time_s = np.arange(251) / 25
    np.testing.assert_allclose(plan(fits, 0)[0].position_m(time_s), FORMULA.position_m(time_s), atol=1e-9)
    with pytest.raises(
        SettingsError, match=r"loop\.csv: expected .* found 10 s; 251 of the 252 frames would fit$"
    ):
        plan(msgspec.structs.replace(fits, num_frames=252), 0)


def test_a_start_after_the_end_is_refused(tmp_path):
    path = tmp_path / "loop.csv"
    path.write_text(csv_table())
    with pytest.raises(
        SettingsError, match=r"^start_s of .*loop\.csv: expected less than its duration, 0\.7 s, found 0\.7$"
    ):
        recorded_flight(FlightFromFile(file=str(path), start_s=0.7), HEADING)


# --- files


@pytest.mark.parametrize("oriented", [True, False])
def test_a_written_recording_is_read_back_exactly(tmp_path, oriented):
    path = tmp_path / "new" / "loop.csv"
    recorded = sample_formula(UNEVEN_S, oriented=oriented)
    write_recorded_flight(path, recorded.time_s, recorded.position_m, recorded.orientation_wxyz)
    again = read_recorded_flight(path)
    np.testing.assert_array_equal(again.time_s, recorded.time_s)
    np.testing.assert_array_equal(again.position_m, recorded.position_m)
    if oriented:
        # Reading normalises the quaternions again, which may change the last digit.
        np.testing.assert_allclose(again.orientation_wxyz, recorded.orientation_wxyz, atol=1e-15)
    else:
        assert again.orientation_wxyz is None
        assert path.read_text().startswith("time_s,x_m,y_m,z_m\n")


def test_semicolons_and_other_columns_are_read_too(tmp_path):
    path = tmp_path / "loop.csv"
    header = ("time_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
    path.write_text(csv_table(";", header))
    recorded = read_recorded_flight(path)
    np.testing.assert_array_equal(recorded.position_m[:, 1], 2.0 * np.arange(8))
    np.testing.assert_array_equal(recorded.orientation_wxyz, np.tile([1.0, 0, 0, 0], (8, 1)))


def test_a_pose_file_of_the_dataset_is_read_without_its_placeholder(tmp_path):
    path = tmp_path / "dron3_pos_25.csv"
    time_s = np.arange(50) / 25
    write_poses(path, FORMULA.position_m(time_s), FORMULA.orientation_wxyz(time_s))
    recorded = read_recorded_flight(path)
    np.testing.assert_array_equal(recorded.time_s, time_s[1:])
    np.testing.assert_array_equal(recorded.position_m, FORMULA.position_m(time_s)[1:])
    # The file holds all digits of the quaternions; reading normalises them, which may change the last digits.
    np.testing.assert_allclose(recorded.orientation_wxyz, FORMULA.orientation_wxyz(time_s)[1:], atol=1e-12)


def test_the_rate_of_a_pose_file_is_in_its_name(tmp_path):
    time_s = np.arange(50) / 100
    write_poses(tmp_path / "dron1_pos_100.csv", FORMULA.position_m(time_s), FORMULA.orientation_wxyz(time_s))
    np.testing.assert_array_equal(read_recorded_flight(tmp_path / "dron1_pos_100.csv").time_s, time_s[1:])
    shutil.copy(tmp_path / "dron1_pos_100.csv", tmp_path / pose_file(1, 29.97))
    again = read_recorded_flight(tmp_path / pose_file(1, 29.97))
    np.testing.assert_array_equal(again.time_s, np.arange(1, 50) / 29.97)
    (tmp_path / "dron1_pos_100.csv").rename(tmp_path / "dron1.csv")
    with pytest.raises(InputError, match=r"dron1\.csv: expected a pose file named like dron1_pos_25\.csv"):
        read_recorded_flight(tmp_path / "dron1.csv")


def test_a_trajectory_of_one_drone_is_a_recording(tmp_path):
    time_s = np.arange(40) / 25
    position_m = np.stack([FORMULA.position_m(time_s), FORMULA.position_m(time_s + 1)], axis=1)
    for drones in (1, 2):
        names = ("a", "b")[:drones]
        tracks = Trajectories(np.arange(40), time_s, names, position_m[:, :drones])
        write_trajectories(tmp_path / f"{drones}.csv", tracks)
    np.testing.assert_array_equal(read_recorded_flight(tmp_path / "1.csv").position_m, position_m[:, 0])
    with pytest.raises(
        InputError, match=r"2\.csv, line 3, column drone: expected one drone, a as above, found b"
    ):
        read_recorded_flight(tmp_path / "2.csv")


QUATERNIONS = ("time_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
BROKEN = {
    "stuck": (
        csv_table().replace("0.3,", "0.2,"),
        "line 5, column time_s: expected a time above 0.2, the time in line 4, found 0.2",
    ),
    "backwards": (
        csv_table().replace("0.3,", "0.1,"),
        "line 5, column time_s: expected a time above 0.2, the time in line 4",
    ),
    "short": (csv_table(count=5), "loop.csv: expected at least 6 samples, found 5"),
    "nan": (
        csv_table().replace("0.3,3,6", "0.3,3,nan"),
        "line 5, column y_m: expected a finite number, found 'nan'",
    ),
    "empty": (
        csv_table().replace("0.3,3,6", "0.3,3,"),
        "line 5, column y_m: expected a value, found nothing",
    ),
    "word": (
        csv_table().replace("0.3,3,6", "0.3,3,six"),
        "line 5, column y_m: expected a number, found 'six'",
    ),
    "time": (
        csv_table().replace("0.3,3", "noon,3"),
        "line 5, column time_s: expected a number, found 'noon'",
    ),
    "no height": (
        csv_table(header=("time_s", "x_m", "y_m", "h")),
        "expected a column z_m, found only time_s, x_m, y_m, h",
    ),
    "no time": (csv_table(header=("t", "x_m", "y_m", "z_m")), "expected a column time_s"),
    "half a quaternion": (csv_table(header=QUATERNIONS[:6]), "expected a column qy, found only"),
    "long quaternion": (
        csv_table(header=QUATERNIONS).replace("0.3,3,6,9,1", "0.3,3,6,9,1.1"),
        "line 5, column qw: expected a quaternion of length 1, found length 1.1",
    ),
    "nothing": ("", "line 1: expected columns separated by ',', found an empty file"),
    "no rows": (csv_table(count=0), "expected rows below the header, found none"),
    "ragged": (csv_table() + "0.9,1,2\n", "line 10: expected 4 values as in the header, found 3"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_errors_in_a_file_are_named_by_file_line_and_column(tmp_path, name):
    text, message = BROKEN[name]
    (tmp_path / "loop.csv").write_text(text)
    with pytest.raises(InputError) as error:
        read_recorded_flight(tmp_path / "loop.csv")
    assert "loop.csv" in str(error.value)
    assert message in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.csv: expected a file to read, found no such file"):
        read_recorded_flight(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("time_s", "index", "value", "message"),
    [
        (np.arange(5.0), None, 0.0, "at least 6 samples, found 5"),
        (np.array([0.0, 1, 2, 2, 4, 5]), None, 0.0, "times that increase, found 2 s at sample 3"),
        (np.arange(6.0), 4, np.nan, "finite numbers, found NaN or infinity at sample 4"),
        (np.arange(6.0), 2, np.inf, "finite numbers, found NaN or infinity at sample 2"),
    ],
)
def test_invalid_recordings_are_not_written(tmp_path, time_s, index, value, message):
    position_m = np.zeros((len(time_s), 3))
    if index is not None:
        position_m[index, 1] = value
    with pytest.raises(SettingsError, match=message):
        write_recorded_flight(tmp_path / "loop.csv", time_s, position_m, None)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="expected a path that can be written"):
        write_recorded_flight(tmp_path / "file" / "loop.csv", EVEN_S, FORMULA.position_m(EVEN_S), None)
