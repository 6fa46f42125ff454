"""Flights of the simulator: derivatives, attitude, limits, what a seed may change."""

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError
from psotrack.simulation import SCENARIOS, flights, scenario

S02 = scenario("S02_D4_A")
TIME_S = np.linspace(0.0, 10.0, 301)
STEP_S = 1e-3


@pytest.fixture(scope="module")
def planned():
    return flights.plan(S02, 0)


def differences(flight, order):
    """Central differences of the position; their error is of order STEP_S squared, 1e-5 for these flights."""
    before, here, after = (flight.position_m(TIME_S + shift) for shift in (-STEP_S, 0.0, STEP_S))
    return (after - before) / (2 * STEP_S) if order == 1 else (after - 2 * here + before) / STEP_S**2


def test_velocity_and_acceleration_are_the_derivatives_of_the_position(planned):
    for flight in planned:
        # Third derivatives are below 5 m/s^3, so differences are off by less than 5 h^2 / 6, and by rounding.
        np.testing.assert_allclose(flight.velocity_m_s(TIME_S), differences(flight, 1), atol=1e-5)
        np.testing.assert_allclose(flight.acceleration_m_s2(TIME_S), differences(flight, 2), atol=1e-4)


def test_the_body_z_axis_points_where_gravity_and_acceleration_demand(planned):
    for flight in planned:
        thrust = differences(flight, 2) + np.array([0.0, 0.0, 9.81])
        body_z = flight.rotation(TIME_S)[:, :, 2]
        # The sine of the angle between them; the differences' 1e-4 of 9.81 m/s^2 is 1e-5 rad.
        sine = np.linalg.norm(np.cross(body_z, thrust), axis=-1) / np.linalg.norm(thrust, axis=-1)
        assert sine.max() < 1e-4
        assert np.all((body_z * thrust).sum(axis=-1) > 0)
        assert body_z[:, 2].min() < np.cos(np.radians(3)), "a flight that never tilts proves nothing"


def test_orientations_are_those_rotations_and_do_not_change_sign(planned):
    for flight in planned:
        wxyz = flight.orientation_wxyz(TIME_S)
        np.testing.assert_allclose(np.linalg.norm(wxyz, axis=-1), 1.0, atol=1e-12)
        matrices = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
        np.testing.assert_allclose(matrices, flight.rotation(TIME_S), atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(flight.rotation(TIME_S)), 1.0, atol=1e-12)
        assert (wxyz[1:] * wxyz[:-1]).sum(axis=-1).min() > 0.99


@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.parametrize("seed", [0, 1, 2, 17])
def test_limits_hold_whatever_the_seed(name, seed):
    recipe = scenario(name)
    position = np.stack(
        [f.position_m(flights.frame_times_s(recipe, recipe.num_frames)) for f in flights.plan(recipe, seed)]
    )
    limits = recipe.limits
    speed = np.linalg.norm(np.diff(position, axis=1), axis=-1) * recipe.fps
    acceleration = np.linalg.norm(np.diff(position, 2, axis=1), axis=-1) * recipe.fps**2
    # Differences are means over a frame or two, so they never exceed the limits of what they average.
    assert speed.max() <= limits.max_speed_m_s
    assert acceleration.max() <= limits.max_acceleration_m_s2
    for a in range(len(position)):
        for b in range(a):
            assert np.linalg.norm(position[a] - position[b], axis=-1).min() >= limits.min_distance_m
    assert np.all(position >= limits.lower_m)
    assert np.all(position <= limits.upper_m)
    assert speed.mean() > 0.5, "drones that hang still are no flight"


def test_a_seed_gives_the_same_flight_again_and_another_seed_another():
    first, again, other = (flights.plan(S02, seed)[0].position_m(TIME_S) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("min_distance_m", 5.0, "distance: 20"),
        ("max_speed_m_s", 0.1, "speed: 20"),
        ("max_acceleration_m_s2", 0.1, "acceleration: 20"),
        ("max_tilt_deg", 0.5, "tilt: 20"),
        ("upper_m", (0.1, 0.1, 3.0), "bounds: 20"),
    ],
)
def test_limits_that_cannot_be_kept_are_named(field, value, reason, monkeypatch):
    monkeypatch.setattr(flights, "NUM_ATTEMPTS", 20)
    tight = msgspec.structs.replace(S02, limits=msgspec.structs.replace(S02.limits, **{field: value}))
    with pytest.raises(
        SettingsError, match=rf"^scenario S02_D4_A: expected .* found none in 20 tries \({reason}\)"
    ):
        flights.plan(tight, 0)


def test_an_unknown_scenario_is_answered_with_those_there_are():
    with pytest.raises(SettingsError, match=r"^scenario: expected one of S02_D4_A.*, found S99$"):
        scenario("S99")
