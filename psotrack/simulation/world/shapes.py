"""Solids for drone models: triangles in metres, corners counter-clockwise seen from outside."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

#: (faces, 3, 3), corners in metres.
Triangles = Float[np.ndarray, "_ 3 3"]
Point = tuple[float, float, float]


def box(centre: Point, size: Point, taper: float = 1.0) -> Triangles:
    """Box whose top is `taper` times as long and wide as its bottom."""
    x, y, z = np.array(size) / 2
    ring = np.array([(-x, -y), (x, -y), (x, y), (-x, y)])
    return _prism(ring, -z, z, taper) + np.array(centre)


def cylinder(centre: Point, radius: float, height: float, taper: float = 1.0, sides: int = 10) -> Triangles:
    """Upright cylinder whose top is `taper` times as wide as its bottom."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return _prism(ring, -height / 2, height / 2, taper) + np.array(centre)


def beam(start: Point, end: Point, width: float, height: float) -> Triangles:
    """Straight bar of rectangular section between two points, which must not be vertically above each other."""
    a, b = np.array(start), np.array(end)
    length = float(np.linalg.norm(b - a))
    ahead = (b - a) / length
    left = np.cross([0.0, 0.0, 1.0], ahead)
    left /= np.linalg.norm(left)
    bar = box((0.0, 0.0, 0.0), (length, width, height))
    return bar @ np.stack([ahead, left, np.cross(ahead, left)]) + (a + b) / 2


def turn(triangles: Triangles, angle_rad: float) -> Triangles:
    """Triangles turned about the z axis, from x towards y."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return triangles @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def pitch(triangles: Triangles, angle_rad: float, about: Point) -> Triangles:
    """Triangles turned about a line through `about` along y, from x towards z, which raises the front."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return (triangles - np.array(about)) @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) + np.array(
        about
    )


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
