"""Light: panels in the ceiling, a share of ambient light from the walls, and the shadows of boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

#: Share of the light that comes from everywhere: walls and ceiling of a bright room throw back much of it.
AMBIENT = 0.4
#: Lower or upper bound of a box, along each axis, at its eight corners.
_CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)


@dataclass(frozen=True)
class Lamps:
    """Equal panels in the ceiling, shining down.

    Attributes:
        centres_m: (lamps, 3).
        size_m: length along x and along y of each.
        exposure: scales light so that a white face, lying in the middle of the floor, is 1.
    """

    centres_m: Float[np.ndarray, "lamps 3"]
    size_m: tuple[float, float]
    exposure: float

    def samples_m(self) -> Float[np.ndarray, "lamps samples 3"]:
        """(lamps, 4, 3): points spread over each panel, for soft shadows."""
        spread = np.array([(-1, -1, 0), (1, -1, 0), (-1, 1, 0), (1, 1, 0)]) * [*self.size_m, 0.0] / 4
        return self.centres_m[:, None] + spread

    def direct(
        self,
        points_m: Float[np.ndarray, "*points 3"],
        normals: Float[np.ndarray, "*points 3"],
        source_m: Float[np.ndarray, "3"],
    ) -> Float[np.ndarray, "*points"]:
        """Light on faces from one point of a panel: Lambert on both sides, inverse square."""
        towards = source_m - points_m
        distance = np.linalg.norm(towards, axis=-1)
        towards = towards / distance[..., None]
        received = np.clip((towards * normals).sum(axis=-1), 0, None)
        return self.exposure * received * np.clip(towards[..., 2], 0, None) / distance**2

    def on_faces(
        self, at_m: Float[np.ndarray, "3"], normals: Float[np.ndarray, "faces 3"]
    ) -> Float[np.ndarray, "faces"]:
        """Light on the faces of a small thing at `at_m`, without shadows."""
        points = np.broadcast_to(at_m, normals.shape)
        direct = sum((self.direct(points, normals, lamp) for lamp in self.centres_m), np.zeros(len(normals)))
        # Faces that look down see the floor, which is darker than walls and ceiling.
        return direct + AMBIENT * (0.75 + 0.25 * normals[:, 2])


def lamps(centres_m: Float[np.ndarray, "lamps 3"], size_m: tuple[float, float]) -> Lamps:
    """Panels whose exposure fits: white on the middle of the floor gets 1, ambient light included."""
    plain = Lamps(centres_m, size_m, 1.0)
    up = np.array([[0.0, 0.0, 1.0]])
    middle = sum(float(plain.direct(np.zeros((1, 3)), up, lamp)[0]) for lamp in centres_m)
    return Lamps(centres_m, size_m, (1.0 - AMBIENT) / middle)


def bake(
    points_m: Float[np.ndarray, "rows columns 3"],
    normal: Float[np.ndarray, "3"],
    panels: Lamps,
    boxes_m: Float[np.ndarray, "boxes 2 3"],
) -> Float[np.ndarray, "rows columns"]:
    """Light on a regular grid of points of one face, shadows of boxes included."""
    raised = points_m + 2e-3 * normal
    normals = np.broadcast_to(normal, points_m.shape)
    light = np.zeros(points_m.shape[:2])
    for panel in panels.samples_m():
        for source in panel:
            if (source - points_m[0, 0]) @ normal <= 0:
                continue
            box, row, column = np.nonzero(_shadowable(points_m, normal, source, boxes_m))
            hidden = _blocked(raised[row, column].T, source, boxes_m[box].T)
            seen = np.ones(light.shape, bool)
            seen[row[hidden], column[hidden]] = False
            light += seen * panels.direct(raised, normals, source) / len(panel)
    return light + AMBIENT * (0.85 + 0.15 * normal[2])


def _shadowable(
    points_m: Float[np.ndarray, "rows columns 3"],
    normal: Float[np.ndarray, "3"],
    source_m: Float[np.ndarray, "3"],
    boxes_m: Float[np.ndarray, "boxes 2 3"],
) -> Bool[np.ndarray, "boxes rows columns"]:
    """Where on a grid a box's shadow may lie: in the window around the shadows of its corners.

    Boxes that reach as high over the plane as the source have shadows without an end: for them it is the whole grid.
    """
    first, size = points_m[0, 0], np.array(points_m.shape[:2])
    steps = np.stack([points_m[1, 0] - first, points_m[0, 1] - first])
    corners = boxes_m[:, _CORNERS, np.arange(3)]
    height = (source_m - first) @ normal
    below_source = (source_m - corners) @ normal
    least = 1e-3 * height
    shadows = source_m - first + (corners - source_m) * (height / np.maximum(below_source, least))[..., None]
    at = shadows @ (steps / (steps**2).sum(axis=-1, keepdims=True)).T
    # A cell more on each side: points are lit a little above the plane.
    low, high = at.min(axis=1) - 1, at.max(axis=1) + 1
    endless = below_source.min(axis=1) < least
    low[endless], high[endless] = 0, size
    # What lies behind the plane shades nothing on it; a box's own faces do.
    high[below_source.min(axis=1) > height - 1e-9] = -1
    rows, columns = (
        (low[:, axis, None] <= np.arange(size[axis])) & (np.arange(size[axis]) <= high[:, axis, None])
        for axis in range(2)
    )
    return rows[:, :, None] & columns[:, None]


def _blocked(
    points_m: Float[np.ndarray, "3 pairs"],
    source_m: Float[np.ndarray, "3"],
    boxes_m: Float[np.ndarray, "3 2 pairs"],
) -> Bool[np.ndarray, "pairs"]:
    """Where a box stands between a point and the source, for pairs of both (slab test, Kay and Kajiya, 1986)."""
    enter, leave = np.full(points_m.shape[1], -np.inf), np.full(points_m.shape[1], np.inf)
    for start, to, (lower, upper) in zip(points_m, source_m, boxes_m, strict=True):
        ray = to - start
        ray = np.where(np.abs(ray) < 1e-9, 1e-9, ray)
        a, b = (lower - start) / ray, (upper - start) / ray
        enter, leave = np.maximum(enter, np.minimum(a, b)), np.minimum(leave, np.maximum(a, b))
    # A point on the box itself touches it at 0: let light leave before it counts as blocked.
    return (enter < leave) & (leave > 1e-3) & (enter < 1) & (leave > np.maximum(enter, 0) + 1e-3)
