"""Flights of the simulator: derivatives, attitude, near passes, groups, limits, variation, recorded flights."""

import itertools

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_flights import ORBIT, WIDE, make_scenario, write_tracks
from scipy.spatial.transform import Rotation

from psotrack.simulation import change_scenario, preset_names, scenario, write_recorded_flight
from psotrack.simulation.flights.motion import (
    HarmonicFlight,
    Heading,
    Recorded,
    RecordedFlight,
    quaternions_wxyz,
    read_recorded_flight,
)
from psotrack.simulation.flights.planning import frame_times_s, plan
from psotrack.simulation.scenarios import (
    Crossing,
    FlightFromFile,
    FollowingFlight,
    Formation,
    Harmonic,
    Harmonics,
    NearPass,
    Variation,
    Waypoints,
)

TIME_S = np.linspace(0.0, 10.0, 301)
#: Step of the central differences, seconds.
STEP_S = 1e-3

#: One flight of every kind; a flight that another flight refers to comes later in the tuple.
FLIGHTS_OF_EVERY_KIND = (
    NearPass(
        other=7, distance_m=0.7, side=(0.0, 0.0, -2.0), swing_m=(1.1, 0.4, 0.0), period_s=5.1, phase_deg=33.0
    ),
    Formation(leader=1, offset_m=(0.0, 0.9, 0.2)),
    FollowingFlight(leader=2, delay_s=1.3),
    Harmonics(
        centre_m=(0.0, 0.1, 1.2),
        terms=(
            Harmonic(amplitude_m=(0.9, 0.7, 0.2), period_s=5.0, phase_deg=(90.0, 0.0, 45.0)),
            Harmonic(amplitude_m=(0.0, 0.2, 0.3), period_s=3.7, phase_deg=(0.0, 10.0, 200.0)),
        ),
    ),
    Crossing(start_m=(-2.0, -1.0, 0.9), end_m=(1.8, 1.2, 2.0), period_s=6.6, phase_deg=70.0),
    Waypoints(
        points_m=((0.0, 0.0, 1.0), (1.5, 0.4, 1.6), (0.2, 1.4, 1.9), (-1.0, 0.1, 0.9)),
        speed_m_s=0.9,
        hover_s=0.4,
    ),
    ORBIT,
)
FLIGHT_KINDS = [type(record).__name__ for record in FLIGHTS_OF_EVERY_KIND]
WAYPOINTS = FLIGHTS_OF_EVERY_KIND[FLIGHT_KINDS.index("Waypoints")]


def positions(recipe, seed, stride=1):
    time_s = frame_times_s(recipe, recipe.num_frames)[::stride]
    return np.stack([flight.position_m(time_s) for flight in plan(recipe, seed)])


def pairwise_distances_m(position_m):
    """Return the distances between all pairs of drones, (pairs, times), metres."""
    first, second = np.triu_indices(len(position_m), 1)
    return np.linalg.norm(position_m[first] - position_m[second], axis=-1)


def derivatives(flight):
    """First and second derivative of the position by central differences."""
    before = flight.position_m(TIME_S - STEP_S)
    here = flight.position_m(TIME_S)
    after = flight.position_m(TIME_S + STEP_S)
    return (after - before) / (2 * STEP_S), (after - 2 * here + before) / STEP_S**2


# --- motion


@pytest.mark.parametrize("flight_kind", FLIGHT_KINDS)
def test_attitude_follows_the_thrust_and_derivatives_the_position(flight_kind):
    flights = plan(make_scenario(*FLIGHTS_OF_EVERY_KIND, variation=Variation()), 3)
    flight = flights[FLIGHT_KINDS.index(flight_kind)]
    # The first difference errs by at most h^2 / 6 times the third derivative. The second difference of waypoints errs
    # by h times the step of their third derivative, 60 d / T^3 with d = 1.7 m and T = 1.9 s: 15 m/s^3.
    atol = 2e-2 if flight_kind == "Waypoints" else 2e-4
    velocity_m_s, acceleration_m_s2 = derivatives(flight)
    np.testing.assert_allclose(flight.velocity_m_s(TIME_S), velocity_m_s, atol=1e-5)
    np.testing.assert_allclose(flight.acceleration_m_s2(TIME_S), acceleration_m_s2, atol=atol)
    assert np.abs(acceleration_m_s2).max() > 0.3, "the flight must accelerate to test the second derivative"
    rotation = flight.rotation(TIME_S)
    thrust = flight.acceleration_m_s2(TIME_S) + np.array([0.0, 0.0, 9.81])
    along = thrust / np.linalg.norm(thrust, axis=-1, keepdims=True)
    np.testing.assert_allclose(rotation[:, :, 2], along, atol=1e-12)
    wxyz = flight.orientation_wxyz(TIME_S)
    same = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
    np.testing.assert_allclose(same, rotation, atol=1e-12)
    assert (wxyz[1:] * wxyz[:-1]).sum(axis=-1).min() > 0.99, "no quaternion changes its sign"


def test_a_quaternion_keeps_its_sign_and_is_not_lost_after_half_a_turn():
    half_a_turn = quaternions_wxyz(np.array([np.eye(3), np.diag([-1.0, -1.0, 1.0])]))
    np.testing.assert_array_equal(np.abs(half_a_turn), [[1, 0, 0, 0], [0, 0, 0, 1]])


def test_the_x_axis_looks_along_the_heading():
    changes = {"drones[0].yaw_deg": 70.0, "drones[0].yaw_sway_deg": 30.0}
    (flight,) = plan(change_scenario(make_scenario(ORBIT), changes), 0)
    swing = np.sin(2 * np.pi / 9.0 * TIME_S + flight.heading.phase_rad)
    yaw_rad = np.radians(70.0 + 30.0 * swing)
    ahead = np.stack([np.cos(yaw_rad), np.sin(yaw_rad), np.zeros_like(yaw_rad)], axis=-1)
    x, y, _ = np.moveaxis(flight.rotation(TIME_S), -1, 0)
    # The body's x axis is the direction perpendicular to z that is nearest to the heading, so y is perpendicular to
    # the heading.
    np.testing.assert_allclose((y * ahead).sum(axis=-1), 0.0, atol=1e-12)
    assert (x * ahead).sum(axis=-1).min() > 0.9


# --- kinds of flights, compared with formulas


@pytest.mark.parametrize("clockwise", [False, True])
def test_an_orbit_starts_at_plus_x_and_turns_in_the_given_direction(clockwise):
    record = msgspec.structs.replace(ORBIT, phase_deg=0.0, clockwise=clockwise, rise_phase_deg=90.0)
    (flight,) = plan(make_scenario(record), 0)
    angle = 2 * np.pi * TIME_S / 6.3
    turn = -1 if clockwise else 1
    x = 0.3 + 1.5 * np.cos(angle)
    y = -0.2 + turn * 1.1 * np.sin(angle)
    z = 1.4 + 0.3 * np.cos(2 * np.pi * TIME_S / 5.0)
    np.testing.assert_allclose(flight.position_m(TIME_S), np.stack([x, y, z], axis=-1), atol=1e-12)


def test_waypoints_are_reached_on_time_and_hovered_at():
    (flight,) = plan(make_scenario(WAYPOINTS), 0)
    points = np.array(WAYPOINTS.points_m)
    following = np.roll(points, -1, axis=0)
    moving_s = np.linalg.norm(following - points, axis=-1) / WAYPOINTS.speed_m_s
    round_s = np.sum(moving_s + WAYPOINTS.hover_s)
    leaving_s = np.cumsum(moving_s + WAYPOINTS.hover_s) - moving_s
    # The first and the second round.
    for start_s in (0.0, round_s):
        for waited_s in (0.001, 0.2, WAYPOINTS.hover_s):
            at_s = start_s + leaving_s - WAYPOINTS.hover_s + waited_s
            np.testing.assert_allclose(flight.position_m(at_s), points, atol=1e-9)
            np.testing.assert_allclose(flight.velocity_m_s(at_s), 0.0, atol=1e-9)
        halfway = flight.position_m(start_s + leaving_s + moving_s / 2)
        np.testing.assert_allclose(halfway, (points + following) / 2, atol=1e-9)


@settings(max_examples=20)
@given(
    distance_m=st.floats(0.2, 2.0),
    angle_deg=st.floats(0.0, 360.0),
    tilt_deg=st.floats(-80.0, 80.0),
    phase_deg=st.floats(-400.0, 400.0),
    seed=st.integers(0, 10_000),
)
def test_a_near_pass_reaches_its_distance_twice_a_period(distance_m, angle_deg, tilt_deg, phase_deg, seed):
    side, swing, _ = Rotation.from_euler("zy", [angle_deg, tilt_deg], degrees=True).as_matrix().T
    record = NearPass(
        other=1,
        distance_m=distance_m,
        side=tuple((7.0 * side).tolist()),
        swing_m=tuple((1.5 * swing).tolist()),
        period_s=4.0,
        phase_deg=phase_deg,
    )
    # The limits demand at least 0.9 m between drones, but they exempt a near pass from this distance.
    limits = msgspec.structs.replace(WIDE, min_distance_m=0.9)
    variation = Variation(period=0.0)
    other, passing = plan(make_scenario(ORBIT, record, limits=limits, variation=variation), seed)
    time_s = np.linspace(0.0, 4.0, 40_001)
    gap_m = np.linalg.norm(passing.position_m(time_s) - other.position_m(time_s), axis=-1)
    # On a grid of 0.1 ms, the minimum is too large by at most (2.5 m/s * 0.05 ms)^2 / (2 * 0.2 m) = 4e-8 m.
    assert gap_m.min() == pytest.approx(distance_m, abs=1e-6)
    assert gap_m.min() >= distance_m - 1e-9
    near = gap_m[:-1] < distance_m + 1e-6
    assert np.count_nonzero(near & ~np.roll(near, 1)) == 2


# --- what a seed changes


@given(seed=st.integers(0, 10_000))
def test_variation_stays_within_what_the_scenario_allows(seed):
    variation = Variation(phase_deg=10.0, centre_m=0.1, size=0.05, period=0.02, yaw_deg=30.0)
    orbit, flight = plan(make_scenario(ORBIT, WAYPOINTS, variation=variation), seed)
    rounding = 1e-9
    moved_m = orbit.centre_m - ORBIT.centre_m
    assert np.abs(moved_m).max() <= 0.1
    shifted_deg = np.degrees(orbit.phase_rad[0, :2]) - [110.0, 20.0]
    assert np.abs(shifted_deg).max() <= 10.0 + rounding
    size = orbit.amplitude_m[0, :2] / ORBIT.radius_m
    assert np.abs(size - 1).max() <= 0.05 + rounding
    period = 2 * np.pi / orbit.angular_rad_s / [6.3, 5.0]
    assert np.abs(period - 1).max() <= 0.02 + rounding
    assert abs(np.degrees(orbit.heading.yaw_rad)) <= 30.0
    assert np.abs(flight.points_m - WAYPOINTS.points_m).max() <= 0.1
    # The variation of the period scales the flying time and the hovering time of the whole round.
    slower = flight.hover_s / WAYPOINTS.hover_s
    assert abs(slower - 1) <= 0.02 + rounding
    way_m = np.linalg.norm(np.roll(flight.points_m, -1, axis=0) - flight.points_m, axis=-1)
    np.testing.assert_allclose(flight.moving_s, slower * way_m / WAYPOINTS.speed_m_s, rtol=1e-12)


def circling(*phases_deg, group="", num_frames=250):
    """Drones on one circle of 1.5 m, with variation."""
    records = []
    for phase_deg in phases_deg:
        records.append(msgspec.structs.replace(ORBIT, phase_deg=phase_deg, radius_m=(1.5, 1.5)))
    groups = (group,) * len(records)
    return make_scenario(*records, groups=groups, variation=Variation(), num_frames=num_frames)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), frames=st.sampled_from([250, 9000]))
def test_drones_of_one_group_keep_their_spacing_on_an_orbit(seed, frames):
    """On a circle of radius r, n evenly spaced drones stay 2 r sin(pi / n) apart; the seed varies r."""
    ring = circling(0.0, 120.0, 240.0, group="ring", num_frames=frames)
    distance_m = pairwise_distances_m(positions(ring, seed, stride=10))
    # The tolerance covers the rounding of angles up to 400 rad.
    np.testing.assert_allclose(distance_m, distance_m[0, 0], atol=1e-9)
    assert distance_m[0, 0] == pytest.approx(1.5 * np.sqrt(3), rel=0.06)


def test_a_group_shares_its_variation_but_no_headings():
    headings = [flight.heading for flight in plan(circling(*range(0, 360, 45), group="ring"), 0)]
    assert len({heading.yaw_rad for heading in headings}) == 8
    assert len({heading.phase_rad for heading in headings}) == 8
    # Kinds of flights may differ within a group.
    line = Crossing(start_m=(-1.0, 0.0, 1.0), end_m=(1.0, 0.0, 1.0), period_s=6.3)
    orbit, crossing = plan(make_scenario(ORBIT, line, groups=("a", "a"), variation=Variation()), 1)
    moved_m = crossing.centre_m - [0.0, 0.0, 1.0]
    np.testing.assert_allclose(orbit.centre_m - ORBIT.centre_m, moved_m, atol=1e-12)
    assert orbit.angular_rad_s[0] == crossing.angular_rad_s[0]


@pytest.mark.parametrize("name", preset_names())
def test_limits_hold_in_every_preset_for_every_seed(name):
    recipe = scenario(name)
    limits = recipe.limits
    #: Pair of drones -> distance of their near pass.
    near_m = {}
    for index, drone in enumerate(recipe.drones):
        if isinstance(drone.flight, NearPass):
            pair = sorted((index, drone.flight.other - 1))
            near_m[tuple(pair)] = drone.flight.distance_m - 1e-9
    # Check all frames of short sequences and every seventh frame of long sequences.
    stride = 1 if recipe.num_frames < 600 else 7
    time_s = frame_times_s(recipe, recipe.num_frames)[::stride]
    for seed in (0, 17):
        flights = plan(recipe, seed)
        here = np.stack([flight.position_m(time_s) for flight in flights])
        there = np.stack([flight.position_m(time_s + STEP_S) for flight in flights])
        # The difference is the speed half a millisecond later, which differs by at most 9 m/s^2 times 0.5 ms.
        speed_m_s = np.linalg.norm(there - here, axis=-1) / STEP_S
        assert speed_m_s.max() <= limits.max_speed_m_s + 0.005
        for flight in flights:
            acceleration_m_s2 = np.linalg.norm(flight.acceleration_m_s2(time_s), axis=-1)
            assert acceleration_m_s2.max() <= limits.max_acceleration_m_s2
        assert np.all((here >= limits.lower_m) & (here <= limits.upper_m))
        pairs = itertools.combinations(range(len(flights)), 2)
        for pair, apart_m in zip(pairs, pairwise_distances_m(here), strict=True):
            assert apart_m.min() >= near_m.get(pair, limits.min_distance_m)


# --- recorded flights


#: A flight with up to 2.4 m/s, 4 m/s^2 and 23 degrees of tilt, similar to the scenarios of the dataset.
FORMULA = HarmonicFlight(
    centre_m=np.array([0.1, -0.2, 1.5]),
    amplitude_m=np.array([[1.5, 1.2, 0.2], [0.2, 0.1, 0.1]]),
    angular_rad_s=np.array([1.2, 2.9]),
    phase_rad=np.array([[0.0, 1.5, 0.3], [0.5, 2.0, 1.0]]),
    heading=Heading(0.4, 0.6, 0.8, 0.1),
)
EVEN_S = np.arange(1001) / 100
#: Uneven sample times at rates of 70 to 160 Hz, seconds.
UNEVEN_S = np.cumsum(np.random.default_rng([5]).uniform(0.006, 0.0145, 1001))
FRAMES_S = np.arange(240) / 25


def sample_formula(time_s, *, oriented=False, noise_m=0.0):
    position_m = FORMULA.position_m(time_s)
    position_m = position_m + np.random.default_rng([7]).normal(0.0, noise_m, position_m.shape)
    return Recorded(time_s, position_m, FORMULA.orientation_wxyz(time_s) if oriented else None)


def make_replay(recorded, heading=FORMULA.heading, start_s=0.0, offset_m=(0.0, 0.0, 0.0)):
    return RecordedFlight(recorded, heading, start_s, np.array(offset_m), "loop.csv")


def angle_deg(a, b):
    """Return the angles between two stacks of rotation matrices, (times,), degrees."""
    return np.degrees(Rotation.from_matrix(np.swapaxes(a, -1, -2) @ b).magnitude())


@pytest.mark.parametrize("time_s", [EVEN_S, UNEVEN_S, np.arange(260) / 25], ids=["100 Hz", "uneven", "25 Hz"])
def test_a_recording_without_noise_replays_the_formula_at_any_time(time_s):
    replay = make_replay(sample_formula(time_s))
    query_s = FRAMES_S + 0.0137
    true_s = query_s + time_s[0]
    # The error of a quintic spline has order h^6 x^(6), and its derivatives have one and two orders less. The largest
    # errors, at 25 Hz near the ends: measured 2e-8 m, 2e-6 m/s and 2e-4 m/s^2.
    for order, atol in enumerate((1e-6, 1e-4, 5e-3)):
        found = replay.derivative(query_s, order)
        np.testing.assert_allclose(found, FORMULA.derivative(true_s, order), atol=atol)
    if time_s is EVEN_S:
        # The attitude follows acceleration and heading: an error of 1e-4 m/s^2 relative to 9.81 m/s^2 tilts the thrust
        # by 6e-4 degrees.
        assert angle_deg(replay.rotation(query_s), FORMULA.rotation(true_s)).max() < 6e-4
    # Beyond both ends, by half an exposure, the jerk j is below 7.5 m/s^3 per axis: j t^3 / 6 is 10 micrometres, and
    # j t^2 / 2 is 1.5 mm/s.
    end_s = replay.recorded.duration_s
    edge_s = np.array([-0.02, -0.004, end_s + 0.004, end_s + 0.02])
    for order, atol in enumerate((1.1e-5, 1.6e-3)):
        found = replay.derivative(edge_s, order)
        np.testing.assert_allclose(found, FORMULA.derivative(edge_s + time_s[0], order), atol=atol)


@pytest.mark.parametrize(("time_s", "oriented"), [(EVEN_S, False), (UNEVEN_S, False), (EVEN_S, True)])
def test_noise_of_a_millimetre_gives_small_errors_of_the_acceleration(time_s, oriented):
    noisy = sample_formula(time_s, oriented=oriented, noise_m=1e-3)
    replay = make_replay(noisy)
    query_s = FRAMES_S + 0.1
    true_s = query_s + time_s[0]
    wrong_m_s2 = replay.acceleration_m_s2(query_s) - FORMULA.acceleration_m_s2(true_s)
    # Least squares with 25 samples per knot: measured standard deviation 0.015 m/s^2, largest error 0.06 m/s^2.
    # Interpolation of the noise would give errors of 100 m/s^2.
    assert np.abs(wrong_m_s2).max() < 0.2
    assert wrong_m_s2.std() < 0.03
    # A third of the noise of the positions remains, measured 0.8 mm at most.
    wrong_m = replay.position_m(query_s) - FORMULA.position_m(true_s)
    assert np.abs(wrong_m).max() < 1.2e-3
    # An error of 0.2 m/s^2 relative to 9.81 m/s^2 tilts the thrust by 1.2 degrees.
    assert angle_deg(replay.rotation(query_s), FORMULA.rotation(true_s)).max() < 1.2
    # At the two ends, with samples on one side only: measured 0.18 and 0.54 m/s^2.
    at_ends = replay.acceleration_m_s2(np.array([0.0, noisy.duration_s]))
    np.testing.assert_allclose(at_ends, FORMULA.acceleration_m_s2(time_s[[0, -1]]), atol=1.0)


def test_gaps_and_short_recordings_with_noise_are_replayed():
    noisy_m = sample_formula(EVEN_S, noise_m=1e-3).position_m
    kept = (EVEN_S < 4.0) | (EVEN_S > 4.4)
    replay = make_replay(Recorded(EVEN_S[kept], noisy_m[kept], None))
    missing_s = np.linspace(4.0, 4.4, 21)
    # Largest measured error 0.5 mm.
    np.testing.assert_allclose(replay.position_m(missing_s), FORMULA.position_m(missing_s), atol=2e-3)
    time_s = EVEN_S[:6]
    short = make_replay(Recorded(time_s, noisy_m[:6], None))
    # The tolerance is the largest value of the noise, about 3.5 mm, and the shift by smoothing.
    np.testing.assert_allclose(short.position_m(time_s), FORMULA.position_m(time_s), atol=5e-3)


def test_a_recorded_flight_is_flown_from_its_start_with_an_offset_and_can_be_followed(tmp_path):
    path = tmp_path / "loop.csv"
    write_recorded_flight(path, EVEN_S + 3.0, FORMULA.position_m(EVEN_S), FORMULA.orientation_wxyz(EVEN_S))
    recipe = make_scenario(
        FlightFromFile(file=str(path), start_s=2.5, offset_m=(1.0, -2.0, 0.5)),
        Formation(leader=1, offset_m=(0.0, 0.9, 0.0)),
        FollowingFlight(leader=1, delay_s=1.5),
        variation=Variation(),
        num_frames=180,
    )
    time_s = frame_times_s(recipe, 180)
    expected_m = FORMULA.position_m(time_s + 2.5) + np.array([1.0, -2.0, 0.5])
    for seed in (0, 1):
        first, wingman, behind = plan(recipe, seed)
        np.testing.assert_allclose(first.position_m(time_s), expected_m, atol=1e-6)
        assert angle_deg(first.rotation(time_s), FORMULA.rotation(time_s + 2.5)).max() < 0.06
        beside_m = wingman.position_m(time_s) - expected_m
        np.testing.assert_allclose(beside_m, [[0.0, 0.9, 0.0]] * 180, atol=1e-6)
        later_s = time_s[40:]
        np.testing.assert_allclose(behind.position_m(later_s), first.position_m(later_s - 1.5), atol=1e-9)


def test_files_without_orientations_and_rows_without_a_position_are_read(tmp_path):
    time_s = np.arange(40) / 25
    position_m = FORMULA.position_m(time_s)
    # The identity in every row says that no orientation is known: the attitude follows the acceleration.
    identity = np.tile([0.0, 0, 0, 1], (40, 1))
    np.savetxt(tmp_path / "level.txt", np.column_stack([time_s, position_m, identity]))
    assert read_recorded_flight(tmp_path / "level.txt").orientation_wxyz is None
    path = tmp_path / "loop.csv"
    write_tracks(path)
    lines = path.read_text().splitlines()
    lines[4] = lines[4].replace(",3.0,6.0,9.0,", ",,,,")
    path.write_text("\n".join(lines))
    np.testing.assert_allclose(read_recorded_flight(path).time_s, [0, 0.1, 0.2, 0.4, 0.5, 0.6, 0.7])
