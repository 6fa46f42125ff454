"""Rasterisation of triangles: OpenCV's rasteriser with depth buffer, in the package's camera convention.

`cv2.triangleRasterize` uses OpenGL's camera (y up, looking along -z) with a symmetric field of view, and samples a
pixel at its corner plus a half in both directions. A `RasterView` is any window of a camera's image at any
magnification: the window's offset and the principal point become a shear of the camera coordinates, in float64, before
the call of OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from psotrack.geometry import Camera

#: Smallest and largest depth that is drawn.
NEAR_M = 0.1
FAR_M = 100.0


@dataclass(frozen=True)
class Pinhole:
    """A camera without lens distortion, in plain NumPy.

    Attributes:
        R: (3, 3), rotation, world to camera.
        t_m: (3,), translation, world to camera.
        K: (3, 3), intrinsics, pixels; pixel centres have integer coordinates.
        width: width of the image, pixels.
        height: height of the image, pixels.
    """

    R: Float[np.ndarray, "3 3"]
    t_m: Float[np.ndarray, "3"]
    K: Float[np.ndarray, "3 3"]
    width: int
    height: int


def pinhole(cam: Camera) -> Pinhole:
    """Convert one camera of a rig; its distortion is ignored."""
    T, (width, height) = np.asarray(cam.T_cam_world), np.asarray(cam.image_size_wh)
    return Pinhole(T[:3, :3], T[:3, 3], np.asarray(cam.K), int(width), int(height))


@dataclass(frozen=True)
class RasterView:
    """A window of a camera's image.

    Attributes:
        cam: the camera.
        x: first column of the window.
        y: first row of the window.
        width: width of the window, the camera's pixels.
        height: height of the window, the camera's pixels.
        magnification: samples per pixel along each side.
        shift_px: (x, y), offset of the samples from the pixel centres, for anti-aliasing by several passes.
    """

    cam: Pinhole
    x: int
    y: int
    width: int
    height: int
    magnification: int = 1
    shift_px: tuple[float, float] = (0.0, 0.0)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the buffers."""
        return self.height * self.magnification, self.width * self.magnification

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns of the window in the camera's image."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)

    def slices_in(self, outer: RasterView) -> tuple[slice, slice]:
        """Rows and columns of the window in the buffers of a window that contains it, both of magnification 1."""
        x, y = self.x - outer.x, self.y - outer.y
        return slice(y, y + self.height), slice(x, x + self.width)

    def overlaps(self, other: RasterView) -> bool:
        """Whether two windows share pixels."""
        return (
            self.x < other.x + other.width
            and other.x < self.x + self.width
            and self.y < other.y + other.height
            and other.y < self.y + self.height
        )

    def union(self, other: RasterView) -> RasterView:
        """Smallest window that contains two windows."""
        x, y = min(self.x, other.x), min(self.y, other.y)
        right = max(self.x + self.width, other.x + other.width)
        bottom = max(self.y + self.height, other.y + other.height)
        return replace(self, x=x, y=y, width=right - x, height=bottom - y)

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """(3, 3), matrix from camera coordinates to the buffer's pixels, whose centres have integer coordinates."""
        m = self.magnification
        offset = [m * (0.5 - self.x - self.shift_px[0]) - 0.5, m * (0.5 - self.y - self.shift_px[1]) - 0.5]
        return np.array([[m, 0, offset[0]], [0, m, offset[1]], [0, 0, 1.0]]) @ self.cam.K


def full_view(cam: Pinhole, magnification: int = 1) -> RasterView:
    """Window that is the whole image of a camera."""
    return RasterView(cam, 0, 0, cam.width, cam.height, magnification)


def enclosing_window(
    view: RasterView, points_world: Float[np.ndarray, "points 3"], margin_px: int
) -> RasterView | None:
    """Part of a window that contains the images of points, with a margin; None if this part is empty.

    If some points are in front of the camera and others behind it, the result is the whole window.
    """
    points = points_world @ view.cam.R.T + view.cam.t_m
    if points[:, 2].max() < NEAR_M:
        return None
    if points[:, 2].min() < NEAR_M:
        return view
    pixels = (points @ view.cam.K[:2].T) / points[:, 2:]
    x1, y1 = (pixels.min(axis=0).round() - margin_px).astype(int)
    x2, y2 = (pixels.max(axis=0).round() + margin_px + 1).astype(int)
    x1, x2 = np.clip([x1, x2], view.x, view.x + view.width).tolist()
    y1, y2 = np.clip([y1, y2], view.y, view.y + view.height).tolist()
    return replace(view, x=x1, y=y1, width=x2 - x1, height=y2 - y1) if x2 > x1 and y2 > y1 else None


_FLAT, _SMOOTH = (
    cv2.TriangleRasterizeSettings().setCullingMode(cv2.RASTERIZE_CULLING_NONE).setShadingType(shading)
    for shading in (cv2.RASTERIZE_SHADING_FLAT, cv2.RASTERIZE_SHADING_SHADED)
)


def empty_buffers(
    view: RasterView,
) -> tuple[Float[np.ndarray, "rows columns 3"], Float[np.ndarray, "rows columns"]]:
    """Black colour buffer, and depth buffer with the depth `FAR_M`."""
    return np.zeros((*view.shape, 3), np.float32), np.full(view.shape, FAR_M, np.float32)


def draw(
    view: RasterView,
    triangles_world: Float[np.ndarray, "faces 3 3"],
    colours: Float[np.ndarray, "faces corners 3"],
    colour_buffer: Float[np.ndarray, "rows columns 3"],
    depth_buffer: Float[np.ndarray, "rows columns"],
) -> None:
    """Draw triangles into buffers at the pixels where the triangles are nearer than the buffer's depth.

    Args:
        view: view of the buffers.
        triangles_world: (faces, 3, 3), corners, world, metres; triangles that reach behind `NEAR_M` are cut there.
        colours: (faces, 1, 3), one colour per face, or (faces, 3, 3), one colour per corner.
        colour_buffer: (rows, columns, 3), float32, changed in place.
        depth_buffer: (rows, columns), float32, metres along the optical axis, changed in place.
    """
    corners = triangles_world.reshape(-1, 3) @ view.cam.R.T + view.cam.t_m
    settings = _SMOOTH if colours.shape[1] == 3 else _FLAT
    colours = np.broadcast_to(colours, triangles_world.shape)
    if corners[:, 2].min(initial=FAR_M) < NEAR_M:
        points, colours = _cut_at_near(corners.reshape(triangles_world.shape), colours)
        corners = points.reshape(-1, 3)
    if not len(corners):
        return
    rows, columns = view.shape
    K = view.K
    focal = K[1, 1]
    # OpenCV projects to rows / 2 - focal y / z and samples pixel p at p + 1/2.
    right = np.array([K[0, 0], K[0, 1], K[0, 2] + 0.5 - columns / 2]) / focal
    down = np.array([0.0, 1.0, (K[1, 2] + 0.5 - rows / 2) / focal])
    to_opengl = np.stack([right, -down, [0.0, 0.0, -1.0]])
    vertices = (corners @ to_opengl.T).astype(np.float32)
    indices = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    cv2.triangleRasterize(
        vertices,
        indices,
        colours.reshape(-1, 3).astype(np.float32),
        colour_buffer,
        depth_buffer,
        np.eye(4, dtype=np.float32),
        2 * np.arctan(rows / 2 / focal),
        NEAR_M / 2,
        FAR_M,
        settings,
    )


def _cut_at_near(
    points: Float[np.ndarray, "faces 3 3"], colours: Float[np.ndarray, "faces 3 3"]
) -> tuple[Float[np.ndarray, "kept 3 3"], Float[np.ndarray, "kept 3 3"]]:
    """Cut triangles in camera coordinates at the depth `NEAR_M` (Sutherland and Hodgman, 1974).

    OpenCV clips triangles that reach behind the camera wrongly, and the walls of a room reach behind the camera.
    """
    in_front = points[..., 2] >= NEAR_M
    whole = in_front.all(axis=1)
    corners = np.concatenate([points, colours], axis=-1)
    pieces = [corners[whole]]
    for triangle, visible in zip(corners[~whole], in_front[~whole], strict=True):
        polygon = []
        for i in range(3):
            a, b = triangle[i], triangle[(i + 1) % 3]
            if visible[i]:
                polygon.append(a)
            if visible[i] != visible[(i + 1) % 3]:
                polygon.append(a + (NEAR_M - a[2]) / (b[2] - a[2]) * (b - a))
        pieces += [
            np.stack([polygon[0], polygon[i], polygon[i + 1]])[None] for i in range(1, len(polygon) - 1)
        ]
    kept = np.concatenate(pieces)
    return kept[..., :3], kept[..., 3:]
