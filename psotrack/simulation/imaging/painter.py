"""Fast drawing of the empty room for moving cameras, which see a different image in each frame.

Surfaces are painted from far to near, each by a homography of its texture into the window where it is visible. Distant
parts use coarser textures (Williams, "Pyramidal parametrics", 1983). Edges of pieces and limits between levels of a
texture are half planes of the image: a pixel shows a piece if its ray is inside the cone of the eye and the piece.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from psotrack.simulation.imaging.backdrop import numbers_and_depth, texel_to_camera
from psotrack.simulation.imaging.raster import RasterView, empty_buffers
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


#: Integer value of light 1. Lamps have light 3, which still fits into 16 bits.
LIGHT_UNIT = 16384

#: BGR light, and the floor's share of the light. OpenCV transforms four channels faster than three.
Light = UInt16[np.ndarray, "rows columns 4"]
#: A texture at one resolution, and the matrix from its texels to the texels at full resolution.
Level = tuple[Light, Float[np.ndarray, "3 3"]]

#: Smallest side of a texture's coarsest level, texels.
_SMALLEST_PX = 8
#: Largest size of a texel in the image. Texels may be smaller than a pixel, because a frame has several samples per
#: pixel.
_TEXEL_PX = 0.6
#: Largest number of texels within `_TEXEL_PX` in the direction of foreshortening. If more texels fall there, a
#: coarser level is used, although it blurs the other direction.
_FORESHORTENED = 2.0
#: Pixels by which pieces are widened, so that no ray passes between two pieces with a common edge.
_OVERLAP_PX = 1e-6


@dataclass(frozen=True)
class _Spans:
    """A convex part of an image.

    Attributes:
        y: first row.
        left: (rows,), first column of each row.
        right: (rows,), last column of each row.
    """

    y: int
    left: Int[np.ndarray, "rows"]
    right: Int[np.ndarray, "rows"]


class RoomPainter:
    """Paints the empty room into any view of any camera."""

    def __init__(self, surfaces: tuple[Surface, ...]) -> None:
        self.surfaces = surfaces
        self._order = Order(surfaces)
        pieces = self._order.pieces
        self._surface_of = [piece.surface for piece in pieces]
        self._surface_normals = np.array([surface.normal for surface in surfaces])
        self._surface_corners_m = np.array([surface.corner_m for surface in surfaces])
        self._normals = self._surface_normals[self._surface_of]
        # Repeated corners change nothing, and give all pieces the same number of corners.
        most = max(len(piece.corners_m) for piece in pieces)
        self._corners_m = np.stack(
            [np.pad(p.corners_m, ((0, most - len(p.corners_m)), (0, 0)), mode="edge") for p in pieces]
        )
        # The first surface of a room is its floor.
        self._levels = [_levels(surface, is_floor=not index) for index, surface in enumerate(surfaces)]
        self._texel_m = [_texel_m(surface) for surface in surfaces]
        self._buffer = np.empty(0, np.uint16)

    def paint(self, view: RasterView, image: Light) -> None:
        """Paint the room in a view, one sample per pixel.

        Args:
            view: view of magnification 1.
            image: (rows, columns, 4), overwritten: BGR light, and 1 at pixels of the floor, in units of `LIGHT_UNIT`.
        """
        cam, K = view.cam, view.K
        eye_m = -cam.R.T @ cam.t_m
        height_m = ((eye_m - self._corners_m[:, 0]) * self._normals).sum(axis=-1)
        corners = self._corners_m @ cam.R.T + cam.t_m
        seen = (height_m > 0) & may_be_seen(corners, K, view.shape)
        image[...] = 0
        for index in self._order.far_to_near(eye_m):
            if seen[index]:
                normal = cam.R @ self._normals[index]
                self._paint_piece(image, view, index, corners[index], normal / height_m[index])

    def hiding_depth_m(
        self, view: RasterView, faces_m: Float[np.ndarray, "faces 3 3"]
    ) -> Float[np.ndarray, "rows columns"]:
        """(rows, columns), depth of the surfaces that may hide the given faces; `FAR_M` at pixels without a surface."""
        points = faces_m.reshape(-1, 3)
        lower, upper = points.min(axis=0), points.max(axis=0)
        # For each plane, the corner of the faces' bounding box that is farthest behind the plane.
        farthest = np.where(self._surface_normals > 0, lower, upper)
        beyond = ((farthest - self._surface_corners_m) * self._surface_normals).sum(axis=-1) < 0
        eye_m = -view.cam.R.T @ view.cam.t_m
        faced = ((eye_m - self._surface_corners_m) * self._surface_normals).sum(axis=-1) > 0
        hiding = [self.surfaces[index] for index in np.flatnonzero(beyond & faced)]
        return numbers_and_depth(hiding, view)[1] if hiding else empty_buffers(view)[1]

    def _paint_piece(
        self,
        image: Light,
        view: RasterView,
        index: int,
        corners: Float[np.ndarray, "corners 3"],
        normal_per_height: Float[np.ndarray, "3"],
    ) -> None:
        K, surface = view.K, self._surface_of[index]
        to_rays = np.linalg.inv(K)
        edges = np.cross(corners, np.roll(corners, -1, axis=0)) @ to_rays
        # Along a ray (x, y, 1) to the plane, 1 / depth is linear in x and y.
        nearness = -normal_per_height @ to_rays
        height_m = 1 / float(np.linalg.norm(normal_per_height))
        to_image = K @ texel_to_camera(self.surfaces[surface], view.cam)
        for level, nearest, farthest in self._by_level(surface, corners[:, 2], height_m, K[0, 0]):
            limits = [nearness - [0, 0, 1 / farthest]] if np.isfinite(farthest) else []
            limits += [[0, 0, 1 / nearest] - nearness] if nearest > 0 else []
            spans = _spans(np.vstack([edges, *limits]), view.shape)
            if spans is not None:
                texture, to_full_size = level
                self._fill(image, spans, texture, to_image @ to_full_size)

    def _by_level(
        self, surface: int, depth_m: Float[np.ndarray, "corners"], height_m: float, focal_px: float
    ) -> Iterator[tuple[Level, float, float]]:
        """Yield the levels of a texture that a piece needs, each with its smallest and largest depth."""
        levels = self._levels[surface]
        texel_px_m = focal_px * self._texel_m[surface]
        nearest = 0.0
        for index, level in enumerate(levels):
            # Depth from which on the next level's texels are small enough.
            scale = texel_px_m * 2 ** (index + 1) / _TEXEL_PX
            farthest = min(scale, float(np.sqrt(_FORESHORTENED * height_m * scale)))
            if index == len(levels) - 1 or depth_m.max() <= farthest:
                yield level, nearest, np.inf
                return
            if depth_m.min() < farthest:
                yield level, nearest, farthest
                nearest = farthest

    def _fill(
        self,
        image: Light,
        spans: _Spans,
        level: UInt16[np.ndarray, "texels_y texels_x 4"],
        H: Float[np.ndarray, "3 3"],
    ) -> None:
        """Paint a level of a texture into spans; H maps texels to pixels."""
        x1, x2 = int(spans.left.min()), int(spans.right.max()) + 1
        window = image[spans.y : spans.y + len(spans.left), x1:x2]
        if self._buffer.size < window.size:
            self._buffer = np.empty(window.size, np.uint16)
        # The buffer is reused, because allocating memory for each piece takes as long as painting it.
        painted = self._buffer[: window.size].reshape(window.shape)
        H = np.array([[1, 0, -x1], [0, 1, -spans.y], [0, 0, 1.0]]) @ H
        cv2.warpPerspective(level, H, window.shape[1::-1], dst=painted, flags=cv2.INTER_LINEAR)
        column = np.arange(x1, x2, dtype=np.int16)
        seen = (column >= spans.left[:, None]) & (column <= spans.right[:, None])
        cv2.copyTo(painted, seen.view(np.uint8), window)


def _texel_m(surface: Surface) -> float:
    """Length of the longer side of a texel."""
    rows, columns = surface.texture.shape[:2]
    return max(float(np.linalg.norm(surface.along_m)) / columns, float(np.linalg.norm(surface.down_m)) / rows)


def _levels(surface: Surface, is_floor: bool) -> list[Level]:
    """Levels of a surface's texture: full resolution, half of it, and so on."""
    rows, columns = surface.texture.shape[:2]
    full = np.full((rows, columns, 4), LIGHT_UNIT * is_floor, np.uint16)
    full[..., :3] = np.clip(surface.texture * LIGHT_UNIT + 0.5, 0, np.iinfo(np.uint16).max)
    levels = []
    level = full
    while True:
        y, x = rows / level.shape[0], columns / level.shape[1]
        # A border of one texel, because painted points may be half a texel outside the outermost texel centres.
        wider = cv2.copyMakeBorder(level, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
        to_full = np.array([[x, 0, (x - 1) / 2 - x], [0, y, (y - 1) / 2 - y], [0, 0, 1.0]])
        levels.append((np.asarray(wider, np.uint16), to_full))
        half = [-(-side // 2) for side in level.shape[1::-1]]
        if min(half) < _SMALLEST_PX:
            return levels
        level = np.asarray(cv2.resize(level, half, interpolation=cv2.INTER_AREA), np.uint16)


def may_be_seen(
    corners: Float[np.ndarray, "pieces corners 3"], K: Float[np.ndarray, "3 3"], shape: tuple[int, int]
) -> Bool[np.ndarray, "pieces"]:
    """(pieces,), False if all corners of a piece are beyond one side of the image or behind the camera."""
    x, y, depth = np.moveaxis(corners @ K.T, -1, 0)
    rows, columns = shape
    beyond = [
        x < -0.5 * depth,
        y < -0.5 * depth,
        x > (columns - 0.5) * depth,
        y > (rows - 0.5) * depth,
        depth <= 0,
    ]
    return ~np.any([side.all(axis=-1) for side in beyond], axis=0)


def _spans(half_planes: Float[np.ndarray, "edges 3"], shape: tuple[int, int]) -> _Spans | None:
    """Pixels (x, y) with a x + b y + c >= 0 for all rows (a, b, c); None if there are no such pixels."""
    rows, columns = shape
    a, b, c = half_planes.T[..., None]
    y = np.arange(rows)
    steep = np.abs(a) > 1e-12 * np.abs(half_planes).max(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = -(b * y + c) / a
    left = np.where(steep & (a > 0), bound, -np.inf).max(axis=0) - _OVERLAP_PX
    right = np.where(steep & (a < 0), bound, np.inf).min(axis=0) + _OVERLAP_PX
    seen = (steep | (b * y + c >= 0)).all(axis=0)
    left = np.ceil(np.clip(left, 0, columns))
    right = np.floor(np.clip(right, -1, columns - 1))
    found = np.flatnonzero(seen & (left <= right))
    if not len(found):
        return None
    part = slice(found[0], found[-1] + 1)
    return _Spans(int(found[0]), left[part].astype(np.int16), right[part].astype(np.int16))
