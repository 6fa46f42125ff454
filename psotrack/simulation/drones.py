"""Drone models: meshes with a body, arms, motors, legs and rotors.

Body frame: x ahead, y left, z up, metres; the origin is the middle of the frame plate, where a flight controller
sits. It is not the middle of the silhouette: bodies and legs reach further down or up, as on real drones.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError

#: Corners of a rotor disc's rim.
_DISC_SIDES = 20

#: (faces, 3, 3), corners in metres.
Triangles = Float[np.ndarray, "_ 3 3"]


@dataclass(frozen=True)
class DroneModel:
    """A drone's shape in its body frame.

    Attributes:
        triangles_m: (faces, 3, 3), corners counter-clockwise seen from outside.
        paint: (faces,), how much of the drone's own paint a face has; the rest is dark plastic.
        rotor_centres_m: (rotors, 3).
        rotor_radius_m: of every rotor.
    """

    triangles_m: Float[np.ndarray, "faces 3 3"]
    paint: Float[np.ndarray, "faces"]
    rotor_centres_m: Float[np.ndarray, "rotors 3"]
    rotor_radius_m: float

    @functools.cached_property
    def normals(self) -> Float[np.ndarray, "faces 3"]:
        """(faces, 3), unit vectors out of the faces."""
        a, b, c = self.triangles_m.swapaxes(0, 1)
        outwards = np.cross(b - a, c - a)
        return outwards / np.linalg.norm(outwards, axis=-1, keepdims=True)

    @functools.cached_property
    def radius_m(self) -> float:
        """Of the smallest sphere about the origin that holds the drone, rotors included."""
        body = np.linalg.norm(self.triangles_m, axis=-1).max()
        reach = np.linalg.norm(self.rotor_centres_m, axis=-1).max() + self.rotor_radius_m
        return float(max(body, reach))


def model(name: str) -> DroneModel:
    """The model of that name.

    Raises:
        SettingsError: there is none; the message lists those there are.
    """
    if name not in MODELS:
        raise SettingsError("drone model", expected=f"one of {', '.join(MODELS)}", found=name)
    return MODELS[name]()


def disc_fans(shape: DroneModel) -> Float[np.ndarray, "slices 3 3"]:
    """(slices, 3, 3): the rotor discs as triangles around their hubs, body frame."""
    angle = 2 * np.pi * np.arange(_DISC_SIDES + 1) / _DISC_SIDES
    rim = shape.rotor_radius_m * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    hub = np.zeros_like(rim[:-1])
    fan = np.stack([hub, rim[:-1], rim[1:]], axis=1)
    return (shape.rotor_centres_m[:, None, None] + fan).reshape(-1, 3, 3)


def box(
    centre: tuple[float, float, float], size: tuple[float, float, float], taper: float = 1.0
) -> Triangles:
    """A box whose top is `taper` times as long and wide as its bottom."""
    x, y, z = np.array(size) / 2
    ring = np.array([(-x, -y), (x, -y), (x, y), (-x, y)])
    return _prism(ring, -z, z, taper) + np.array(centre)


def cylinder(
    centre: tuple[float, float, float], radius: float, height: float, taper: float = 1.0, sides: int = 10
) -> Triangles:
    """An upright cylinder whose top is `taper` times as wide as its bottom."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return _prism(ring, -height / 2, height / 2, taper) + np.array(centre)


def _prism(ring: Float[np.ndarray, "sides 2"], bottom: float, top: float, taper: float) -> Triangles:
    low = np.column_stack([ring, np.full(len(ring), bottom)])
    high = np.column_stack([ring * taper, np.full(len(ring), top)])
    low_next, high_next = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
    fan = np.arange(1, len(ring) - 1)
    first = np.zeros_like(fan)
    return np.concatenate(
        [
            np.stack([low, low_next, high_next], axis=1),
            np.stack([low, high_next, high], axis=1),
            high[np.stack([first, fan, fan + 1], axis=1)],
            low[np.stack([first, fan + 1, fan], axis=1)],
        ]
    )


def beam(
    start: tuple[float, float, float], end: tuple[float, float, float], width: float, height: float
) -> Triangles:
    """A straight bar of rectangular section between two points that do not lie above one another."""
    a, b = np.array(start), np.array(end)
    length = float(np.linalg.norm(b - a))
    ahead = (b - a) / length
    left = np.cross([0.0, 0.0, 1.0], ahead)
    left /= np.linalg.norm(left)
    bar = box((0.0, 0.0, 0.0), (length, width, height))
    return bar @ np.stack([ahead, left, np.cross(ahead, left)]) + (a + b) / 2


def _turned(triangles: Triangles, angle_rad: float) -> Triangles:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return triangles @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _assembled(
    parts: list[tuple[Triangles, float]], motors: Float[np.ndarray, "rotors 3"], rotor_radius_m: float
) -> DroneModel:
    for x, y, z in motors:
        parts.append((cylinder((x, y, z), 0.014, 0.026), 0.1))
        parts.append((cylinder((x, y, z + 0.017), 0.006, 0.010, sides=6), 0.0))
    triangles = np.concatenate([triangles for triangles, _ in parts])
    paint = np.concatenate([np.full(len(triangles), share) for triangles, share in parts])
    return DroneModel(triangles, paint, motors + np.array([0.0, 0.0, 0.020]), rotor_radius_m)


def _ring(radius: float, angles_deg: tuple[float, ...], z: float) -> Float[np.ndarray, "rotors 3"]:
    angles = np.radians(angles_deg)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(len(angles), z)], axis=-1)


def x_frame() -> DroneModel:
    """A carbon X frame with its battery on top: 0.34 m from motor to motor, 0.40 m over all along x."""
    arms = (45.0, 135.0, 225.0, 315.0)
    motors = _ring(0.17, arms, 0.012)
    parts = [
        (box((0.0, 0.0, 0.0), (0.15, 0.075, 0.012)), 1.0),
        (box((0.0, 0.0, 0.032), (0.13, 0.06, 0.006)), 1.0),
        (box((0.0, 0.0, 0.016), (0.06, 0.045, 0.026)), 0.3),
        (box((-0.005, 0.0, 0.053), (0.10, 0.042, 0.034), 0.92), 0.6),
        (box((0.075, 0.0, 0.022), (0.024, 0.03, 0.03)), 0.2),
    ]
    for angle in np.radians(arms):
        parts.append((_turned(beam((0.02, 0.0, 0.0), (0.185, 0.0, 0.0), 0.026, 0.010), angle), 1.0))
        parts.append((_turned(cylinder((0.165, 0.0, -0.024), 0.007, 0.040, sides=6), angle), 0.3))
    return _assembled(parts, motors, 0.076)


def camera_drone() -> DroneModel:
    """A folding camera drone: long rounded body, thin arms from its corners, a gimbal below its nose; 0.46 m wide."""
    motors = np.array(
        [(0.14, 0.15, 0.030), (0.14, -0.15, 0.030), (-0.13, 0.14, 0.006), (-0.13, -0.14, 0.006)]
    )
    parts = [
        (box((0.0, 0.0, -0.012), (0.20, 0.085, 0.034), 1.06), 1.0),
        (box((-0.01, 0.0, 0.022), (0.17, 0.075, 0.034), 0.72), 1.0),
        (box((0.105, 0.0, 0.002), (0.03, 0.06, 0.04), 0.8), 0.7),
        (cylinder((0.085, 0.0, -0.045), 0.019, 0.034, sides=8), 0.15),
        (box((0.105, 0.0, -0.045), (0.016, 0.026, 0.026)), 0.05),
    ]
    for x, y, z in motors:
        root = (0.07 if x > 0 else -0.08, 0.035 * np.sign(y), z - 0.022)
        parts.append((beam(root, (x, y, z - 0.014), 0.020, 0.014), 1.0))
    for x, y, _ in motors[:2]:
        parts.append((cylinder((x, y, -0.015), 0.007, 0.06, sides=6), 0.8))
    return _assembled(parts, motors, 0.082)


def tall_cross() -> DroneModel:
    """A cross frame with a tall body and landing legs: 0.40 m from motor to motor, 0.58 m over all along x."""
    arms = (0.0, 90.0, 180.0, 270.0)
    motors = _ring(0.20, arms, 0.020)
    parts = [
        (cylinder((0.0, 0.0, 0.0), 0.065, 0.016, sides=12), 0.8),
        (cylinder((0.0, 0.0, 0.045), 0.055, 0.075, 0.75, sides=12), 1.0),
        (cylinder((0.0, 0.0, 0.095), 0.028, 0.03, 0.5, sides=8), 0.4),
        (box((0.0, 0.0, -0.032), (0.11, 0.05, 0.045)), 0.5),
    ]
    for angle in np.radians(arms):
        parts.append((_turned(beam((0.03, 0.0, 0.002), (0.21, 0.0, 0.002), 0.020, 0.018), angle), 0.7))
    for angle in np.radians((45.0, 135.0, 225.0, 315.0)):
        parts.append((_turned(beam((0.045, 0.0, -0.01), (0.115, 0.0, -0.105), 0.012, 0.012), angle), 0.3))
        parts.append((_turned(box((0.118, 0.0, -0.11), (0.03, 0.018, 0.012)), angle), 0.2))
    return _assembled(parts, motors, 0.092)


MODELS: Mapping[str, Callable[[], DroneModel]] = {
    "x_frame": x_frame,
    "camera_drone": camera_drone,
    "tall_cross": tall_cross,
}
