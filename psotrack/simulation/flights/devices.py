"""Input devices for flying by hand: a game controller, the keyboard, or a file of stick positions.

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
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from psotrack.errors import SettingsError, install_command
from psotrack.simulation.flights.piloting import FlightState, Sample, Space, Sticks, read_sticks

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
