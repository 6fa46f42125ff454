"""Light: panels in the ceiling, ambient light from the walls, and shadows of boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

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
        source_m: Float[np.ndarray, "3"],
    ) -> Float[np.ndarray, "*points"]:
        """Light on faces from one point of a panel: Lambert's law at the panel and at the face, inverse square law."""
        towards = source_m - points_m
        distance = np.linalg.norm(towards, axis=-1)
        towards = towards / distance[..., None]
        received = np.clip((towards * normals).sum(axis=-1), 0, None)
        return self.exposure * received * np.clip(towards[..., 2], 0, None) / distance**2

    def on_faces(
        self, at_m: Float[np.ndarray, "3"], normals: Float[np.ndarray, "faces 3"]
    ) -> Float[np.ndarray, "faces"]:
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
    points_m: Float[np.ndarray, "rows columns 3"],
    normal: Float[np.ndarray, "3"],
    panels: Lamps,
    boxes_m: Float[np.ndarray, "boxes 2 3"],
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
    points_m: Float[np.ndarray, "rows columns 3"],
    source_m: Float[np.ndarray, "3"],
    boxes_m: Float[np.ndarray, "boxes 2 3"],
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
