"""Order of a room's rectangles from far to near for any viewpoint, without a depth buffer.

The order comes from a binary space partition (Fuchs, Kedem and Naylor, "On visible surface generation by a priori tree
structures", 1980): the plane of each node divides the remaining pieces into pieces in front and pieces behind, and cuts
the pieces that cross it. From any viewpoint, the pieces on the far side of the plane can be drawn first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from psotrack.simulation.world.rooms import Surface

#: Largest distance of a point on a plane from the plane.
_ON_PLANE_M = 1e-6


@dataclass(frozen=True)
class Piece:
    """A part of a surface that no plane of the tree cuts.

    Attributes:
        surface: index of the surface.
        corners_m: (corners, 3), convex polygon, in the order of the surface's corners.
    """

    surface: int
    corners_m: Float[np.ndarray, "corners 3"]


@dataclass(frozen=True)
class _Node:
    """A node of the tree: a plane with the pieces in it.

    Attributes:
        normal: (3,), normal of the plane; its points x satisfy normal @ x = offset_m.
        offset_m: offset of the plane.
        pieces: indices of the pieces in the plane.
        before: subtree on the side of the normal.
        behind: subtree on the other side.
    """

    normal: Float[np.ndarray, "3"]
    offset_m: float
    pieces: tuple[int, ...]
    before: _Node | None
    behind: _Node | None


class Order:
    """Pieces of surfaces that have an order from far to near for every viewpoint.

    Attributes:
        pieces: pieces of all surfaces.
    """

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self._normals = np.array([surface.normal for surface in surfaces]).reshape(-1, 3)
        self.pieces: list[Piece] = []
        self._root = self._node([Piece(index, surface.corners_m) for index, surface in enumerate(surfaces)])

    def far_to_near(self, eye_m: Float[np.ndarray, "3"]) -> list[int]:
        """Indices of all pieces in an order in which no piece is hidden by an earlier one, seen from a point."""
        found: list[int] = []

        def visit(node: _Node | None) -> None:
            if node is None:
                return
            in_front = node.normal @ eye_m > node.offset_m
            visit(node.behind if in_front else node.before)
            found.extend(node.pieces)
            visit(node.before if in_front else node.behind)

        visit(self._root)
        return found

    def _node(self, pieces: list[Piece]) -> _Node | None:
        if not pieces:
            return None
        normal, offset_m = _best_plane(pieces, self._normals)
        first = len(self.pieces)
        before: list[Piece] = []
        behind: list[Piece] = []
        for piece in pieces:
            height_m = piece.corners_m @ normal - offset_m
            if np.abs(height_m).max() <= _ON_PLANE_M:
                self.pieces.append(piece)
                continue
            for side, sign in ((before, 1.0), (behind, -1.0)):
                part = _cut(piece.corners_m, sign * height_m)
                if part is not None:
                    side.append(Piece(piece.surface, part))
        inside = tuple(range(first, len(self.pieces)))
        return _Node(normal, offset_m, inside, self._node(before), self._node(behind))


def _best_plane(
    pieces: list[Piece], normals: Float[np.ndarray, "surfaces 3"]
) -> tuple[Float[np.ndarray, "3"], float]:
    """Plane of a piece that cuts the fewest other pieces; among equal planes, the one with the most equal halves."""
    planes = normals[[piece.surface for piece in pieces]]
    offset_m = np.array([plane @ piece.corners_m[0] for plane, piece in zip(planes, pieces, strict=True)])
    starts = np.cumsum([0, *(len(piece.corners_m) for piece in pieces[:-1])])
    corners = np.concatenate([piece.corners_m for piece in pieces])
    height_m = planes @ corners.T - offset_m[:, None]
    above = np.maximum.reduceat(height_m, starts, axis=1) > _ON_PLANE_M
    below = np.minimum.reduceat(height_m, starts, axis=1) < -_ON_PLANE_M
    cuts = (above & below).sum(axis=1)
    uneven = np.abs(above.sum(axis=1) - below.sum(axis=1))
    best = int(np.lexsort((uneven, cuts))[0])
    return planes[best], float(offset_m[best])


def _cut(
    corners_m: Float[np.ndarray, "corners 3"], height_m: Float[np.ndarray, "corners"]
) -> Float[np.ndarray, "kept 3"] | None:
    """Part of a convex polygon with positive heights, or None if it is empty (Sutherland and Hodgman, 1974)."""
    if height_m.max() <= _ON_PLANE_M:
        return None
    if height_m.min() >= -_ON_PLANE_M:
        return corners_m
    kept = []
    for i in range(len(corners_m)):
        j = (i + 1) % len(corners_m)
        if height_m[i] >= 0:
            kept.append(corners_m[i])
        if (height_m[i] >= 0) != (height_m[j] >= 0):
            share = height_m[i] / (height_m[i] - height_m[j])
            kept.append(corners_m[i] + share * (corners_m[j] - corners_m[i]))
    return np.array(kept)
