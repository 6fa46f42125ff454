"""Pictures of ArUco markers, with their true corners: on flat and bent sheets, and at any four corners."""

from dataclasses import dataclass

import cv2
import numpy as np

from psotrack.foreground.markers import marker_dictionary
from psotrack.geometry import undistort

BLACK, WHITE, GAMMA = 35.0, 215.0, 2.2
#: Samples per pixel along each side.
FINE = 3
#: Error of a sample's place on a sheet, pixels.
CONVERGED_PX = 1e-4
#: Distance of the camera from a sheet, in sides of the marker.
FAR = 5.0


@dataclass(frozen=True)
class Sheet:
    """A marker on a sheet of paper with one white cell around it.

    `turn` is its rotation in the image, `tilt` that about an axis in the image at the angle `axis`, rad. `bow` is the
    height of the bent sheet's middle over its ends, in sides of the marker.
    """

    marker: int
    centre: tuple[float, float]
    side_px: float
    turn: float = 0.0
    tilt: float = 0.0
    axis: float = 0.0
    bow: float = 0.0

    @property
    def R(self):
        about = np.array([np.cos(self.axis), np.sin(self.axis), 0]) * self.tilt
        return cv2.Rodrigues(about)[0] @ cv2.Rodrigues(np.array([0, 0, self.turn]))[0]

    def pixels(self, u, v):
        """Pixels of places on the sheet; the marker is from -0.5 to 0.5 along u and v."""
        points = np.stack([u, v, 4 * self.bow * (0.8 * u + 0.6 * v) ** 2], axis=-1) @ self.R.T
        return np.array(self.centre) + self.side_px * points[..., :2] * (FAR / (FAR + points[..., 2:]))

    @property
    def corners_px(self):
        return self.pixels(np.array([-0.5, 0.5, 0.5, -0.5]), np.array([-0.5, -0.5, 0.5, 0.5]))


def _places(sheet, x, y):
    """Places on the sheet that pixels show: by a homography for a flat sheet, by Newton's method for a bent one."""
    off_x, off_y = x - sheet.centre[0], y - sheet.centre[1]
    if not sheet.bow:
        to_pixels = np.array([[sheet.side_px * FAR], [sheet.side_px * FAR], [1]]) * sheet.R
        to_pixels[:, 2] = 0, 0, FAR
        u, v, scale = (row[0] * off_x + row[1] * off_y + row[2] for row in np.linalg.inv(to_pixels))
        return u / scale, v / scale
    cos, sin = np.cos(sheet.turn) / sheet.side_px, np.sin(sheet.turn) / sheet.side_px
    u, v = off_x * cos + off_y * sin, off_y * cos - off_x * sin
    small = 1e-4
    for _ in range(5):
        at = sheet.pixels(u, v)
        # Far beyond the sheet a steep one has no place for a pixel, and none is needed.
        near = np.maximum(np.abs(u), np.abs(v)) < 1
        left_x, left_y = x - at[..., 0], y - at[..., 1]
        if np.hypot(left_x, left_y)[near].max(initial=0.0) < CONVERGED_PX:
            break
        by_u, by_v = (sheet.pixels(u + small, v) - at) / small, (sheet.pixels(u, v + small) - at) / small
        area = by_u[..., 0] * by_v[..., 1] - by_u[..., 1] * by_v[..., 0]
        u = np.clip(u + (left_x * by_v[..., 1] - left_y * by_v[..., 0]) / area, -2, 2)
        v = np.clip(v + (left_y * by_u[..., 0] - left_x * by_u[..., 1]) / area, -2, 2)
    return u, v


def picture(  # noqa: PLR0913
    sheets,
    size_wh=(480, 360),
    dictionary="4x4_50",
    *,
    inverted=False,
    blur_px=0.7,
    noise=2.0,
    shaded=False,
    seed=0,
):
    """Grey picture of sheets before a wall with a texture and dark and light boards."""
    rng, (width, height) = np.random.default_rng(seed), size_wh
    coarse = rng.normal(0, 1, (height // 12 + 2, width // 12 + 2)).astype(np.float32)
    image = 140 + 15 * cv2.resize(coarse, size_wh, interpolation=cv2.INTER_CUBIC).astype(float)
    for _ in range(12):
        x, y = rng.uniform((0, 0), size_wh).astype(int)
        board_wh = rng.integers(width // 30, width // 6, 2)
        image[y : y + board_wh[1], x : x + board_wh[0]] = rng.uniform(20, 230)
    model = marker_dictionary(dictionary)
    cells = model.markerSize + 2
    for sheet in sheets:
        reach = 1.1 * sheet.side_px
        low = np.maximum(np.floor(np.array(sheet.centre) - reach), 0).astype(int)
        high = np.minimum(np.ceil(np.array(sheet.centre) + reach), size_wh).astype(int)
        axes = [(np.arange(FINE * (b - a)) + 0.5) / FINE - 0.5 + a for a, b in zip(low, high, strict=True)]
        u, v = _places(sheet, *np.meshgrid(*axes))
        white = cv2.aruco.generateImageMarker(model, sheet.marker, cells) > 0
        shown = np.ones((cells + 2, cells + 2), bool)
        shown[1:-1, 1:-1] = white
        row, column = (np.floor((place + 0.5) * cells).astype(int) + 1 for place in (v, u))
        on_sheet = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < cells + 2)
        bright = np.zeros(u.shape, bool)
        bright[on_sheet] = shown[row[on_sheet], column[on_sheet]] ^ inverted
        part = image[low[1] : high[1], low[0] : high[0]]
        fine = np.where(on_sheet, np.where(bright, WHITE, BLACK), part.repeat(FINE, 0).repeat(FINE, 1))
        light = (fine / 255) ** GAMMA
        light = light.reshape(part.shape[0], FINE, part.shape[1], FINE).mean(axis=(1, 3))
        part[:] = 255 * light ** (1 / GAMMA)
    light = (np.clip(image, 0, 255) / 255) ** GAMMA
    light = cv2.GaussianBlur(light, (0, 0), blur_px) if blur_px else light
    if shaded:
        light = light * (0.1 + 0.9 / (1 + np.exp(-12 * (np.arange(width) / width - 0.5))))
    gray = 255 * light ** (1 / GAMMA) + rng.normal(0, noise, light.shape)
    return np.clip(np.round(gray), 0, 255).astype(np.uint8)


def rows_of_sheets(rng, count, size_wh, side_px, *, ids=50, tilt=0.6, bow=0.0):
    """Sheets in a grid over the picture, of random sizes, turns, tilts and bows."""
    cell = 2.3 * side_px[1]
    places = [
        (x, y) for y in np.arange(cell / 2, size_wh[1], cell) for x in np.arange(cell / 2, size_wh[0], cell)
    ]
    places = [(x, y) for x, y in places if x + cell / 2 <= size_wh[0] and y + cell / 2 <= size_wh[1]]
    names = rng.permutation(ids)
    return [
        Sheet(
            int(names[index]),
            (x + rng.uniform(0, 1), y + rng.uniform(0, 1)),
            np.exp(rng.uniform(*np.log(side_px))),
            rng.uniform(0, 2 * np.pi),
            rng.uniform(0, tilt),
            rng.uniform(0, 2 * np.pi),
            bow * rng.uniform(0.5, 1) * rng.choice([-1, 1]),
        )
        for index, (x, y) in enumerate(places[:count])
    ]


#: Grey levels of markers that are drawn at given corners, and of the wall.
DRAWN_BLACK, DRAWN_WHITE, WALL = 40, 200, 140
#: Pixels along a cell of a marker's own image.
CELL_PX = 20


def marker_image(marker, dictionary):
    """Image of a marker with a white zone of one cell, and the corners of the marker's border in it, pixels."""
    model = marker_dictionary(dictionary)
    side_px = (model.markerSize + 2) * CELL_PX
    own = cv2.aruco.generateImageMarker(model, marker, side_px)
    low, high = CELL_PX - 0.5, CELL_PX + side_px - 0.5
    return np.pad(own, CELL_PX, constant_values=255), np.array(
        [[low, low], [high, low], [high, high], [low, high]]
    )


def draw(markers, *, size_wh=(640, 480), dictionary="4x4_1000", lens=None, exponent=2.0, fine=8):
    """Grey picture of a wall with markers at given corners, pairs of id and (4, 2) pixels, one ray for each sample.

    `fine` is the number of samples along each side of a pixel. The light of a pixel is the mean of its samples, and its
    grey level is a root of the light. Corners are undistorted ones where a `lens` is given.
    """
    drawn = np.full(size_wh[::-1], WALL, np.uint8)
    for marker, corners in markers:
        image, own = marker_image(marker, dictionary)
        towards = cv2.getPerspectiveTransform(corners.astype(np.float32), own.astype(np.float32))
        # The block of whole pixels that holds the marker and its white zone.
        margin = np.ptp(corners, axis=0).max() / 4
        low = np.clip(np.floor(corners.min(axis=0) - margin), 0, size_wh).astype(int)
        high = np.clip(np.ceil(corners.max(axis=0) + margin), 0, size_wh).astype(int)
        ends = zip(low, high, strict=True)
        axes = [np.arange(fine * start, fine * end) / fine + 0.5 / fine - 0.5 for start, end in ends]
        grid = np.stack(np.meshgrid(*axes), axis=-1)
        if lens is not None:
            grid = undistort(lens, grid) @ lens.K[:2, :2].T + lens.K[:2, 2]
        # Positions of the samples in the marker's image.
        there = grid @ towards[:, :2].T + towards[:, 2]
        there = np.round(there[..., :2] / there[..., 2:]).astype(int)
        inside = ((there >= 0) & (there < image.shape[0])).all(axis=-1)
        levels = np.where(inside, 0.0, float(WALL))
        shown = image[there[inside][:, 1], there[inside][:, 0]] / 255
        levels[inside] = DRAWN_BLACK + (DRAWN_WHITE - DRAWN_BLACK) * shown
        blocks = high[1] - low[1], fine, high[0] - low[0], fine
        light = (levels**exponent).reshape(blocks).mean(axis=(1, 3))
        part = drawn[low[1] : high[1], low[0] : high[0]]
        touched = inside.reshape(blocks).any(axis=(1, 3))
        part[touched] = np.round(light ** (1 / exponent))[touched]
    return drawn
