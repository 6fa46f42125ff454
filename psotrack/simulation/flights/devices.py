"""What a person flies with: a game controller, the keyboard, or a file that says what the sticks do.

The sticks are those of mode 2, which most pilots know: left stick up and turn, right stick forward and left.
Controllers and windows come through pyglet, an extra (`pip install 'psotrack[control]'`) that is imported when used.
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

#: Around the middle, where springs do not bring sticks back to exactly 0.
DEAD_ZONE = 0.12
#: How often sticks are read; the flight itself is integrated in finer steps.
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
#: Key names of pyglet, and what each adds to the sticks.
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
    """Where sticks' samples come from; closed at the end of a `with` block."""

    @abstractmethod
    def samples(self) -> Iterator[Sample]:
        """Samples of the sticks, times increasing from 0, until the flight is over."""

    @abstractmethod
    def watch(self, time_s: float, state: FlightState) -> None:
        """Show the pilot where the drone is."""

    @abstractmethod
    def close(self) -> None:
        """Give back what was opened."""

    def __enter__(self) -> Device:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def open_device(name: str, space: Space) -> Device:
    """The device of that name: `gamepad`, `keyboard`, or a file of `read_sticks`.

    Args:
        name: of the device, or path of the file.
        space: that is flown in, for the pilot's window.

    Raises:
        SettingsError: pyglet is not installed, no controller is plugged in, or there is no display.
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
    """Sticks that were written down, or recorded; the last sample's time is the end."""

    script: tuple[Sample, ...]

    def samples(self) -> Iterator[Sample]:
        """All of them at once: nobody waits."""
        return iter(self.script)

    def watch(self, time_s: float, state: FlightState) -> None:
        """Nobody looks."""

    def close(self) -> None:
        """Nothing was opened."""


# --- people


@runtime_checkable
class Panel(Protocol):
    """The window that a pilot looks at."""

    @property
    def closed(self) -> bool:
        """Whether the pilot pressed Esc or closed it."""

    def pump(self) -> None:
        """Let events arrive: keys, sticks, the window's closing."""

    def draw(self, time_s: float, state: FlightState) -> None:
        """Show where the drone is."""

    def close(self) -> None:
        """Take the window away."""


class LiveDevice(Device):
    """A device that a person holds, read at 60 Hz of the wall clock."""

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
        """Where they stand now."""

    def stop(self, *signal_and_frame: object) -> None:
        """End the flight with the next sample; a signal's handler too."""
        self._stopped = True

    def __enter__(self) -> Device:
        # Ctrl-C ends a flight as Esc does, between two samples: what was flown is worth keeping.
        self._handler = signal.signal(signal.SIGINT, self.stop)
        return super().__enter__()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        signal.signal(signal.SIGINT, self._handler)
        super().__exit__(kind, error, trace)

    def samples(self) -> Iterator[Sample]:
        """Where the sticks stand at 60 Hz, or as often as the machine manages; the last is the end."""
        begin_s = self._clock()
        polls = 0
        while True:
            self._panel.pump()
            yield Sample(self._clock() - begin_s, self.sticks())
            if self._stopped or self._panel.closed:
                return
            # From the beginning, not from now: so the time that drawing takes does not add up.
            polls = max(polls + 1, int((self._clock() - begin_s) / _POLL_S))
            self._sleep(max(0.001, polls * _POLL_S - (self._clock() - begin_s)))

    def watch(self, time_s: float, state: FlightState) -> None:
        """Show the pilot where the drone is."""
        self._panel.draw(time_s, state)

    def close(self) -> None:
        """Take the window away."""
        self._panel.close()


class KeyboardDevice(LiveDevice):
    """Keys that are down are sticks at their ends."""

    def __init__(self, panel: Panel, is_down: Callable[[str], bool], **timing: Any) -> None:
        super().__init__(panel, **timing)
        self._is_down = is_down

    def sticks(self) -> Sticks:
        """The sum of what the keys mean that are down."""
        down = [meaning for name, meaning in KEYS.items() if self._is_down(name)]
        return Sticks(*(sum(axis) for axis in zip(Sticks(), *down, strict=True)))


class GamepadDevice(LiveDevice):
    """A game controller: any that pyglet knows the layout of."""

    def __init__(self, panel: Panel, controller: Any, **timing: Any) -> None:
        super().__init__(panel, **timing)
        self._controller = controller
        self._sticks = Sticks()
        # Events, because the values that pyglet can be asked for point up on one system and down on another.
        controller.push_handlers(on_stick_motion=self._move, on_button_press=self._press)

    def _move(self, controller: Any, stick: str, vector: tuple[float, float]) -> None:
        right, up = (_live(value) for value in vector)
        if stick == "leftstick":
            self._sticks = self._sticks._replace(up=up, turn=0.0 - right)
        elif stick == "rightstick":
            self._sticks = self._sticks._replace(forward=up, left=0.0 - right)

    def _press(self, controller: Any, button: str) -> None:
        if button in ("start", "back"):
            self.stop()

    def sticks(self) -> Sticks:
        """Both sticks, without their dead zones."""
        return self._sticks

    def close(self) -> None:
        """Give back the controller, and take the window away."""
        self._controller.close()
        super().close()


def _live(value: float) -> float:
    """A stick's axis without its dead zone, still reaching its ends."""
    beyond = (abs(value) - DEAD_ZONE) / (1 - DEAD_ZONE)
    return math.copysign(min(beyond, 1.0), value) if beyond > 0 else 0.0


# --- opening them


def _open_gamepad(space: Space) -> GamepadDevice:
    pads = pyglet_module("input", "gamepad")
    try:
        controllers = pads.get_controllers()
    except OSError:  # Linux without any input devices has not even their folder.
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
