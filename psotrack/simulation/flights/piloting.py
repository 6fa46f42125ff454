"""Flying by hand: input devices, stick samples, and by the dynamics of a drone and its autopilot a recorded flight.

The flight depends only on the samples and their times, so the same samples give the same flight again.

The sticks are in mode 2, which most pilots know: the left stick controls climb and turn, the right stick controls
forward and sideways motion. Controllers and windows need pyglet, an extra (`pip install '.[control]'`) that is
imported at the first use.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError, install_command
from psotrack.simulation.flights.motion import GRAVITY_M_S2, MIN_SAMPLES, Recorded, attitude
from psotrack.simulation.world.rooms import HALLS
from psotrack.support import Column, TextRow, read_table, write_rows

#: Smallest distance from a wall to the body origin: half the size of a drone with rotors.
_CLEARANCE_M = 0.4
#: Height of the body origin of a drone that stands on the floor.
_ON_FLOOR_M = 0.15

Vector = Float[np.ndarray, "3"]


class Sticks(NamedTuple):
    """Positions of the sticks, each from -1 to 1, in the drone's own directions."""

    forward: float = 0.0
    left: float = 0.0
    up: float = 0.0
    turn: float = 0.0


@dataclass(frozen=True)
class Dynamics:
    """Parameters of a drone and its autopilot.

    Attributes:
        max_speed_m_s: largest horizontal speed.
        max_climb_m_s: largest vertical speed, up or down.
        max_turn_rad_s: largest rate of the heading.
        max_tilt_deg: largest angle between the thrust and the vertical.
        max_climb_m_s2: largest vertical acceleration by the thrust, without gravity.
        response_s: time in which the autopilot tries to reach the commanded velocity.
        lag_s: time constant of attitude, thrust and turning.
        drag_per_s: deceleration by drag, divided by the speed.
        braking_per_s: strength of braking near walls; braking from a speed v begins at the distance
            2 v / braking_per_s.
    """

    max_speed_m_s: float = 2.5
    max_climb_m_s: float = 1.2
    max_turn_rad_s: float = 1.5
    max_tilt_deg: float = 20.0
    max_climb_m_s2: float = 2.5
    response_s: float = 0.5
    lag_s: float = 0.1
    drag_per_s: float = 0.2
    braking_per_s: float = 3.0


#: Dynamics of a small drone in a hall.
DYNAMICS = Dynamics()


@dataclass(frozen=True)
class Space:
    """Box that the body origin stays in.

    Attributes:
        lower_m: (3,), lower corner, world.
        upper_m: (3,), upper corner, world.
    """

    lower_m: Vector
    upper_m: Vector


def flight_space(hall: str) -> Space:
    """Space in which a drone touches neither floor nor walls nor ceiling of a hall; furniture is ignored.

    Raises:
        SettingsError: no hall has this name.
    """
    if hall not in HALLS:
        raise SettingsError("hall", expected=f"one of {', '.join(HALLS)}", found=hall)
    length_m, width_m, height_m = HALLS[hall].size_m
    x_m, y_m = length_m / 2 - _CLEARANCE_M, width_m / 2 - _CLEARANCE_M
    return Space(np.array([-x_m, -y_m, _ON_FLOOR_M]), np.array([x_m, y_m, height_m - _CLEARANCE_M]))


@dataclass(frozen=True)
class FlightState:
    """State of a drone in flight.

    Attributes:
        position_m: (3,), world.
        velocity_m_s: (3,), world.
        push_m_s2: (3,), thrust divided by mass, without the part that carries the weight.
        yaw_rad: heading.
        turn_rad_s: rate of the heading, positive to the left.
    """

    position_m: Vector
    velocity_m_s: Vector
    push_m_s2: Vector
    yaw_rad: float = 0.0
    turn_rad_s: float = 0.0


def step(state: FlightState, sticks: Sticks, space: Space, step_s: float) -> FlightState:
    """State after one step with constant stick positions."""
    x_m, v_m_s = state.position_m, state.velocity_m_s
    # Forward and left at full deflection together are limited to the speed of one of them.
    level = DYNAMICS.max_speed_m_s / max(1.0, float(np.hypot(sticks.forward, sticks.left)))
    cos, sin = np.cos(state.yaw_rad), np.sin(state.yaw_rad)
    x, y = cos * sticks.forward - sin * sticks.left, sin * sticks.forward + cos * sticks.left
    commanded_m_s = np.array([level * x, level * y, DYNAMICS.max_climb_m_s * sticks.up])
    # The thrust compensates the drag at the commanded velocity; otherwise the drone would not reach this velocity.
    # The thrust is limited already here, because the second limit would weaken the braking of a too large command.
    push = _limit_thrust((commanded_m_s - v_m_s) / DYNAMICS.response_s + DYNAMICS.drag_per_s * commanded_m_s)
    braking, drag = DYNAMICS.braking_per_s, DYNAMICS.drag_per_s * v_m_s
    ends_m = (space.lower_m, space.upper_m)
    push = np.clip(push, *(braking * (braking * (end_m - x_m) - 2 * v_m_s) + drag for end_m in ends_m))
    follow = -np.expm1(-step_s / DYNAMICS.lag_s)
    push = state.push_m_s2 + follow * (_limit_thrust(push) - state.push_m_s2)
    turn = state.turn_rad_s + follow * (sticks.turn * DYNAMICS.max_turn_rad_s - state.turn_rad_s)
    v_m_s = v_m_s + step_s * (push - DYNAMICS.drag_per_s * v_m_s)
    x_m = x_m + step_s * v_m_s
    stopped_m = np.clip(x_m, space.lower_m, space.upper_m)
    v_m_s = np.where(stopped_m == x_m, v_m_s, 0.0)
    return FlightState(stopped_m, v_m_s, push, state.yaw_rad + step_s * turn, turn)


def _limit_thrust(push_m_s2: Vector) -> Vector:
    """Thrust within the limits that is nearest to a given thrust; the vertical part has priority.

    The possible thrusts are a convex set, so a mixture of two possible thrusts, as the lag makes, is possible too.
    """
    up = float(np.clip(push_m_s2[2], -DYNAMICS.max_climb_m_s2, DYNAMICS.max_climb_m_s2))
    level = float(np.hypot(push_m_s2[0], push_m_s2[1]))
    most = float(np.tan(np.radians(DYNAMICS.max_tilt_deg))) * (GRAVITY_M_S2 + up)
    share = min(1.0, most / level) if level > 0 else 1.0
    return np.array([share * push_m_s2[0], share * push_m_s2[1], up])


#: Smallest number of integration steps per second: several steps in each time constant of the dynamics.
_MIN_STEPS_HZ = 250.0
#: Rounding error of sample times, which come from divisions and clocks, as a share of a step.
_ROUNDING = 1e-6

_HEADER = ("time_s", *Sticks._fields)


class Sample(NamedTuple):
    """Stick positions from a time on, until the next sample."""

    time_s: float
    sticks: Sticks


def fly(
    samples: Iterable[Sample],
    start_m: Vector,
    space: Space,
    *,
    rate_hz: float = 25.0,
    max_s: float = np.inf,
    watch: Callable[[float, FlightState], None] = lambda time_s, state: None,
) -> tuple[Recorded, tuple[Sample, ...]]:
    """Simulate a flight that stick samples control, from hovering until the time of the last sample.

    Args:
        samples: samples of the sticks, with times that increase from 0; the iterator may wait for a person.
        start_m: (3,), position at time 0, where the drone hovers.
        space: space that the drone stays in.
        rate_hz: rate of the recorded flight; its times are exactly k / rate_hz.
        max_s: longest duration of the flight.
        watch: function that is called with the time of each sample and the state at that time.

    Returns:
        The recorded flight, and the samples of the sticks that made it.

    Raises:
        SettingsError: the start is outside the space, or the flight is too short to be replayed.
    """
    if not np.all((start_m >= space.lower_m) & (start_m <= space.upper_m)):
        lower, upper, start = (
            ", ".join(f"{value:g}" for value in point) for point in (space.lower_m, space.upper_m, start_m)
        )
        raise SettingsError("start", expected=f"a point from ({lower}) to ({upper})", found=f"({start})")
    per_record = int(np.ceil(_MIN_STEPS_HZ / rate_hz))
    step_s = 1 / (rate_hz * per_record)
    # At rest, and pointing along x.
    state, sticks, done = FlightState(start_m, np.zeros(3), np.zeros(3)), Sticks(), 0
    records: list[FlightState] = [state]
    used: list[Sample] = []
    for sample in samples:
        if sample.time_s >= max_s:
            sample = Sample(max_s, sticks)
        used.append(sample)
        due = int(sample.time_s / step_s + _ROUNDING)
        while done < due:
            state = step(state, sticks, space, step_s)
            done += 1
            if done % per_record == 0:
                records.append(state)
        sticks = sample.sticks
        watch(sample.time_s, state)
        if sample.time_s == max_s:
            break
    return _recorded(records, rate_hz), tuple(used)


def _recorded(states: list[FlightState], rate_hz: float) -> Recorded:
    if len(states) < MIN_SAMPLES:
        raise SettingsError("flight", expected=f"at least {MIN_SAMPLES} samples", found=f"{len(states)}")
    thrust = np.array([state.push_m_s2 for state in states]) + np.array([0.0, 0.0, GRAVITY_M_S2])
    rotation = attitude(thrust, np.array([state.yaw_rad for state in states]))
    return Recorded(
        np.arange(len(states)) / rate_hz,
        np.array([state.position_m for state in states]),
        Rotation.from_matrix(rotation).as_quat(scalar_first=True),
    )


# --- files


def read_sticks(path: Path) -> tuple[Sample, ...]:
    """Read stick samples: `time_s,forward,left,up,turn`, positions from -1 to 1 that hold until the next row.

    Raises:
        InputError: the file cannot be read, a column is missing, the times do not increase from 0, or a stick position
            is not from -1 to 1. The message names file, line and column.
    """
    table = read_table(path, ",")
    time_column, *stick_columns = (table.column(name) for name in _HEADER)
    samples: list[Sample] = []
    for row in table.rows:
        time_s = row.number(time_column)
        if time_s < 0 or (samples and time_s <= samples[-1].time_s):
            expected = f"a time above {samples[-1].time_s:g}" if samples else "a time of 0 or more"
            raise row.error(time_column, expected, row.text(time_column))
        samples.append(Sample(time_s, Sticks(*(_stick(row, column) for column in stick_columns))))
    return tuple(samples)


def write_sticks(path: Path, samples: Iterable[Sample]) -> None:
    """Write stick samples in the format of `read_sticks`, with all digits, so that they give the same flight again.

    Raises:
        OutputError: the file cannot be written.
    """
    write_rows(path, [_HEADER, *((sample.time_s, *sample.sticks) for sample in samples)], ",")


def _stick(row: TextRow, column: Column) -> float:
    value = row.number(column)
    if abs(value) > 1:
        raise row.error(column, "a number from -1 to 1", row.text(column))
    return value


#: Longer side of the hall in the window, its margin, the drone, and the line ahead of it, pixels.
_PLAN_PX, _MARGIN_PX, _DRONE_PX, _AHEAD_PX = 520, 30, 7, 24
_GREY, _WHITE, _ORANGE = (150, 150, 150, 255), (255, 255, 255, 255), (255, 170, 60, 255)
#: Half width of the range around the middle that counts as 0, because springs do not return sticks exactly to 0.
DEAD_ZONE = 0.12
#: Time between two readings of the sticks; the flight itself is integrated in finer steps.
_POLL_S = 1 / 60

GAMEPAD_HELP = "left stick: up, down, turn; right stick: forward, back, left, right; start, back or Esc: end"
KEYBOARD_HELP = "W S A D: forward, back, left, right; arrows: rise, sink, turn; Esc: end"
#: Stick positions that each key adds, by the key's name in pyglet.
KEYS: Mapping[str, Sticks] = {
    "W": Sticks(forward=1.0),
    "S": Sticks(forward=-1.0),
    "A": Sticks(left=1.0),
    "D": Sticks(left=-1.0),
    "UP": Sticks(up=1.0),
    "DOWN": Sticks(up=-1.0),
    "LEFT": Sticks(turn=1.0),
    "RIGHT": Sticks(turn=-1.0),
}

#: Stick samples as they come, and a function that shows the time and the state at each sample.
Device = tuple[Iterator[Sample], Callable[[float, FlightState], None]]


@contextlib.contextmanager
def _display(device: str) -> Iterator[None]:
    """Turn every error in this block into one for a machine that cannot open a window.

    pyglet has several classes of such errors, some of which cannot be imported without a display.
    """
    try:
        yield
    except Exception as error:
        raise SettingsError(
            f"device {device}",
            expected="a display with OpenGL for the pilot's window",
            found=f"{error}".partition("\n")[0] or type(error).__name__,
            remedy="run it on a desktop, or give a file of sticks as --device",
        ) from error


def pyglet_module(name: str, device: str) -> ModuleType:
    """Import a module of pyglet, such as `input`.

    Raises:
        SettingsError: pyglet is not installed, or there is no display with OpenGL, which pyglet needs.
    """
    try:
        importlib.import_module("pyglet")
    except ImportError as error:
        expected, found = "the package pyglet", "it is not installed"
        remedy = install_command("control")
        raise SettingsError(f"device {device}", expected=expected, found=found, remedy=remedy) from error
    with _display(device):
        return importlib.import_module(f"pyglet.{name}")


class Panel:
    """A window with the hall seen from above, whose title says where the drone is.

    Attributes:
        closed: whether the pilot has ended the flight.
    """

    def __init__(self, device: str, space: Space, words: str) -> None:
        app, self._shapes, window = (pyglet_module(name, device) for name in ("app", "shapes", "window"))
        self._space, self._words, self.closed = space, words, False
        sides_m = (space.upper_m - space.lower_m)[:2]
        self._px_per_m = _PLAN_PX / sides_m.max()
        self._plan_px = sides_m * self._px_per_m
        with _display(device):
            sides_px = (round(side) + 2 * _MARGIN_PX for side in self._plan_px.tolist())
            self._window = window.Window(*sides_px, caption=words, vsync=False)
        self._names, self._keys = window.key, window.key.KeyStateHandler()
        self._window.push_handlers(self._keys)
        self._loop = app.platform_event_loop
        self._loop.start()

    def end(self, *signal_and_frame: object) -> None:
        """End the flight with the next sample; also the handler of SIGINT."""
        self.closed = True

    def is_down(self, name: str) -> bool:
        """Whether the named key is pressed."""
        return self._keys[getattr(self._names, name)]

    def pump(self) -> None:
        """Process events of keys, sticks and the window."""
        self._loop.step(0.0)
        self._window.switch_to()
        self._window.dispatch_events()
        # Esc, or the window was closed.
        self.closed = self.closed or bool(self._window.has_exit)

    def draw(self, time_s: float, state: FlightState) -> None:
        """Draw the drone's state."""
        x, y, z = state.position_m
        speed = float(np.linalg.norm(state.velocity_m_s))
        self._window.set_caption(
            f"{time_s:.1f} s  x {x:+.2f}  y {y:+.2f}  z {z:.2f} m  {speed:.2f} m/s  ({self._words})"
        )
        self._window.clear()
        shapes, corner = self._shapes, np.full(2, float(_MARGIN_PX))
        shapes.Box(*corner, *self._plan_px, thickness=2, color=_GREY).draw()
        at = corner + (state.position_m - self._space.lower_m)[:2] * self._px_per_m
        ahead = at + _AHEAD_PX * np.array([np.cos(state.yaw_rad), np.sin(state.yaw_rad)])
        shapes.Line(*at, *ahead, thickness=3, color=_WHITE).draw()
        shapes.Circle(*at, _DRONE_PX, color=_ORANGE).draw()
        self._window.flip()

    def close(self) -> None:
        """Close the window."""
        self._window.close()
        self._loop.stop()


def poll(
    panel: Panel,
    sticks: Callable[[], Sticks],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Sample]:
    """Yield stick samples at 60 Hz, or as fast as the machine can; the last sample ends the flight.

    Args:
        panel: the pilot's window.
        sticks: gives the current positions of the sticks.
        clock: gives the time in seconds.
        sleep: waits for a number of seconds.
    """
    begin_s, polls = clock(), 0
    while True:
        panel.pump()
        yield Sample(clock() - begin_s, sticks())
        if panel.closed:
            return
        # Time is counted from the beginning of the flight, so that the time of drawing does not accumulate.
        polls = max(polls + 1, int((clock() - begin_s) / _POLL_S))
        sleep(max(0.001, polls * _POLL_S - (clock() - begin_s)))


@contextlib.contextmanager
def flying(panel: Panel) -> Iterator[Panel]:
    """Let Ctrl-C end the flight between two samples, as Esc does, so that it is kept; close the window at last."""
    with contextlib.closing(panel):
        handler = signal.signal(signal.SIGINT, panel.end)
        try:
            yield panel
        finally:
            signal.signal(signal.SIGINT, handler)


@contextlib.contextmanager
def open_device(name: str, space: Space) -> Iterator[Device]:
    """Open the device `gamepad` or `keyboard`, or a file in the format of `read_sticks`, for a `with` block.

    Args:
        name: name of the device, or path of the file.
        space: space of the flight, which the pilot's window shows.

    Raises:
        SettingsError: pyglet is not installed, no controller is connected, or there is no display.
        InputError: the file cannot be used.
    """
    if name == "gamepad":
        controller = _controller()
        controller.open()
        with contextlib.closing(controller), flying(Panel(name, space, GAMEPAD_HELP)) as panel:
            gamepad = Gamepad(controller, panel.end)
            yield poll(panel, lambda: gamepad.sticks), panel.draw
    elif name == "keyboard":
        with flying(Panel(name, space, KEYBOARD_HELP)) as panel:
            yield poll(panel, lambda: key_sticks(panel.is_down)), panel.draw
    elif Path(name).suffix:
        yield iter(read_sticks(Path(name))), lambda time_s, state: None
    else:
        raise SettingsError("device", expected="gamepad, keyboard, or a file of sticks (.csv)", found=name)


def key_sticks(is_down: Callable[[str], bool]) -> Sticks:
    """Sum of the stick positions of all pressed keys: a key moves a stick to its end."""
    down = [meaning for name, meaning in KEYS.items() if is_down(name)]
    return Sticks(*(sum(axis) for axis in zip(Sticks(), *down, strict=True)))


class Gamepad:
    """Sticks of a game controller with a layout that pyglet knows.

    Args:
        controller: the controller.
        end: called when the pilot presses start or back.

    Attributes:
        sticks: positions of both sticks, without their dead zones.
    """

    def __init__(self, controller: Any, end: Callable[[], None]) -> None:
        self.sticks, self._end = Sticks(), end
        # Events are used, because the sign of pyglet's polled values depends on the operating system.
        controller.push_handlers(on_stick_motion=self._move, on_button_press=self._press)

    def _move(self, controller: Any, stick: str, vector: tuple[float, float]) -> None:
        right, up = (_without_dead_zone(value) for value in vector)
        if stick == "leftstick":
            self.sticks = self.sticks._replace(up=up, turn=0.0 - right)
        elif stick == "rightstick":
            self.sticks = self.sticks._replace(forward=up, left=0.0 - right)

    def _press(self, controller: Any, button: str) -> None:
        if button in ("start", "back"):
            self._end()


def _without_dead_zone(value: float) -> float:
    """Position along one axis of a stick, 0 in the dead zone and continuous from there to both ends."""
    beyond = (abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE)
    return math.copysign(min(beyond, 1.0), value) if beyond > 0 else 0.0


def _controller() -> Any:
    """The first controller that is connected."""
    try:
        controllers = pyglet_module("input", "gamepad").get_controllers()
    except OSError:  # Linux without input devices does not even have their folder.
        controllers = []
    if controllers:
        return controllers[0]
    remedy = "plug one in, or use --device keyboard"
    raise SettingsError("device gamepad", expected="a game controller", found="none", remedy=remedy)
