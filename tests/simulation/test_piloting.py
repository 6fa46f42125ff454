"""Flying by hand: dynamics, limits, input devices, the command `fly`. Scripts and fakes of pyglet give the sticks."""

import re
import signal
import sys
from collections import defaultdict
from functools import partial
from types import ModuleType
from unittest.mock import Mock, call

import numpy as np
import pytest
from helpers import assert_refused
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from psotrack.errors import install_command
from psotrack.simulation import flight_space
from psotrack.simulation.flights import piloting
from psotrack.simulation.flights.motion import read_recorded_flight
from psotrack.simulation.flights.piloting import (
    DYNAMICS,
    Gamepad,
    Panel,
    Sample,
    Space,
    Sticks,
    fly,
    flying,
    key_sticks,
    open_device,
    poll,
    write_sticks,
)

LABORATORY = flight_space("laboratory")
UNBOUNDED_SPACE = Space(np.full(3, -1e6), np.full(3, 1e6))
START_M = np.array([0.0, 0.0, 1.0])
STEP_HZ = 250.0
#: Upper bound of the acceleration of every flight: full tilt at full thrust, plus the drag at full speed.
MOST_M_S2 = np.hypot(
    np.tan(np.radians(DYNAMICS.max_tilt_deg)) * (9.81 + DYNAMICS.max_climb_m_s2)
    + DYNAMICS.drag_per_s * DYNAMICS.max_speed_m_s,
    DYNAMICS.max_climb_m_s2 + DYNAMICS.drag_per_s * DYNAMICS.max_climb_m_s,
)
#: Sticks that use all axes: rows of (time, forward, left, up, turn).
ROWS = [(0, 1, 0.3, 0.1, 0.5), (0.9, -0.4, 1, 0, -1), (1.8, 0, 0, 0.6, 0), (2.5, 1, -1, -1, 0.3), (4,)]


def record_flight(*rows, space=LABORATORY, start_m=START_M, **settings):
    """Fly rows of (time, sticks) and return the recorded flight."""
    samples = [Sample(float(time_s), Sticks(*sticks)) for time_s, *sticks in rows]
    recorded, _ = fly(samples, start_m, space, **settings)
    return recorded


def velocity_and_acceleration(recorded):
    """Return velocity and acceleration as differences of a flight that is recorded at the integration's rate.

    At this rate the differences are exactly the velocities of the integration.
    """
    velocity_m_s = np.diff(recorded.position_m, axis=0) * STEP_HZ
    return velocity_m_s, np.diff(velocity_m_s, axis=0) * STEP_HZ


def body_rotations(recorded):
    return Rotation.from_quat(recorded.orientation_wxyz, scalar_first=True).as_matrix()


# --- dynamics


@pytest.mark.parametrize(
    ("sticks", "velocity_m_s"),
    [
        ((0, 0, 0, 0), (0, 0, 0)),
        ((-0.5, 0, 0, 0), (-1.25, 0, 0)),
        ((0, 1, 0, 0), (0, 2.5, 0)),
        ((0, 0, -1, 0), (0, 0, -1.2)),
        # The speed limit is the same for a diagonal as for one axis.
        ((1, -1, 1, 0), (2.5 / np.sqrt(2), -2.5 / np.sqrt(2), 1.2)),
    ],
)
def test_sticks_reach_the_stated_speeds_and_centred_sticks_hover(sticks, velocity_m_s):
    recorded = record_flight((0, *sticks), (9.5,), space=UNBOUNDED_SPACE)
    moved_m = recorded.position_m[-1] - recorded.position_m[-2]
    # The slower of the two modes decays as exp(-3.1 t), which reduces 2.5 m/s to 4e-13 m/s.
    np.testing.assert_allclose(moved_m * 25, velocity_m_s, atol=1e-11)
    if not any(sticks):
        np.testing.assert_array_equal(recorded.position_m, np.tile(START_M, (238, 1)))
        np.testing.assert_array_equal(recorded.orientation_wxyz, np.tile([1.0, 0, 0, 0], (238, 1)))


def test_the_response_to_a_small_step_solves_the_linear_equations():
    """The oracle solves x' = v, v' = p - k v, p' = ((1 / T + k) w - v / T - p) / lag by the matrix exponential."""
    recorded = record_flight((0, 0.2, 0, 0.3, 0), (2,), space=UNBOUNDED_SPACE, rate_hz=STEP_HZ)
    k, response_s, lag_s = DYNAMICS.drag_per_s, DYNAMICS.response_s, DYNAMICS.lag_s
    matrix = np.zeros((4, 4))
    matrix[0, 1] = 1.0
    matrix[1, 1:3] = -k, 1.0
    matrix[2, 1:] = -1 / (response_s * lag_s), -1 / lag_s, (1 / response_s + k) / lag_s
    moved = [expm(matrix * time_s)[0, 3] for time_s in recorded.time_s[::5]]
    for axis, wished_m_s in ((0, 0.2 * 2.5), (2, 0.3 * 1.2)):
        true_m = START_M[axis] + np.array(moved) * wished_m_s
        # The integration has first order: velocity and position are half a step early each, so the error is about
        # one step times the speed; measured 1.04 times that.
        np.testing.assert_allclose(
            recorded.position_m[::5, axis], true_m, rtol=0, atol=1.1 * wished_m_s / STEP_HZ
        )


def test_turning_reaches_the_stated_rate_and_turns_the_forward_direction():
    turning, ahead, end_s = (0, 0, 0, 0, 1), (6, 0.2, 0, 0, 0), (9,)
    still = (4, 0, 0, 0, 0)
    recorded = record_flight(turning, still, ahead, end_s, space=UNBOUNDED_SPACE, rate_hz=STEP_HZ)
    x_axis = body_rotations(recorded)[:, :, 0]
    yaw_rad = np.unwrap(np.arctan2(x_axis[:, 1], x_axis[:, 0]))
    rate_rad_s = np.diff(yaw_rad) * STEP_HZ
    assert rate_rad_s.max() == pytest.approx(1.5, abs=1e-9)
    # The yaw rate has a first-order lag: the angle lost at the start is made up at the end.
    assert yaw_rad[-1] == pytest.approx(4 * 1.5, abs=1e-6)
    way_m = recorded.position_m[-1] - recorded.position_m[1500]
    direction = way_m / np.linalg.norm(way_m)
    np.testing.assert_allclose(direction, [np.cos(6.0), np.sin(6.0), 0.0], atol=1e-6)


def test_body_z_points_along_the_thrust():
    rows = [(0, 1, 0.3, 0.5, 0.4), (1.2, -1, 0.5, -1, -1), (2.5, 0.2, -1, 1, 0), (4,)]
    recorded = record_flight(*rows, rate_hz=STEP_HZ)
    velocity_m_s, acceleration_m_s2 = velocity_and_acceleration(recorded)
    # The thrust accelerates the drone, carries its weight and overcomes drag. The integration is semi-implicit: drag
    # uses the velocity before the step.
    drag_m_s2 = DYNAMICS.drag_per_s * velocity_m_s[:-1]
    thrust = acceleration_m_s2 + drag_m_s2 + [0.0, 0.0, 9.81]
    along = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    # Rounding of positions of a few metres, 1e-15 m, is multiplied by the rate squared.
    np.testing.assert_allclose(body_rotations(recorded)[2:, :, 2], along, atol=1e-9)
    assert along[:, 2].min() < np.cos(np.radians(15)), "the flight must tilt to test the attitude"


STICKS = st.tuples(st.floats(0.05, 1.5), *[st.sampled_from([-1.0, 0.0, 1.0]) | st.floats(-1, 1)] * 4)


#: Full sticks along x must leave enough thrust to brake along y. Otherwise these sticks hit the wall at y = 3.6 m with
#: 34 m/s^2.
TOWARDS_A_WALL = [
    (0.655, 0, -1, -1, -1),
    (0.655, -1, -1, -1, 1),
    (0.655, 0, 1, 0, 0),
    (0.655, 1, 1, 0, 0),
    (0.655, 0, 1, -1, 1),
    (0.655, 1, -1, 0, 1),
    (0.655, 0, -1, 1, 1),
    (0.655, 1, -1, -1, 1),
    (0.655, -1, 0, -1, -1),
]


@example(TOWARDS_A_WALL, (0.5, 0.5, 0.25))
@settings(max_examples=15)
@given(st.lists(STICKS, min_size=2, max_size=5), st.tuples(*[st.floats(0, 1)] * 3))
def test_limits_hold_for_any_sticks_and_the_drone_stays_in_the_hall(positions, share):
    """Each position of the sticks is held for a time, and begins with it."""
    rows, now_s = [], 0.0
    for held_s, *sticks in positions:
        rows.append((now_s, *sticks))
        now_s += held_s
    lower_m, upper_m = LABORATORY.lower_m, LABORATORY.upper_m
    start_m = lower_m + share * (upper_m - lower_m)
    recorded = record_flight(*rows, (now_s,), start_m=start_m, rate_hz=STEP_HZ)
    velocity_m_s, acceleration_m_s2 = velocity_and_acceleration(recorded)
    slack = 1e-6  # rounding of the differences: 1e-15 m times the rate squared, with a margin
    speed_m_s = np.linalg.norm(velocity_m_s[:, :2], axis=1)
    assert speed_m_s.max() <= DYNAMICS.max_speed_m_s + slack
    assert np.abs(velocity_m_s[:, 2]).max() <= DYNAMICS.max_climb_m_s + slack
    assert np.linalg.norm(acceleration_m_s2, axis=1).max() <= MOST_M_S2 + slack
    upright = body_rotations(recorded)[:, 2, 2].clip(-1, 1)
    tilt_deg = np.degrees(np.arccos(upright))
    assert tilt_deg.max() <= DYNAMICS.max_tilt_deg + slack
    assert np.all((recorded.position_m >= lower_m) & (recorded.position_m <= upper_m))


@pytest.mark.parametrize(
    ("sticks", "axis", "end_m"),
    [((1, 0, 0, 0), 0, 4.6), ((0, -1, 0, 0), 1, -3.6), ((0, 0, 1, 0), 2, 3.6), ((0, 0, -1, 0), 2, 0.15)],
)
def test_walls_floor_and_ceiling_stop_the_drone_gently(sticks, axis, end_m):
    recorded = record_flight((0, *sticks), (8,), rate_hz=STEP_HZ)
    velocity_m_s, acceleration_m_s2 = velocity_and_acceleration(recorded)
    # The drone stops where braking balances the sticks, at most 0.1 m from the wall.
    assert abs(recorded.position_m[-1, axis] - end_m) < 0.1
    assert np.abs(velocity_m_s[-1]).max() < 1e-3
    assert np.abs(acceleration_m_s2).max() < MOST_M_S2


def test_flights_of_all_rates_are_nearly_the_same():
    fine = record_flight(*ROWS, rate_hz=STEP_HZ)
    for rate_hz in (5.0, 50.0, 125.0):
        coarse = record_flight(*ROWS, rate_hz=rate_hz)
        np.testing.assert_array_equal(coarse.position_m, fine.position_m[:: round(STEP_HZ / rate_hz)])
        np.testing.assert_array_equal(coarse.time_s, np.arange(4 * rate_hz + 1) / rate_hz)
    # A rate that does not divide the step.
    recorded = record_flight(*ROWS, rate_hz=29.97)
    np.testing.assert_array_equal(recorded.time_s, np.arange(120) / 29.97)
    for axis in range(3):
        expected_m = np.interp(recorded.time_s, fine.time_s, fine.position_m[:, axis])
        # Sticks take effect at the next step, here 3.7 ms instead of 4 ms long: a shift of at most 3.7 ms at 3.5 m/s.
        np.testing.assert_allclose(recorded.position_m[:, axis], expected_m, rtol=0, atol=0.013)
    for end_s in (1.4, 1.64, 2.28):
        assert int(end_s / (1 / 250)) < round(end_s * 250), "the division must round down"
        assert record_flight((0, 1, 0, 0, 0), (end_s,)).time_s[-1] == end_s


def test_a_flight_ends_at_the_maximum_duration():
    samples = (Sample(0.0, Sticks(1.0)), Sample(1.0, Sticks(0.5)), Sample(2.0, Sticks()))
    recorded, used = fly(samples, START_M, LABORATORY, max_s=1.5)
    assert used == (*samples[:2], Sample(1.5, Sticks(0.5)))
    assert recorded.duration_s == pytest.approx(1.48)
    _, used = fly(samples, START_M, LABORATORY, max_s=3.0)
    assert used == samples


# --- devices


SCRIPT = (Sample(0.0, Sticks(1.0, -0.5, 0.1, 0.0)), Sample(1 / 3, Sticks(turn=-1.0)), Sample(2.5, Sticks()))


def test_keys_act_as_full_sticks_and_opposite_keys_cancel():
    for keys, sticks in {
        "": Sticks(),
        "W": Sticks(forward=1.0),
        "S D": Sticks(forward=-1.0, left=-1.0),
        "A UP LEFT": Sticks(left=1.0, up=1.0, turn=1.0),
        "DOWN RIGHT": Sticks(up=-1.0, turn=-1.0),
        "W S A D UP DOWN LEFT RIGHT": Sticks(),
    }.items():
        assert key_sticks(lambda name, keys=keys: name in keys.split()) == sticks


def controlled(end):
    """A game controller, and the functions that pyglet calls when a stick moves (y is up) or a button is pressed."""
    controller = Mock()
    device = Gamepad(controller, end)
    handlers = controller.push_handlers.call_args.kwargs
    move = partial(handlers["on_stick_motion"], controller)
    press = partial(handlers["on_button_press"], controller)
    return device, move, press


def test_a_controller_uses_mode_2_and_rests_within_a_dead_zone():
    device, move, _ = controlled(lambda: None)
    move("leftstick", (1.0, 0.0))
    assert device.sticks == Sticks(turn=-1.0)
    move("leftstick", (0.0, -1.0))
    move("rightstick", (-1.0, 1.0))
    assert device.sticks == Sticks(forward=1.0, left=1.0, up=-1.0)
    for raw, live in ((0.11, 0.0), (-0.12, 0.0), (0.56, 0.5), (-0.56, -0.5), (-1.01, -1.0)):
        move("rightstick", (0.0, raw))
        assert device.sticks.forward == pytest.approx(live, abs=1e-12)


class FakePanel(Panel):
    """Fake of the pilot's window, with a clock of its own; `on_pump` is called with the number of each reading."""

    def __init__(self, on_pump):
        self.on_pump = on_pump
        self.count = 0
        self.now_s = 100.0
        self.shown = []
        self.closed = self.gone = False

    def pump(self):
        self.count += 1
        self.now_s += 1e-4
        self.on_pump(self.count)

    def draw(self, time_s, state):
        self.shown.append((time_s, state.position_m))

    def close(self):
        self.gone = True

    def sleep(self, seconds):
        assert seconds > 0
        self.now_s += seconds

    def samples(self, sticks):
        return poll(self, sticks, clock=lambda: self.now_s, sleep=self.sleep)


def test_a_live_flight_is_sampled_at_60_hz_shown_and_reproducible():
    def pilot(count):
        moves = {30: ("leftstick", (-0.6, 1.0)), 90: ("rightstick", (0.2, 0.9)), 200: ("leftstick", (0, 0))}
        if count in moves:
            move(*moves[count])
        if count == 241:
            press("a")
            assert not panel.closed
            press("start")

    panel = FakePanel(pilot)
    gamepad, move, press = controlled(panel.end)
    samples = panel.samples(lambda: gamepad.sticks)
    with flying(panel):
        recorded, used = fly(samples, START_M, LABORATORY, watch=panel.draw)
    assert panel.gone
    times_s = [sample.time_s for sample in used]
    assert len(times_s) == 241
    # The sleep is shortened by the time of drawing, so the rate is kept.
    np.testing.assert_allclose(np.diff(times_s), 1 / 60, atol=2e-4)
    assert recorded.time_s[-1] == 4.0
    assert [time_s for time_s, _ in panel.shown] == times_s
    _, last_m = panel.shown[-1]
    np.testing.assert_allclose(last_m, recorded.position_m[-1], atol=0.05)
    again, _ = fly(used, START_M, LABORATORY)
    np.testing.assert_array_equal(again.position_m, recorded.position_m)
    assert np.linalg.norm(recorded.position_m[-1] - START_M) > 1.0


def test_ctrl_c_ends_a_flight_keeps_it_and_is_restored_afterwards():
    def interrupt(count):
        if count == 60:
            signal.raise_signal(signal.SIGINT)

    panel = FakePanel(interrupt)
    before = signal.getsignal(signal.SIGINT)
    with flying(panel):
        recorded, used = fly(panel.samples(lambda: Sticks(up=1.0)), START_M, LABORATORY)
    assert len(used) in (60, 61)
    assert recorded.position_m[-1, 2] > 1.3
    assert signal.getsignal(signal.SIGINT) == before


# --- the package pyglet, whose modules are fakes here, whether it is installed or not


@pytest.fixture
def pyglet(monkeypatch):
    """Return a function that gives pyglet other modules, by name; None stands for one that cannot be imported."""

    def install(**changed):
        modules = {name: Mock() for name in ("app", "input", "shapes", "window")} | changed
        monkeypatch.setitem(sys.modules, "pyglet", modules.pop("pyglet", Mock()))
        for name, module in modules.items():
            if module is not None:
                # `isinstance` takes the fake for a module, as the annotations want.
                module.__class__ = ModuleType
            monkeypatch.setitem(sys.modules, f"pyglet.{name}", module)
        return modules

    return install


NO_WINDOW = RuntimeError('Cannot connect to "None"')
#: Name of the case -> device, modules of pyglet, and words of the line.
NOTHING_TO_FLY_WITH = {
    "no package": ("gamepad", {"pyglet": None}, "pyglet, found it is not installed; " + install_command("control")),
    "no controller": ("gamepad", {"input": Mock(**{"get_controllers.return_value": []})},
        "expected a game controller, found none; plug"),
    "no folder of devices": ("gamepad", {"input": Mock(**{"get_controllers.side_effect": OSError})},
        "found none; plug one in"),
    "no display": ("keyboard", {"window": None},
        "expected a display with OpenGL for the pilot's window, found import of pyglet.window"),
    "no window": ("keyboard", {"window": Mock(**{"Window.side_effect": NO_WINDOW})},
        "a display with OpenGL for the pilot's window, found Cannot connect to"),
}  # fmt: skip


@pytest.mark.parametrize("case", NOTHING_TO_FLY_WITH)
def test_a_missing_package_controller_or_display_is_one_line(case, pyglet, tmp_path):
    name, modules, words = NOTHING_TO_FLY_WITH[case]
    pyglet(**modules)
    device = open_device(name, LABORATORY)
    assert_refused(device.__enter__, f"device {name}: ", words, unchanged=tmp_path)


def test_the_keyboard_flies_in_a_window_that_shows_keys_and_position(pyglet):
    modules = pyglet()
    module = modules["window"]
    keys = defaultdict(bool)
    module.key.KeyStateHandler.return_value = keys
    window = module.Window.return_value
    window.has_exit = False

    def dispatch():
        keys[module.key.W] = window.dispatch_events.call_count > 5
        window.has_exit = window.dispatch_events.call_count > 40

    window.dispatch_events.side_effect = dispatch
    with open_device("keyboard", LABORATORY) as (samples, watch):
        _, used = fly(samples, START_M, LABORATORY, watch=watch)
    assert window.mock_calls[-1] == call.close()
    width, height = module.Window.call_args.args
    assert type(width) is type(height) is int
    assert window.flip.call_count == len(used) == 41
    title = window.set_caption.call_args_list[0].args[0]
    # The device uses the real clock, so the first time may be above 0.
    assert re.match(r"\d+\.\d s  x \+0\.00  y \+0\.00  z 1\.00 m  0\.00 m/s", title)
    assert piloting.KEYBOARD_HELP in title
    assert used[0].sticks == Sticks()
    assert used[-1].sticks == Sticks(forward=1.0)
    circles = modules["shapes"].Circle.call_args_list
    x, y = np.array([circle.args[:2] for circle in circles]).T
    assert np.diff(x).min() >= 0
    assert x[-1] - x[0] > 1
    assert np.ptp(y) == 0


# --- the command


def test_the_command_writes_a_flight_and_sticks_that_reproduce_it(run_psotrack, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_sticks(tmp_path / "script.csv", SCRIPT)
    common = ("simulate", "fly", "--start", "1,0,2", "--rate", "50", "--out")
    result = run_psotrack(*common, "new/loop.csv", "--device", "script.csv")
    assert (result.code, result.err) == (0, "")
    assert "new/loop.csv: 126 samples at 50 Hz, 2.5 s" in result.out
    assert 'flight = { kind = "recording", file = "new/loop.csv" }' in result.out
    recorded = read_recorded_flight(tmp_path / "new" / "loop.csv")
    np.testing.assert_array_equal(recorded.time_s, np.arange(126) / 50)
    np.testing.assert_array_equal(recorded.position_m[0], [1.0, 0.0, 2.0])
    again = run_psotrack(*common, "again.csv", "--device", "new/loop.sticks.csv", "--quiet")
    assert again == (0, "", "")
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "new" / "loop.csv").read_bytes()
