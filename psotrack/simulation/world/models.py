"""Drone models: solids of triangles, and rotors.

The corners of a triangle are counter-clockwise seen from outside, metres.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

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


def turn(corners: Float[np.ndarray, "*corners 3"], angle_rad: float) -> Float[np.ndarray, "*corners 3"]:
    """Points turned about the z axis, from x towards y."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return corners @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


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


#: Number of corners of a rotor disc.
_DISC_SIDES = 20


@dataclass(frozen=True)
class DroneModel:
    """Shape of a drone in its body frame.

    Attributes:
        triangles_m: (faces, 3, 3), corners counter-clockwise seen from outside.
        paint: (faces,), share of the drone's paint in the colour of a face; the rest is dark plastic.
        rotor_centres_m: (rotors, 3), hubs; the discs are horizontal in the body frame.
        rotor_radii_m: (rotors,), radii of the rotor discs.
    """

    triangles_m: Float[np.ndarray, "faces 3 3"]
    paint: Float[np.ndarray, "faces"]
    rotor_centres_m: Float[np.ndarray, "rotors 3"]
    rotor_radii_m: Float[np.ndarray, "rotors"]

    @functools.cached_property
    def normals(self) -> Float[np.ndarray, "faces 3"]:
        """(faces, 3), outward unit normals of the faces."""
        a, b, c = self.triangles_m.swapaxes(0, 1)
        outwards = np.cross(b - a, c - a)
        return outwards / np.linalg.norm(outwards, axis=-1, keepdims=True)

    @functools.cached_property
    def radius_m(self) -> float:
        """Radius of the smallest sphere about the origin that contains the drone with its rotors."""
        body = np.linalg.norm(self.triangles_m, axis=-1).max()
        reach = np.linalg.norm(self.rotor_centres_m, axis=-1) + self.rotor_radii_m
        return float(max(body, reach.max(initial=0.0)))


def disc_fans(model: DroneModel) -> Float[np.ndarray, "slices 3 3"]:
    """(slices, 3, 3), rotor discs as triangles around their hubs, body frame."""
    angle = 2 * np.pi * np.arange(_DISC_SIDES + 1) / _DISC_SIDES
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    fan = np.stack([np.zeros_like(rim[:-1]), rim[:-1], rim[1:]], axis=1)
    discs = model.rotor_centres_m[:, None, None] + model.rotor_radii_m[:, None, None, None] * fan
    return discs.reshape(-1, 3, 3)
