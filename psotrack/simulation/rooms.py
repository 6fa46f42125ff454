"""Rooms: textured rectangles (floor, walls, ceiling, furniture, markers), with their light baked in."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from collections.abc import Sequence as Ordered
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError
from psotrack.simulation import textures
from psotrack.simulation.lighting import Lamps, bake, lamps

MARKER_DICTIONARY = cv2.aruco.DICT_4X4_1000
MARKER_SIZE_M = 0.30
#: White paper around the black square.
_MARKER_MARGIN_M = 0.06
#: Lightmaps are that coarse: panels are large, so shadows are soft.
_LIGHT_STEP_M = 0.12

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Surface:
    """A textured rectangle, seen from both sides.

    Attributes:
        corner_m: (3,), where the texture's first texel lies.
        along_m, down_m: (3,), edges along the texture's columns and rows.
        texture: (rows, columns, 3), linear BGR light, 1 is white in the middle of the floor.
    """

    corner_m: Float[np.ndarray, "3"]
    along_m: Float[np.ndarray, "3"]
    down_m: Float[np.ndarray, "3"]
    texture: textures.Texture

    @property
    def normal(self) -> Float[np.ndarray, "3"]:
        """(3,), unit normal, out of the side from which the texture is not mirrored."""
        n = np.cross(self.down_m, self.along_m)
        return n / np.linalg.norm(n)

    @property
    def corners_m(self) -> Float[np.ndarray, "4 3"]:
        """(4, 3): top left, top right, bottom right, bottom left of the texture."""
        a, b = self.along_m, self.down_m
        return self.corner_m + np.stack([np.zeros(3), a, a + b, b])


@dataclass(frozen=True)
class Room:
    """A lit room.

    Attributes:
        surfaces: the first is the floor.
        panels: its lamps.
        marker_corners_m: (4, 3) per marker: top left, top right, bottom right, bottom left of the black square.
    """

    surfaces: tuple[Surface, ...]
    panels: Lamps
    marker_corners_m: Mapping[int, Float[np.ndarray, "4 3"]]


@dataclass(frozen=True)
class Box:
    """A piece of furniture, or a part of one."""

    lower_m: Vector
    upper_m: Vector
    bgr: Vector


@dataclass(frozen=True)
class Hall:
    """The plan of a room: a hall around the origin, floor at z = 0.

    Attributes:
        size_m: length along x, along y, and height.
        lamps_xy_m: centres of the panels in the ceiling.
        lamp_size_m: of each panel, along x and y.
        markers: ArUco markers on the walls at y > 0, x > 0, y < 0 and x < 0; ids count from 1 in that order.
        boxes: furniture.
        seed: of its textures.
    """

    size_m: Vector
    lamps_xy_m: tuple[tuple[float, float], ...]
    lamp_size_m: tuple[float, float]
    markers: tuple[int, int, int, int]
    boxes: tuple[Box, ...]
    seed: int


@functools.lru_cache(maxsize=2)
def room(name: str, with_markers: bool, texel_m: float) -> Room:
    """The room of that name, with light and textures ready; the same every time.

    Args:
        name: in `HALLS`.
        with_markers: whether ArUco markers hang on its walls.
        texel_m: size of a texel on the floor and walls.

    Raises:
        SettingsError: there is no such room; the message lists those there are.
    """
    if name not in HALLS:
        raise SettingsError("room", expected=f"one of {', '.join(HALLS)}", found=name)
    return _furnished(HALLS[name], with_markers, texel_m)


def _furnished(hall: Hall, with_markers: bool, texel_m: float) -> Room:
    length, width, height = hall.size_m
    x, y = length / 2, width / 2
    rng = np.random.default_rng(hall.seed)
    panels = lamps(np.array([(*at, height) for at in hall.lamps_xy_m]), hall.lamp_size_m)
    walls = [
        ((-x, y, height), (length, 0.0, 0.0), (0.0, 0.0, -height)),
        ((x, y, height), (0.0, -width, 0.0), (0.0, 0.0, -height)),
        ((x, -y, height), (-length, 0.0, 0.0), (0.0, 0.0, -height)),
        ((-x, -y, height), (0.0, width, 0.0), (0.0, 0.0, -height)),
    ]
    surfaces = [
        _surface(
            (-x, y, 0.0), (length, 0.0, 0.0), (0.0, -width, 0.0), textures.floor(length, width, texel_m, rng)
        ),
        _surface(
            (-x, -y, height),
            (length, 0.0, 0.0),
            (0.0, width, 0.0),
            textures.ceiling(length, width, texel_m, rng),
        ),
        *(_surface(*wall, textures.wall(abs(sum(wall[1])), height, texel_m, rng)) for wall in walls),
        *(side for box in hall.boxes for side in _sides(box, 2 * texel_m, rng)),
    ]
    marker_corners: dict[int, Float[np.ndarray, "4 3"]] = {}
    if with_markers:
        for marker, (corner, along) in enumerate(_marker_places(surfaces[2:6], hall.markers), start=1):
            surface, marker_corners[marker] = _marker(marker, corner, along)
            surfaces.append(surface)
    boxes_m = np.array([(box.lower_m, box.upper_m) for box in hall.boxes])
    lit = [_lit(surface, panels, boxes_m) for surface in surfaces]
    glowing = [_lamp(centre, panels.size_m) for centre in panels.centres_m]
    return Room((*lit, *glowing), panels, marker_corners)


def _surface(corner: Vector, along: Vector, down: Vector, texture: textures.Texture) -> Surface:
    return Surface(np.array(corner, float), np.array(along, float), np.array(down, float), texture)


def _lit(surface: Surface, panels: Lamps, boxes_m: Float[np.ndarray, "boxes 2 3"]) -> Surface:
    """The surface with its light baked into its texture."""
    columns, rows = (
        max(2, int(np.linalg.norm(edge) / _LIGHT_STEP_M)) for edge in (surface.along_m, surface.down_m)
    )
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    points = surface.corner_m + u[..., None] * surface.along_m + v[..., None] * surface.down_m
    light = bake(points.reshape(-1, 3), surface.normal, panels, boxes_m).reshape(rows, columns)
    height, width = surface.texture.shape[:2]
    fine = cv2.resize(light.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return Surface(surface.corner_m, surface.along_m, surface.down_m, surface.texture * fine[..., None])


def _lamp(centre: Float[np.ndarray, "3"], size_m: tuple[float, float]) -> Surface:
    corner = centre - np.array([size_m[0] / 2, size_m[1] / 2, 0.02])
    glow = np.full((8, 16, 3), 3.0, np.float32)
    return Surface(corner, np.array([size_m[0], 0.0, 0.0]), np.array([0.0, size_m[1], 0.0]), glow)


def _marker_places(
    walls: Ordered[Surface], counts: tuple[int, ...]
) -> list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]:
    """Top left corner of each sheet, and the direction along it: spread over the walls, at changing heights."""
    sheet_m = MARKER_SIZE_M + 2 * _MARKER_MARGIN_M
    places = []
    for wall, count in zip(walls, counts, strict=True):
        length = float(np.linalg.norm(wall.along_m))
        along = wall.along_m / length
        for i in range(count):
            left = (i + 0.5) * length / count - sheet_m / 2
            top = (0.75, 1.45, 2.15)[i % 3]
            # A little before the wall, so that the depth buffer can tell them apart.
            corner = wall.corner_m + left * along - np.array([0.0, 0.0, top]) + 0.01 * wall.normal
            places.append((corner, along))
    return places


def _marker(marker: int, corner: np.ndarray, along: np.ndarray) -> tuple[Surface, Float[np.ndarray, "4 3"]]:
    per_cell, cells = 12, 6
    side_px = per_cell * cells
    margin_px = round(_MARKER_MARGIN_M / MARKER_SIZE_M * side_px)
    bits = cv2.aruco.getPredefinedDictionary(MARKER_DICTIONARY).generateImageMarker(marker, side_px)
    sheet = np.pad(0.05 + 0.8 * (bits.astype(np.float32) / 255), margin_px, constant_values=0.85)
    size_m = MARKER_SIZE_M * len(sheet) / side_px
    down = np.array([0.0, 0.0, -1.0])
    surface = Surface(corner, along * size_m, down * size_m, np.repeat(sheet[..., None], 3, axis=-1))
    a, b = (margin_px / len(sheet), 1 - margin_px / len(sheet))
    inner = [(a, a), (b, a), (b, b), (a, b)]
    corners = np.stack([corner + u * surface.along_m + v * surface.down_m for u, v in inner])
    return surface, corners


def _sides(box: Box, texel_m: float, rng: np.random.Generator) -> list[Surface]:
    """The four sides and the top of a box."""
    (x1, y1, z1), (x2, y2, z2) = box.lower_m, box.upper_m
    x, y, z = x2 - x1, y2 - y1, z2 - z1
    sides = (
        ((x1, y1, z2), (x, 0.0, 0.0), (0.0, 0.0, -z)),
        ((x2, y1, z2), (0.0, y, 0.0), (0.0, 0.0, -z)),
        ((x2, y2, z2), (-x, 0.0, 0.0), (0.0, 0.0, -z)),
        ((x1, y2, z2), (0.0, -y, 0.0), (0.0, 0.0, -z)),
        ((x1, y2, z2), (x, 0.0, 0.0), (0.0, -y, 0.0)),
    )
    return [
        _surface(corner, along, down, textures.plain(abs(sum(along)), abs(sum(down)), texel_m, box.bgr, rng))
        for corner, along, down in sides
    ]


_LABORATORY = Hall(
    size_m=(10.0, 8.0, 4.0),
    lamps_xy_m=((-2.6, -1.9), (-2.6, 1.9), (2.6, -1.9), (2.6, 1.9)),
    lamp_size_m=(0.6, 0.6),
    markers=(12, 9, 11, 9),
    seed=2025,
    boxes=(
        # Two pillars that stand free: they hide drones from some cameras now and then.
        Box((-2.1, 2.75, 0.0), (-1.85, 3.0, 4.0), (0.48, 0.50, 0.52)),
        Box((1.7, -3.0, 0.0), (1.92, -2.78, 4.0), (0.30, 0.33, 0.36)),
        # Cupboards and shelves along the walls.
        Box((-4.98, -1.9, 0.0), (-4.5, -0.6, 1.9), (0.16, 0.22, 0.34)),
        Box((4.5, -0.4, 0.0), (4.98, 1.3, 1.1), (0.40, 0.38, 0.34)),
        Box((4.55, 1.5, 0.0), (4.98, 2.4, 2.0), (0.22, 0.10, 0.09)),
        Box((-2.4, 3.5, 0.0), (-0.6, 3.98, 0.85), (0.20, 0.30, 0.42)),
        Box((1.2, -3.98, 0.0), (2.8, -3.45, 0.95), (0.12, 0.13, 0.14)),
        # A table with screens, and things upon it.
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

HALLS: Mapping[str, Hall] = {"laboratory": _LABORATORY}
