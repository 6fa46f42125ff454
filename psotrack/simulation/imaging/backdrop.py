"""The empty room in a camera's image: drawn once for static cameras, and fast for moving cameras.

Moving cameras see a different image in each frame. For them, surfaces are painted from far to near, each by a
homography of its texture into the window where it is visible. Distant parts use coarser textures (Williams, "Pyramidal
parametrics", 1983). Edges of surfaces and limits between levels of a texture are half planes of the image: a pixel
shows a surface if its ray is inside the cone of the eye and the surface.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from psotrack.simulation.imaging import raster
from psotrack.simulation.scenarios import Imaging
from psotrack.simulation.world.rooms import Point, Room, Surface

#: Samples per pixel along each side, for anti-aliasing.
_MAGNIFICATION = 2


@dataclass(frozen=True)
class Backdrop:
    """The empty room in one camera's image.

    Attributes:
        light: (height, width, 3), linear BGR light.
        depth_m: (height, width), depth along the optical axis at pixel centres.
        floor: (height, width), True at the pixels that show the floor.
    """

    light: Float[np.ndarray, "height width 3"]
    depth_m: Float[np.ndarray, "height width"]
    floor: Bool[np.ndarray, "height width"]


def render(room: Room, cam: raster.Pinhole, imaging: Imaging) -> Backdrop:
    """Draw the empty room for one camera."""
    number, depth = numbers_and_depth(room.surfaces, raster.full_view(cam))
    light = lens_blur(render_light(room.surfaces, cam, imaging.antialiasing), imaging.lens_blur_px)
    return Backdrop(light, depth, np.equal(number, 0))


def render_light(
    surfaces: Sequence[Surface], cam: raster.Pinhole, antialiasing: bool
) -> Float[np.ndarray, "height width 3"]:
    """(height, width, 3), linear BGR light of textured surfaces, without the lens's blur."""
    view = raster.full_view(cam, _MAGNIFICATION if antialiasing else 1)
    number, _ = numbers_and_depth(surfaces, view)
    light = np.zeros((*view.shape, 3), np.float32)
    for index, surface in enumerate(surfaces):
        seen = np.equal(number, index).astype(np.uint8)
        x, y, width, height = cv2.boundingRect(seen)
        if not width:
            continue
        H = raster.from_corner(x, y) @ view.K @ texel_to_camera(surface, cam)
        window = cv2.warpPerspective(
            surface.texture, H, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        cv2.copyTo(window, seen[y : y + height, x : x + width], light[y : y + height, x : x + width])
    return cv2.resize(light, (cam.width, cam.height), interpolation=cv2.INTER_AREA)


def numbers_and_depth(
    surfaces: Sequence[Surface], view: raster.RasterView
) -> tuple[Int[np.ndarray, "rows columns"], raster.Depth]:
    """Index of the visible surface at each pixel, -1 without a surface, and its depth along the optical axis."""
    corners = np.stack([surface.corners_m for surface in surfaces])
    triangles = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    colours = np.repeat(np.arange(1.0, len(corners) + 1), 2)[:, None, None]
    buffer, depth = raster.empty_buffers(view)
    raster.draw(view, triangles, np.repeat(colours, 3, axis=-1), buffer, depth)
    return buffer[..., 0].round().astype(np.int32) - 1, depth


def lens_blur(light: Float[np.ndarray, "*shape"], sigma_px: float) -> Float[np.ndarray, "*shape"]:
    """Light after a Gaussian blur of the lens; unchanged if `sigma_px` is 0."""
    return cv2.GaussianBlur(light, (0, 0), sigma_px) if sigma_px > 0 else light


def texel_to_camera(surface: Surface, cam: raster.Pinhole) -> raster.Matrix:
    """(3, 3), matrix from a texel (column, row, 1) to the camera coordinates of the texel's point on the surface."""
    rows, columns = surface.texture.shape[:2]
    edges = [cam.R @ edge for edge in (surface.along_m, surface.down_m)]
    plane = np.column_stack([*edges, cam.R @ surface.corner_m + cam.t_m])
    return plane @ np.array([[1 / columns, 0, 0.5 / columns], [0, 1 / rows, 0.5 / rows], [0, 0, 1]])


#: Largest distance of a point on a plane from the plane.
_ON_PLANE_M = 1e-6


@dataclass(frozen=True)
class _Tree:
    """Surfaces in an order from far to near for every viewpoint: a plane, and the surfaces in it and on both sides.

    Each surface is wholly on one side, because the planes are those of surfaces that cut no other surface, as there are
    between walls and boxes.

    Attributes:
        normal: (3,), normal of the plane; its points x satisfy normal @ x = offset_m.
        offset_m: offset of the plane.
        inside: indices of the surfaces in the plane.
        before: surfaces on the side of the normal; None for none.
        behind: surfaces on the other side; None for none.
    """

    normal: Point
    offset_m: float
    inside: list[int]
    before: _Tree | None
    behind: _Tree | None

    @classmethod
    def of(
        cls,
        corners_m: Float[np.ndarray, "surfaces 4 3"],
        normals: Float[np.ndarray, "surfaces 3"],
        chosen: Int[np.ndarray, "chosen"],
    ) -> _Tree | None:
        """The tree of some surfaces; of the planes that cut the fewest, it takes the one with the most equal halves."""
        if not len(chosen):
            return None
        offset_m = (corners_m[chosen, 0] * normals[chosen]).sum(axis=-1)
        height_m = np.einsum("pi,sci->psc", normals[chosen], corners_m[chosen]) - offset_m[:, None, None]
        above, below = (height_m > _ON_PLANE_M).any(axis=-1), (height_m < -_ON_PLANE_M).any(axis=-1)
        uneven = np.abs(above.sum(axis=1) - below.sum(axis=1))
        best = int(np.lexsort((uneven, (above & below).sum(axis=1)))[0])
        above, below = above[best], below[best]
        sides = (cls.of(corners_m, normals, chosen[side]) for side in (above, below & ~above))
        inside = chosen[~(above | below)].tolist()
        return cls(normals[chosen[best]], float(offset_m[best]), inside, *sides)

    def far_to_near(self, eye_m: Point) -> Iterator[int]:
        """Yield all surfaces in an order in which none is hidden by an earlier one, seen from a point."""
        sides = [self.behind, self.before]
        far, near = sides if self.normal @ eye_m > self.offset_m else sides[::-1]
        yield from far.far_to_near(eye_m) if far else ()
        yield from self.inside
        yield from near.far_to_near(eye_m) if near else ()


#: Integer value of light 1. Lamps have light 3, which still fits into 16 bits.
LIGHT_UNIT = 16384

_Corners = Float[np.ndarray, "corners 3"]
#: BGR light, and the floor's share of the light. OpenCV transforms four channels faster than three.
Light = UInt16[np.ndarray, "rows columns 4"]
#: A texture at one resolution, and the matrix from its texels to the texels at full resolution.
Level = tuple[Light, raster.Matrix]

#: Smallest side of a texture's coarsest level, texels.
_SMALLEST_PX = 8
#: Largest size of a texel in the image. Texels may be smaller than a pixel, because a frame has several samples per
#: pixel.
_TEXEL_PX = 0.6
#: Largest number of texels within `_TEXEL_PX` in the direction of foreshortening. If more texels fall there, a
#: coarser level is used, although it blurs the other direction.
_FORESHORTENED = 2.0
#: Pixels by which surfaces are widened, so that no ray passes between two surfaces with a common edge.
_OVERLAP_PX = 1e-6


#: A convex part of an image: the first row, and (part,) the first and the last column of each row from there on.
_Spans = tuple[int, Int[np.ndarray, "part"], Int[np.ndarray, "part"]]


class RoomPainter:
    """Paints the empty room into any view of any camera."""

    def __init__(self, surfaces: tuple[Surface, ...]) -> None:
        self.surfaces = surfaces
        self._normals = np.array([surface.normal for surface in surfaces])
        self._corners_m = np.array([surface.corners_m for surface in surfaces])
        # The first surface of a room is its floor.
        self._levels = [_levels(surface, is_floor=not index) for index, surface in enumerate(surfaces)]
        self._texel_m = [_texel_m(surface) for surface in surfaces]
        self._buffer = np.empty(0, np.uint16)
        tree = _Tree.of(self._corners_m, self._normals, np.arange(len(surfaces)))
        assert tree is not None, "a room has surfaces"
        self._tree = tree

    def paint(self, view: raster.RasterView, image: Light) -> None:
        """Paint the room in a view, one sample per pixel.

        Args:
            view: view of magnification 1.
            image: (rows, columns, 4), overwritten: BGR light, and 1 at pixels of the floor, in units of `LIGHT_UNIT`.
        """
        cam = view.cam
        corners = self._corners_m @ cam.R.T + cam.t_m
        height_m = self._heights_m(view)
        image[...] = 0
        seen = (height_m > 0) & may_be_seen(corners, view.K, view.shape)
        for index in self._tree.far_to_near(-cam.R.T @ cam.t_m):
            if seen[index]:
                normal = cam.R @ self._normals[index]
                self._paint_surface(image, view, index, corners[index], normal / height_m[index])

    def _heights_m(self, view: raster.RasterView) -> Float[np.ndarray, "surfaces"]:
        """(surfaces,), height of the eye over the plane of each surface."""
        eye_m = -view.cam.R.T @ view.cam.t_m
        return ((eye_m - self._corners_m[:, 0]) * self._normals).sum(axis=-1)

    def hiding_depth_m(
        self, view: raster.RasterView, faces_m: Float[np.ndarray, "faces 3 3"]
    ) -> raster.Depth:
        """(rows, columns), depth of the surfaces that may hide the given faces; `FAR_M` at pixels without a surface."""
        points = faces_m.reshape(-1, 3)
        lower, upper = points.min(axis=0), points.max(axis=0)
        # For each plane, the corner of the faces' bounding box that is farthest behind the plane.
        farthest = np.where(self._normals > 0, lower, upper)
        beyond = ((farthest - self._corners_m[:, 0]) * self._normals).sum(axis=-1) < 0
        hiding = [self.surfaces[index] for index in np.flatnonzero(beyond & (self._heights_m(view) > 0))]
        return numbers_and_depth(hiding, view)[1] if hiding else raster.empty_buffers(view)[1]

    def _paint_surface(
        self, image: Light, view: raster.RasterView, index: int, corners: _Corners, normal_per_height: Point
    ) -> None:
        K = view.K
        to_rays = np.linalg.inv(K)
        edges = np.cross(corners, np.roll(corners, -1, axis=0)) @ to_rays
        # Along a ray (x, y, 1) to the plane, 1 / depth is linear in x and y.
        nearness = -normal_per_height @ to_rays
        height_m = 1 / float(np.linalg.norm(normal_per_height))
        to_image = K @ texel_to_camera(self.surfaces[index], view.cam)
        for level, nearest, farthest in self._by_level(index, corners[:, 2], height_m, K[0, 0]):
            limits = [nearness - [0, 0, 1 / farthest]] if np.isfinite(farthest) else []
            limits += [[0, 0, 1 / nearest] - nearness] if nearest > 0 else []
            spans = _spans(np.vstack([edges, *limits]), view.shape)
            if spans is not None:
                texture, to_full_size = level
                self._fill(image, spans, texture, to_image @ to_full_size)

    def _by_level(
        self, surface: int, depth_m: Float[np.ndarray, "corners"], height_m: float, focal_px: float
    ) -> Iterator[tuple[Level, float, float]]:
        """Yield the levels of a texture that a surface needs, each with its smallest and largest depth."""
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
        self, image: Light, spans: _Spans, level: UInt16[np.ndarray, "texels_y texels_x 4"], H: raster.Matrix
    ) -> None:
        """Paint a level of a texture into spans; H maps texels to pixels."""
        y, left, right = spans
        x1, x2 = int(left.min()), int(right.max()) + 1
        window = image[y : y + len(left), x1:x2]
        if self._buffer.size < window.size:
            self._buffer = np.empty(window.size, np.uint16)
        # The buffer is reused, because allocating memory for each surface takes as long as painting it.
        painted = self._buffer[: window.size].reshape(window.shape)
        H = raster.from_corner(x1, y) @ H
        cv2.warpPerspective(level, H, window.shape[1::-1], dst=painted, flags=cv2.INTER_LINEAR)
        column = np.arange(x1, x2, dtype=np.int16)
        seen = (column >= left[:, None]) & (column <= right[:, None])
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
    corners: Float[np.ndarray, "surfaces corners 3"], K: raster.Matrix, shape: tuple[int, int]
) -> Bool[np.ndarray, "surfaces"]:
    """(surfaces,), False if all corners of a surface are beyond one side of the image or behind the camera."""
    *places, depth = np.moveaxis(corners @ K.T, -1, 0)
    beyond = [depth <= 0]
    for place, side in zip(places, shape[::-1], strict=True):
        beyond += [place < -0.5 * depth, place > (side - 0.5) * depth]
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
    return int(found[0]), left[part].astype(np.int16), right[part].astype(np.int16)
