"""Recorded flights: file formats, error messages, and resampling compared with the formula that was sampled."""

import re

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.simulation import Scenario, write_recorded_flight
from psotrack.simulation.flights.motion import HarmonicFlight, Heading
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


def write_tracks(path, num_drones=1, count=8, orientation_wxyz=None):
    """Tracks of some drones, one of which is at k, 2 k and 3 k metres after k / 10 seconds."""
    k = np.arange(count)
    position_m = np.repeat(np.stack([k, 2.0 * k, 3.0 * k], axis=-1)[:, None], num_drones, axis=1)
    names = ("a", "b", "c")[:num_drones]
    write_trajectories(path, Trajectories(k, k / 10, names, position_m, orientation_wxyz=orientation_wxyz))


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
    write_tracks(path)
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


def test_a_tum_file_is_read_with_and_without_orientations(tmp_path):
    time_s = np.arange(40) / 25
    quaternion = FORMULA.orientation_wxyz(time_s)[:, [1, 2, 3, 0]]
    for name, xyzw in (("turned.tum", quaternion), ("level.txt", np.tile([0.0, 0, 0, 1], (40, 1)))):
        np.savetxt(tmp_path / name, np.column_stack([time_s, FORMULA.position_m(time_s), xyzw]), fmt="%.17g")
    turned, level = (read_recorded_flight(tmp_path / name) for name in ("turned.tum", "level.txt"))
    np.testing.assert_allclose(turned.time_s, time_s, atol=1e-12)
    np.testing.assert_array_equal(turned.position_m, FORMULA.position_m(time_s))
    np.testing.assert_allclose(turned.orientation_wxyz, FORMULA.orientation_wxyz(time_s), atol=1e-12)
    # The identity in every row says that no orientation is known: the attitude follows the acceleration.
    assert level.orientation_wxyz is None


def test_rows_without_a_position_are_left_out(tmp_path):
    path = tmp_path / "loop.csv"
    write_tracks(path)
    lines = path.read_text().splitlines()
    lines[4] = lines[4].replace(",3.0,6.0,9.0,", ",,,,")
    path.write_text("\n".join(lines))
    np.testing.assert_allclose(read_recorded_flight(path).time_s, [0, 0.1, 0.2, 0.4, 0.5, 0.6, 0.7])


def half_turned(count=8):
    orientation_wxyz = np.tile([1.0, 0, 0, 0], (count, 1, 1))
    orientation_wxyz[5] = np.nan
    return orientation_wxyz


@pytest.mark.parametrize(
    ("tracks", "message"),
    [
        ({"num_drones": 2}, "loop.csv: expected the flight of one drone, found a, b; keep one drone's rows"),
        ({"count": 5}, "loop.csv: expected at least 6 positions, found 5"),
        (
            {"orientation_wxyz": half_turned()},
            "loop.csv: expected an orientation with each position, or no orientations, found none at 0.5 s",
        ),
    ],
)
def test_tracks_that_cannot_be_flown_are_refused(tmp_path, tracks, message):
    write_tracks(tmp_path / "loop.csv", **tracks)
    with pytest.raises(InputError, match=re.escape(message)):
        read_recorded_flight(tmp_path / "loop.csv")


def test_errors_of_a_file_name_it_and_the_line(tmp_path):
    path = tmp_path / "loop.csv"
    write_tracks(path)
    path.write_text(path.read_text().replace("3.0,6.0", "3.0,six"))
    with pytest.raises(InputError, match=r"loop\.csv, line 5: expected a number in y_m, found 'six'"):
        read_recorded_flight(path)
    with pytest.raises(InputError, match=r"none\.csv: expected a file or folder of tracks, found no such"):
        read_recorded_flight(tmp_path / "none.csv")


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="expected a path"):
        write_recorded_flight(tmp_path / "file" / "loop.csv", EVEN_S, FORMULA.position_m(EVEN_S), None)
