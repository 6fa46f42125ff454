"""Input devices for flying by hand: a game controller, the keyboard, or a file of stick positions.

The sticks are in mode 2, which most pilots know: the left stick controls climb and turn, the right stick controls
forward and sideways motion. Controllers and windows need pyglet, an extra (`pip install '.[control]'`) that is
imported at the first use.
"""

from __future__ import annotations

import contextlib
import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from psotrack.errors import SettingsError
from psotrack.simulation.flights.dynamics import FlightState, Space, Sticks
from psotrack.simulation.flights.panel import Panel, pyglet_module
from psotrack.simulation.flights.piloting import Sample, read_sticks

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
