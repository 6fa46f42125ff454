"""Rooms: halls from `halls.toml` with their camera rigs, textured rectangles, and light in their textures."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Literal

import cv2
import msgspec
import numpy as np
from jaxtyping import Bool, Float

from psotrack.simulation.scenarios import CameraPlace, Vector
from psotrack.simulation.world import textures

Point = Float[np.ndarray, "3"]
_Corners = Float[np.ndarray, "4 3"]
_Boxes = Float[np.ndarray, "boxes 2 3"]


class Box(msgspec.Struct, frozen=True, array_like=True):
    """A box with the colour `bgr` (linear reflectance): a piece of furniture or a part of it."""

    lower_m: Vector
    upper_m: Vector
    bgr: Vector


class Hall(msgspec.Struct, frozen=True):
    """Plan of a hall around the origin, with the floor at z = 0.

    Attributes:
        size_m: length along x, length along y, and height.
        lamps_xy_m: centres of the lamp panels in the ceiling.
        lamp_size_m: size of each panel along x and y.
        markers: numbers of ArUco markers on the walls at y > 0, x > 0, y < 0 and x < 0; ids start at 1 in this order.
        marker_size_m: side of a marker's black square.
        texel_m: texel size of floor and walls at full size; about a pixel at the smallest distance of a drone.
        light_step_m: step of the lightmaps; it can be large, because the large panels make soft shadows.
        floor, ceiling, walls: names of the functions of `textures` that draw them.
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
    floor: Literal["floor", "slab"]
    ceiling: Literal["ceiling", "sheeting"]
    walls: Literal["wall", "cladding"]
    boxes: tuple[Box, ...]
    seed: int


class _Plans(msgspec.Struct, frozen=True):
    halls: dict[str, Hall]
    rigs: dict[str, tuple[CameraPlace, ...]]


_PLANS = msgspec.toml.decode(
    resources.files("psotrack.simulation.world").joinpath("halls.toml").read_bytes(), type=_Plans
)
HALLS: Mapping[str, Hall] = _PLANS.halls
RIGS: Mapping[str, tuple[CameraPlace, ...]] = {
    "laboratory": _PLANS.rigs["laboratory"],
    "laboratory_corners": _PLANS.rigs["laboratory"][:4],
    "large_hall": _PLANS.rigs["large_hall"],
}


#: Share of ambient light. The share is large, because walls and ceiling of a bright room reflect much light.
AMBIENT = 0.4


@dataclass(frozen=True)
class Lamps:
    """Equal panels in the ceiling that shine downwards.

    Attributes:
        centres_m: (lamps, 3), centres of the panels.
        size_m: size of each panel along x and along y.
        exposure: factor of the light; with the right factor, a white horizontal face in the middle of the floor is 1.
    """

    centres_m: Float[np.ndarray, "lamps 3"]
    size_m: tuple[float, float]
    exposure: float

    def samples_m(self) -> Float[np.ndarray, "lamps samples 3"]:
        """(lamps, 4, 3), points on each panel, for soft shadows."""
        spread = np.array([(-1, -1, 0), (1, -1, 0), (-1, 1, 0), (1, 1, 0)]) * [*self.size_m, 0.0] / 4
        return self.centres_m[:, None] + spread

    def direct(
        self,
        points_m: Float[np.ndarray, "*points 3"],
        normals: Float[np.ndarray, "*points 3"],
        source_m: Point,
    ) -> Float[np.ndarray, "*points"]:
        """Light on faces from one point of a panel: Lambert's law at the panel and at the face, inverse square law."""
        towards = source_m - points_m
        distance = np.linalg.norm(towards, axis=-1)
        towards = towards / distance[..., None]
        received = np.clip((towards * normals).sum(axis=-1), 0, None)
        return self.exposure * received * np.clip(towards[..., 2], 0, None) / distance**2

    def on_faces(self, at_m: Point, normals: Float[np.ndarray, "faces 3"]) -> Float[np.ndarray, "faces"]:
        """Light on the faces of a small object at `at_m`, without shadows."""
        points = np.broadcast_to(at_m, normals.shape)
        direct = sum((self.direct(points, normals, lamp) for lamp in self.centres_m), np.zeros(len(normals)))
        # Faces that point down receive light of the floor, which is darker than walls and ceiling.
        return direct + AMBIENT * (0.75 + 0.25 * normals[:, 2])


def lamps(centres_m: Float[np.ndarray, "lamps 3"], size_m: tuple[float, float]) -> Lamps:
    """Panels with the exposure that gives 1 for white in the middle of the floor, ambient light included."""
    plain = Lamps(centres_m, size_m, 1.0)
    up = np.array([[0.0, 0.0, 1.0]])
    middle = sum(float(plain.direct(np.zeros((1, 3)), up, lamp)[0]) for lamp in centres_m)
    return Lamps(centres_m, size_m, (1.0 - AMBIENT) / middle)


def bake(
    points_m: Float[np.ndarray, "rows columns 3"], normal: Point, panels: Lamps, boxes_m: _Boxes
) -> Float[np.ndarray, "rows columns"]:
    """Light at a regular grid of points on one face, with shadows of boxes."""
    raised = points_m + 2e-3 * normal
    normals = np.broadcast_to(normal, points_m.shape)
    # Boxes behind the plane cast no shadow on it.
    reach_m = np.where(normal > 0, boxes_m[:, 1], boxes_m[:, 0]) - points_m[0, 0]
    before = boxes_m[reach_m @ normal > 1e-9]
    light = np.zeros(points_m.shape[:2])
    for panel in panels.samples_m():
        for source in panel:
            if (source - points_m[0, 0]) @ normal > 0:
                seen = ~_blocked(raised, source, before).any(axis=0)
                light += seen * panels.direct(raised, normals, source) / len(panel)
    return light + AMBIENT * (0.85 + 0.15 * normal[2])


def _blocked(
    points_m: Float[np.ndarray, "rows columns 3"], source_m: Point, boxes_m: _Boxes
) -> Bool[np.ndarray, "boxes rows columns"]:
    """Whether a box stands between a point and the source (slab test, Kay and Kajiya, 1986)."""
    enter, leave = -np.inf, np.inf
    for axis in range(3):
        start = points_m[..., axis]
        ray = source_m[axis] - start
        ray = np.where(np.abs(ray) < 1e-9, 1e-9, ray)
        a, b = ((boxes_m[:, side, axis, None, None] - start) / ray for side in range(2))
        enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
    # A point on the box itself touches the box at 0, which does not count as blocked.
    return (enter < leave) & (leave > 1e-3) & (enter < 1) & (leave > np.maximum(enter, 0) + 1e-3)


MARKER_DICTIONARY = cv2.aruco.DICT_4X4_1000
#: Largest factor of the texel size for small images.
_COARSEST = 8
#: Width of the white margin around a marker's black square, as a share of the square's side.
_MARKER_MARGIN = 0.2
#: Distances of the sheets' upper edges from the ceiling, as shares of the hall's height, used in turn.
_MARKER_TOPS = (0.1875, 0.3625, 0.5375)


@dataclass(frozen=True)
class Surface:
    """A textured rectangle, visible from both sides.

    Attributes:
        corner_m: (3,), corner at the texture's first texel.
        along_m: (3,), edge in the direction of increasing columns of the texture.
        down_m: (3,), edge in the direction of increasing rows of the texture.
        texture: (rows, columns, 3), linear BGR light; 1 is white in the middle of the floor.
    """

    corner_m: Point
    along_m: Point
    down_m: Point
    texture: textures.Texture

    @property
    def normal(self) -> Point:
        """(3,), unit normal of the side from which the texture does not appear mirrored."""
        n = np.cross(self.down_m, self.along_m)
        return n / np.linalg.norm(n)

    @property
    def corners_m(self) -> _Corners:
        """(4, 3), corners: top left, top right, bottom right, bottom left of the texture."""
        a, b = self.along_m, self.down_m
        return self.corner_m + np.stack([np.zeros(3), a, a + b, b])


@dataclass(frozen=True)
class Room:
    """A lit room.

    Attributes:
        surfaces: all surfaces; the first is the floor.
        panels: lamp panels.
        marker_corners_m: (4, 3) by marker id: top left, top right, bottom right, bottom left of the black square.
    """

    surfaces: tuple[Surface, ...]
    panels: Lamps
    marker_corners_m: Mapping[int, _Corners]


@functools.lru_cache(maxsize=2)
def room(name: str, with_markers: bool, scale: float) -> Room:
    """Room of a hall, with light in its textures.

    Args:
        name: name of a hall in `HALLS`.
        with_markers: whether ArUco markers hang on the walls.
        scale: scale of the image size, 1 is full size; it decides the resolution of the textures.
    """
    hall = HALLS[name]
    texel_m = hall.texel_m * min(max(1.0, 1 / scale), _COARSEST)
    return _build(hall, with_markers, round(texel_m, 3))


def _build(hall: Hall, with_markers: bool, texel_m: float) -> Room:
    length, width, height = hall.size_m
    x, y = length / 2, width / 2
    rng = np.random.default_rng(hall.seed)
    panels = lamps(np.array([(*at, height) for at in hall.lamps_xy_m]), hall.lamp_size_m)
    shell = [
        (hall.floor, (-x, y, 0.0), (length, 0.0, 0.0), (0.0, -width, 0.0)),
        (hall.ceiling, (-x, -y, height), (length, 0.0, 0.0), (0.0, width, 0.0)),
        (hall.walls, (-x, y, height), (length, 0.0, 0.0), (0.0, 0.0, -height)),
        (hall.walls, (x, y, height), (0.0, -width, 0.0), (0.0, 0.0, -height)),
        (hall.walls, (x, -y, height), (-length, 0.0, 0.0), (0.0, 0.0, -height)),
        (hall.walls, (-x, -y, height), (0.0, width, 0.0), (0.0, 0.0, -height)),
    ]
    surfaces = []
    for name, corner, along, down in shell:
        drawn = getattr(textures, name)(abs(sum(along)), abs(sum(down)), texel_m, rng)
        surfaces.append(_surface(corner, along, down, drawn))
    for box in hall.boxes:
        surfaces += _sides(box, 2 * texel_m, rng)
    surfaces += [_underside(box, 2 * texel_m, rng) for box in hall.boxes if box.lower_m[2] > 0]
    marker_corners: dict[int, _Corners] = {}
    if with_markers:
        for marker, place_m in enumerate(_marker_places(surfaces[2:6], hall), start=1):
            surface, marker_corners[marker] = _marker(marker, hall.marker_size_m, *place_m)
            surfaces.append(surface)
    boxes_m = np.array([(box.lower_m, box.upper_m) for box in hall.boxes])
    lit = [_add_light(surface, hall.light_step_m, panels, boxes_m) for surface in surfaces]
    lamp_surfaces = [_lamp(centre, panels.size_m) for centre in panels.centres_m]
    return Room((*lit, *lamp_surfaces), panels, marker_corners)


def _surface(corner: Vector, along: Vector, down: Vector, texture: textures.Texture) -> Surface:
    return Surface(np.array(corner, float), np.array(along, float), np.array(down, float), texture)


def _add_light(surface: Surface, step_m: float, panels: Lamps, boxes_m: _Boxes) -> Surface:
    """Surface with its texture multiplied by the light; changes the texture in place."""
    columns, rows = (max(2, int(np.linalg.norm(edge) / step_m)) for edge in (surface.along_m, surface.down_m))
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    points = surface.corner_m + u[..., None] * surface.along_m + v[..., None] * surface.down_m
    light = bake(points, surface.normal, panels, boxes_m)
    height, width = surface.texture.shape[:2]
    fine = cv2.resize(light.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    # In place, because the textures of a large hall take most of a process's memory.
    texture = np.multiply(surface.texture, fine[..., None], out=surface.texture)
    return Surface(surface.corner_m, surface.along_m, surface.down_m, texture)


def _lamp(centre: Point, size_m: tuple[float, float]) -> Surface:
    corner = centre - np.array([size_m[0] / 2, size_m[1] / 2, 0.02])
    glow = np.full((8, 16, 3), 3.0, np.float32)
    return Surface(corner, np.array([size_m[0], 0.0, 0.0]), np.array([0.0, size_m[1], 0.0]), glow)


def _marker_places(walls: Sequence[Surface], hall: Hall) -> list[tuple[Point, Point]]:
    """Top left corner of each marker's sheet, and direction of its upper edge; sheets are spread over the walls."""
    sheet_m = hall.marker_size_m * (1 + 2 * _MARKER_MARGIN)
    places = []
    for wall, count in zip(walls, hall.markers, strict=True):
        length = float(np.linalg.norm(wall.along_m))
        along = wall.along_m / length
        for i in range(count):
            left = (i + 0.5) * length / count - sheet_m / 2
            top = hall.size_m[2] * _MARKER_TOPS[i % len(_MARKER_TOPS)]
            # A little in front of the wall, so that the depth buffer separates sheet and wall.
            corner = wall.corner_m + left * along - np.array([0.0, 0.0, top]) + 0.01 * wall.normal
            places.append((corner, along))
    return places


def _marker(marker: int, size_m: float, corner: Point, along: Point) -> tuple[Surface, _Corners]:
    # 20 texels per cell, so that cell edges remain texel edges when the texture is halved twice.
    per_cell, cells = 20, 6
    side_px = per_cell * cells
    margin_px = round(_MARKER_MARGIN * side_px)
    bits = cv2.aruco.getPredefinedDictionary(MARKER_DICTIONARY).generateImageMarker(marker, side_px)
    sheet = np.pad(0.05 + 0.8 * (bits.astype(np.float32) / 255), margin_px, constant_values=0.85)
    sheet_m = size_m * len(sheet) / side_px
    down = np.array([0.0, 0.0, -1.0])
    surface = Surface(corner, along * sheet_m, down * sheet_m, np.repeat(sheet[..., None], 3, axis=-1))
    a, b = (margin_px / len(sheet), 1 - margin_px / len(sheet))
    inner = [(a, a), (b, a), (b, b), (a, b)]
    corners = np.stack([corner + u * surface.along_m + v * surface.down_m for u, v in inner])
    return surface, corners


def _sides(box: Box, texel_m: float, rng: np.random.Generator) -> list[Surface]:
    """Four sides and top of a box."""
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


def _underside(box: Box, texel_m: float, rng: np.random.Generator) -> Surface:
    """Bottom of a box above the floor, such as a table top, which drones can fly below."""
    (x1, y1, z), (x2, y2, _) = box.lower_m, box.upper_m
    texture = textures.plain(x2 - x1, y2 - y1, texel_m, box.bgr, rng)
    return _surface((x1, y1, z), (x2 - x1, 0.0, 0.0), (0.0, y2 - y1, 0.0), texture)
