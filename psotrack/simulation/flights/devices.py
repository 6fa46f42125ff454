"""Input devices for flying by hand: a game controller, the keyboard, or a file of stick positions.

The sticks are in mode 2, which most pilots know: the left stick controls climb and turn, the right stick controls
forward and sideways motion. Controllers and windows need pyglet, an extra (`pip install '.[control]'`) that is
imported at the first use.
"""

from __future__ import annotations

import math
import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, runtime_checkable

from psotrack.errors import SettingsError
from psotrack.simulation.flights.dynamics import FlightState, Space, Sticks
from psotrack.simulation.flights.panel import PygletPanel, pyglet_module
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


class Device(ABC):
    """Source of stick samples; closed at the end of a `with` block."""

    @abstractmethod
    def samples(self) -> Iterator[Sample]:
        """Yield samples of the sticks with times that increase from 0, until the flight ends."""

    @abstractmethod
    def watch(self, time_s: float, state: FlightState) -> None:
        """Show the drone's state to the pilot."""

    @abstractmethod
    def close(self) -> None:
        """Release the controller and the window."""

    def __enter__(self) -> Device:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_device(name: str, space: Space) -> Device:
    """Open the device `gamepad` or `keyboard`, or a file in the format of `read_sticks`.

    Args:
        name: name of the device, or path of the file.
        space: space of the flight, which the pilot's window shows.

    Raises:
        SettingsError: pyglet is not installed, no controller is connected, or there is no display.
        InputError: the file cannot be used.
    """
    if name == "gamepad":
        return _open_gamepad(space)
    if name == "keyboard":
        return _open_keyboard(space)
    if not Path(name).suffix:
        raise SettingsError("device", expected="gamepad, keyboard, or a file of sticks (.csv)", found=name)
    return ScriptedDevice(read_sticks(Path(name)))


@dataclass(frozen=True)
class ScriptedDevice(Device):
    """Stick samples from a file; the flight ends at the time of the last sample."""

    script: tuple[Sample, ...]

    def samples(self) -> Iterator[Sample]:
        """Yield all samples without waiting."""
        return iter(self.script)

    def watch(self, time_s: float, state: FlightState) -> None:
        """Do nothing: there is no window."""

    def close(self) -> None:
        """Do nothing: there is no controller and no window."""


# --- live devices


@runtime_checkable
class Panel(Protocol):
    """The pilot's window."""

    @property
    def closed(self) -> bool:
        """Whether the pilot pressed Esc or closed the window."""

    def pump(self) -> None:
        """Process events of keys, sticks and the window."""

    def draw(self, time_s: float, state: FlightState) -> None:
        """Draw the drone's state."""

    def close(self) -> None:
        """Close the window."""


class LiveDevice(Device):
    """A device that a person operates, read at 60 Hz of the wall clock."""

    def __init__(
        self,
        panel: Panel,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._panel = panel
        self._clock = clock
        self._sleep = sleep
        self._stopped = False

    @abstractmethod
    def sticks(self) -> Sticks:
        """Current positions of the sticks."""

    def stop(self, *signal_and_frame: object) -> None:
        """End the flight with the next sample; also the handler of SIGINT."""
        self._stopped = True

    def __enter__(self) -> Device:
        # Ctrl-C ends the flight between two samples, as Esc does, so that the flight up to then is kept.
        self._handler = signal.signal(signal.SIGINT, self.stop)
        return super().__enter__()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        signal.signal(signal.SIGINT, self._handler)
        super().__exit__(kind, error, trace)

    def samples(self) -> Iterator[Sample]:
        """Yield stick samples at 60 Hz, or as fast as the machine can; the last sample ends the flight."""
        begin_s = self._clock()
        polls = 0
        while True:
            self._panel.pump()
            yield Sample(self._clock() - begin_s, self.sticks())
            if self._stopped or self._panel.closed:
                return
            # Time is counted from the beginning of the flight, so that the time of drawing does not accumulate.
            polls = max(polls + 1, int((self._clock() - begin_s) / _POLL_S))
            self._sleep(max(0.001, polls * _POLL_S - (self._clock() - begin_s)))

    def watch(self, time_s: float, state: FlightState) -> None:
        """Show the drone's state to the pilot."""
        self._panel.draw(time_s, state)

    def close(self) -> None:
        """Close the window."""
        self._panel.close()


class KeyboardDevice(LiveDevice):
    """The keyboard: a pressed key moves a stick to its end."""

    def __init__(self, panel: Panel, is_down: Callable[[str], bool], **timing: Any) -> None:
        super().__init__(panel, **timing)
        self._is_down = is_down

    def sticks(self) -> Sticks:
        """Sum of the stick positions of all pressed keys."""
        down = [meaning for name, meaning in KEYS.items() if self._is_down(name)]
        return Sticks(*(sum(axis) for axis in zip(Sticks(), *down, strict=True)))


class GamepadDevice(LiveDevice):
    """A game controller with a layout that pyglet knows."""

    def __init__(self, panel: Panel, controller: Any, **timing: Any) -> None:
        super().__init__(panel, **timing)
        self._controller = controller
        self._sticks = Sticks()
        # Events are used, because the sign of pyglet's polled values depends on the operating system.
        controller.push_handlers(on_stick_motion=self._move, on_button_press=self._press)

    def _move(self, controller: Any, stick: str, vector: tuple[float, float]) -> None:
        right, up = (_without_dead_zone(value) for value in vector)
        if stick == "leftstick":
            self._sticks = self._sticks._replace(up=up, turn=0.0 - right)
        elif stick == "rightstick":
            self._sticks = self._sticks._replace(forward=up, left=0.0 - right)

    def _press(self, controller: Any, button: str) -> None:
        if button in ("start", "back"):
            self.stop()

    def sticks(self) -> Sticks:
        """Positions of both sticks, without their dead zones."""
        return self._sticks

    def close(self) -> None:
        """Release the controller, and close the window."""
        self._controller.close()
        super().close()


def _without_dead_zone(value: float) -> float:
    """Position along one axis of a stick, 0 in the dead zone and continuous from there to both ends."""
    beyond = (abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE)
    return math.copysign(min(beyond, 1.0), value) if beyond > 0 else 0.0


# --- opening devices


def _open_gamepad(space: Space) -> GamepadDevice:
    pads = pyglet_module("input", "gamepad")
    try:
        controllers = pads.get_controllers()
    except OSError:  # Linux without input devices does not even have their folder.
        controllers = []
    if not controllers:
        raise SettingsError(
            "device gamepad",
            expected="a game controller",
            found="none",
            remedy="plug one in, or use --device keyboard",
        )
    controllers[0].open()
    return GamepadDevice(PygletPanel("gamepad", space, GAMEPAD_HELP), controllers[0])


def _open_keyboard(space: Space) -> KeyboardDevice:
    panel = PygletPanel("keyboard", space, KEYBOARD_HELP)
    return KeyboardDevice(panel, panel.is_down)
