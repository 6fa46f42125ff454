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
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from psotrack.errors import SettingsError, install_command
from psotrack.simulation.flights.piloting import FlightState, Sample, Space, Sticks, read_sticks

_PLAN_PX = 520
_MARGIN_PX = 30
_LINE_PX = 20
#: Width of the column beside the plan that shows the height.
_HEIGHT_PX = 40
_DRONE_PX = 7
_AHEAD_PX = 24

_GREY = (150, 150, 150, 255)
_WHITE = (255, 255, 255, 255)
_ORANGE = (255, 170, 60, 255)


def pyglet_module(name: str, device: str) -> ModuleType:
    """Import a module of pyglet, such as `input`.

    Raises:
        SettingsError: pyglet is not installed, or there is no display with OpenGL, which pyglet needs.
    """
    try:
        importlib.import_module("pyglet")
    except ImportError as error:
        raise SettingsError(
            f"device {device}",
            expected="the package pyglet",
            found="it is not installed",
            remedy=install_command("control"),
        ) from error
    try:
        return importlib.import_module(f"pyglet.{name}")
    # The import opens a display, and the classes of its errors cannot be imported before.
    except Exception as error:
        raise _no_display(device, error) from error


def _no_display(device: str, error: Exception) -> SettingsError:
    """Error for a machine that cannot open a window."""
    return SettingsError(
        f"device {device}",
        expected="a display with OpenGL for the pilot's window",
        found=f"{error}".partition("\n")[0] or type(error).__name__,
        remedy="run it on a desktop, or give a file of sticks as --device",
    )


class Panel:
    """A window with the hall seen from above."""

    def __init__(self, device: str, space: Space, help_lines: tuple[str, ...]) -> None:
        self._pyglet = {name: pyglet_module(name, device) for name in ("app", "shapes", "text", "window")}
        self._space = space
        length_m, width_m = (space.upper_m - space.lower_m)[:2]
        self._px_per_m = _PLAN_PX / max(length_m, width_m)
        self._plan_px = np.array([length_m, width_m]) * self._px_per_m
        self._text_px = _LINE_PX * (len(help_lines) + 1)
        extra_px = np.array([_MARGIN_PX + _HEIGHT_PX, _MARGIN_PX + self._text_px])
        size_px = self._plan_px + extra_px + 2 * _MARGIN_PX
        window = self._pyglet["window"]
        try:
            self._window = window.Window(
                *(round(side) for side in size_px), caption="psotrack simulate fly", vsync=False
            )
        # pyglet has different classes for a missing display and for screens without OpenGL.
        except Exception as error:
            raise _no_display(device, error) from error
        self._keys = window.key.KeyStateHandler()
        self._window.push_handlers(self._keys)
        self._pyglet["app"].platform_event_loop.start()
        self._help_lines = help_lines

    @property
    def closed(self) -> bool:
        """Whether the pilot pressed Esc or closed the window."""
        return bool(self._window.has_exit)

    def is_down(self, name: str) -> bool:
        """Whether the named key is pressed."""
        return self._keys[getattr(self._pyglet["window"].key, name)]

    def pump(self) -> None:
        """Process events of keys, sticks and the window."""
        self._pyglet["app"].platform_event_loop.step(0.0)
        self._window.switch_to()
        self._window.dispatch_events()

    def draw(self, time_s: float, state: FlightState) -> None:
        """Draw the drone's state."""
        x, y, z = state.position_m
        speed = float(np.linalg.norm(state.velocity_m_s))
        yaw_deg = np.degrees(state.yaw_rad) % 360
        now = (
            f"{time_s:6.1f} s   x {x:+.2f}   y {y:+.2f}   z {z:.2f} m   {speed:.2f} m/s   {yaw_deg:3.0f} deg"
        )
        self._window.clear()
        for row, (line, colour) in enumerate([(now, _WHITE), *((line, _GREY) for line in self._help_lines)]):
            height_px = _MARGIN_PX + self._text_px - row * _LINE_PX
            label = self._pyglet["text"].Label(line, x=_MARGIN_PX, y=height_px, font_size=11, color=colour)
            label.draw()
        self._draw_plan(state)
        self._window.flip()

    def _draw_plan(self, state: FlightState) -> None:
        shapes = self._pyglet["shapes"]
        corner = np.array([_MARGIN_PX, 2 * _MARGIN_PX + self._text_px], float)
        shapes.Box(*corner, *self._plan_px, thickness=2, color=_GREY).draw()
        at = corner + (state.position_m - self._space.lower_m)[:2] * self._px_per_m
        ahead = at + _AHEAD_PX * np.array([np.cos(state.yaw_rad), np.sin(state.yaw_rad)])
        shapes.Line(*at, *ahead, thickness=3, color=_WHITE).draw()
        shapes.Circle(*at, _DRONE_PX, color=_ORANGE).draw()
        left, bottom = corner[0] + self._plan_px[0] + _MARGIN_PX, corner[1]
        shapes.Box(left, bottom, _HEIGHT_PX, self._plan_px[1], thickness=2, color=_GREY).draw()
        height_m = self._space.upper_m[2] - self._space.lower_m[2]
        share = float((state.position_m[2] - self._space.lower_m[2]) / height_m)
        shapes.Rectangle(left, bottom + share * self._plan_px[1] - 2, _HEIGHT_PX, 4, color=_ORANGE).draw()

    def close(self) -> None:
        """Close the window."""
        self._window.close()
        self._pyglet["app"].platform_event_loop.stop()


#: Half width of the range around the middle that counts as 0, because springs do not return sticks exactly to 0.
DEAD_ZONE = 0.12
#: Time between two readings of the sticks; the flight itself is integrated in finer steps.
_POLL_S = 1 / 60

GAMEPAD_HELP = (
    "left stick: up, down, turn",
    "right stick: forward, back, left, right",
    "start, back or Esc: end",
)
KEYBOARD_HELP = (
    "W S: forward, back      A D: left, right",
    "arrows up, down: rise, sink      arrows left, right: turn",
    "Esc: end",
)
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


@dataclass(frozen=True)
class Script:
    """Stick samples from a file; the flight ends at the time of the last sample, and nothing is shown."""

    script: tuple[Sample, ...]

    def samples(self) -> Iterator[Sample]:
        """Yield all samples without waiting."""
        return iter(self.script)

    def watch(self, time_s: float, state: FlightState) -> None:
        """Do nothing: there is no window."""


class Pilot:
    """A person with a window, who moves sticks that are read at 60 Hz of the wall clock.

    Args:
        panel: the pilot's window.
        sticks: gives the current positions of the sticks.
        clock: gives the time in seconds.
        sleep: waits for a number of seconds.
    """

    def __init__(
        self,
        panel: Panel,
        sticks: Callable[[], Sticks],
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._panel, self._sticks, self._clock, self._sleep = panel, sticks, clock, sleep
        self._stopped = False

    def stop(self, *signal_and_frame: object) -> None:
        """End the flight with the next sample; also the handler of SIGINT."""
        self._stopped = True

    @contextlib.contextmanager
    def flying(self) -> Iterator[Pilot]:
        """Let Ctrl-C end the flight between two samples, as Esc does, so that it is kept; close the window at last."""
        with contextlib.closing(self._panel):
            handler = signal.signal(signal.SIGINT, self.stop)
            try:
                yield self
            finally:
                signal.signal(signal.SIGINT, handler)

    def samples(self) -> Iterator[Sample]:
        """Yield stick samples at 60 Hz, or as fast as the machine can; the last sample ends the flight."""
        begin_s = self._clock()
        polls = 0
        while True:
            self._panel.pump()
            yield Sample(self._clock() - begin_s, self._sticks())
            if self._stopped or self._panel.closed:
                return
            # Time is counted from the beginning of the flight, so that the time of drawing does not accumulate.
            polls = max(polls + 1, int((self._clock() - begin_s) / _POLL_S))
            self._sleep(max(0.001, polls * _POLL_S - (self._clock() - begin_s)))

    def watch(self, time_s: float, state: FlightState) -> None:
        """Show the drone's state to the pilot."""
        self._panel.draw(time_s, state)


@contextlib.contextmanager
def open_device(name: str, space: Space) -> Iterator[Script | Pilot]:
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
        with contextlib.closing(controller):
            gamepad = Gamepad(controller)
            pilot = Pilot(Panel(name, space, GAMEPAD_HELP), gamepad.sticks)
            gamepad.on_end = pilot.stop
            with pilot.flying():
                yield pilot
    elif name == "keyboard":
        panel = Panel(name, space, KEYBOARD_HELP)
        with Pilot(panel, lambda: key_sticks(panel.is_down)).flying() as pilot:
            yield pilot
    elif Path(name).suffix:
        yield Script(read_sticks(Path(name)))
    else:
        raise SettingsError("device", expected="gamepad, keyboard, or a file of sticks (.csv)", found=name)


def key_sticks(is_down: Callable[[str], bool]) -> Sticks:
    """Sum of the stick positions of all pressed keys: a key moves a stick to its end."""
    down = [meaning for name, meaning in KEYS.items() if is_down(name)]
    return Sticks(*(sum(axis) for axis in zip(Sticks(), *down, strict=True)))


class Gamepad:
    """Sticks of a game controller with a layout that pyglet knows.

    Attributes:
        on_end: called when the pilot presses start or back.
    """

    def __init__(self, controller: Any) -> None:
        self._now = Sticks()
        self.on_end: Callable[[], None] = lambda: None
        # Events are used, because the sign of pyglet's polled values depends on the operating system.
        controller.push_handlers(on_stick_motion=self._move, on_button_press=self._press)

    def sticks(self) -> Sticks:
        """Positions of both sticks, without their dead zones."""
        return self._now

    def _move(self, controller: Any, stick: str, vector: tuple[float, float]) -> None:
        right, up = (_without_dead_zone(value) for value in vector)
        if stick == "leftstick":
            self._now = self._now._replace(up=up, turn=0.0 - right)
        elif stick == "rightstick":
            self._now = self._now._replace(forward=up, left=0.0 - right)

    def _press(self, controller: Any, button: str) -> None:
        if button in ("start", "back"):
            self.on_end()


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
