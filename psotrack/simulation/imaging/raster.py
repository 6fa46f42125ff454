"""Drones in windows of a camera's image, drawn by OpenCV's rasteriser of triangles with a depth buffer.

`cv2.triangleRasterize` uses OpenGL's camera (y up, looking along -z) with a symmetric field of view, and samples a
pixel at its corner plus a half in both directions. A `RasterView` is any window of a camera's image at any
magnification: the window's offset and the principal point become a shear of the camera coordinates, in float64, before
the call of OpenCV.

A drone is drawn in several passes with different sample positions in the pixel and different times in the exposure,
which gives anti-aliasing and motion blur together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from psotrack.geometry import Camera
from psotrack.simulation.scenarios import Imaging
from psotrack.simulation.scene import Scene
from psotrack.simulation.world.drones import disc_fans

Depth = Float[np.ndarray, "rows columns"]
_Faces = Float[np.ndarray, "faces 3 3"]
Matrix = Float[np.ndarray, "3 3"]
Samples = Float[np.ndarray, "passes 3"]
_Seen = Float[np.ndarray, "rows columns 4"]
_Colour = Float[np.ndarray, "rows columns 3"]
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

    R: Matrix
    t_m: Float[np.ndarray, "3"]
    K: Matrix
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
        both = self.union(other)
        return both.width < self.width + other.width and both.height < self.height + other.height

    def union(self, other: RasterView) -> RasterView:
        """Smallest window that contains two windows."""
        x, y = min(self.x, other.x), min(self.y, other.y)
        right = max(self.x + self.width, other.x + other.width)
        bottom = max(self.y + self.height, other.y + other.height)
        return replace(self, x=x, y=y, width=right - x, height=bottom - y)

    @property
    def K(self) -> Matrix:
        """(3, 3), matrix from camera coordinates to the buffer's pixels, whose centres have integer coordinates."""
        m = self.magnification
        offset = [m * (0.5 - self.x - self.shift_px[0]) - 0.5, m * (0.5 - self.y - self.shift_px[1]) - 0.5]
        return np.array([[m, 0, offset[0]], [0, m, offset[1]], [0, 0, 1.0]]) @ self.cam.K


def from_corner(x: int, y: int) -> Matrix:
    """(3, 3), matrix from the pixels of an image to those of a part of it with the first column x and row y."""
    return np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1.0]])


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


def empty_buffers(view: RasterView) -> tuple[_Colour, Depth]:
    """Black colour buffer, and depth buffer with the depth `FAR_M`."""
    return np.zeros((*view.shape, 3), np.float32), np.full(view.shape, FAR_M, np.float32)


def draw(
    view: RasterView,
    triangles_world: _Faces,
    colours: Float[np.ndarray, "faces corners 3"],
    colour_buffer: _Colour,
    depth_buffer: Depth,
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
    points: _Faces, colours: _Faces
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


NUM_PASSES = 8
#: Reflectance of unpainted parts.
_DARK_PLASTIC = 0.02
#: Opacity of a rotor disc, which shows blurred blades, at the hub and at the tip, and its reflectance.
_DISC_OPACITY = (0.55, 0.30)
_DISC_REFLECTANCE = 0.06

#: Factors that mirror a point in the floor.
MIRRORED = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True)
class PosedDrone:
    """One drone during one exposure.

    Attributes:
        faces_m: (times, faces, 3, 3), corners of the faces, world.
        light: (faces, 1, 3), linear BGR light of the faces in the middle of the exposure.
        discs_m: (times, slices, 3, 3), rotor discs as fans of triangles with the hub as first corner, world.
        disc_opacity_light: (slices, 3, 3), opacity and light of the discs' corners in the first two channels.
    """

    faces_m: Float[np.ndarray, "times faces 3 3"]
    light: Float[np.ndarray, "faces 1 3"]
    discs_m: Float[np.ndarray, "times slices 3 3"]
    disc_opacity_light: Float[np.ndarray, "slices 3 3"]

    def mirrored(self, times: list[int]) -> PosedDrone:
        """Mirror image of the drone in the floor at the times with the given indices; the faces keep their light."""
        return replace(self, faces_m=self.faces_m[times] * MIRRORED, discs_m=self.discs_m[times] * MIRRORED)


def pass_samples(imaging: Imaging) -> Samples:
    """(passes, 3), position in the pixel (x, y) and time in the exposure (-1/2 to 1/2) of each pass's samples.

    The samples are Hammersley points of bases 2 and 3, shifted so that their mean is the pixel's centre and the middle
    of the exposure. Without anti-aliasing, all positions are the pixel's centre; without motion blur too, there is only
    one pass.
    """
    passes = NUM_PASSES if imaging.antialiasing or imaging.shutter_s else 1
    # Imported here, because the import is slow.
    from scipy.stats import qmc

    during = (np.arange(passes)[:, None] + 0.5) / passes
    points = np.hstack([qmc.Halton(2, scramble=False).random(passes), during])
    return (points - points.mean(axis=0)) * [imaging.antialiasing, imaging.antialiasing, 1.0]


def pose(scene: Scene, drone: int, time_s: Float[np.ndarray, "times"]) -> PosedDrone:
    """Pose a drone of a scene at given times of one exposure."""
    flight, shape = scene.flights[drone], scene.models[drone]
    rotation, position = flight.rotation(time_s), flight.position_m(time_s)
    middle = len(time_s) // 2
    normals = shape.normals @ rotation[middle].T
    panels = scene.room.panels
    paint = np.array(scene.scenario.drones[drone].paint_bgr)
    reflectance = _DARK_PLASTIC + shape.paint[:, None] * (paint - _DARK_PLASTIC)
    light = reflectance * panels.on_faces(position[middle], normals)[:, None]
    discs = disc_fans(shape)
    shade = _DISC_REFLECTANCE * panels.on_faces(position[middle], rotation[middle, :, 2][None])[0]
    hub, tip = _DISC_OPACITY
    corner_values = np.array([(hub, shade, 0.0), (tip, shade, 0.0), (tip, shade, 0.0)])
    return PosedDrone(
        faces_m=_to_world(shape.triangles_m, rotation, position),
        light=light[:, None],
        discs_m=_to_world(discs, rotation, position),
        disc_opacity_light=np.broadcast_to(corner_values, discs.shape),
    )


def _to_world(
    triangles_m: _Faces, rotation: Float[np.ndarray, "times 3 3"], position_m: Float[np.ndarray, "times 3"]
) -> Float[np.ndarray, "times faces 3 3"]:
    """(times, faces, 3, 3), triangles transformed from the body frame to the world."""
    corners = triangles_m.reshape(-1, 3) @ rotation.swapaxes(-1, -2) + position_m[:, None]
    return corners.reshape(len(rotation), *triangles_m.shape)


def margin_px(blur_px: float) -> int:
    """Margin of a window around a drone, pixels, for motion and for a blur of the given standard deviation."""
    return 2 + int(np.ceil(4 * blur_px))


def windows(
    whole: RasterView, posed: list[PosedDrone], margin_px: int
) -> list[tuple[RasterView, list[PosedDrone]]]:
    """Parts of a window that contain drones, each with its drones; overlapping parts are merged."""
    found: list[tuple[RasterView, list[PosedDrone]]] = []
    for drone in posed:
        # With constant velocity, the positions at the ends of the exposure enclose all others.
        ends = [points[[0, -1]].reshape(-1, 3) for points in (drone.faces_m, drone.discs_m)]
        window, drones = enclosing_window(whole, np.concatenate(ends), margin_px), [drone]
        if window is None:
            continue
        while (
            index := next((i for i, (other, _) in enumerate(found) if window.overlaps(other)), None)
        ) is not None:
            other, others = found.pop(index)
            window, drones = window.union(other), others + drones
        found.append((window, drones))
    return found


def average(window: RasterView, posed: list[PosedDrone], samples: Samples, behind_m: Depth) -> _Seen:
    """(rows, columns, 4), light of drones and visible share of the background, averaged over all passes.

    Args:
        window: part of an image.
        posed: drones, posed at the times of the samples.
        samples: (passes, 3), samples from `pass_samples`.
        behind_m: (rows, columns), depth of the background, which may hide drones.
    """
    total = np.zeros((*window.shape, 4), np.float32)
    for index, (x, y, _) in enumerate(samples):
        total += sample(replace(window, shift_px=(float(x), float(y))), posed, index, behind_m)
    return total / len(samples)


def sample(view: RasterView, posed: list[PosedDrone], index: int, behind_m: Depth) -> _Seen:
    """(rows, columns, 4), light of drones and visible share of the background at one time of the exposure."""
    light, depth = np.full((*view.shape, 3), -1.0, np.float32), behind_m.copy()
    for drone in posed:
        draw(view, drone.faces_m[index], drone.light, light, depth)
    # Pixels without drones are found by colour, because OpenCV also rounds depths at pixels where it draws nothing.
    clear = np.less(light[..., 0], 0).astype(np.float32)
    light += clear[..., None]
    seen = cv2.merge([light, clear])
    # Discs are transparent, so they are drawn from the farthest to the nearest over what is behind them.
    ahead = view.cam.R[2]
    with_discs = [drone for drone in posed if drone.discs_m.size]
    for drone in sorted(with_discs, key=lambda drone: -float(ahead @ drone.discs_m[index, 0, 0])):
        alone = len(posed) == 1
        inner = view if alone else enclosing_window(view, drone.discs_m[index].reshape(-1, 3), 1)
        if inner is None:
            continue
        part = inner.slices_in(view)
        disc, _ = empty_buffers(inner)
        draw(inner, drone.discs_m[index], drone.disc_opacity_light, disc, depth[part].copy())
        seen[part] *= (1 - disc[..., 0])[..., None]
        seen[part][..., :3] += (disc[..., 0] * disc[..., 1])[..., None]
    return seen
