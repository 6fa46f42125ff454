"""Flying by hand, with scripted sticks, and with fakes of what pyglet gives: dynamics, limits, devices, the command."""

import re
import signal
import sys
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from psotrack import cli
from psotrack.errors import InputError, SettingsError
from psotrack.simulation import space_in
from psotrack.simulation.flights import devices
from psotrack.simulation.flights.devices import GamepadDevice, KeyboardDevice, ScriptedDevice, open_device
from psotrack.simulation.flights.dynamics import DYNAMICS, Space, Sticks
from psotrack.simulation.flights.motion import Heading
from psotrack.simulation.flights.piloting import Sample, fly, read_sticks, until, write_sticks
from psotrack.simulation.flights.recordings import read_recording, recorded_flight
from psotrack.simulation.scenarios import FlightFromFile

LABORATORY = space_in("laboratory")
OUTDOORS = Space(np.full(3, -1e6), np.full(3, 1e6))
START_M = np.array([0.0, 0.0, 1.0])
STEP_HZ = 250.0


def flown(*rows, space=LABORATORY, start_m=START_M, **settings):
    """What is recorded of rows of time and sticks."""
    samples = [Sample(float(time_s), Sticks(*sticks)) for time_s, *sticks in rows]
    return fly(samples, start_m, space, **settings).recorded


def derivatives(recorded):
    """Differences of a recording at the rate of the integration, in which velocities are exactly these."""
    velocity_m_s = np.diff(recorded.position_m, axis=0) * STEP_HZ
    return velocity_m_s, np.diff(velocity_m_s, axis=0) * STEP_HZ


def body(recorded):
    return Rotation.from_quat(recorded.orientation_wxyz, scalar_first=True).as_matrix()


# --- dynamics


def test_nobody_touches_the_sticks_and_the_drone_stays_where_it_is():
    recorded = flown((5,))
    np.testing.assert_array_equal(recorded.position_m, np.tile(START_M, (126, 1)))
    np.testing.assert_array_equal(recorded.orientation_wxyz, np.tile([1.0, 0, 0, 0], (126, 1)))


@pytest.mark.parametrize(
    ("sticks", "velocity_m_s"),
    [
        ((1, 0, 0, 0), (2.5, 0, 0)),
        ((-0.5, 0, 0, 0), (-1.25, 0, 0)),
        ((0, 1, 0, 0), (0, 2.5, 0)),
        ((0, 0, -1, 0), (0, 0, -1.2)),
        # Both axes at their ends are no faster than one.
        ((1, -1, 1, 0), (2.5 / np.sqrt(2), -2.5 / np.sqrt(2), 1.2)),
    ],
)
def test_sticks_at_their_ends_are_the_stated_speeds_in_the_end(sticks, velocity_m_s):
    recorded = flown((0, *sticks), (9.5,), space=OUTDOORS)
    # The slower of the two modes is exp(-3.1 t): of 2.5 m/s it leaves 4e-13 m/s.
    np.testing.assert_allclose(np.diff(recorded.position_m[-2:], axis=0)[0] * 25, velocity_m_s, atol=1e-11)


@pytest.mark.parametrize("rate_hz", [250.0, 1000.0])
def test_a_small_step_is_answered_like_the_linear_equations(rate_hz):
    """x' = v, v' = p - k v, p' = ((1 / T + k) w - v / T - p) / lag, by the matrix exponential."""
    recorded = flown((0, 0.2, 0, 0.3, 0), (2,), space=OUTDOORS, rate_hz=rate_hz)
    k, response_s, lag_s = DYNAMICS.drag_per_s, DYNAMICS.response_s, DYNAMICS.lag_s
    matrix = np.zeros((4, 4))
    matrix[0, 1] = 1.0
    matrix[1, 1:3] = -k, 1.0
    matrix[2, 1:] = np.array([-1 / response_s, -1.0, 1 / response_s + k]) / lag_s
    every = round(rate_hz / 50)
    solution = np.array([expm(matrix * time_s) for time_s in recorded.time_s[::every]])
    for axis, wished_m_s in ((0, 0.2 * 2.5), (2, 0.3 * 1.2)):
        true_m = START_M[axis] + solution[:, 0, 3] * wished_m_s
        # Of first order in the step: velocity and position are half a step early each, so up to one step times the
        # speed; measured 1.04 of it.
        assert np.abs(recorded.position_m[::every, axis] - true_m).max() < 1.1 * wished_m_s / rate_hz


def test_turning_reaches_the_stated_rate_and_takes_forward_with_it():
    recorded = flown((0, 0, 0, 0, 1), (4, 0, 0, 0, 0), (6, 0.2, 0, 0, 0), (9,), space=OUTDOORS, rate_hz=250.0)
    yaw_rad = np.unwrap(np.arctan2(body(recorded)[:, 1, 0], body(recorded)[:, 0, 0]))
    rate_rad_s = np.diff(yaw_rad) * STEP_HZ
    assert rate_rad_s.max() == pytest.approx(1.5, abs=1e-9)
    # First order: what it is late at the start, it goes on at the end.
    assert yaw_rad[-1] == pytest.approx(4 * 1.5, abs=1e-6)
    ahead = recorded.position_m[-1] - recorded.position_m[1500]
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), [np.cos(6.0), np.sin(6.0), 0.0], atol=1e-6)


def test_the_attitude_is_where_the_thrust_points():
    recorded = flown(
        (0, 1, 0.3, 0.5, 0.4), (1.2, -1, 0.5, -1, -1), (2.5, 0.2, -1, 1, 0), (4,), rate_hz=STEP_HZ
    )
    velocity_m_s, acceleration_m_s2 = derivatives(recorded)
    # Newton: what accelerates, carries, and works against drag, is the thrust. Semi-implicit: drag is that of before.
    thrust = acceleration_m_s2 + DYNAMICS.drag_per_s * velocity_m_s[:-1] + [0.0, 0.0, 9.81]
    along = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    # Differences of positions of some metres: 1e-15 times the rate squared.
    np.testing.assert_allclose(body(recorded)[2:, :, 2], along, atol=1e-9)
    assert np.degrees(np.arccos(along[:, 2])).max() > 15, "a flight that never tilts proves nothing"


STICKS = st.tuples(st.floats(0.05, 1.5), *[st.sampled_from([-1.0, 0.0, 1.0]) | st.floats(-1, 1)] * 4)


@settings(max_examples=15)
@given(st.lists(STICKS, min_size=2, max_size=5), st.tuples(*[st.floats(0, 1)] * 3))
def test_limits_hold_whatever_the_pilot_does_and_the_hall_holds_the_drone(holds, share):
    times_s = np.cumsum([0.0, *(hold[0] for hold in holds)])
    rows = [(time_s, *hold[1:]) for time_s, hold in zip(times_s, holds, strict=False)]
    start_m = LABORATORY.lower_m + share * (LABORATORY.upper_m - LABORATORY.lower_m)
    recorded = flown(*rows, (times_s[-1],), start_m=start_m, rate_hz=STEP_HZ)
    velocity_m_s, acceleration_m_s2 = derivatives(recorded)
    slack = 1e-6  # Of differences: 1e-15 m times the rate squared, and some.
    assert np.hypot(velocity_m_s[:, 0], velocity_m_s[:, 1]).max() <= DYNAMICS.max_speed_m_s + slack
    assert np.abs(velocity_m_s[:, 2]).max() <= DYNAMICS.max_climb_m_s + slack
    assert np.linalg.norm(acceleration_m_s2, axis=1).max() <= DYNAMICS.max_acceleration_m_s2 + slack
    assert np.degrees(np.arccos(body(recorded)[:, 2, 2].clip(-1, 1)).max()) <= DYNAMICS.max_tilt_deg + slack
    assert np.all((recorded.position_m >= LABORATORY.lower_m) & (recorded.position_m <= LABORATORY.upper_m))


@pytest.mark.parametrize(
    ("sticks", "axis", "end_m"),
    [((1, 0, 0, 0), 0, 4.6), ((0, -1, 0, 0), 1, -3.6), ((0, 0, 1, 0), 2, 3.6), ((0, 0, -1, 0), 2, 0.15)],
)
def test_walls_floor_and_ceiling_stop_it_gently(sticks, axis, end_m):
    recorded = flown((0, *sticks), (8,), rate_hz=STEP_HZ)
    velocity_m_s, acceleration_m_s2 = derivatives(recorded)
    # It comes to rest where braking balances the sticks that still push: 0.1 m away at most.
    assert abs(recorded.position_m[-1, axis] - end_m) < 0.1
    assert np.abs(velocity_m_s[-1]).max() < 1e-3
    assert np.abs(acceleration_m_s2).max() < DYNAMICS.max_acceleration_m_s2


def test_braking_is_not_scaled_away_with_a_wish_that_is_beyond_the_tilt():
    """This pilot once hit the wall at y = 3.6 with 34 m/s^2, because full sticks along x took the thrust to brake."""
    pilot = [
        *((0, -1, -1, -1), (-1, -1, -1, 1), (0, 1, 0, 0), (1, 1, 0, 0), (0, 1, -1, 1)),
        *((1, -1, 0, 1), (0, -1, 1, 1), (1, -1, -1, 1), (-1, 0, -1, -1)),
    ]
    recorded = flown(*((0.655 * k, *sticks) for k, sticks in enumerate(pilot)), (6,), rate_hz=STEP_HZ)
    assert recorded.position_m[:, 1].max() > 3.4, "this one was to come near the wall"
    acceleration_m_s2 = derivatives(recorded)[1]
    assert np.linalg.norm(acceleration_m_s2, axis=1).max() < DYNAMICS.max_acceleration_m_s2


def test_a_wall_stops_even_a_drone_that_does_not_brake():
    reckless = replace(DYNAMICS, braking_per_s=100.0)
    recorded = flown((0, 1, 0.2, 0, 0), (6,), dynamics=reckless, rate_hz=STEP_HZ)
    assert derivatives(recorded)[1][:, 0].min() < -50, "this one was to hit the wall"
    assert recorded.position_m[:, 0].max() == LABORATORY.upper_m[0]
    # Along the wall it goes on.
    assert np.diff(recorded.position_m[-2:, 1])[0] > 0


def test_the_same_sticks_are_the_same_flight_however_often_they_are_sampled():
    held = [(0, 1, 0.3, 0.1, 0.5), (1.0, -0.4, 1, 0, -1), (2.7, 0, 0, 0.6, 0), (4,)]
    often = [
        (time_s, *held[int(np.searchsorted([1.0, 2.7], time_s, "right"))][1:])
        for time_s in np.arange(400) / 100
    ]
    once = flown(*held)
    for other in (flown(*held), flown(*often, (4,))):
        np.testing.assert_array_equal(other.position_m, once.position_m)
        np.testing.assert_array_equal(other.orientation_wxyz, once.orientation_wxyz)


@pytest.mark.parametrize("rate_hz", [5.0, 50.0, 125.0])
def test_rates_that_divide_the_step_record_the_same_flight(rate_hz):
    rows = [(0, 1, 0.3, 0.1, 0.5), (1.0, -0.4, 1, 0, -1), (2.4,)]
    fine, coarse = flown(*rows, rate_hz=STEP_HZ), flown(*rows, rate_hz=rate_hz)
    every = round(STEP_HZ / rate_hz)
    np.testing.assert_array_equal(coarse.position_m, fine.position_m[::every])
    np.testing.assert_array_equal(coarse.time_s, np.arange(round(2.4 * rate_hz) + 1) / rate_hz)


@pytest.mark.parametrize("end_s", [1.4, 1.64, 2.28])
def test_a_last_time_that_rounds_to_before_its_step_is_recorded(end_s):
    assert int(end_s / (1 / 250)) < round(end_s * 250), "rounding that does no harm"
    assert flown((0, 1, 0, 0, 0), (end_s,)).time_s[-1] == end_s


def test_a_rate_that_divides_nothing_has_its_own_times_and_the_same_flight():
    rows = [(0, 1, 0.3, 0.1, 0.5), (1.0, -0.4, 1, 0, -1), (3.0,)]
    recorded, fine = flown(*rows, rate_hz=29.97), flown(*rows, rate_hz=STEP_HZ)
    np.testing.assert_array_equal(recorded.time_s, np.arange(90) / 29.97)
    there_m = np.array([np.interp(recorded.time_s, fine.time_s, x) for x in fine.position_m.T]).T
    # Sticks are heard at a step, here every 3.7 instead of 4 ms: 3.7 ms later at most, which is 3.5 m/s times that.
    assert np.abs(recorded.position_m - there_m).max() < 0.013


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (
            {"start_m": np.array([0.0, 0.0, 4.0])},
            "start: expected a point from (-4.6, -3.6, 0.15) to (4.6, 3.6, 3.6)",
        ),
        ({"start_m": np.array([0.0, np.nan, 1.0])}, "found (0, nan, 1)"),
        ({"rate_hz": 0.0}, "rate: expected a number above 0, found 0"),
        ({"rate_hz": float("nan")}, "rate: expected a number above 0, found nan"),
    ],
)
def test_a_flight_that_cannot_start_is_refused(change, complaint):
    with pytest.raises(SettingsError, match=re.escape(complaint)):
        flown((0, 1), (2,), **change)


def test_sticks_must_move_forward_in_time_and_a_flight_must_last():
    with pytest.raises(SettingsError, match=r"^sticks: expected a time after 1 s, found 1 s$"):
        flown((0, 1), (1, 0), (1, 1))
    with pytest.raises(SettingsError, match=r"^recording: expected at least 6 samples, found 4$"):
        flown((0, 1), (0.13,))


def test_a_flight_that_lasts_too_long_ends_on_time():
    samples = [Sample(0.0, Sticks(1.0)), Sample(1.0, Sticks(0.5)), Sample(2.0, Sticks())]
    assert list(until(samples, 1.5)) == [*samples[:2], Sample(1.5, Sticks(0.5))]
    assert list(until(samples, 3.0)) == samples


def test_what_was_flown_replays_as_it_was(tmp_path):
    """Through the file and its spline: the flight between its samples too."""
    rows = [(0, 1, 0.3, 0.1, 0.5), (0.9, -0.4, 1, 0, -1), (1.8, 0, 0, 0.6, 0), (2.5, 1, -1, -1, 0.3), (4,)]
    record(tmp_path / "loop.csv", rows)
    replay = recorded_flight(FlightFromFile(file=str(tmp_path / "loop.csv")), Heading(1.0))
    fine = flown(*rows, rate_hz=STEP_HZ)
    assert np.all(np.diff(fine.position_m, axis=0).any(axis=1)), "a flight that stands still proves nothing"
    np.testing.assert_allclose(replay.position_m(fine.time_s[::10]), fine.position_m[::10], atol=1e-12)
    # Sticks that jump make jerk that jumps by 60 m/s^3 or so; h^3 / 60 of it, measured 0.03 mm.
    assert np.abs(replay.position_m(fine.time_s) - fine.position_m).max() < 1e-4
    turned = Rotation.from_matrix(np.swapaxes(body(fine), -1, -2) @ replay.rotation(fine.time_s)).magnitude()
    # Then the tilt's rate jumps too, by up to 7 rad/s: a quarter of that times 40 ms between samples.
    assert np.degrees(turned).max() < 4.0
    assert np.degrees(turned[::10]).max() < 1e-6


def record(path, rows):
    from psotrack.simulation import write_recording

    recorded = flown(*rows)
    write_recording(path, recorded.time_s, recorded.position_m, recorded.orientation_wxyz)


# --- sticks on disk

SCRIPT = (Sample(0.0, Sticks(1.0, -0.5, 0.1, 0.0)), Sample(1 / 3, Sticks(turn=-1.0)), Sample(2.5, Sticks()))


def test_sticks_read_back_as_they_were_written(tmp_path):
    write_sticks(tmp_path / "s.csv", SCRIPT)
    assert read_sticks(tmp_path / "s.csv") == SCRIPT
    assert list(open_device(str(tmp_path / "s.csv"), LABORATORY).samples()) == list(SCRIPT)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("-0.5", "-1.5", "line 2, column left: expected a number from -1 to 1, found -1.5"),
        ("-0.5", "west", "line 2, column left: expected a number, found 'west'"),
        ("-0.5", "nan", "line 2, column left: expected a finite number, found 'nan'"),
        ("2.5", "0.2", "line 4, column time_s: expected a time above 0.333333, found 0.2"),
        ("0.0,1.0", "-1,1.0", "line 2, column time_s: expected a time of 0 or more, found -1"),
        ("turn", "roll", "expected a column turn, found only time_s, forward, left, up, roll"),
    ],
)
def test_broken_sticks_are_named_by_file_line_and_column(tmp_path, old, new, complaint):
    write_sticks(tmp_path / "s.csv", SCRIPT)
    text = (tmp_path / "s.csv").read_text()
    (tmp_path / "s.csv").write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=re.escape(complaint)) as error:
        read_sticks(tmp_path / "s.csv")
    assert "s.csv" in str(error.value)


# --- devices


@dataclass
class FakePanel:
    """A window that closes after some events, on a clock that only sleeping moves."""

    lasts: int = 10**9
    now_s: float = 100.0
    shown: list = field(default_factory=list)
    gone: bool = False
    on_pump: object = None

    @property
    def closed(self):
        return self.lasts <= 0

    def pump(self):
        self.lasts -= 1
        self.now_s += 1e-4
        if self.on_pump:
            self.on_pump()

    def draw(self, time_s, state):
        self.shown.append((time_s, state.position_m))

    def close(self):
        self.gone = True

    def sleep(self, seconds):
        assert seconds > 0
        self.now_s += seconds

    def timing(self):
        return {"clock": lambda: self.now_s, "sleep": self.sleep}


class FakeController:
    """What devices use of `pyglet.input.Controller`; y is up in its events."""

    def __init__(self):
        self.handlers, self.open_now = {}, True

    def push_handlers(self, **handlers):
        self.handlers |= handlers

    def move(self, stick, x, y):
        self.handlers["on_stick_motion"](self, stick, (x, y))

    def press(self, button):
        self.handlers["on_button_press"](self, button)

    def close(self):
        self.open_now = False


@pytest.mark.parametrize(
    ("keys", "sticks"),
    [
        ("", Sticks()),
        ("W", Sticks(forward=1.0)),
        ("S D", Sticks(forward=-1.0, left=-1.0)),
        ("A UP LEFT", Sticks(left=1.0, up=1.0, turn=1.0)),
        ("DOWN RIGHT", Sticks(up=-1.0, turn=-1.0)),
        ("W S A D UP DOWN LEFT RIGHT", Sticks()),
    ],
)
def test_keys_are_sticks_at_their_ends_and_opposite_keys_cancel(keys, sticks):
    assert KeyboardDevice(FakePanel(), lambda name: name in keys.split()).sticks() == sticks


def test_a_controller_is_flown_in_mode_2():
    pad = FakeController()
    device = GamepadDevice(FakePanel(), pad)
    pad.move("leftstick", 1.0, 0.0)
    assert device.sticks() == Sticks(turn=-1.0)
    pad.move("leftstick", 0.0, -1.0)
    pad.move("rightstick", -1.0, 1.0)
    assert device.sticks() == Sticks(forward=1.0, left=1.0, up=-1.0)


@pytest.mark.parametrize(
    ("raw", "live"),
    [(0.0, 0.0), (0.11, 0.0), (-0.12, 0.0), (0.56, 0.5), (-0.56, -0.5), (1.0, 1.0), (-1.01, -1.0)],
)
def test_sticks_rest_within_the_dead_zone_and_reach_their_ends(raw, live):
    pad = FakeController()
    device = GamepadDevice(FakePanel(), pad)
    pad.move("rightstick", 0.0, raw)
    assert device.sticks().forward == pytest.approx(live, abs=1e-12)


def test_a_live_flight_is_sampled_at_60_hz_shown_and_the_same_when_its_sticks_fly_again():
    panel, pad = FakePanel(), FakeController()

    def pilot():
        moves = {-30: ("leftstick", -0.6, 1.0), -90: ("rightstick", 0.2, 0.9), -200: ("leftstick", 0.0, 0.0)}
        if panel.lasts - 10**9 in moves:
            pad.move(*moves[panel.lasts - 10**9])
        if panel.lasts - 10**9 == -241:
            pad.press("a")
            pad.press("start")

    panel.on_pump = pilot
    with GamepadDevice(panel, pad, **panel.timing()) as device:
        live = fly(device.samples(), START_M, LABORATORY, watch=device.watch)
    assert not pad.open_now
    assert panel.gone
    times_s = np.array([sample.time_s for sample in live.samples])
    assert len(times_s) == 241
    # Drawing takes time off the sleep: the rate is kept.
    np.testing.assert_allclose(np.diff(times_s), 1 / 60, atol=2e-4)
    assert live.recorded.time_s[-1] == 4.0
    assert [time_s for time_s, _ in panel.shown] == list(times_s)
    np.testing.assert_allclose(panel.shown[-1][1], live.recorded.position_m[-1], atol=0.05)
    again = fly(ScriptedDevice(live.samples).samples(), START_M, LABORATORY)
    np.testing.assert_array_equal(again.recorded.position_m, live.recorded.position_m)
    assert np.linalg.norm(live.recorded.position_m[-1] - START_M) > 1.0


def test_a_slow_machine_samples_less_often_but_keeps_the_time():
    panel = FakePanel(lasts=20)
    panel.on_pump = lambda: panel.sleep(0.1)
    device = KeyboardDevice(panel, lambda name: name == "W", **panel.timing())
    samples = list(device.samples())
    assert len(samples) == 20
    assert samples[-1].time_s == pytest.approx(2.0, rel=0.2)
    assert np.all(np.diff([sample.time_s for sample in samples]) > 0.1)


def test_samples_that_a_stall_cost_are_not_made_up_for():
    panel = FakePanel(lasts=60)
    panel.on_pump = lambda: panel.sleep(1.0 if panel.lasts == 50 else 1e-4)
    device = KeyboardDevice(panel, lambda name: name == "W", **panel.timing())
    gaps_s = np.diff([sample.time_s for sample in device.samples()])
    assert gaps_s.max() > 0.99
    # The next two may come early, to be back in step; sixty were missed.
    assert np.count_nonzero(gaps_s < 1 / 60 - 3e-4) <= 2


def test_ctrl_c_ends_a_flight_with_what_was_flown_and_is_itself_again_afterwards():
    panel = FakePanel()
    panel.on_pump = lambda: panel.lasts == 10**9 - 60 and signal.raise_signal(signal.SIGINT)
    before = signal.getsignal(signal.SIGINT)
    with KeyboardDevice(panel, lambda name: name == "UP", **panel.timing()) as device:
        live = fly(device.samples(), START_M, LABORATORY)
    assert len(live.samples) in (60, 61)
    assert live.recorded.position_m[-1, 2] > 1.3
    assert signal.getsignal(signal.SIGINT) == before


# --- pyglet, or a package that pretends to be it


@pytest.fixture
def pyglet(tmp_path, monkeypatch):
    """A function that puts modules in the place of pyglet's, whether that is installed or not."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "pyglet"]:
        monkeypatch.delitem(sys.modules, name)
    folder = tmp_path / "site" / "pyglet"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(str(folder.parent))

    def put(**modules):
        for name, text in modules.items():
            (folder / f"{name}.py").write_text(text)

    yield put
    for name in [name for name in sys.modules if name.partition(".")[0] == "pyglet"]:
        del sys.modules[name]


@pytest.mark.parametrize("name", ["gamepad", "keyboard"])
def test_without_pyglet_the_way_to_install_it_is_shown(name, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyglet", None)
    sentence = f"device {name}: expected the package pyglet, found it is not installed; pip install 'psotrack[control]'"
    with pytest.raises(SettingsError, match=f"^{re.escape(sentence)}$"):
        open_device(name, LABORATORY)


@pytest.mark.parametrize(
    "code", ["def get_controllers(): return []", "import os\ndef get_controllers(): os.listdir('/no/dev')"]
)
def test_without_a_controller_one_is_asked_for(code, pyglet):
    pyglet(input=code)
    with pytest.raises(
        SettingsError, match=r"^device gamepad: expected a game controller, found none; plug one in"
    ):
        open_device("gamepad", LABORATORY)


def test_without_a_display_there_is_one_clear_line(pyglet):
    pyglet(app="", shapes="", text="", window="raise RuntimeError('Cannot connect to \"None\"')")
    sentence = (
        "device keyboard: expected a display with OpenGL for the pilot's window, found Cannot connect to"
    )
    with pytest.raises(SettingsError, match=f"^{re.escape(sentence)}"):
        open_device("keyboard", LABORATORY)


def test_a_word_that_is_no_device_is_refused():
    with pytest.raises(
        SettingsError, match=r"^device: expected gamepad, keyboard, or a file .*, found joystick$"
    ):
        open_device("joystick", LABORATORY)


WINDOW = """
from types import SimpleNamespace

key = SimpleNamespace(W=1, S=2, A=3, D=4, UP=5, DOWN=6, LEFT=7, RIGHT=8)
log = []

class KeyStateHandler(dict):
    def __getitem__(self, name):
        return self.get(name, False)

key.KeyStateHandler = KeyStateHandler

class Window:
    has_exit = False
    count = 0

    def __init__(self, width, height, caption, vsync):
        assert isinstance(width, int) and isinstance(height, int)
        log.append("open")

    def push_handlers(self, keys):
        self.keys = keys

    def dispatch_events(self):
        self.count += 1
        self.keys[key.W] = self.count > 5
        self.has_exit = self.count > 40

    def switch_to(self): pass
    def clear(self): log.append("clear")
    def flip(self): log.append("flip")
    def close(self): log.append("close")
"""
DRAWN = """
from pyglet.window import log

class Shape:
    def __init__(self, *arguments, **options):
        self.arguments = arguments

    def draw(self):
        log.append((type(self).__name__, *self.arguments))
"""


def test_the_keyboard_flies_in_a_window_that_shows_keys_and_place(pyglet):
    kinds = "".join(f"\nclass {name}(Shape): pass\n" for name in ("Box", "Line", "Circle", "Rectangle"))
    pyglet(
        app="class platform_event_loop:\n    start = stop = lambda *ignored: None\n    step = lambda timeout: None\n",
        window=WINDOW,
        shapes=DRAWN + kinds,
        text=DRAWN + "\nclass Label(Shape): pass\n",
    )
    with open_device("keyboard", LABORATORY) as device:
        live = fly(device.samples(), START_M, LABORATORY, watch=device.watch)
    log = sys.modules["pyglet.window"].log
    assert log[0] == "open"
    assert log[-1] == "close"
    assert log.count("flip") == len(live.samples) == 41
    texts = [entry[1] for entry in log if entry[0] == "Label"]
    assert texts[1:4] == list(devices.KEYBOARD_HELP)
    # The clock is a real one here: it may be later than 0.
    assert re.fullmatch(r" +\d+\.\d s   x \+0\.00   y \+0\.00   z 1\.00 m   0\.00 m/s     0 deg", texts[0])
    assert live.samples[0].sticks == Sticks()
    assert live.samples[-1].sticks == Sticks(forward=1.0)
    places = np.array([entry[1:3] for entry in log if entry[0] == "Circle"])
    assert np.all(np.diff(places[:, 0]) >= 0)
    assert places[-1, 0] - places[0, 0] > 1
    assert np.ptp(places[:, 1]) == 0


# --- the command


@pytest.fixture
def run(monkeypatch, capfd, tmp_path):
    """Runs `psotrack fly` in this process, in an empty folder with a script of sticks."""
    monkeypatch.chdir(tmp_path)
    write_sticks(tmp_path / "script.csv", SCRIPT)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["psotrack", "fly", *arguments])
        capfd.readouterr()
        try:
            cli.main()
            code = 0
        except SystemExit as stop:
            code = int(stop.code or 0)
        return SimpleNamespace(code=code, **capfd.readouterr()._asdict())

    return call


def test_the_command_writes_a_recording_and_its_sticks_which_fly_it_again(run, tmp_path):
    answer = run("--out", "new/loop.csv", "--device", "script.csv", "--start", "1,0,2", "--rate", "50")
    assert answer.code == 0
    assert answer.err == ""
    assert "new/loop.csv: 126 samples at 50 Hz, 2.5 s" in answer.out
    assert 'flight = { kind = "recording", file = "new/loop.csv" }' in answer.out
    recorded = read_recording(tmp_path / "new" / "loop.csv")
    np.testing.assert_array_equal(recorded.time_s, np.arange(126) / 50)
    np.testing.assert_array_equal(recorded.position_m[0], [1.0, 0.0, 2.0])
    again = run(
        *(
            "--out",
            "again.csv",
            "--device",
            "new/loop.sticks.csv",
            "--start",
            "1,0,2",
            "--rate",
            "50",
            "--quiet",
        )
    )
    assert again == SimpleNamespace(code=0, out="", err="")
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "new" / "loop.csv").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--device", "none.csv"), "none.csv: expected a file to read, found no such file or directory"),
        (("--device", "script.csv", "--hall", "barn"), "hall: expected one of laboratory"),
        (("--device", "script.csv", "--start", "9,0,1"), "start: expected a point from"),
        (("--device", "joystick"), "device: expected gamepad, keyboard, or a file"),
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_is_written(run, tmp_path, arguments, complaint):
    answer = run("--out", "loop.csv", *arguments)
    assert answer.code == 2
    assert complaint in answer.err
    assert answer.err.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["script.csv"]


@pytest.mark.parametrize("there", ["loop.csv", "loop.sticks.csv"])
def test_what_is_there_is_kept_unless_forced(run, tmp_path, there):
    (tmp_path / there).write_text("mine")
    answer = run("--out", "loop.csv", "--device", "script.csv")
    assert answer.code == 2
    assert re.fullmatch(
        rf"psotrack: {there}: expected a path that does not exist yet, found an existing file; pass --force .*\n",
        answer.err,
    )
    assert (tmp_path / there).read_text() == "mine"
    assert run("--out", "loop.csv", "--device", "script.csv", "--force").code == 0
    assert (tmp_path / there).read_text() != "mine"


def test_a_long_script_is_cut(run, tmp_path):
    assert run("--out", "loop.csv", "--device", "script.csv", "--max-seconds", "1").code == 0
    assert read_recording(tmp_path / "loop.csv").time_s[-1] == 1.0
