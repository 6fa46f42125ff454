"""Flights of the simulator: derivatives, attitude, near passes, groups, limits, and variation by the seed."""

import itertools

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError
from psotrack.simulation import Scenario, change_scenario, preset_names, scenario, write_recorded_flight
from psotrack.simulation.flights.motion import GRAVITY_M_S2, quaternions_wxyz
from psotrack.simulation.flights.planning import frame_times_s, plan
from psotrack.simulation.scenarios import (
    Crossing,
    Drone,
    FlightFromFile,
    FollowingFlight,
    Formation,
    Harmonic,
    Harmonics,
    Limits,
    NearPass,
    Orbit,
    Variation,
    Waypoints,
)

S02 = scenario("S02_D4_A")
TIME_S = np.linspace(0.0, 10.0, 301)
#: Step of the central differences, seconds.
STEP_S = 1e-3

ORBIT = Orbit(centre_m=(0.3, -0.2, 1.4), radius_m=(1.5, 1.1), period_s=6.3, phase_deg=20.0, rise_m=0.3)
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
WIDE = Limits(
    max_speed_m_s=9.0,
    max_acceleration_m_s2=9.0,
    max_tilt_deg=60.0,
    min_distance_m=0.0,
    lower_m=(-9.0, -9.0, -9.0),
    upper_m=(9.0, 9.0, 9.0),
)
NO_VARIATION = Variation(phase_deg=0.0, centre_m=0.0, size=0.0, period=0.0, yaw_deg=0.0)


def make_scenario(*records, groups=(), limits=WIDE, variation=NO_VARIATION, num_frames=250):
    """Make a scenario from flights; by default with wide limits and without variation."""
    drones = tuple(
        Drone(flight=record, group=group)
        for record, group in itertools.zip_longest(records, groups, fillvalue="")
    )
    return Scenario(
        name="T",
        hall="laboratory",
        cameras="laboratory",
        num_frames=num_frames,
        drones=drones,
        limits=limits,
        variation=variation,
    )


@pytest.fixture(scope="module")
def planned_flights():
    return dict(
        zip(FLIGHT_KINDS, plan(make_scenario(*FLIGHTS_OF_EVERY_KIND, variation=Variation()), 3), strict=True)
    )


def positions(recipe, seed, stride=1):
    time_s = frame_times_s(recipe, recipe.num_frames)[::stride]
    return np.stack([flight.position_m(time_s) for flight in plan(recipe, seed)])


def pairwise_distances_m(position_m):
    """Return the distances between all pairs of drones, (pairs, times), metres."""
    first, second = np.triu_indices(len(position_m), 1)
    return np.linalg.norm(position_m[first] - position_m[second], axis=-1)


def central_differences(flight, order):
    """Return the first or second derivative of the position by central differences."""
    before, here, after = (flight.position_m(TIME_S + shift) for shift in (-STEP_S, 0.0, STEP_S))
    return (after - before) / (2 * STEP_S) if order == 1 else (after - 2 * here + before) / STEP_S**2


# --- motion


@pytest.mark.parametrize("flight_kind", FLIGHT_KINDS)
def test_velocity_and_acceleration_are_the_derivatives_of_the_position(planned_flights, flight_kind):
    flight = planned_flights[flight_kind]
    # The first difference errs by at most h^2 / 6 times the third derivative. The second difference of waypoints errs
    # by h times the step of their third derivative, 60 d / T^3 with d = 1.7 m and T = 1.9 s: 15 m/s^3.
    step = flight_kind == "Waypoints"
    np.testing.assert_allclose(flight.velocity_m_s(TIME_S), central_differences(flight, 1), atol=1e-5)
    np.testing.assert_allclose(
        flight.acceleration_m_s2(TIME_S), central_differences(flight, 2), atol=2e-2 if step else 2e-4
    )
    assert np.abs(flight.acceleration_m_s2(TIME_S)).max() > 0.3, (
        "the flight must accelerate to test the second derivative"
    )


@pytest.mark.parametrize("flight_kind", FLIGHT_KINDS)
def test_the_body_z_axis_points_along_the_thrust(planned_flights, flight_kind):
    flight = planned_flights[flight_kind]
    thrust = flight.acceleration_m_s2(TIME_S) + np.array([0.0, 0.0, GRAVITY_M_S2])
    body_z = flight.rotation(TIME_S)[:, :, 2]
    # Sine of the angle between body z and thrust.
    sine = np.linalg.norm(np.cross(body_z, thrust), axis=-1) / np.linalg.norm(thrust, axis=-1)
    assert sine.max() < 1e-12
    assert np.all((body_z * thrust).sum(axis=-1) > 0)


@pytest.mark.parametrize("flight_kind", FLIGHT_KINDS)
def test_orientations_are_the_rotations_as_quaternions_of_constant_sign(planned_flights, flight_kind):
    flight = planned_flights[flight_kind]
    wxyz = flight.orientation_wxyz(TIME_S)
    np.testing.assert_allclose(np.linalg.norm(wxyz, axis=-1), 1.0, atol=1e-12)
    matrices = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
    np.testing.assert_allclose(matrices, flight.rotation(TIME_S), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0, atol=1e-12)
    assert (wxyz[1:] * wxyz[:-1]).sum(axis=-1).min() > 0.99


def test_quaternions_stay_unit_across_half_a_turn():
    turns = np.stack([np.eye(3), np.diag([-1.0, -1.0, 1.0]), np.eye(3)])
    np.testing.assert_array_equal(np.abs(quaternions_wxyz(turns)), [[1, 0, 0, 0], [0, 0, 0, 1], [1, 0, 0, 0]])


def test_the_x_axis_looks_along_the_heading():
    recipe = change_scenario(
        make_scenario(ORBIT), {"drones[0].yaw_deg": 70.0, "drones[0].yaw_sway_deg": 30.0}
    )
    (flight,) = plan(recipe, 0)
    rotation = flight.rotation(TIME_S)
    yaw = np.radians(70.0) + np.radians(30.0) * np.sin(2 * np.pi / 9.0 * TIME_S + flight.heading.phase_rad)
    ahead = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=-1)
    # The body's x axis is the direction perpendicular to z that is nearest to the heading, so y is perpendicular to
    # the heading.
    np.testing.assert_allclose((rotation[:, :, 1] * ahead).sum(axis=-1), 0.0, atol=1e-12)
    assert np.all((rotation[:, :, 0] * ahead).sum(axis=-1) > 0.9)


# --- kinds of flights, compared with formulas


@pytest.mark.parametrize("clockwise", [False, True])
def test_an_orbit_starts_at_plus_x_and_turns_in_the_given_direction(clockwise):
    record = msgspec.structs.replace(ORBIT, phase_deg=0.0, clockwise=clockwise, rise_phase_deg=90.0)
    (flight,) = plan(make_scenario(record), 0)
    angle = 2 * np.pi * TIME_S / 6.3
    y = -0.2 + (-1 if clockwise else 1) * 1.1 * np.sin(angle)
    rise = 1.4 + 0.3 * np.cos(2 * np.pi * TIME_S / 5.0)
    np.testing.assert_allclose(
        flight.position_m(TIME_S), np.stack([0.3 + 1.5 * np.cos(angle), y, rise], axis=-1), atol=1e-12
    )


def test_a_crossing_goes_straight_from_end_to_end_and_rests_at_both():
    start, end = np.array([-2.0, -1.0, 0.9]), np.array([1.8, 1.2, 2.0])
    (flight,) = plan(make_scenario(Crossing(start_m=tuple(start), end_m=tuple(end), period_s=6.0)), 0)
    at_s = np.array([0.0, 1.5, 3.0, 4.5, 6.0])
    expected = [start, (start + end) / 2, end, (start + end) / 2, start]
    np.testing.assert_allclose(flight.position_m(at_s), expected, atol=1e-12)
    np.testing.assert_allclose(flight.velocity_m_s(at_s[::2]), 0.0, atol=1e-12)


def test_formations_keep_their_offset_and_followers_their_delay(planned_flights):
    first, second, third = (
        planned_flights[flight_kind] for flight_kind in ("NearPass", "Formation", "FollowingFlight")
    )
    np.testing.assert_allclose(
        second.position_m(TIME_S) - first.position_m(TIME_S), np.tile([0.0, 0.9, 0.2], (301, 1)), atol=1e-12
    )
    np.testing.assert_allclose(third.position_m(TIME_S + 1.3), second.position_m(TIME_S), atol=1e-12)


def test_waypoints_are_reached_on_time_and_hovered_at():
    record = FLIGHTS_OF_EVERY_KIND[FLIGHT_KINDS.index("Waypoints")]
    (flight,) = plan(make_scenario(record), 0)
    points = np.array(record.points_m)
    leg_s = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=-1) / record.speed_m_s + record.hover_s
    # Two rounds: the first point follows the last point.
    arrival_s = np.concatenate([[0.0], np.cumsum(np.tile(leg_s, 2))[:-1]])
    for wait_s in (0.0, 0.2, 0.399):
        np.testing.assert_allclose(flight.position_m(arrival_s + wait_s), np.tile(points, (2, 1)), atol=1e-9)
        np.testing.assert_allclose(flight.velocity_m_s(arrival_s + wait_s), 0.0, atol=1e-9)
    halfway_s = arrival_s[:3] + record.hover_s + (leg_s[:3] - record.hover_s) / 2
    np.testing.assert_allclose(flight.position_m(halfway_s), (points[:3] + points[1:4]) / 2, atol=1e-12)


@given(
    distance_m=st.floats(0.2, 2.0),
    angle_deg=st.floats(0.0, 360.0),
    tilt_deg=st.floats(-80.0, 80.0),
    length=st.floats(0.1, 10.0),
    phase_deg=st.floats(-400.0, 400.0),
    seed=st.integers(0, 10_000),
)
def test_a_near_pass_reaches_its_distance_twice_a_period(
    distance_m, angle_deg, tilt_deg, length, phase_deg, seed
):
    axes = Rotation.from_euler("zy", [angle_deg, tilt_deg], degrees=True).as_matrix()
    record = NearPass(
        other=1,
        distance_m=distance_m,
        side=tuple((axes[:, 0] * length).tolist()),
        swing_m=tuple((axes[:, 1] * 1.5).tolist()),
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


def test_a_recorded_flight_does_not_depend_on_the_seed_and_can_be_followed(tmp_path):
    (original,) = plan(make_scenario(ORBIT), 0)
    samples_s = np.arange(0.0, 12.0, 0.01)
    write_recorded_flight(tmp_path / "r.csv", samples_s, original.position_m(samples_s), None)
    replay = FlightFromFile(file=str(tmp_path / "r.csv"), start_s=1.0)
    wingman = Formation(leader=1, offset_m=(0.0, 0.9, 0.0))
    time_s = frame_times_s(S02, 250)
    for seed in (0, 1):
        first, second = plan(make_scenario(replay, wingman, variation=Variation()), seed)
        # The flight is a spline through exact samples at 100 Hz; its own tests use a smaller tolerance.
        np.testing.assert_allclose(first.position_m(time_s), original.position_m(time_s + 1.0), atol=1e-6)
        np.testing.assert_allclose(
            second.position_m(time_s) - first.position_m(time_s), [[0.0, 0.9, 0.0]] * 250
        )
    with pytest.raises(SettingsError, match=r"r.csv: expected a recording of at least "):
        plan(make_scenario(replay, num_frames=300), 0)
    behind = FollowingFlight(leader=1, delay_s=1.5)
    plan(make_scenario(msgspec.structs.replace(replay, start_s=1.5), behind), 0)
    with pytest.raises(
        SettingsError, match=r"r.csv: expected a start_s of at least 1.5 s, found 1 s; the drone that foll"
    ):
        plan(make_scenario(replay, behind), 0)


# --- what a seed changes


def test_flights_are_determined_by_the_seed():
    first, again, other = (plan(S02, seed)[0].position_m(TIME_S) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1


@pytest.mark.parametrize("flight_kind", FLIGHT_KINDS)
def test_without_variation_every_seed_gives_the_same_flight(flight_kind):
    first, other = (
        plan(make_scenario(*FLIGHTS_OF_EVERY_KIND), seed)[FLIGHT_KINDS.index(flight_kind)] for seed in (0, 1)
    )
    np.testing.assert_array_equal(first.position_m(TIME_S), other.position_m(TIME_S))
    assert first.heading.yaw_rad == other.heading.yaw_rad == 0.0


@given(seed=st.integers(0, 10_000))
def test_variation_stays_within_what_the_scenario_allows(seed):
    variation = Variation(phase_deg=10.0, centre_m=0.1, size=0.05, period=0.02, yaw_deg=30.0)
    waypoints = FLIGHTS_OF_EVERY_KIND[FLIGHT_KINDS.index("Waypoints")]
    orbit, waypoint_flight = plan(make_scenario(ORBIT, waypoints, variation=variation), seed)
    assert np.all(np.abs(orbit.centre_m - ORBIT.centre_m) <= 0.1)
    assert np.all(np.abs(np.rad2deg(orbit.phase_rad[0]) - [110.0, 20.0, 0.0])[:2] <= 10.0 + 1e-9)
    assert np.all(np.abs(orbit.amplitude_m[0, :2] / ORBIT.radius_m - 1) <= 0.05 + 1e-12)
    assert np.all(np.abs(2 * np.pi / orbit.angular_rad_s / [6.3, 5.0] - 1) <= 0.02 + 1e-12)
    assert abs(np.degrees(orbit.heading.yaw_rad)) <= 30.0
    assert np.all(np.abs(waypoint_flight.points_m - waypoints.points_m) <= 0.1)
    # The variation of the period scales the flying time and the hovering time of the whole round.
    slower = waypoint_flight.hover_s / waypoints.hover_s
    assert abs(slower - 1) <= 0.02 + 1e-12
    way_m = np.linalg.norm(np.roll(waypoint_flight.points_m, -1, axis=0) - waypoint_flight.points_m, axis=-1)
    np.testing.assert_allclose(waypoint_flight.moving_s, slower * way_m / waypoints.speed_m_s, rtol=1e-12)


def make_orbit(phase_deg, **changes):
    return msgspec.structs.replace(ORBIT, phase_deg=phase_deg, **changes)


@given(seed=st.integers(0, 10_000), frames=st.sampled_from([250, 9000]))
def test_drones_of_one_group_keep_their_spacing_on_an_orbit(seed, frames):
    """On a circle of radius r, n evenly spaced drones stay 2 r sin(pi / n) apart; the seed varies r."""
    circle = [make_orbit(phase, radius_m=(1.5, 1.5)) for phase in (0.0, 120.0, 240.0)]
    recipe = make_scenario(*circle, groups=("ring",) * 3, variation=Variation(), num_frames=frames)
    distance_m = pairwise_distances_m(positions(recipe, seed, stride=10))
    # The tolerance covers the rounding of angles up to 400 rad.
    np.testing.assert_allclose(distance_m, distance_m[0, 0], atol=1e-9)
    assert 1.5 * np.sqrt(3) * (1 - 0.06) <= distance_m[0, 0] <= 1.5 * np.sqrt(3) * (1 + 0.06)


def test_spacing_changes_without_a_group_and_headings_differ_within_a_group():
    circle = [make_orbit(phase, radius_m=(1.5, 1.5)) for phase in (0.0, 120.0)]
    alone = make_scenario(*circle, variation=Variation(), num_frames=9000)
    assert np.ptp(pairwise_distances_m(positions(alone, 0, stride=10))) > 0.5
    first, other = plan(make_scenario(*circle, groups=("ring",) * 2, variation=Variation()), 0)
    assert first.heading.yaw_rad != other.heading.yaw_rad
    assert first.heading.phase_rad != other.heading.phase_rad


def test_different_kinds_of_flights_of_one_group_share_their_variation():
    line = Crossing(start_m=(-1.0, 0.0, 1.0), end_m=(1.0, 0.0, 1.0), period_s=6.3)
    orbit, crossing = plan(make_scenario(ORBIT, line, groups=("a", "a"), variation=Variation()), 1)
    np.testing.assert_allclose(
        orbit.centre_m - ORBIT.centre_m, crossing.centre_m - [0.0, 0.0, 1.0], atol=1e-12
    )
    assert orbit.angular_rad_s[0] == crossing.angular_rad_s[0]


# --- limits


@pytest.mark.parametrize("name", preset_names())
@pytest.mark.parametrize("seed", [0, 1, 17])
def test_limits_hold_in_every_preset_for_every_seed(name, seed):
    recipe = scenario(name)
    flights = plan(recipe, seed)
    limits = recipe.limits
    # Check all frames of short sequences and every seventh frame of long sequences.
    time_s = frame_times_s(recipe, recipe.num_frames)[:: 1 if recipe.num_frames < 600 else 7]
    here, there = (np.stack([f.position_m(time_s + shift) for f in flights]) for shift in (0.0, STEP_S))
    speed = np.linalg.norm(there - here, axis=-1) / STEP_S
    acceleration = np.stack([flight.acceleration_m_s2(time_s) for flight in flights])
    thrust = acceleration + np.array([0.0, 0.0, GRAVITY_M_S2])
    tilt_deg = np.degrees(np.arctan2(np.hypot(thrust[..., 0], thrust[..., 1]), thrust[..., 2]))
    # The difference is the speed half a millisecond later, which differs by at most 9 m/s^2 times 0.5 ms.
    assert speed.max() <= limits.max_speed_m_s + 0.005
    assert np.linalg.norm(acceleration, axis=-1).max() <= limits.max_acceleration_m_s2
    assert tilt_deg.max() <= limits.max_tilt_deg
    assert np.all(here >= limits.lower_m)
    assert np.all(here <= limits.upper_m)
    distance_m = dict(
        zip(itertools.combinations(range(len(flights)), 2), pairwise_distances_m(here), strict=True)
    )
    for index, drone in enumerate(recipe.drones):
        if isinstance(drone.flight, NearPass):
            passed = distance_m.pop(tuple(sorted((index, drone.flight.other - 1))))
            assert drone.flight.distance_m - 1e-9 <= passed.min() < drone.flight.distance_m + 0.1
    assert min((distance.min() for distance in distance_m.values()), default=9.0) >= limits.min_distance_m


CROSSINGS = (
    Crossing(start_m=(-2.0, 0.0, 1.0), end_m=(2.0, 0.0, 1.0), period_s=8.0),
    Crossing(start_m=(0.0, -2.0, 1.5), end_m=(0.0, 2.0, 1.5), period_s=8.0),
)


@pytest.mark.parametrize(
    ("field", "value", "sentence"),
    [
        ("min_distance_m", 1.0, r"drones\[1\].flight: expected at least 1 m from drones\[0\] "
         r"\(limits.min_distance_m\), found 0.5 m at 2.00 s"),
        ("max_speed_m_s", 1.2, r"drones\[0\].flight: expected at most 1.2 m/s \(limits.max_speed_m_s\), "
         r"found 1.571 m/s at 2.00 s"),
        ("max_acceleration_m_s2", 0.5, r"drones\[0\].flight: expected at most 0.5 m/s2 "
         r"\(limits.max_acceleration_m_s2\), found 1.234 m/s2 at 0.00 s"),
        ("max_tilt_deg", 3.0, r"drones\[0\].flight: expected at most 3 degrees of tilt \(limits.max_tilt_deg\), "
         r"found 7.168 degrees of tilt at 0.00 s"),
        ("upper_m", (3.0, 1.9, 2.0), r"drones\[1\].flight: expected positions from \[-9.0, -9.0, -9.0\] "
         r"\(limits.lower_m\) to \[3.0, 1.9, 2.0\] \(limits.upper_m\), found \[0.000, 2.000, 1.500\] at 4.00 s"),
    ],
)  # fmt: skip
def test_a_broken_limit_is_named_with_value_and_time(field, value, sentence):
    """The crossing is a sinusoid with speed 2 m * 2 pi / 8 s = 1.571 m/s and acceleration 1.571 m/s * 2 pi / 8 s."""
    limits = msgspec.structs.replace(WIDE, **{field: value})
    with pytest.raises(SettingsError, match=rf"^scenario T: {sentence}$"):
        plan(make_scenario(*CROSSINGS, limits=limits), 0)


def test_a_leg_shorter_than_a_frame_interval_is_checked_too():
    """The drone flies 1 m in 10 ms between two frames, and hovers at every frame."""
    points_m = ((0.0, 0.0, 1.0), (1.0, 0.0, 1.0))
    dash = Waypoints(points_m=points_m, speed_m_s=100.0, hover_s=0.99)
    with pytest.raises(
        SettingsError,
        match=r"^scenario T: drones\[0\].flight.speed_m_s: expected at most 9 m/s \(limits.max_speed_m_s\), found 100$",
    ):
        plan(make_scenario(dash), 0)


def test_numbers_that_overflow_are_refused():
    far = Waypoints(points_m=((0.0, 0.0, 1.0), (1e300, 0.0, 1.0)), speed_m_s=1.0)
    with (
        np.errstate(all="ignore"),
        pytest.raises(SettingsError, match=r"expected positions from .*found \[nan, "),
    ):
        plan(make_scenario(far), 0)


def test_limits_broken_by_variation_are_named_with_their_count():
    limits = msgspec.structs.replace(WIDE, lower_m=(-2.5, -2.5, 1.0), upper_m=(2.5, 2.5, 1.0))
    with pytest.raises(
        SettingsError,
        match=r"^scenario T: drones\[0\].flight: expected positions from .*; 400 of 400 variations broke this limit: ",
    ):
        plan(make_scenario(CROSSINGS[0], limits=limits, variation=Variation()), 0)


def test_the_minimum_distance_applies_to_formations_but_not_to_near_passes():
    limits = msgspec.structs.replace(WIDE, min_distance_m=0.8)
    near = NearPass(other=1, distance_m=0.3, side=(0.0, 0.0, 1.0), swing_m=(1.5, 0.0, 0.0), period_s=4.0)
    plan(make_scenario(ORBIT, near, limits=limits), 0)
    with pytest.raises(SettingsError, match=r"drones\[1\].flight: expected at least 0.8 m from drones\[0\]"):
        plan(make_scenario(ORBIT, Formation(leader=1, offset_m=(0.0, 0.0, 0.3)), limits=limits), 0)
    # The minimum distance still applies between the passing drone and a third drone.
    with pytest.raises(SettingsError, match=r"drones\[2\].flight: expected at least 0.8 m from drones\[1\]"):
        plan(make_scenario(ORBIT, near, Formation(leader=2, offset_m=(0.0, 0.0, 0.5)), limits=limits), 0)


def test_a_limit_broken_in_a_single_frame_is_found():
    """The orbit breaks the limit in one frame only, which a coarser grid of times would miss."""
    limits = msgspec.structs.replace(WIDE, upper_m=(1.79999, 9.0, 9.0))
    # x = 0.3 + 1.5 cos(2 pi t / 6.28 s - 2 pi / 6.28 * 1 frame): frame 1 is at 1.8 m, frames 0 and 6 are lower.
    record = make_orbit(-360.0 / (25 * 6.28), period_s=6.28, rise_m=0.0)
    with pytest.raises(SettingsError, match=r"found \[1.800, -0.200, 1.400\] at 0.04 s"):
        plan(make_scenario(record, limits=limits, num_frames=100), 0)


# --- invalid flights


NEAR = NearPass(other=1, distance_m=0.6, side=(0.0, 0.0, 1.0), swing_m=(1.0, 0.0, 0.0), period_s=4.0)
POINTS = Waypoints(points_m=((0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (0.0, 1.0, 1.0)), speed_m_s=0.5)


@pytest.mark.parametrize(
    ("records", "sentence"),
    [
        ((ORBIT, Formation(leader=3, offset_m=(0, 0, 1))), r"drones\[1\].flight.leader: .* 1 to 2, found 3$"),
        ((ORBIT, FollowingFlight(leader=9, delay_s=1.0)), r"drones\[1\].flight.leader: .* 1 to 2, found 9$"),
        ((ORBIT, msgspec.structs.replace(NEAR, other=5)), r"drones\[1\].flight.other: .* 1 to 2, found 5$"),
        (
            (NEAR,),
            r"drones\[0\].flight.other: expected relative flights without a cycle, found drones 1 -> 1$",
        ),
        (
            (Formation(leader=2, offset_m=(0, 0, 1)), FollowingFlight(leader=3, delay_s=1.0), NEAR, ORBIT),
            r"drones\[2\].flight.other: expected relative flights without a cycle, found drones 1 -> 2 -> 3 -> 1$",
        ),
        (
            (ORBIT, msgspec.structs.replace(NEAR, side=(1.0, 0.0, 1.0))),
            r"drones\[1\].flight.side: expected a direction perpendicular to swing_m, found one at 45 degrees to it; ",
        ),
        (
            (ORBIT, msgspec.structs.replace(NEAR, side=(0.0, 0.0, 0.0))),
            r"drones\[1\].flight.side: expected a direction, found \[0, 0, 0\]$",
        ),
        (
            (ORBIT, msgspec.structs.replace(NEAR, swing_m=(0.0, 0.0, 0.0))),
            r"drones\[1\].flight.swing_m: expected a direction, found \[0, 0, 0\]$",
        ),
        (
            (msgspec.structs.replace(POINTS, points_m=(*POINTS.points_m, (0.0, 1.0, 1.0))),),
            r"drones\[0\].flight.points_m\[3\]: expected a point that differs .*, found \[0.0, 1.0, 1.0\] again; ",
        ),
        (
            (msgspec.structs.replace(POINTS, points_m=(*POINTS.points_m, (0.0, 0.0, 1.0))),),
            r"drones\[0\].flight.points_m\[0\]: expected a point that differs .*, found \[0.0, 0.0, 1.0\] again; ",
        ),
    ],
)
def test_invalid_flights_are_refused_and_the_field_is_named(records, sentence):
    with pytest.raises(SettingsError, match=rf"^scenario T: {sentence}"):
        plan(make_scenario(*records), 0)
