"""Images of distorting lenses and of rolling shutters, put together from images of cameras without either.

Each pixel of a lens looks along one ray. Lenses of a moderate angle are cut from one wide image without distortion;
lenses of a wide angle from several images, the faces of a cube around the optical axis. A pixel where the lens shows
nothing is black.

A rolling shutter exposes each row at its own time, so strips of the image are drawn one by one, each with the pose of
the camera when its middle row is exposed. The strips of different samples of a pixel begin at different rows, so that
the mean time of the samples of every row is the time of the row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy.spatial.transform import Rotation

from psotrack.geometry import Camera, has_image, to_pixels, undistort
from psotrack.simulation.imaging.raster import Matrix, Pinhole, RasterView, full_view

#: Largest distance from the optical axis along x or y, as a tangent, in lenses that are cut from one image: 60 degrees.
_ONE_FACE = 1.75
#: Margin of a face around the pixels that the lens uses, pixels; blurs of the lens reach beyond these pixels.
_MARGIN_PX = 16
#: Largest side of a face, pixels.
_MAX_SIDE_PX = 6000
#: Share of the pixels of a lens for which a face has at least the same resolution.
_SHARP_SHARE = 95
#: Turns of the camera, Rodrigues vectors in its own axes, to the faces: ahead, and to the four sides.
_TURNS = np.pi / 2 * np.array([[0, 0, 0], [0, -1, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0]])


@dataclass(frozen=True)
class LensImage:
    """The image of a lens as pixels of cameras without distortion.

    Attributes:
        faces: cameras without distortion, at the place of the lens.
        face: (height, width), index of the camera that shows what a pixel of the lens sees; -1 where it sees nothing.
        at_px: (height, width, 2), column and row in the image of this camera.
        used: for each camera (height, width), True at the pixels that are in the image of the lens.
        shows_px: for each camera (height, width, 2), column and row of the lens's image that a pixel shows.
    """

    faces: tuple[Pinhole, ...]
    face: Int[np.ndarray, "height width"]
    at_px: Float[np.ndarray, "height width 2"]
    used: tuple[Bool[np.ndarray, "_ _"], ...]
    shows_px: tuple[Float[np.ndarray, "_ _ 2"], ...]

    def assemble(
        self, images: Sequence[Shaped[np.ndarray, "..."]], interpolation: int = cv2.INTER_CUBIC
    ) -> Shaped[np.ndarray, "..."]:
        """The image of the lens from the images of the faces."""
        whole = np.zeros((*self.face.shape, *images[0].shape[2:]), images[0].dtype)
        # Two maps, because OpenCV reads a single map of both coordinates wrongly without interpolation.
        x, y = np.ascontiguousarray(np.moveaxis(self.at_px, -1, 0))
        for index, image in enumerate(images):
            seen = self.face == index
            shown = cv2.remap(image, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)
            whole[seen] = shown[seen]
        return whole


def lens_image(camera: Camera) -> LensImage:
    """Divide the image of one camera with distortion among cameras without distortion."""
    width, height = (int(side) for side in camera.image_size_wh)
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    normalised = undistort(camera, pixels)
    rays = np.concatenate([normalised, np.ones((height, width, 1))], axis=-1)
    is_shown = np.isfinite(normalised).all(axis=-1)
    turns = Rotation.from_rotvec(_TURNS).as_matrix()
    if np.abs(normalised[is_shown]).max(initial=0.0) <= _ONE_FACE:
        turns = turns[:1]
    nearest = np.where(is_shown, _nearest_face(rays, turns), -1)
    faces: list[Pinhole] = []
    used: list[Bool[np.ndarray, "_ _"]] = []
    shows_px: list[Float[np.ndarray, "_ _ 2"]] = []
    face, at_px = np.full((height, width), -1), np.zeros((height, width, 2), np.float32)
    for index, turn in enumerate(turns):
        seen = nearest == index
        if not seen.any():
            continue
        along = np.where(seen[..., None], rays @ turn.T, np.nan)
        cam, K_inverse = _face(camera, turn, along[..., :2] / along[..., 2:])
        face[seen] = len(faces)
        at_px[seen] = (along[seen] / along[seen][:, 2:]) @ cam.K[:2].T
        faces.append(cam)
        own = np.stack(np.meshgrid(np.arange(cam.width), np.arange(cam.height), [1.0]), axis=-1)[:, :, 0]
        back = own @ K_inverse.T @ turn
        back_px = to_pixels(camera, back)
        inside = (back_px >= -0.5) & (back_px <= camera.image_size_wh - 0.5)
        shows_px.append(np.nan_to_num(back_px, nan=-1e6).astype(np.float32))
        used.append(has_image(camera, back) & inside.all(axis=-1) & (_nearest_face(back, turns) == index))
    return LensImage(tuple(faces), face, at_px, tuple(used), tuple(shows_px))


def _nearest_face(
    rays: Float[np.ndarray, "rows columns 3"], turns: Float[np.ndarray, "faces 3 3"]
) -> Int[np.ndarray, "rows columns"]:
    """Index of the face whose axis has the smallest angle to each ray; the axis of a turn is its last row."""
    return np.nan_to_num(rays @ turns[:, 2].T).argmax(axis=-1)


def _face(
    camera: Camera, turn: Matrix, normalised: Float[np.ndarray, "rows columns 2"]
) -> tuple[Pinhole, Matrix]:
    """A camera without distortion that shows given normalised coordinates, NaN at other pixels, and inverse K."""
    (x_down, x_along), (y_down, y_along) = (np.gradient(normalised[..., axis]) for axis in range(2))
    area = np.abs(x_along * y_down - x_down * y_along)
    seen = np.isfinite(normalised).all(axis=-1)
    extent = np.ptp(normalised[seen], axis=0).max()
    known = area[np.isfinite(area) & (area > 0)]
    focal_px = 1 / np.sqrt(np.percentile(known, 100 - _SHARP_SHARE)) if known.size else float(camera.K[0, 0])
    focal_px = min(focal_px, (_MAX_SIDE_PX - 2 * _MARGIN_PX) / max(extent, 1e-9))
    low, high = (
        np.floor(focal_px * normalised[seen].min(axis=0)) - _MARGIN_PX,
        np.ceil(focal_px * normalised[seen].max(axis=0)) + _MARGIN_PX,
    )
    K = np.array([[focal_px, 0.0, -low[0]], [0.0, focal_px, -low[1]], [0.0, 0.0, 1.0]])
    width, height = (int(side) + 1 for side in high - low)
    T = np.asarray(camera.T_cam_world)
    return Pinhole(turn @ T[:3, :3], turn @ T[:3, 3], K, width, height), np.linalg.inv(K)


#: Largest motion of the image, pixels, between the first and the last row of a strip, and smallest number of rows.
_STRIP_PX, _MIN_ROWS = 0.5, 4
#: Pixels around the part of a face that a strip shows, which the interpolation needs.
_STRIP_MARGIN_PX = 3


@dataclass(frozen=True)
class Strip:
    """Neighbouring rows of an image.

    Attributes:
        first, end: first row, and the row after the last row.
        middle: row whose time of exposure is that of the strip; outside of the image for an incomplete strip.
    """

    first: int
    end: int
    middle: float

    @property
    def rows(self) -> slice:
        """The rows of the image."""
        return slice(self.first, self.end)


def strips(height: int, motion_px: float, sample: int, num_samples: int) -> Iterator[Strip]:
    """Divide the rows of an image into strips.

    Args:
        height: number of rows.
        motion_px: motion of the image between the exposures of two neighbouring rows, pixels; 0 gives a single strip.
        sample: number of the sample of a pixel.
        num_samples: number of samples of a pixel.
    """
    if motion_px * height <= _STRIP_PX:
        yield Strip(0, height, (height - 1) / 2)
        return
    rows = max(int(_STRIP_PX / motion_px), _MIN_ROWS)
    start = -((rows * (2 * sample + 1)) // (2 * num_samples))
    for first in range(start, height, rows):
        if first + rows > 0:
            yield Strip(max(first, 0), min(first + rows, height), first + (rows - 1) / 2)


def show_strip(
    lens: LensImage | None,
    strip: Strip,
    cam: Pinhole,
    draw: Callable[[RasterView], Shaped[np.ndarray, "..."]],
) -> Shaped[np.ndarray, "..."]:
    """The strip as a camera at the pose of `cam` sees it; `draw` gives the image of a view."""
    if lens is None:
        return draw(replace(full_view(cam), y=strip.first, height=strip.end - strip.first))
    face, at_px = lens.face[strip.rows], lens.at_px[strip.rows]
    images = []
    for index, one in enumerate(lens.faces):
        seen = face == index
        if not seen.any():
            continue
        x, y = np.maximum(np.floor(at_px[seen].min(axis=0)).astype(int) - _STRIP_MARGIN_PX, 0).tolist()
        right, bottom = (np.ceil(at_px[seen].max(axis=0)).astype(int) + _STRIP_MARGIN_PX + 1).tolist()
        whole = full_view(Pinhole(one.R @ cam.R, one.R @ cam.t_m, one.K, one.width, one.height))
        view = replace(whole, x=x, y=y, width=min(right, one.width) - x, height=min(bottom, one.height) - y)
        columns, rows = (np.ascontiguousarray(at_px[..., axis]) for axis in (0, 1))
        columns, rows = columns - np.float32(x), rows - np.float32(y)
        image = cv2.remap(draw(view), columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        images.append(np.where(seen.reshape(seen.shape + (1,) * (image.ndim - 2)), image, 0))
    return sum(images[1:], images[0])
