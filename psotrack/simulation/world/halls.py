"""Plans of the halls, and the camera rigs in them, from `halls.toml`."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from typing import Literal

import msgspec

from psotrack.simulation.scenarios import CameraPlace, Vector


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
