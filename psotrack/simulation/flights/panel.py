"""The pilot's window: help for keys or sticks, the drone in the hall seen from above, its height and its speed.

The window needs pyglet, an extra (`pip install '.[control]'`) that is imported when the window opens.
"""

from __future__ import annotations

import importlib
from types import ModuleType

import numpy as np

from psotrack.errors import SettingsError, install_command
from psotrack.simulation.flights.dynamics import FlightState, Space

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
