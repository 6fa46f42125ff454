"""Plans of the halls, and the camera rigs in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from psotrack.simulation.scenarios import CameraPlace, Vector
from psotrack.simulation.world import textures

#: Function that draws a texture: length and height in metres, size of a texel in metres, random generator.
Painter = Callable[[float, float, float, np.random.Generator], textures.Texture]


@dataclass(frozen=True)
class Box:
    """A box with the colour `bgr` (linear reflectance): a piece of furniture or a part of it."""

    lower_m: Vector
    upper_m: Vector
    bgr: Vector


@dataclass(frozen=True)
class Hall:
    """Plan of a hall around the origin, with the floor at z = 0.

    Attributes:
        size_m: length along x, length along y, and height.
        lamps_xy_m: centres of the lamp panels in the ceiling.
        lamp_size_m: size of each panel along x and y.
        markers: numbers of ArUco markers on the walls at y > 0, x > 0, y < 0 and x < 0; ids start at 1 in this order.
        marker_size_m: side of a marker's black square.
        texel_m: texel size of floor and walls at full size; about a pixel at the smallest distance of a drone.
        light_step_m: step of the lightmaps; it can be large, because the large panels make soft shadows.
        floor: function that draws the floor's texture.
        ceiling: function that draws the ceiling's texture.
        walls: function that draws the walls' textures.
        boxes: furniture.
        seed: seed of the textures.
    """

    size_m: Vector
    lamps_xy_m: tuple[tuple[float, float], ...]
    lamp_size_m: tuple[float, float]
    markers: tuple[int, int, int, int]
    marker_size_m: float
    texel_m: float
    light_step_m: float
    floor: Painter
    ceiling: Painter
    walls: Painter
    boxes: tuple[Box, ...]
    seed: int


def _table(corner_m: tuple[float, float], size_m: tuple[float, float], bgr: Vector) -> tuple[Box, ...]:
    """Table top on four legs; `corner_m` is the corner with the smallest x and y."""
    (x1, y1), (length, width) = corner_m, size_m
    leg_m, inset_m, top_m = 0.06, 0.05, 0.75
    legs = [
        (x, y)
        for x in (x1 + inset_m, x1 + length - inset_m - leg_m)
        for y in (y1 + inset_m, y1 + width - inset_m - leg_m)
    ]
    return (
        Box((x1, y1, top_m), (x1 + length, y1 + width, top_m + 0.04), bgr),
        *(Box((x, y, 0.0), (x + leg_m, y + leg_m, top_m), (0.05, 0.05, 0.05)) for x, y in legs),
    )


_LABORATORY = Hall(
    size_m=(10.0, 8.0, 4.0),
    lamps_xy_m=((-2.6, -1.9), (-2.6, 1.9), (2.6, -1.9), (2.6, 1.9)),
    lamp_size_m=(0.6, 0.6),
    markers=(12, 9, 11, 9),
    marker_size_m=0.30,
    texel_m=0.005,
    light_step_m=0.12,
    floor=textures.floor,
    ceiling=textures.ceiling,
    walls=textures.wall,
    seed=2025,
    boxes=(
        # Two free-standing pillars, which occlude drones in some cameras for short times.
        Box((-2.1, 2.75, 0.0), (-1.85, 3.0, 4.0), (0.48, 0.50, 0.52)),
        Box((1.7, -3.0, 0.0), (1.92, -2.78, 4.0), (0.30, 0.33, 0.36)),
        # Cupboards and shelves along the walls.
        Box((-4.98, -1.9, 0.0), (-4.5, -0.6, 1.9), (0.16, 0.22, 0.34)),
        Box((4.5, -0.4, 0.0), (4.98, 1.3, 1.1), (0.40, 0.38, 0.34)),
        Box((4.55, 1.5, 0.0), (4.98, 2.4, 2.0), (0.22, 0.10, 0.09)),
        Box((-2.4, 3.5, 0.0), (-0.6, 3.98, 0.85), (0.20, 0.30, 0.42)),
        Box((1.2, -3.98, 0.0), (2.8, -3.45, 0.95), (0.12, 0.13, 0.14)),
        # A table with screens.
        Box((-2.9, -3.9, 0.70), (-1.1, -3.1, 0.74), (0.35, 0.45, 0.55)),
        Box((-2.85, -3.85, 0.0), (-2.79, -3.79, 0.70), (0.05, 0.05, 0.05)),
        Box((-1.21, -3.85, 0.0), (-1.15, -3.79, 0.70), (0.05, 0.05, 0.05)),
        Box((-2.85, -3.21, 0.0), (-2.79, -3.15, 0.70), (0.05, 0.05, 0.05)),
        Box((-1.21, -3.21, 0.0), (-1.15, -3.15, 0.70), (0.05, 0.05, 0.05)),
        Box((-2.6, -3.65, 0.80), (-2.0, -3.61, 1.18), (0.04, 0.04, 0.04)),
        Box((-1.9, -3.65, 0.80), (-1.3, -3.61, 1.18), (0.30, 0.18, 0.10)),
        # Boxes on the floor, a tripod's pole with its head, a flight case.
        Box((3.3, -3.2, 0.0), (3.9, -2.6, 0.5), (0.16, 0.30, 0.42)),
        Box((3.4, -3.1, 0.5), (3.8, -2.75, 0.85), (0.20, 0.36, 0.50)),
        Box((-3.9, 2.6, 0.0), (-3.1, 3.1, 0.6), (0.07, 0.07, 0.08)),
        Box((0.9, 3.15, 0.0), (0.95, 3.2, 1.7), (0.03, 0.03, 0.03)),
        Box((0.8, 3.08, 1.7), (1.05, 3.27, 1.85), (0.05, 0.05, 0.05)),
        Box((-4.3, 0.9, 0.0), (-3.8, 1.4, 0.45), (0.10, 0.10, 0.45)),
    ),
)

_LARGE_HALL = Hall(
    size_m=(20.0, 16.0, 8.0),
    lamps_xy_m=tuple((x, y) for x in (-6.6, 0.0, 6.6) for y in (-5.0, 0.0, 5.0)),
    lamp_size_m=(1.2, 1.2),
    markers=(12, 9, 11, 9),
    marker_size_m=0.50,
    texel_m=0.010,
    light_step_m=0.18,
    floor=textures.slab,
    ceiling=textures.sheeting,
    walls=textures.cladding,
    seed=2026,
    boxes=(
        # Free-standing columns and poles, which occlude drones in some cameras for short times.
        Box((-3.9, 5.2, 0.0), (-3.5, 5.6, 8.0), (0.48, 0.50, 0.52)),
        Box((3.5, -5.7, 0.0), (3.9, -5.3, 8.0), (0.30, 0.33, 0.36)),
        Box((6.1, 2.0, 0.0), (6.45, 2.35, 8.0), (0.20, 0.28, 0.42)),
        Box((-6.6, -2.6, 0.0), (-6.25, -2.25, 8.0), (0.42, 0.44, 0.46)),
        Box((2.7, 4.7, 0.0), (2.8, 4.8, 3.6), (0.03, 0.03, 0.04)),
        Box((2.55, 4.62, 3.6), (2.95, 4.88, 3.85), (0.05, 0.05, 0.05)),
        Box((-3.0, -4.7, 0.0), (-2.9, -4.6, 3.2), (0.55, 0.55, 0.55)),
        Box((-3.3, -4.75, 3.2), (-2.6, -4.55, 3.5), (0.06, 0.06, 0.07)),
        # A stage with a lectern and loudspeakers.
        Box((-9.9, 2.6, 0.0), (-6.9, 6.6, 0.7), (0.06, 0.07, 0.09)),
        Box((-8.0, 3.0, 0.7), (-7.5, 3.5, 1.85), (0.16, 0.26, 0.40)),
        Box((-7.5, 5.9, 0.7), (-7.1, 6.4, 2.2), (0.03, 0.03, 0.03)),
        Box((-7.5, 2.7, 0.7), (-7.1, 2.95, 2.2), (0.03, 0.03, 0.03)),
        # Cupboards, lockers and shelves along the walls.
        Box((9.2, -6.4, 0.0), (9.98, -3.0, 2.1), (0.34, 0.24, 0.14)),
        Box((9.4, 3.2, 0.0), (9.98, 5.6, 1.9), (0.16, 0.22, 0.34)),
        Box((-9.98, -5.8, 0.0), (-9.3, -3.4, 2.3), (0.12, 0.10, 0.30)),
        Box((-6.4, 7.2, 0.0), (-3.6, 7.98, 1.0), (0.40, 0.38, 0.34)),
        Box((4.4, 7.3, 0.0), (6.8, 7.98, 2.0), (0.20, 0.30, 0.42)),
        Box((-7.0, -7.98, 0.0), (-4.6, -7.2, 1.9), (0.30, 0.33, 0.30)),
        Box((1.6, -7.98, 0.0), (3.2, -7.3, 1.2), (0.12, 0.13, 0.14)),
        # Crates, flight cases and rolled mats.
        Box((6.9, -6.0, 0.0), (8.0, -4.9, 1.0), (0.16, 0.30, 0.42)),
        Box((7.0, -5.9, 1.0), (7.8, -5.1, 1.7), (0.20, 0.36, 0.50)),
        Box((5.6, -7.0, 0.0), (6.5, -6.2, 0.8), (0.14, 0.26, 0.38)),
        Box((7.3, 4.6, 0.0), (8.3, 5.5, 0.75), (0.05, 0.05, 0.06)),
        Box((5.9, 5.6, 0.0), (6.9, 6.3, 0.6), (0.10, 0.10, 0.45)),
        Box((-5.6, -6.4, 0.0), (-4.4, -5.5, 0.7), (0.50, 0.20, 0.08)),
        Box((-6.7, 0.4, 0.0), (-6.0, 1.5, 0.55), (0.30, 0.12, 0.05)),
        Box((-0.9, 6.2, 0.0), (0.9, 7.0, 0.45), (0.08, 0.30, 0.14)),
        # Tables with screens.
        *_table((-0.8, -7.0), (1.8, 0.8), (0.35, 0.45, 0.55)),
        Box((-0.5, -6.65, 0.80), (0.15, -6.60, 1.20), (0.04, 0.04, 0.04)),
        Box((0.3, -6.65, 0.80), (0.85, -6.60, 1.18), (0.30, 0.18, 0.10)),
        *_table((8.3, -0.9), (0.8, 2.2), (0.48, 0.50, 0.50)),
        Box((8.65, -0.5, 0.80), (8.70, 0.1, 1.20), (0.04, 0.04, 0.04)),
        Box((8.5, 0.5, 0.79), (8.9, 1.0, 1.05), (0.10, 0.35, 0.45)),
    ),
)

HALLS: Mapping[str, Hall] = {"laboratory": _LABORATORY, "large_hall": _LARGE_HALL}

#: cam1 to cam4 are in the corners, cam5 and cam6 2 cm apart, cam7 and cam8 both near x = 0, as in the paper.
LABORATORY_CAMERAS = (
    CameraPlace(position_m=(-4.7, -3.7, 3.1), target_m=(0.1, 0.0, 1.25)),
    CameraPlace(position_m=(4.7, -3.7, 3.0), target_m=(0.0, 0.1, 1.3)),
    CameraPlace(position_m=(4.7, 3.7, 3.05), target_m=(-0.1, 0.0, 1.25)),
    CameraPlace(position_m=(-4.7, 3.7, 3.0), target_m=(0.0, -0.1, 1.3)),
    CameraPlace(position_m=(-4.8, 0.30, 2.9), target_m=(0.0, 0.0, 1.3)),
    CameraPlace(position_m=(-4.8, 0.32, 2.9), target_m=(0.0, -0.15, 1.35)),
    CameraPlace(position_m=(0.10, 3.85, 3.0), target_m=(0.0, 0.0, 1.35)),
    CameraPlace(position_m=(-0.05, -3.85, 2.95), target_m=(0.1, 0.0, 1.4)),
)

LARGE_HALL_CAMERAS = (
    CameraPlace(position_m=(-8.9, -6.9, 5.3), target_m=(0.2, 0.0, 2.4)),
    CameraPlace(position_m=(8.9, -6.9, 5.2), target_m=(0.0, 0.2, 2.45)),
    CameraPlace(position_m=(8.9, 6.9, 5.25), target_m=(-0.2, 0.0, 2.4)),
    CameraPlace(position_m=(-8.9, 6.9, 5.2), target_m=(0.0, -0.2, 2.45)),
    CameraPlace(position_m=(-9.1, 0.30, 5.0), target_m=(0.0, 0.0, 2.4)),
    CameraPlace(position_m=(-9.1, 0.32, 5.0), target_m=(0.0, -0.3, 2.5)),
    CameraPlace(position_m=(0.10, 7.1, 5.0), target_m=(0.0, 0.0, 2.4)),
    CameraPlace(position_m=(-0.05, -7.1, 4.95), target_m=(0.2, 0.0, 2.5)),
)

RIGS: Mapping[str, tuple[CameraPlace, ...]] = {
    "laboratory": LABORATORY_CAMERAS,
    "laboratory_corners": LABORATORY_CAMERAS[:4],
    "large_hall": LARGE_HALL_CAMERAS,
}
